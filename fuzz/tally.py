# SPDX-License-Identifier: Apache-2.0
"""Counts of what happened to the inputs of one reader or node."""


class Tally:
    """Counts for one reader: inputs, how many were refused, and failures."""

    def __init__(self, name):
        self.name, self.inputs, self.refused, self.failures = name, 0, 0, 0
        self.first = {}  # kind of failure -> the first one of it, as text
        self.seconds = 0.0

    @property
    def accepted(self):
        """Inputs that were read."""
        return self.inputs - self.refused
