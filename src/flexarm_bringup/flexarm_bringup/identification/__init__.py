"""Finds an arm's parameters from how it moved: ``flexarm identify`` (docs/identification.md)."""
