# SPDX-License-Identifier: Apache-2.0
"""Finds an arm's parameters from how it moved: ``flexarm identify`` (docs/identification.md)."""
