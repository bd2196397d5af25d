# SPDX-License-Identifier: Apache-2.0
"""Checks whether the readings of an arm can be true together; one check per file, which `monitor` runs."""
