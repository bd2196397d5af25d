# SPDX-License-Identifier: Apache-2.0
r"""Computes the safe action `damp`: how large the torque against a joint's velocity becomes, and how softly it begins.

A drive without fresh torque takes its velocity loop to zero, :math:`-T(t)\tanh(\dot q/v_0)` with :math:`v_0` =
`DAMP_SPEED`. A torque T decelerates a joint of inertia J by a = T/J. From a speed v it stops within the angle

.. math:: s \approx \tfrac12 v\,t_d + \frac{v^2}{2a},

and bends the links as this acceleration does, or twice as far if the torque begins suddenly. A stop with the whole
torque limit bends arm R seven times as far as the move that it ends. Therefore, for each joint:

- T is what stops it within `WAY`, :math:`Jv^2/(2\,\mathrm{WAY})`, with its largest speed v since the safe action began.
  So a fast motion is stopped with more torque than a slow one, in proportion to the torque of the motion: a move over 1
  rad from rest to rest accelerates as much. T is at least `FRACTION` of what the arm allows, and at most all of it. The
  arm allows the smaller of two torques: its torque limit, and the torque that strains a gauge, by accelerating the
  rigid arm, to `OF_RANGE` of its full scale. The largest torque that the arm's weight needs in any pose is added,
  within the torque limit. `damp_torque` in the arm file replaces all of this.
- It grows linearly within :math:`t_d`, half a period of the lowest bending mode with locked joints but at most
  `MAX_TIME`; `damp_time` in the arm file replaces it. The part that bears the weight acts at once, so the arm does not
  drop.

With a `damp_coefficient` c in the arm file the torque is :math:`-c\,\dot q` without a bound, with the same soft
start. An arm without torque limit and gauges has the same, with c = `DAMP_RATE` times its inertia. Under gravity
these act at once.
"""

import numpy as np

from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_dynamics.singular_perturbation import quasi_steady_state, slow_torque

#: v_0: links that continue to vibrate move a stopped joint at only a fraction of this speed [rad/s].
DAMP_SPEED = 0.05
#: Where nothing bounds the torque, the rigid arm is stopped at this rate [1/s].
DAMP_RATE = 10.0
#: Angle within which a joint is stopped, not counting the soft start [rad].
WAY = 0.35
#: Minimum torque, as a fraction of what the arm allows; fraction of the gauges' full scale that it allows [-].
FRACTION, OF_RANGE = 0.2, 0.5
#: Maximum duration of the soft start, if the arm file does not give one [s].
MAX_TIME = 0.25
#: Number of poses in which the weight is evaluated.
POSES = 64


class Damping:
    """Torques of `damp` for the joints of an arm; see the module.

    Parameters
    ----------
    model : ArmModel

    Attributes
    ----------
    active : ndarray of bool, shape (n,)
        Which joints have this safe action.
    coefficient : ndarray, shape (n,)
        c [N m s/rad]; 0 where the torque is bounded.
    time : ndarray, shape (n,)
        t_d [s].
    elapsed : float
        Progress of the soft start [s]; while a torque acts, it decreases as fast as it grew.
    speed : ndarray, shape (n,)
        Each joint's largest since the safe action began [rad/s].
    """

    def __init__(self, model):
        joints, limit, n = model.arm.joints, model.arm.torque_limits, model.n_joints
        self.active = np.array([j.safe_action == "damp" for j in joints])
        self._inertia = np.diag(model.terms(np.zeros(n), np.zeros(n)).M)[:n].copy()
        self._weight = _weight(model)
        allowed = np.minimum(limit, OF_RANGE * _torque_at_full_scale(model))
        stated = np.array([_given(j.damp_torque) for j in joints])
        coefficient = np.array([_given(j.damp_coefficient) for j in joints])
        chosen = np.isnan(stated)
        free = np.isnan(coefficient) & chosen & np.isinf(allowed)
        self.coefficient = np.where(free, DAMP_RATE * self._inertia, coefficient)
        bounded = np.isnan(self.coefficient)
        self.coefficient[bounded] = 0.0
        least = np.where(chosen, self._weight + FRACTION * allowed, stated)
        most = np.where(chosen, self._weight + allowed, stated)
        self._least, self._most = np.where(bounded, np.minimum([least, most], limit), 0.0)
        period = 2.0 * np.pi / float(model.frequencies(locked=True)[0]) if model.n_modes else 0.0
        usual = min(0.5 * period, MAX_TIME)
        self.time = np.array([usual if j.damp_time is None else j.damp_time for j in joints])
        self.speed = np.zeros(n)
        self.begin()

    def begin(self):
        """Forget the past: the next safe action begins softly."""
        self.elapsed = 0.0
        self.speed[:] = 0.0

    def act(self, time, velocity):
        """Note that the safe action acts for a `time` [s] on joints at a velocity (n,) [rad/s]."""
        self.elapsed = min(self.elapsed + time, self.time.max())
        np.maximum(self.speed, np.abs(velocity), out=self.speed)

    def release(self, time):
        """Note that a torque acts for a `time` [s]; rare torques must not keep `damp` soft for ever."""
        self.elapsed = max(0.0, self.elapsed - time)
        if not self.elapsed:
            self.speed[:] = 0.0

    def torque(self, elapsed, speed):
        """Largest torque that acts on each joint, T, (n,) [N m]; 0 where there is a coefficient.

        Parameters
        ----------
        elapsed : float
            Since the safe action began [s].
        speed : ndarray, shape (n,)
            Each joint's largest since then [rad/s]; infinite for the largest torque of all.
        """
        needed = self._weight + self._inertia * np.square(speed) / (2.0 * WAY)
        full = np.clip(needed, self._least, self._most)
        at_once = np.minimum(self._weight, full)
        return at_once + self._grown(elapsed) * (full - at_once)

    def viscous(self, elapsed):
        """Coefficient that acts on each joint a time after the safe action began [s], (n,) [N m s/rad]."""
        return np.where(self._weight > 0.0, 1.0, self._grown(elapsed)) * self.coefficient

    def _grown(self, elapsed):
        grown = np.divide(elapsed, self.time, out=np.ones_like(self.time), where=self.time > 0.0)
        return np.minimum(grown, 1.0)


def _given(value):
    return np.nan if value is None else value


def _weight(model):
    """Largest torque by which each joint bears the arm's weight in any pose, (n,) [N m]."""
    n = model.n_joints
    if not np.any(model.arm.gravity):
        return np.zeros(n)
    low, high = np.clip(model.arm.position_limits, -np.pi, np.pi).T
    poses = np.random.default_rng(0).uniform(low, high, (POSES, n))
    poses[0] = np.clip(0.0, low, high)
    still = np.zeros(n)
    return np.abs([slow_torque(model.terms(q, still), still) for q in poses]).max(axis=0)


def _torque_at_full_scale(model):
    """Torque on each joint that, by accelerating the rigid arm, bends a gauge to its full scale, (n,) [N m]."""
    n, gauges = model.n_joints, model.arm.gauges
    if not (gauges and model.n_modes):
        return np.full(n, np.inf)
    terms = model.terms(np.zeros(n), np.zeros(n))
    bent = quasi_steady_state(terms, np.zeros(n))
    bending = np.array([quasi_steady_state(terms, torque) - bent for torque in np.eye(n)])
    strain = np.abs(bending @ gauge_rows(model, gauges).T)  # (n, gauges), of 1 N m
    strain /= np.array([gauge.full_scale for gauge in gauges])
    with np.errstate(divide="ignore"):
        return 1.0 / strain.max(axis=1)
