# SPDX-License-Identifier: Apache-2.0
"""Case study, reports and command line of flexarm."""
