# SPDX-License-Identifier: Apache-2.0
"""Finds an arm's parameters from its recorded motion: ``flexarm identify`` (docs/identification.md)."""
