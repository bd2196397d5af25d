# SPDX-License-Identifier: Apache-2.0
r"""Feed-forward with preview: follows a motion that bends the arm and leaves it at rest at its end.

A trajectory is known as a whole when it is received, and the joints need not follow it exactly. At that time the module
`planner` computes, off the control path, a motion of the whole arm whose joints stay near the trajectory. `model`
follows this motion in place of the slow manifold: the regulator of its simulated arm removes the remaining error.

If no shift is found within the torque limit, and the feed-forward knows more of the arm than the control, the plan of
the control's own model is taken. If that has none either, the motion that `model` makes with that model is taken. If
the feed-forward knows no more than the control, the manifold remains, for which the torque may not suffice. The reason
is in `Preparation.note`.

In a stop, or where the speed of the trajectory is scaled on the way, the plan can't be followed. Its bending beside the
slow manifold is a vibration, which goes on in its own time and ends with the plan. The regulator damps it as the joints
slow down. Let s_ref be the manifold's motion along the slowed trajectory, and s_path that along the trajectory at full
speed. The simulated arm is then held to

.. math:: s_{ref}(t) + \dot s(t)\,\bigl(s_{plan}(t) - s_{path}(t)\bigr),

where :math:`\dot s`, 1 at first, is the rate of the trajectory's time (modules `trajectory.path`,
`trajectory.scaling`); the torque changes likewise. Where the trajectory becomes faster again, the factor does not rise:
what the regulator has damped does not come back. If the plan were dropped at once instead, the simulated arm would be
left with its vibration: two random arms were lost when their speed was halved on the way. A trajectory whose speed is
scaled from its start on follows the manifold.
"""

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models.model import copy

from ..trajectory.values import SECOND
from .model import At, ModelFeedforward, Preparation, gains_along
from .planner import Plan, finite, planned


class Preview(ModelFeedforward):
    """The planned motion, while there is one; `model` otherwise. See the module."""

    plans = True

    def _make_stepper(self):
        super()._make_stepper()
        n, size = self.model.n_joints, 2 * (self.model.n_joints + self.model.n_modes)
        none = Plan(
            1.0, CubicHermiteSpline([0.0, 1.0], *np.zeros((2, 2, size))), np.zeros((2, n)), 1.0
        )
        none.state_at(0.0), none.torque_at(0.0)

    def _plan(self, model, path, start):
        settings = self.settings
        known, given = settings.known, (path, start, self.limit, settings.spread, settings.share)
        with np.errstate(over="ignore", invalid="ignore"):  # `finite` checks the results
            try:
                return planned(model, *given)
            except DesignError:
                if known is None:
                    raise
            # The plan of the control's own model nearly fits, and is within the torque limit; the manifold may not be.
            known = copy(known)
            try:
                plan = planned(known, *given)
            except DesignError as error:
                plan = replace(self._regulated(known, path, start), note=str(error))
            return plan.among(known, model)

    def _regulated(self, known, path, start):
        """The motion of `model` along a path with the control's own model, as a `Plan` within the torque limit."""
        settings, period = replace(self.settings, known=None), self.settings.period
        forward = ModelFeedforward(known, self.manifold.of(known), settings)
        forward.limit = self.limit
        gains = gains_along(known, path, period)
        forward.take(Preparation(start, gains, gains), path.trajectory_id)
        count = int(np.ceil(path.duration_ns / SECOND / period))
        states, rates = np.zeros((2, count + 1, forward.state.size))
        torque = np.zeros((count + 1, known.n_joints))
        for k in range(count + 1):
            forward.update(At(path, round(k * period * SECOND)), period if k else 0.0)
            states[k], torque[k] = forward.state, forward.torque
            rates[k] = known.derivative(states[k], torque[k])
        states, rates = finite(states, rates)
        motion = CubicHermiteSpline(period * np.arange(count + 1), states, rates)
        return Plan(count * period, motion, torque, period)

    def _planned(self, prepared, path, stamp_ns):
        if prepared is None or prepared.plan is None or not path.kept:
            return None  # a trajectory that was slower from its start on has no plan
        elapsed_ns = stamp_ns - path.followed.start_ns
        return prepared.plan if 0 <= elapsed_ns < prepared.plan.duration * SECOND else None

    def _along(self, plan, path, stamp_ns, offset):
        way = path.followed
        elapsed = (stamp_ns - way.start_ns) / SECOND + offset
        # The torque is held over the coming period, so the plan's torque in the middle of that period is taken.
        state, torque = plan.state_at(elapsed), plan.torque_at(elapsed + 0.5 * self.settings.period)
        if path is way:
            return state, torque
        stop, motion = (self._on_manifold(At(p, stamp_ns, offset)) for p in (path, way))
        left = min(path.kept, path.pace(stamp_ns, offset))
        return stop[0] + left * (state - motion[0]), stop[1] + left * (torque - motion[1])
