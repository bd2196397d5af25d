# SPDX-License-Identifier: Apache-2.0
"""The errors that flexarm raises; every one of them is a `FlexarmError`.

A message names the joint, mode, parameter or field, the value, the limit, and what to do.
"""


class FlexarmError(Exception):
    """Base of all errors that flexarm raises on purpose."""


class ArmFileError(FlexarmError):
    """An arm file that can't be used; the message starts with the field's path."""

    def __init__(self, path, reason):
        super().__init__(f"{path}: {reason}")
        self.path = path
        self.reason = reason


class ParameterError(FlexarmError):
    """A parameter that is unknown, of the wrong type, length or range."""


class TrajectoryError(FlexarmError):
    """A trajectory that can't be followed."""


class MessageError(FlexarmError):
    """A state or torque message that can't be used."""


class ShapeError(FlexarmError):
    """An array of the wrong shape; the message names both shapes."""


class ModelError(FlexarmError):
    """An arm for which there is no model, or a model asked for what it has not."""


class DesignError(FlexarmError):
    """A control or observer design that has no solution for these numbers."""


class UnknownComponentError(FlexarmError):
    """A law, observer or model name that no installed package provides."""
