# SPDX-License-Identifier: Apache-2.0
r"""Optimal fast control with a gain scheduled over the workspace: that of `lqr`, as (11) changes with q.

Siciliano & Book (1986) solve (20) once, at the end of the trajectory. Here it is solved on a regular grid of
joint configurations. The control path interpolates the gain multilinearly between them:

.. math::
    u_f = K_f(q)\,z_f, \qquad
    K_f(q) = \sum_{c} \Big[\prod_j w_{j}(c, q_j)\Big] K_c, \qquad w_j \in \{1-t_j,\; t_j\} .

The sum runs over the 2^d corners c of the cell that contains q; t_j in [0, 1] is the place of q_j in the cell. The grid
leaves out joints that do not change A2 and B2, such as the first joint of a planar arm or the yaw of an arm on a
column. Evaluations of (11) find them. Beyond an end of the grid, the gain is that of the end. The angle of a joint
without position limits is first wrapped to +-pi.

The closed boundary layer A2(q) + B2(q) K_f(q) is checked in the middle of every cell, where the interpolation error is
largest, and at random configurations. Every pole must lie left of -alpha/2. The check treats q as constant, because q
changes slowly compared with the fast states of (11).
"""

import itertools

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import fast_subsystem

from .base import FastLaw
from .lqr import WEIGHTS, regulator


class GainTable:
    """Matrices on a regular grid of joint configurations, interpolated multilinearly.

    Parameters
    ----------
    joints : sequence of int
        The d joints that span the grid; the index of the last one runs fastest.
    low, high : ndarray, shape (d,)
        Ends of the grid [rad].
    points : int
        Points per joint.
    turns : ndarray of bool, shape (d,)
        True for joints without position limits, whose angle is first wrapped to +-pi.
    matrices : ndarray, shape (points**d, rows, columns)
    """

    def __init__(self, joints, low, high, points, turns, matrices):
        strides = points ** np.arange(len(joints) - 1, -1, -1)
        scale = (points - 1) / (high - low)
        # Plain numbers are cheaper than arrays of this size.
        self._axes = [
            (int(j), float(a), float(s), int(stride), bool(turn))
            for j, a, s, stride, turn in zip(joints, low, scale, strides, turns, strict=True)
        ]
        self._last = points - 1
        self._corners = np.array(
            [int(np.dot(c, strides)) for c in itertools.product((0, 1), repeat=len(joints))]
        )
        self._shape = matrices.shape[1:]
        self._rows = np.ascontiguousarray(matrices.reshape(matrices.shape[0], -1))

    def __call__(self, q):
        """Matrix in joint configuration q, shape (rows, columns)."""
        first, weights = 0, [1.0]
        for joint, low, scale, stride, turns in self._axes:
            angle = float(q[joint])
            if turns:
                angle -= 2.0 * np.pi * round(angle / (2.0 * np.pi))
            place = min(max((angle - low) * scale, 0.0), self._last)
            cell = min(int(place), self._last - 1)
            t = place - cell
            first += cell * stride
            weights = [w * v for w in weights for v in (1.0 - t, t)]
        return np.dot(weights, self._rows[first + self._corners]).reshape(self._shape)


class ScheduledLqr(FastLaw):
    """Gain interpolated over the workspace; see the module.

    Attributes
    ----------
    scheduled : ndarray of int
        Joints that the gain depends on.
    nodes : ndarray, shape (N, n)
        Joint configurations of the grid [rad]; the other joints are in the middle of their range.
    gains : ndarray, shape (N, n, 2m)
        K_f at the nodes.
    K_f : ndarray, shape (n, 2m)
        Gain in the middle of the range.
    low, high : ndarray, shape (n,)
        Range of every joint [rad].
    """

    PARAMETERS = (
        *WEIGHTS,
        parameter("grid", 5, "-", 2, 41).described(
            "Designs per joint that changes the boundary layer (11); the gain is interpolated between them."
        ),
        parameter("low", [0.0], "rad", -100.0, 100.0, length="joints").described(
            "Lower end of the scheduled range; with 0.0 here and in high: limits.position, or -pi if there is none."
        ),
        parameter("high", [0.0], "rad", -100.0, 100.0, length="joints").described(
            "Upper end of the scheduled range; with 0.0 here and in low: limits.position, or pi if there is none."
        ),
    )

    #: For an arm of ten modes, this many designs take some minutes.
    MAX_DESIGNS = 20000
    #: At most this many random configurations are checked in addition to the middles of the cells.
    CHECKED = 1000
    #: Relative change of A2 or B2 below which a joint does not matter.
    NEGLIGIBLE = 1e-9

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self._set_range()
        self.scheduled = self._find_joints()
        grid = self.parameters["grid"]
        self._refuse_too_many(grid)
        self.nodes = self._grid(np.linspace(0.0, 1.0, grid))
        self.gains = np.array([regulator(model, q, self.parameters).K_f for q in self.nodes])
        s = self.scheduled
        self._table = GainTable(s, self.low[s], self.high[s], grid, self._turns[s], self.gains)
        self._check(grid)
        self.K_f = self.gain(self.configuration)

    def _set_range(self):
        """Set the range of each joint, from the parameters or from the arm file's limits."""
        low, high = np.array(self.parameters["low"]), np.array(self.parameters["high"])
        default = (low == 0.0) & (high == 0.0)
        limits = self.model.arm.position_limits
        self._turns = default & np.isinf(limits).all(axis=1)
        limits = np.where(np.isfinite(limits), limits, [-np.pi, np.pi])
        self.low, self.high = (np.where(default, limits[:, i], (low, high)[i]) for i in (0, 1))
        for i in np.flatnonzero(self.low > self.high):
            raise DesignError(
                f"rad of {self.model.joint_names[i]} is above fast.high[{i}]",
                field=f"fast.low[{i}]",
                value=float(self.low[i]),
                limit=f"{self.high[i]:.4g} rad",
                hint="give both",
            )

    def _find_joints(self):
        """Joints that change A2 or B2 when turned alone from a few configurations."""
        n = self.model.n_joints
        if not self.model.n_modes:
            return np.array([], int)
        draw = np.random.default_rng(0)
        matters = np.zeros(n, bool)
        for _ in range(3):
            base, other = draw.uniform(self.low, self.high, (2, n))
            here = self._boundary_layer(base)
            for i in np.flatnonzero(~matters & (self.high > self.low)):
                turned = base.copy()
                turned[i] = other[i]
                matters[i] = any(
                    np.abs(b - a).max() > self.NEGLIGIBLE * np.abs(a).max()
                    for a, b in zip(here, self._boundary_layer(turned), strict=True)
                )
        return np.flatnonzero(matters)

    def _boundary_layer(self, q):
        return fast_subsystem(self.model.terms(q, np.zeros(q.size)))

    def _refuse_too_many(self, grid):
        d = self.scheduled.size
        if grid**d > self.MAX_DESIGNS:
            names = ", ".join(self.model.joint_names[i] for i in self.scheduled)
            raise DesignError(
                f"points for each of {d} joints ({names}) make {grid**d} designs",
                field="fast.grid",
                value=grid,
                limit=f"at most {self.MAX_DESIGNS}",
                hint=f"lower fast.grid to {int(self.MAX_DESIGNS ** (1.0 / d) + 1e-9)}, or hold a joint with fast.low ="
                " fast.high",
            )

    def _grid(self, places):
        """Joint configurations at all combinations of `places` in [0, 1], shape (N, n)."""
        combined = np.array(list(itertools.product(places, repeat=self.scheduled.size)))
        out = np.tile(0.5 * (self.low + self.high), (combined.shape[0], 1))
        s = self.scheduled
        out[:, s] = self.low[s] + combined * (self.high - self.low)[s]
        return out

    def _check(self, grid):
        """Refuse a table that leaves a pole too slow between the nodes."""
        if not self.scheduled.size:
            return
        middles = self._grid((np.arange(grid - 1) + 0.5) / (grid - 1))
        count = min(max(50, len(middles)), self.CHECKED)
        drawn = np.random.default_rng(1).uniform(self.low, self.high, (count, self.low.size))
        slowest = -0.5 * self.parameters["alpha"]
        for q in np.vstack([middles, drawn]):
            A2, B2 = self._boundary_layer(q)
            poles = np.linalg.eigvals(A2 + B2 @ self._table(q))
            worst = poles[np.argmax(poles.real)]
            if not worst.real < slowest:
                raise DesignError(
                    f"points per joint leave a pole of the interpolated gain at {worst.real:.4g} +"
                    f" {abs(worst.imag):.4g}j 1/s, not left of -alpha/2 = {slowest:.4g}, at joint configuration"
                    f" {np.round(q, 4).tolist()}",
                    field="fast.grid",
                    value=grid,
                    hint="raise fast.grid, narrow fast.low to fast.high, or lower fast.alpha",
                )

    @property
    def configuration(self):
        """Joint configuration in the middle of the range, shape (n,) [rad]."""
        return 0.5 * (self.low + self.high)

    def gain(self, q):
        return self._table(q)
