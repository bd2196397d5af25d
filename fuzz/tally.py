# SPDX-License-Identifier: Apache-2.0
"""What became of the inputs of one reader or node."""


class Tally:
    """What came of one reader's inputs."""

    def __init__(self, name):
        self.name, self.inputs, self.refused, self.failures = name, 0, 0, 0
        self.first = {}  # kind of failure -> the first one of it, as text
        self.seconds = 0.0

    @property
    def accepted(self):
        """Inputs that were read."""
        return self.inputs - self.refused
