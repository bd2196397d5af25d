# SPDX-License-Identifier: Apache-2.0
"""The case study of Siciliano & Book (1986), section 5."""
