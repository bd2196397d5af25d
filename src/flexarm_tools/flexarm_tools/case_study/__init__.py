# SPDX-License-Identifier: Apache-2.0
"""The case study with the three nodes as processes: `flexarm demo`."""
