# SPDX-License-Identifier: Apache-2.0
"""The composite law (12), its design, and the checks of the full-order loop."""
