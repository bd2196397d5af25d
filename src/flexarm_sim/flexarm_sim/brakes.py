# SPDX-License-Identifier: Apache-2.0
r"""Brakes that stick: an arm without drive torque under Coulomb's law, without smoothing.

Brake i, of torque :math:`T_i`, gives :math:`-T_i\,\mathrm{sign}\,\dot q_i` while its joint turns. A joint at rest it
holds with what that takes, up to :math:`T_i`. With the accelerations a of the joints at rest when their brakes give
nothing, and H of (3) for those joints, the brakes' torques :math:`\lambda` are the only ones with

.. math::
    \ddot q = a + H\lambda, \qquad \ddot q_i = 0 \text{ and } |\lambda_i|\le T_i, \quad\text{or}\quad
    \lambda_i = -T_i\,\mathrm{sign}\,\ddot q_i .

They minimise :math:`\tfrac12\lambda^TH\lambda + a^T\lambda` over a box (Gauss's least constraint); H is positive
definite, and principal pivoting by the least index finds them (Murty 1974, Math. Program. 7, 367-370).

Joints that stick are locked: taken out of the equations of motion, so that they rest to the last bit. A step within
which a joint stops is cut there.
"""

import math

import numpy as np

from flexarm_dynamics.models.fixed_step import METHODS

from . import integrators

#: A joint has stopped when its speed is this share of what it was at the start of the step.
STOPPED = 1e-11
#: What is left of a step and shorter than this share of it is not integrated.
SLIVER = 1e-12
#: While every brake holds, that is looked at so often [s].
LOOK = 1e-3
#: A brake that holds with less than this share of its torque does so without being solved for anew.
SAFE_SHARE = 0.8
#: Bounds of loops that end long before.
PIVOTS, REFINEMENTS = 100, 80


def pivot(acceleration, response):
    """Shares of their torque that brakes give joints at rest.

    Parameters
    ----------
    acceleration : ndarray, shape (k,)
        When the brakes give nothing [rad/s^2].
    response : ndarray, shape (k, k)
        What the whole torque of each brake adds to it, by columns [rad/s^2].

    Returns
    -------
    share : ndarray, shape (k,)
        From -1 to 1.
    slips : ndarray of int, shape (k,)
        0: sticks; else the sign of the joint's acceleration.
    """
    slips = np.zeros(acceleration.size, int)
    for _ in range(PIVOTS):
        sticks = slips == 0
        share = -slips.astype(float)
        rest = acceleration + response @ share
        share[sticks] = np.linalg.solve(response[np.ix_(sticks, sticks)], -rest[sticks])
        slip = acceleration + response @ share
        wrong = np.flatnonzero(np.where(sticks, np.abs(share) > 1.0, slip * slips < 0.0))
        if not wrong.size:
            break
        first = wrong[0]
        slips[first] = -np.sign(share[first]) if sticks[first] else 0
    return share, slips


class Brakes:
    """Steps of an arm whose joints are braked.

    Parameters
    ----------
    model : ArmModel
    period : float
        Of `advance` [s].
    torque : ndarray, shape (n,)
        Of each brake; 0: none [N m].
    friction : ndarray, shape (n, 3)
        Of all joints, brakes aside: as `ArmModel.friction_table`.
    implicit : bool
        For modes too fast for an explicit method.

    Attributes
    ----------
    side : ndarray of int, shape (n,)
        What each brake did last: 0 it held; 1, -1 its joint turned that way; 2: it has none.
    """

    #: `side` of a joint without brake.
    FREE = 2

    def __init__(self, model, period, torque, friction, implicit=False):
        self.model, self.torque, self.friction = model, np.asarray(torque, float), friction
        self.period = period
        self.substeps = 1 if implicit else integrators.substeps(model, period, "dop853")
        self._step = model.lockable_stepper(None if implicit else METHODS["rk4"])
        n, size = model.n_joints, 2 * (model.n_joints + model.n_modes)
        self._rates = slice(size // 2, size // 2 + n)
        self._has = self.torque > 0.0
        self.side = np.where(self._has, 0, self.FREE)
        self._known, self._at = None, np.zeros(n)

    def refine(self, factor):
        """Take so many times the substeps."""
        self.substeps *= factor

    def advance(self, state, share=1.0):
        """Advance `state`, (2 (n + m),), in place by a share of a period.

        Brakes at rest are looked at every `LOOK` seconds, or substep where those are longer; while a joint turns,
        every substep.
        """
        count = max(1, math.ceil(share * self.substeps))
        step = share * self.period / count
        at_once = max(1, int(LOOK / step))
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
        """One substep, cut where joints stop; `_settle` has been called."""
        left = step
        for _ in range(4 * self.side.size + 4):
            start = state.copy()
            self._stretch(state, left)
            # A joint that left rest can't turn the other way: it sticks after all.
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
        """Leave the state where the first joint stops, by the Illinois method; the time that takes [s]."""
        low, high, before, last, reached = 0.0, length, 1.0, 0, length
        for _ in range(REFINEMENTS):
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
        """Least of the turning joints' speeds, each over that at the start; below zero: it has turned back."""
        turns = self._turns(start)
        return (state[self._rates][turns] / start[self._rates][turns]).min(initial=np.inf)

    def _stretch(self, state, step, count=1):
        """Steps in which no brake changes what it does."""
        self._step.lock(self.side == 0)
        self._step(state, self._pull(), step, count, self.friction)

    def _pull(self):
        """Torque of the brakes that slip, (n,) [N m]."""
        return np.where(np.abs(self.side) == 1, -self.side * self.torque, 0.0)

    # Who sticks --------------------------------------------------------------------------------

    def _settle(self, state):
        """Decide what each brake does."""
        rates = state[self._rates]
        resting = self._has & (rates == 0.0)
        self.side[:] = np.where(self._has, np.sign(rates), self.FREE)
        if not resting.any():
            return
        viscous, coulomb, smoothing = self.friction.T
        friction = viscous * rates + coulomb * np.tanh(rates / smoothing)
        pull = self._pull() - friction + self.model.friction(rates)  # the model has that of its own
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
        """Whether all brakes at rest hold by far, by what was known of the arm in this pose."""
        if self._known is None:
            return False
        joints, inverse, pose = self._known
        same = np.array_equal(joints, where) and np.array_equal(pose, state[: pose.size])
        return same and bool(np.abs(inverse @ free).max() < SAFE_SHARE)
