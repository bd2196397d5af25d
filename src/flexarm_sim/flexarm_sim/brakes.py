# SPDX-License-Identifier: Apache-2.0
r"""Brakes that stick: an arm without drive torque under Coulomb's law without smoothing.

Brake i, of torque :math:`T_i`, gives :math:`-T_i\,\mathrm{sign}\,\dot q_i` while its joint turns. It holds a joint at
rest with the torque that is needed, up to :math:`T_i`. Let a be the accelerations of the joints at rest without their
brakes, and H the block of the inverse mass matrix for those joints, as in (3). The brakes' torques :math:`\lambda` are
the only ones with

.. math::
    \ddot q = a + H\lambda, \qquad \ddot q_i = 0 \text{ and } |\lambda_i|\le T_i, \quad\text{or}\quad
    \lambda_i = -T_i\,\mathrm{sign}\,\ddot q_i .

They minimise :math:`\tfrac12\lambda^TH\lambda + a^T\lambda` over a box (Gauss's least constraint); H is positive
definite, and principal pivoting by the least index finds them (Murty 1974, Math. Program. 7, 367-370).

Joints that stick are locked: they are taken out of the equations of motion, so they rest to the last bit. A step in
which a joint stops is divided there.
"""

import math

import numpy as np

from flexarm_dynamics.models.fixed_step import METHODS

from . import integrators

#: A joint has stopped when its speed is this fraction of that at the start of the step.
STOPPED = 1e-11
#: The remainder of a step is dropped when it is a smaller fraction of the step than this.
SLIVER = 1e-12
#: While every brake holds, this is checked at this interval [s].
CHECK_INTERVAL = 1e-3
#: A brake that holds with less than this fraction of its torque need not be solved for again.
SAFE_FRACTION = 0.8
#: Maximum numbers of iterations of two loops, which usually end much earlier.
MAX_PIVOTS, MAX_REFINEMENTS = 100, 80


def pivot(acceleration, response):
    """Torques of brakes on joints at rest, as fractions of their full torque.

    Parameters
    ----------
    acceleration : ndarray, shape (k,)
        Accelerations without the brakes [rad/s^2].
    response : ndarray, shape (k, k)
        What the full torque of each brake adds to it, by columns [rad/s^2].

    Returns
    -------
    fraction : ndarray, shape (k,)
        From -1 to 1.
    slips : ndarray of int, shape (k,)
        0: it sticks; otherwise the sign of the joint's acceleration.
    """
    slips = np.zeros(acceleration.size, int)
    for _ in range(MAX_PIVOTS):
        sticks = slips == 0
        fraction = -slips.astype(float)
        rest = acceleration + response @ fraction
        fraction[sticks] = np.linalg.solve(response[np.ix_(sticks, sticks)], -rest[sticks])
        slip = acceleration + response @ fraction
        wrong = np.flatnonzero(np.where(sticks, np.abs(fraction) > 1.0, slip * slips < 0.0))
        if not wrong.size:
            break
        first = wrong[0]
        slips[first] = -np.sign(fraction[first]) if sticks[first] else 0
    return fraction, slips


class Brakes:
    """Integrates an arm whose joints are braked.

    Parameters
    ----------
    model : ArmModel
    period : float
        Period of `advance` [s].
    torque : ndarray, shape (n,)
        Torque of each brake [N m]; 0: none.
    friction : ndarray, shape (n, 3)
        Friction of all joints without brakes, as `ArmModel.friction_table`.
    implicit : bool
        Use the implicit method, for modes too fast for an explicit one.
    refinement : int
        Factor of the substeps that the modes need.

    Attributes
    ----------
    side : ndarray of int, shape (n,)
        Last state of each brake: 0 it held; 1, -1 its joint turned in this direction; 2: there is none.
    """

    #: `side` of a joint without brake.
    FREE = 2

    def __init__(self, model, period, torque, friction, implicit=False, refinement=1):
        self.model, self.torque, self.friction = model, np.asarray(torque, float), friction
        self.period = period
        # RK4 in these substeps dissipates far more of a mode's energy than dop853 would.
        needed = 1 if implicit else integrators.substeps(model, period, "dop853", undamped=True)
        self.substeps = refinement * needed
        self._step = model.lockable_stepper(None if implicit else METHODS["rk4"])
        n, size = model.n_joints, 2 * (model.n_joints + model.n_modes)
        self._rates = slice(size // 2, size // 2 + n)
        self._has = self.torque > 0.0
        self.side = np.where(self._has, 0, self.FREE)
        self._known, self._at = None, np.zeros(n)

    def advance(self, state, fraction=1.0):
        """Advance `state`, (2 (n + m),), in place by a fraction of a period.

        Brakes are checked at each substep while a joint turns, and every `CHECK_INTERVAL` (or substep, if that is
        longer) while all hold.
        """
        count = max(1, math.ceil(fraction * self.substeps))
        step = fraction * self.period / count
        at_once = max(1, int(CHECK_INTERVAL / step))
        while count > 0 and np.isfinite(state).all():
            self._settle(state)
            moving = (self.side != 0) & self._has
            many = 1 if moving.any() else min(count, at_once)
            if moving.any():
                self._cut_step(state, step)
            else:
                self._stretch(state, step, many)
            count -= many

    def _cut_step(self, state, step):
        """Integrate one substep, divided where joints stop; call `_settle` before."""
        left = step
        for _ in range(4 * self.side.size + 4):
            start = state.copy()
            self._stretch(state, left)
            # A joint that left rest can't turn in the other direction: it sticks after all.
            while (back := self._left_rest(start) & (state[self._rates] * self.side < 0.0)).any():
                self.side[back] = 0
                state[:] = start
                self._stretch(state, left)
            after = self._slowest(state, start)
            if not after < 0.0:
                return
            left -= self._stop(state, start, left, after)
            rates, before = state[self._rates], start[self._rates]
            rates[self._turns(start) & (rates * np.sign(before) <= STOPPED * np.abs(before))] = 0.0
            if left <= SLIVER * step:
                return
            self._settle(state)

    def _stop(self, state, start, length, after):
        """Integrate until the first joint stops, by the Illinois method; return the time taken [s]."""
        low, high, before, last, reached = 0.0, length, 1.0, 0, length
        for _ in range(MAX_REFINEMENTS):
            reached = (low * after - high * before) / (after - before)
            state[:] = start
            self._stretch(state, reached)
            value = self._slowest(state, start)
            if abs(value) <= STOPPED or high - low <= SLIVER * length:
                break
            if value > 0.0:
                after *= 0.5 if last > 0 else 1.0
                low, before, last = reached, value, 1
            else:
                before *= 0.5 if last < 0 else 1.0
                high, after, last = reached, value, -1
        return reached

    def _turns(self, start):
        return self._has & (self.side != 0) & (start[self._rates] != 0.0)

    def _left_rest(self, start):
        return self._has & (self.side != 0) & (start[self._rates] == 0.0)

    def _slowest(self, state, start):
        """Minimum speed of the turning joints, relative to the start; negative: a joint has turned back."""
        turns = self._turns(start)
        return (state[self._rates][turns] / start[self._rates][turns]).min(initial=np.inf)

    def _stretch(self, state, step, count=1):
        """Integrate steps in which no brake changes its state."""
        self._step.lock(self.side == 0)
        self._step(state, self._pull(), step, count, self.friction)

    def _pull(self):
        """Torque of the brakes that slip, (n,) [N m]."""
        return np.where(np.abs(self.side) == 1, -self.side * self.torque, 0.0)

    # Who sticks --------------------------------------------------------------------------------

    def _settle(self, state):
        """Determine the state of each brake."""
        rates = state[self._rates]
        resting = self._has & (rates == 0.0)
        self.side[:] = np.where(self._has, np.sign(rates), self.FREE)
        if not resting.any():
            return
        viscous, coulomb, smoothing = self.friction.T
        friction = viscous * rates + coulomb * np.tanh(rates / smoothing)
        pull = self._pull() - friction + self.model.friction(rates)  # the model adds its own
        free = self.model.derivative(state, pull)[self._rates]
        where = np.flatnonzero(resting)
        if self._holds(free[where], where, state):
            return
        response = np.empty((where.size, where.size))
        for column, i in enumerate(where):
            pull[i] = self.torque[i]
            response[:, column] = self.model.derivative(state, pull)[self._rates][where]
            pull[i] = 0.0
        response -= free[where][:, None]
        self._known = (where, np.linalg.inv(response), state[: rates.size].copy())
        self.side[where] = pivot(free[where], response)[1]

    def _holds(self, free, where, state):
        """Whether all brakes at rest hold with a margin, by the solution kept for this pose."""
        if self._known is None:
            return False
        joints, inverse, pose = self._known
        same = np.array_equal(joints, where) and np.array_equal(pose, state[: pose.size])
        return same and bool(np.abs(inverse @ free).max() < SAFE_FRACTION)
