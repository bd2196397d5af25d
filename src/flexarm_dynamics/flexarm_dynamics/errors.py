# SPDX-License-Identifier: Apache-2.0
"""Defines the errors that flexarm raises; each of them is a `FlexarmError`.

An error carries what a program or a test needs (`field`, `value`, `limit`, `hint`). Its text for the user always has
the form ``field: value problem (limit); hint``, without the parts that are not given.
"""

import numpy as np

from .shown import show

#: Values beyond this can't be a measurement of an arm [rad, m, rad/s, m/s].
MAX_MEASUREMENT = 1e6


class _NotGiven:
    def __repr__(self):
        return "NOT_GIVEN"

    def __reduce__(self):
        return "NOT_GIVEN"  # the same object in every process


#: Stands for a value that was not given; None may be a value.
NOT_GIVEN = _NotGiven()


class FlexarmError(Exception):
    """Base of all errors that flexarm raises on purpose.

    Parameters
    ----------
    problem : str
        What is wrong. With a `value`, the words that follow it: "is not finite".
    field : str, optional
        Full name of the parameter, field of a file or message, joint or mode that has the problem.
    value : object, optional
        The value found there.
    limit : object, optional
        What is allowed: a number, a range or a list of names.
    hint : str, optional
        What the user can do.

    Attributes
    ----------
    problem, field, value, limit, hint
        As given. What was not given is an empty string, `NOT_GIVEN` (value) or None (limit).

    Examples
    --------
    >>> str(FlexarmError("is too large", field="slow.kp[0]", value=7.0, limit="at most 5", hint="write 5.0"))
    'slow.kp[0]: 7.0 is too large (at most 5); write 5.0'
    """

    def __init__(self, problem="", *, field="", value=NOT_GIVEN, limit=None, hint=""):
        super().__init__(problem)
        self.problem, self.field, self.value = problem, field, value
        self.limit, self.hint = limit, hint

    def __str__(self):
        text = f"{self.field}: " if self.field else ""
        if self.value is not NOT_GIVEN:
            text += f"{show(self.value)} "
        text += self.problem
        if self.limit is not None:
            text += f" ({self.limit})"
        return f"{text}; {self.hint}" if self.hint else text

    def __reduce__(self):
        """Keep all attributes of an error that is sent to another process."""
        return _again, (type(self), vars(self))


def _again(kind, fields):
    error = kind.__new__(kind)
    vars(error).update(fields)
    return error


class ArmFileError(FlexarmError):
    """An arm file that can't be used; `field` is the path of the entry, as ``links[0].length``."""

    def __init__(self, field, problem, *, value=NOT_GIVEN, limit=None, hint=""):
        super().__init__(problem, field=field, value=value, limit=limit, hint=hint)


class ParameterError(FlexarmError):
    """A parameter that is unknown, of the wrong type, length or range."""


class TrajectoryError(FlexarmError):
    """A trajectory that can't be followed."""


class MessageError(FlexarmError):
    """A state or torque message that can't be used."""


class ShapeError(FlexarmError):
    """An array of the wrong shape; the message names both shapes."""


class ModelError(FlexarmError):
    """An arm for which there is no model, or a request that a model does not support."""


class DesignError(FlexarmError):
    """A control or observer design that has no solution for these numbers."""


class UnknownComponentError(FlexarmError):
    """A law, observer or model name that no installed package provides."""


def check_shape(array, shape, field):
    """Refuse an array of another shape; the error calls it `field`.

    Raises
    ------
    ShapeError
        With both shapes.
    """
    if np.shape(array) != shape:
        raise ShapeError("is the wrong shape", field=field, value=np.shape(array), limit=shape)


def check_finite(values, names, field):
    """Refuse measurements that are not finite, or too large for any arm.

    Parameters
    ----------
    values : ndarray, shape (k,)
    names : sequence of str
        Names of the joints or modes that the values belong to.
    field : str
        Field of the message, such as ``joint_position``.

    Raises
    ------
    MessageError
        Naming the first bad value and its joint or mode.
    """
    if values.dot(values) < MAX_MEASUREMENT:
        return  # true for ordinary samples; this product costs a third of the check below
    if not np.abs(values).max(initial=0.0) < MAX_MEASUREMENT:  # false for NaN too
        i = int(np.argmin(np.abs(values) < MAX_MEASUREMENT))
        value, where = float(values[i]), f"{field} of {names[i]}"
        if not np.isfinite(value):
            raise MessageError("is not finite", field=where, value=value)
        problem = "is beyond what an arm measures"
        raise MessageError(problem, field=where, value=value, limit=MAX_MEASUREMENT)
