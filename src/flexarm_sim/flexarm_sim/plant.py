# SPDX-License-Identifier: Apache-2.0
"""The simulated arm: its state, its motion under torque, and its safe action."""

import math

import numpy as np

from flexarm_dynamics.errors import ModelError, check_shape

from . import integrators
from .brakes import Brakes
from .damping import DAMP_SPEED, Damping

#: The safe action is integrated in more substeps if rate * substep of its damping exceeds this [-].
DAMP_RATE_PER_STEP = 2.0


class Plant:
    """A simulated arm.

    Parameters
    ----------
    model : ArmModel
        The plant's model; it may have more modes than the controller's.
    period : float
        Interval over which torque is constant [s].
    integrator : str
        One of `integrators.METHODS`.

    Attributes
    ----------
    state : ndarray, shape (2 (n + m),)
        (q, delta, qd, delta_d) [rad, m, rad/s, m/s].
    substeps : int
        Per period, while there is torque.
    implicit : bool
        Whether the integrator is.
    """

    def __init__(self, model, period, integrator="dop853"):
        n, m = model.n_joints, model.n_modes
        self.model, self.period = model, period
        self.state = np.zeros(2 * (n + m))
        self.q, self.delta, self.qd, self.delta_d = np.split(self.state, [n, n + m, 2 * n + m])
        self.substeps = integrators.substeps(model, period, integrator)  # of the modes alone
        self._advance = model.stepper(integrators.METHODS[integrator])
        self._friction = model.friction_table()
        self._damping, self.implicit = Damping(model), integrators.METHODS[integrator] is None
        self._safe = self._damped(np.inf, np.inf)
        brake = self._brake_torques()
        refinement = self._refinement()
        self.substeps = integrators.plant_substeps(model, period, integrator)
        self._safe_substeps = self.substeps * self._refinement()
        self._no_torque = np.zeros(n)
        self._drives = None  # of `advance_damped`: damping, friction table and substeps
        self._brakes = None
        if brake.any():
            self._brakes = Brakes(model, period, brake, self._safe, self.implicit, refinement)

    def reset(self, position=None, delta=None):
        """Put the arm at rest at `position` [rad], bent by `delta`; by default as its weight bends it, joints held."""
        n = self.model.n_joints
        position = np.zeros(n) if position is None else np.asarray(position, float)
        check_shape(position, (n,), "initial position")
        self.state[:] = 0.0
        self._damping.begin()
        self.q[:] = position
        self.delta[:] = self.model.static_deflection(position) if delta is None else delta

    def advance(self, torque, fraction=1.0):
        """Advance by one period, or a fraction of it, under constant torque, shape (n,) [N m]."""
        self._damping.release(fraction * self.period)
        self._run(torque, self._friction, fraction, self.substeps)

    def advance_damped(self, torque, damping, fraction=1.0):
        """Advance by one period, or a fraction of it, under a torque minus `damping` times the joints' velocities.

        This is a velocity loop that is faster than any mode, like that of a drive.

        Parameters
        ----------
        torque : ndarray, shape (n,)
            [N m]
        damping : ndarray, shape (n,)
            [N m s/rad]; pass the same array in every call, and do not change it.
        fraction : float
            [-]

        Returns
        -------
        ndarray, shape (n,)
            Mean of what the drives applied [N m].
        """
        if self._drives is None or self._drives[0] is not damping:
            table = self._friction.copy()
            table[:, 0] += damping
            self._drives = damping, table, self.damped_substeps(damping)
        self._damping.release(fraction * self.period)
        before = self.q.copy()
        self._run(torque, self._drives[1], fraction, self._drives[2])
        return torque - damping * (self.q - before) / (fraction * self.period)

    def damped_substeps(self, damping):
        """Substeps of a period under a `damping` (n,) of the joints [N m s/rad]: with an explicit method, many."""
        return self.substeps * self._refined(damping)

    def advance_safely(self, fraction=1.0):
        """Advance by one period, or a fraction of it, without drive torque, under each joint's safe action."""
        damping = self._damping
        damping.act(fraction * self.period, self.qd)
        self._safe[:] = self._damped(damping.elapsed, damping.speed)
        if self._brakes is None:
            self._run(self._no_torque, self._safe, fraction, self._safe_substeps)
            return
        self._brakes.advance(self.state, fraction)
        self._check()

    def _run(self, torque, friction, fraction, substeps):
        count = max(1, math.ceil(fraction * substeps))  # none longer than those of a whole period
        self._advance(self.state, torque, fraction * self.period / count, count, friction)
        self._check()

    def _check(self):
        state = self.state
        if not (state.dot(state) < math.inf or np.isfinite(state).all()):
            raise ModelError(
                "is no longer finite: torque or speed are beyond the range of its model",
                field=f"state of {self.model.arm.name}",
                hint="reset the simulator",
            )

    def _damped(self, elapsed, speed):
        """Friction table, shape (n, 3), with the safe action `damp` added; arguments as for `Damping.torque`.

        A joint's own Coulomb friction gets the smoothing of the velocity loop.
        """
        table, where = self._friction.copy(), self._damping.active
        torque = self._damping.torque(elapsed, speed)
        table[where, 0] += self._damping.viscous(elapsed)[where]
        table[where, 1] += torque[where]
        table[where & (torque > 0.0), 2] = DAMP_SPEED
        return table

    def _brake_torques(self):
        """Torques of the joints' brakes, shape (n,) [N m]; 0: none."""
        joints = zip(self.model.arm.joints, self._inertia(), strict=True)
        return np.array(
            [self._brake_torque(j, B) if j.safe_action == "brake" else 0.0 for j, B in joints]
        )

    def _refinement(self):
        viscous, coulomb, speed = self._safe.T
        return self._refined(
            viscous + np.where(coulomb > self._friction[:, 1], coulomb / speed, 0.0)
        )

    def _refined(self, damping):
        """Factor of the substeps of an explicit method that keeps it stable under a damping (n,) [N m s/rad].

        A joint before a flexible link turns with little inertia while the link bends. Its damping may be faster
        than the highest mode, for which the substeps are chosen.
        """
        if self.implicit:
            return 1
        n = self.model.n_joints
        damped = np.linalg.inv(integrators.straight_mass_matrix(self.model))[:n, :n] @ np.diag(
            damping
        )
        fastest = np.abs(np.linalg.eigvals(damped)).max()
        return max(1, math.ceil(fastest * self.period / self.substeps / DAMP_RATE_PER_STEP))

    def _brake_torque(self, joint, inertia):
        if joint.brake_torque is not None:
            return joint.brake_torque
        # If not given: the torque limit; without one, the torque that stops the rigid arm from 1 rad/s in 0.1 s.
        return joint.limits.torque if np.isfinite(joint.limits.torque) else 10.0 * inertia

    def _inertia(self):
        return np.diag(integrators.straight_mass_matrix(self.model))[: self.model.n_joints]
