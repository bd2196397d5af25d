# SPDX-License-Identifier: Apache-2.0
r"""Compares motor currents with the torque of the motion, for torque constant and friction of each joint.

Let :math:`\tau` be the torque of the model when its joints move as recorded. Then

.. math::
    K\,I = \tau + J\ddot q + f_v\dot q + f_c\tanh(\dot q/v_0) + b,

This is linear in 1/K, J/K, f_v/K, f_c/K and b/K; a regression on the fitted part finds them. K is the torque per ampere
at the joint. It scales with the masses of the arm file. J must be added to the rotor's inertia in the file. The
unexplained fraction of the current is the normalised residual sum of squares :math:`\sum(I - \hat I)^2/\sum(I - \bar
I)^2`; it is 0 if the model explains everything.
"""

from dataclasses import dataclass

import numpy as np

from ..recordings.trends import regression
from .fit import bandwidth
from .prescribed import MotionPredictor, prescribed_torque

#: A joint is explained if the unexplained fraction of its current is at most this [-].
EXPLAINED = 0.5


@dataclass(frozen=True)
class MotorFit:
    """How the model explains the current of one joint's motor.

    Attributes
    ----------
    joint : str
    constant, viscous, coulomb, inertia : tuple of float
        Value and half of its 95 % interval: torque per ampere [N m/A], viscous and Coulomb friction [N m s/rad], [N m],
        inertia in addition to the file's [kg m^2].
    left, left_of_scored : float
        Normalised residual sum of squares in the fitted and in the scored part [-].
    """

    joint: str
    constant: tuple
    viscous: tuple
    coulomb: tuple
    inertia: tuple
    left: float
    left_of_scored: float

    @property
    def explained(self):
        """Whether the model explains the current; only then are friction and torque constant meaningful."""
        return self.constant[0] > 0.0 and self.left < EXPLAINED


def torques(arm, run, corner, offset=None):
    """Torque of each motor in the recorded motion, without friction, shape (s, n) [N m], and the predictor.

    Parameters
    ----------
    arm : Arm
    run : Recording
        It begins at rest.
    corner : float
        Of the low pass of the joint angles [Hz].
    offset : ndarray, shape (n,), optional
        Added to the measured angles [rad].
    """
    predictor = MotionPredictor(arm, run, corner)
    delta, rate, built = predictor.states(arm, offset)
    position = predictor.position + (0.0 if offset is None else offset)
    states = np.hstack([position, delta, predictor.velocity, rate])
    friction = np.array([built.friction(v) for v in predictor.velocity])
    found = np.array(
        [
            prescribed_torque(built, s, a)
            for s, a in zip(states, predictor.acceleration, strict=True)
        ]
    )
    return found - friction, predictor


def motor_fits(found, run, fitted, scored, corner, other=None):
    """A `MotorFit` of each joint whose current was recorded.

    Parameters
    ----------
    found : StrainFit
    run : Recording
    fitted, scored : slice
        Samples of `run`; if `other` is given, `scored` are samples of `other`.
    corner : float
        Of the low pass of the joint angles [Hz].
    other : Recording, optional
        It begins at rest.
    """
    if run.current is None:
        return []
    regressors = _regressors(found, run, corner)
    later = regressors if other is None else _regressors(found, other, corner)
    other, made = other or run, []
    for j, joint in enumerate(found.setup.arm.joints):
        current, X = run.current[:, j], regressors[j]
        if not np.isfinite(current).all():
            continue
        value, width = _regressed(X[fitted], current[fitted])
        left = [_left(current[fitted], X[fitted] @ value), np.nan]
        if other.current is not None:
            left[1] = _left(other.current[scored, j], later[j][scored] @ value)
        made.append(_made(joint.name, value, width, left))
    return made


def _regressors(found, run, corner):
    """Regressors of each joint's current: torque, acceleration, speed, direction, one; shape (s, 5) each."""
    arm = found.setup.arm
    torque, predictor = torques(arm, run, corner, found.setup.offset)
    made = []
    for j, joint in enumerate(arm.joints):
        speed = predictor.velocity[:, j]
        slides = np.tanh(speed / joint.friction.smoothing)
        columns = torque[:, j], predictor.acceleration[:, j], speed, slides, np.ones(len(speed))
        made.append(np.column_stack(columns))
    return made


def _left(current, predicted):
    """Fraction of the current's sum of squares, about its mean, that a prediction does not explain."""
    whole = np.sum((current - current.mean()) ** 2)
    return float(np.sum((current - predicted) ** 2) / max(whole, 1e-300))


def _regressed(X, y):
    """As `regression`; the number of lags follows from the correlation of successive residuals."""
    left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    return regression(X, y, min(bandwidth(left[:, None]), len(y) // 4))


def _made(name, value, width, left):
    """A `MotorFit` from the regression's coefficients: inertia and friction are coefficients over the first one."""
    a, wide = value[0], width[0] / max(abs(value[0]), 1e-300)
    ratio = lambda k: (float(value[k] / a), float(np.hypot(width[k] / a, value[k] / a * wide)))  # noqa: E731
    return MotorFit(
        name, (float(1.0 / a), float(wide / abs(a))), ratio(2), ratio(3), ratio(1), *left
    )
