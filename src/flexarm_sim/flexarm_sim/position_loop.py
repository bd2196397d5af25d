# SPDX-License-Identifier: Apache-2.0
r"""Simulates industrial drives before the simulated arm: joint loops that take positions, velocities or efforts.

A joint_trajectory_controller (JTC), or a robot's own controller, commands positions at its rate, for example 125 Hz.
The drive of each joint closes a loop around them at a rate of its own,

.. math:: u = \mathrm{sat}\bigl(k_p (r - q) + k_d (\dot r - \dot q) + i + g(q) + u_c\bigr), \qquad \dot i = k_i (r - q),

with the torque limit of the joint. The integral part i stops while the torque is at its limit and would grow further.
The weight g(q) of the rigid arm is optional, and :math:`u_c` is the effort of the command, if any. The drive does not
know of bending. A natural frequency :math:`\omega` and a damping ratio :math:`\zeta` give

.. math:: k_p = J\omega^2, \qquad k_d = 2\zeta J\omega,

with the inertia J that the joint of the straight rigid arm turns while the other joints stand still.

As in a real drive, the velocity loop is faster than any mode: the link behind a light hub yields, so the loop acts on
the hub's inertia alone. Within a sample of the simulated arm it acts continuously, and the rest of the torque is
constant. If the torque meets its limit, the loop is closed in steps within the sample, and bounded in each.

The fields of a command determine what it means, for all joints alike: positions, with velocities as their feed-forward;
velocities alone, whose integral is the reference; or efforts alone, which are passed on.
"""

import math
from collections import deque

import numpy as np
from scipy.linalg import expm

from flexarm_dynamics.errors import DesignError, MessageError
from flexarm_dynamics.linear import linear_plant
from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import slow_subsystem, slow_torque

PARAMETERS = (
    parameter("bandwidth", 20.0, "rad/s", 0.1, 1e4, read_only=True).described(
        "Natural frequency of the drives' loops on the rigid arm."
    ),
    parameter("damping", 1.0, "-", 0.0, 100.0, read_only=True).described(
        "Damping ratio of these loops."
    ),
    parameter("kp", [-1.0], "N m/rad", -1.0, 1e9, length="joints", read_only=True).described(
        "Position gains; negative: from bandwidth and damping."
    ),
    parameter("kd", [-1.0], "N m s/rad", -1.0, 1e9, length="joints", read_only=True).described(
        "Velocity gains; negative: from bandwidth and damping."
    ),
    parameter("ki", [0.0], "N m/(rad s)", 0.0, 1e9, length="joints", read_only=True).described(
        "Gains of the integral parts."
    ),
    parameter("gravity", True, read_only=True).described(
        "Whether the drives compensate the weight of the rigid arm, with the payload of the arm file."
    ),
    parameter("command_rate", 125.0, "Hz", 1.0, 20000.0, read_only=True).described(
        "Rate of the commands. They are interpolated over its period."
    ),
    parameter("interpolation", "linear", choices=("hold", "linear"), read_only=True).described(
        "Path from one position command to the next. hold: a step; linear: within a period of the commands."
    ),
    parameter("command_delay", 0.008, "s", 0.0, 10.0, read_only=True).described(
        "Time from a command until it acts: transport and computation."
    ),
)
#: Eigenvalues of the sampled loop may be outside of the unit circle by this much: rounding [-].
ROUNDING = 1e-9
#: The sampled loop must be stable with its gains multiplied by this [-].
MARGIN = 1.5
#: Rate of the velocity loop times its step, while the torque is at its limit [-]; max. number of steps in a sample.
RATE_PER_STEP, MAX_STEPS = 0.5, 100


class PositionLoop:
    """The drives of an arm; see the module.

    Parameters
    ----------
    model : ArmModel
        The drives' model of the arm: inertia, weight and torque limits.
    period : float
        Sample period of the simulated arm [s].
    settings : mapping
        Checked values of `PARAMETERS`.

    Attributes
    ----------
    kp, kd, ki : ndarray, shape (n,)
        [N m/rad], [N m s/rad], [N m/(rad s)]
    reference, reference_velocity : ndarray, shape (n,)
        What the loops follow now [rad], [rad/s].
    saturated : ndarray of bool, shape (n,)
        Joints whose torque was at its limit.

    Raises
    ------
    DesignError
        If the sampled loop around the flexible arm is unstable with `MARGIN` times its gains.
    """

    def __init__(self, model, period, settings):
        self.model, self.period = model, float(period)
        n = model.n_joints
        self.limit = np.asarray(model.arm.torque_limits, float)
        still = np.zeros(n)
        inertia = np.diag(np.linalg.inv(slow_subsystem(model.terms(still, still))[1]))
        w, ratio = settings["bandwidth"], settings["damping"]
        chosen = inertia * w**2, 2.0 * ratio * inertia * w
        given = (np.array(settings[name], float) for name in ("kp", "kd"))
        self.kp, self.kd = (
            np.where(own >= 0.0, own, ours) for own, ours in zip(given, chosen, strict=True)
        )
        self.ki = np.array(settings["ki"], float)
        self._gravity = settings["gravity"]
        self._interval = 1.0 / settings["command_rate"]
        self._linear = settings["interpolation"] == "linear"
        self._delay = settings["command_delay"]
        self.reference, self.reference_velocity = np.zeros(n), np.zeros(n)
        self.saturated = np.zeros(n, bool)
        self._refuse_unstable()
        free = np.linalg.inv(model.terms(still, still).M)[:n, :n]
        fastest = np.abs(np.linalg.eigvals(free @ np.diag(self.kd))).max()
        self._steps = min(math.ceil(fastest * self.period / RATE_PER_STEP) or 1, MAX_STEPS)
        self.begin(still)

    def _refuse_unstable(self):
        gains = (MARGIN * self.kp, MARGIN * self.kd, MARGIN * self.ki)
        radius = spectral_radius(self.model, self.period, *gains)
        if radius > 1.0 + ROUNDING:
            raise DesignError(
                f"is outside of the unit circle: the drives' loop is unstable with {MARGIN:g} times its gains",
                field=f"largest eigenvalue at {1.0 / self.period:g} Hz",
                value=float(f"{radius:.6g}"),
                limit=1.0,
                hint="lower bandwidth or gains, raise the damping, or the rate",
            )

    def begin(self, position):
        """Hold a position (n,) [rad]; commands that are on their way are forgotten."""
        self.reference[:] = position
        self.reference_velocity[:] = 0.0
        self._integral, self._effort = np.zeros_like(self.reference), None
        self._waiting = deque()
        self._act(None, None, None)

    def command(self, time, position=None, velocity=None, effort=None):
        """Take a command that was sent at a time; it acts `command_delay` later.

        Parameters
        ----------
        time : float
            On the clock of `torque` [s].
        position, velocity, effort : (n,) array_like, optional
            [rad], [rad/s], [N m]; at least one of them.

        Raises
        ------
        MessageError
            If numbers are missing or not finite; then the last command remains active.
        """
        n = self.reference.size
        taken = [
            _numbers(name, values, n)
            for name, values in (
                ("position", position),
                ("velocity", velocity),
                ("effort", effort),
            )
        ]
        if all(values is None for values in taken):
            hint = "give position, velocity or effort"
            raise MessageError("is empty", field="command", hint=hint)
        self._waiting.append((time + self._delay, taken))

    def torque(self, time, position, velocity):
        """The torques for measured joints at a time; call it once in each `period`, or let `drive` call it.

        Parameters
        ----------
        time : float
            [s]
        position, velocity : ndarray, shape (n,)
            [rad], [rad/s]

        Returns
        -------
        ndarray, shape (n,)
            Within the torque limits [N m].
        """
        held = self._held(time, position)
        out = self._bounded(held if self._passes else held - self.kd * velocity)
        self._integrate(position, held)
        return out

    def drive(self, plant, time):
        """Move a plant by a period; for `Simulator.advance_with`.

        Parameters
        ----------
        plant : Plant
        time : float
            At the beginning [s].

        Returns
        -------
        ndarray, shape (n,)
            Mean torque [N m].
        """
        before = plant.q.copy()
        held = self._held(time, before)
        if self._passes:
            out = self._bounded(held)
            plant.advance(out)
            return out
        self._bounded(held - self.kd * plant.qd)
        if self.saturated.any():
            out, limited = np.zeros_like(held), np.zeros_like(self.saturated)
            for _ in range(self._steps):
                part = self._bounded(held - self.kd * plant.qd)
                limited |= self.saturated
                plant.advance(part, 1.0 / self._steps)
                out += part / self._steps
            self.saturated = limited
        else:
            out = plant.advance_damped(held, self.kd)
        self._integrate(before, held)
        return out

    def _held(self, time, position):
        """Torque of the drives by the commands that act by now, without the part of the measured velocity [N m]."""
        while self._waiting and self._waiting[0][0] <= time + 1e-9:
            self._act(*self._waiting.popleft()[1])
        if self._passes:
            return self._effort
        self._advance()
        held = self.kp * (self.reference - position) + self.kd * self.reference_velocity
        held += self._integral
        if self._gravity:
            still = np.zeros_like(position)
            held += slow_torque(self.model.terms(position, still), still)
        if self._effort is not None:
            held += self._effort
        return held

    def _integrate(self, position, held):
        if self._passes:
            return
        error = self.reference - position
        grows = self.saturated & (np.sign(error) == np.sign(held))
        self._integral += np.where(grows, 0.0, self.ki * error * self.period)

    def _bounded(self, wanted):
        out = np.clip(wanted, -self.limit, self.limit)
        self.saturated = out != wanted
        return out

    def _act(self, position, velocity, effort):
        """Make a command active."""
        self._effort, self._passes = effort, False
        self._target, self._left, self._rate = None, 0, None
        if position is not None:
            self._target = position
            self._left = max(round(self._interval / self.period), 1) if self._linear else 1
            self._given = velocity
        elif velocity is not None:
            self._rate = velocity
        elif effort is not None:
            self._passes = True

    def _advance(self):
        """Advance the reference to the next period of the drives."""
        velocity = self.reference_velocity
        if self._rate is not None:
            velocity[:] = self._rate
            self.reference += self.period * self._rate
        elif self._target is not None and self._left > 0:
            step = (self._target - self.reference) / self._left
            self.reference += step
            self._left -= 1
            if self._given is not None:
                velocity[:] = self._given
            else:
                velocity[:] = step / self.period if self._linear else 0.0
        elif self._target is None or self._given is None:
            velocity[:] = 0.0


def spectral_radius(model, period, kp, kd, ki):
    """Largest modulus of the eigenvalues of the joint loops around the straight arm at rest.

    The velocity parts act continuously, the others once in a period.

    Parameters
    ----------
    model : ArmModel
    period : float
        [s]
    kp, kd, ki : ndarray, shape (n,)

    Returns
    -------
    float
    """
    n = model.n_joints
    A, B = linear_plant(model, np.zeros(n), coulomb=False)
    size, half = len(A), len(A) // 2
    A[:, half : half + n] -= B * kd
    block = np.zeros((size + n, size + n))
    block[:size, :size], block[:size, size:] = A, B
    moved = expm(period * block)
    # The state, and the integral parts.
    loop = np.eye(size + n)
    loop[:size] = moved[:size]
    loop[:size, :n] -= moved[:size, size:] * kp
    loop[size:, :n] = -period * np.diag(ki)
    if not ki.any():
        loop = loop[:size, :size]
    return float(np.abs(np.linalg.eigvals(loop)).max())


def _numbers(name, values, n):
    """A field of a command as (n,) finite numbers; None where it is empty."""
    if values is None or not len(values):
        return None
    values = np.array(values, float)
    if values.shape != (n,):
        raise MessageError("values", field=name, value=values.size, limit=f"{n} joints")
    if not np.isfinite(values).all():
        raise MessageError("is not finite", field=name, value=values.tolist())
    return values
