# SPDX-License-Identifier: Apache-2.0
"""A long life of the three nodes with random motions, parameters and faults; see ``python -m soak --help``."""
