# SPDX-License-Identifier: Apache-2.0
r"""PID feedback of each joint about the rigid arm's torque on the reference.

.. math::
    \bar u = B^{-1}(x_{ref})\,[\ddot q_{ref} - a(x_{ref})] + K_q e + K_{\dot q}\dot e + w, \qquad
    \dot w = K_w e, \quad |w| \le w_{max}, \qquad e = q_{ref} - q .

The feedback passes a low-pass filter (`flexarm_control.low_pass`).

The gains are diagonal, in torque per angle. `flexarm design` makes gains for this slow law, together with a constant
feedback of the deflections (`fast.type: fixed_gain`) on the manifold of the reference. Gains of (13) multiply the
inertia of the arm file. These do not, so a design for an uncertain arm does not change with the file's numbers. The
integral removes the error at rest that a payload, friction or weight beyond the file's would leave. On a motion that
the model explains e is zero, and so is w. w stops at its limit. While the torque is beyond the joint's limit,
w does not grow in that direction.

Friction holds a joint whose error is small. The integral moves it on only slowly, and a vibration whose torque is less
than the friction is not damped. So a fraction :math:`\gamma` of the arm file's Coulomb friction is added without the
low-pass filter, minus the friction of the motion, which :math:`\bar u` already contains:

.. math:: u_f = \gamma\,f_c\,[\tanh((\dot q + \lambda e)/v_0) - \tanh(\dot q_{ref}/v_0)] .

A joint that sticks beside its reference is pushed back as if it moved there at the speed :math:`\lambda e`. Without
that it creeps, and the integral grows until the joint breaks loose. With :math:`\gamma` below 1 some friction remains,
whatever the delay, so this torque alone moves no joint that is at its reference. But if the true friction is less than
:math:`\gamma` times the file's, small movements grow.

A light joint moves far before the torque answers, so little of its friction can be cancelled in this way. If the torque
depends on the error alone, the delay does not turn it against the joint, and nearly all friction can be overcome. So a
fraction :math:`\beta` of the friction, minus what is already cancelled, is added as for a joint that goes back from
where it sticks at the speed :math:`\lambda_\beta e`:

.. math:: u_b = \max(\beta - \gamma, 0)\,f_c
    \,[\tanh((\dot q_{ref} + \lambda_\beta e)/v_0) - \tanh(\dot q_{ref}/v_0)] .

The friction itself damps this loop: if the torque acts as a stiffness k at some amplitude and frequency :math:`\omega`,
the friction acts there as a damper of at least :math:`k/\omega`. Linear loops are judged without these two torques;
`flexarm design` also has loops of joints that stick, with both (`robust.loop`).

Where a joint sticks, these two torques hold it like a spring many times as stiff as :math:`K_q`. Then what a motion
leaves in the integral is removed only slowly, and the joint rests where this spring balances it. So where the torque on
a joint that stands opposes its integral, the integral shrinks as by the error for which :math:`K_q` gives this torque:

.. math:: \dot w = K_w\,(e + m/K_q) \;\text{ where } m w < 0, \qquad \dot m = \lambda_m (u_s - m), \qquad
    u_s = (u_f + u_b)\,[1 - \tanh^2(\dot q/v_0)] ,

and m alone takes it no further than zero. A joint that slides has no :math:`u_s`. Here m is a mean, and
:math:`\lambda_m` is the larger one of :math:`\lambda` and :math:`\lambda_\beta`. If links shake the joint, half of each
vibration opposes the integral. Without the mean, the integral would shrink below what the weight needs.

There may be several sets of gains, each designed for its own configuration (`flexarm_control.schedule`). w is a torque,
not an angle, so a change of K_w does not change w.
"""

import math
from contextlib import contextmanager

import numpy as np

from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import slow_torque

from ..arrays import some
from ..low_pass import BANDWIDTH, LowPass
from ..schedule import SCHEDULE, Schedule
from .base import SlowLaw

#: Parameters that are scheduled.
GAINS = ("stiffness", "damping", "integral")


class JointPid(SlowLaw):
    """PID of each joint about the model's torque; see the module.

    Attributes
    ----------
    integral : ndarray, shape (n,)
        w [N m].
    """

    separate = True

    PARAMETERS = (
        parameter("stiffness", [0.0], "N m/rad", 0.0, 1e9, length="joints*").described(
            "K_q of joint_pid: torque per joint error; one set for each configuration of the schedule, or one for all."
        ),
        parameter("damping", [0.0], "N m s/rad", -1e9, 1e9, length="joints*").described(
            "K_qd of joint_pid: torque per error of the joint's speed; sets as for stiffness."
        ),
        parameter("integral", [0.0], "N m/(rad s)", 0.0, 1e9, length="joints*").described(
            "K_w of joint_pid: torque per integrated joint error; 0.0: no integral; sets as for stiffness."
        ),
        parameter("integral_torque", [0.0], "N m", 0.0, 1e9, length="joints").described(
            "Largest torque of joint_pid's integral; 0.0: the torque limit."
        ),
        parameter("friction", [0.0], "-", 0.0, 1.0, length="joints").described(
            "Fraction of the arm file's Coulomb friction that joint_pid cancels where a joint moves differently from"
            " its motion; a joint with less friction than that fraction may hunt."
        ),
        parameter("return_rate", 0.0, "1/s", 0.0, 1e4).described(
            "For joint_pid's friction cancellation, a joint's error times this is added to its speed, so that a joint"
            " that sticks beside its reference is pushed back."
        ),
        parameter("breakaway", [0.0], "-", 0.0, 1.0, length="joints").described(
            "Fraction of the arm file's Coulomb friction, including what joint_pid cancels, that is overcome where a"
            " joint sticks beside its reference."
        ),
        parameter("breakaway_rate", 0.0, "1/s", 0.0, 1e4).described(
            "Speed per error at which a joint is assumed to go back from where it sticks, for breakaway."
        ),
        SCHEDULE,
        BANDWIDTH,
    )

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        n = model.n_joints
        self._schedule = Schedule(model, self.parameters["schedule"], "slow.schedule")
        sets = [self._schedule.sets(self.parameters[k], n, f"slow.{k}") for k in GAINS]
        self._sets, self._gains = np.hstack(sets), np.array([rows[0] for rows in sets])
        self._limit, most = model.arm.torque_limits, np.array(self.parameters["integral_torque"])
        self._most = np.where(most > 0.0, most, self._limit)
        self.integral, self._error, self._beyond = np.zeros(n), np.zeros(n), np.zeros(n)
        self._known = b"", np.zeros(n)
        self._low_pass = LowPass(n, self.parameters["bandwidth"])
        _, coulomb, self._smoothing = model.friction_table().T.copy()
        self._cancelled = np.array(self.parameters["friction"]) * coulomb
        self._overcome = np.maximum(
            np.array(self.parameters["breakaway"]) * coulomb - self._cancelled, 0.0
        )
        rates = self.parameters["return_rate"], self.parameters["breakaway_rate"]
        self._rates = np.array(rates)[:, None]
        self._cancels = some(self._cancelled) or some(self._overcome)
        self._slides, self._more = np.zeros((4, n)), np.zeros(n)
        self._pushed, self._mean = np.zeros(n), np.zeros(n)  # u_s and m

    @contextmanager
    def without_friction(self):
        cancels, self._cancels = self._cancels, False
        try:
            yield
        finally:
            self._cancels = cancels

    @property
    def stiffness(self):
        """K_q of the last sample, (n,) [N m/rad]."""
        return self._gains[0]

    @property
    def damping(self):
        """K_qd of the last sample, (n,) [N m s/rad]."""
        return self._gains[1]

    @property
    def gain(self):
        """K_w of the last sample, (n,) [N m/(rad s)]."""
        return self._gains[2]

    def reset(self):
        self._low_pass.reset()
        for state in (self.integral, self._error, self._beyond, self._pushed, self._mean):
            state[:] = 0.0

    def resume(self, other):
        if isinstance(other, JointPid):
            np.clip(other.integral, -self._most, self._most, out=self.integral)
            self.integral *= self.gain > 0.0
            self._low_pass.resume(other._low_pass)

    def advance(self, dt):
        self._low_pass.advance(dt)
        # Where the torque is beyond its limit, an error that pushes further is not integrated.
        grows = np.where(self._beyond * self._error > 0.0, 0.0, self._error)
        if self._cancels:
            self._shrink(dt)
        self.integral += dt * self.gain * grows
        np.clip(self.integral, -self._most, self._most, out=self.integral)

    def _shrink(self, dt):
        """Let the integral shrink, at most to zero, where the mean m of the friction torque u_s opposes it."""
        mean, step = self._mean, np.zeros_like(self._mean)
        mean += (1.0 - math.exp(-dt * self._rates.max())) * (self._pushed - mean)
        np.divide(dt * self.gain * mean, self.stiffness, out=step, where=self.stiffness > 0.0)
        opposes = step * self.integral < 0.0
        np.copyto(step, -self.integral, where=np.abs(step) > np.abs(self.integral))
        np.add(self.integral, step, out=self.integral, where=opposes)

    def torque(self, q, qd, reference, terms):
        return self._on(reference) + self.feedback(q, qd, reference)

    def feedback(self, q, qd, motion):
        self._schedule.blend(q, self._sets, self._gains.reshape(-1))
        stiffness, damping, _ = self._gains
        np.subtract(motion.position, q, out=self._error)
        u = stiffness * self._error
        u += damping * (motion.velocity - qd)
        u += self.integral
        u = self._low_pass(u)
        if self._cancels:
            u += self._friction(qd, motion.velocity)
        return u

    def _friction(self, qd, expected):
        """Friction torque u_f + u_b at joint speeds qd and the present error; the motion has the `expected` speeds.

        Speeds are (n,) [rad/s]; the result is (n,) [N m]. The part on joints that stand, u_s, is kept for the integral.
        """
        slides, more, pushed = self._slides, self._more, self._pushed
        np.multiply(self._rates, self._error, out=slides[:2])
        slides[0] += qd
        slides[1] += expected
        slides[2] = expected
        slides[3] = qd
        slides /= self._smoothing
        np.tanh(slides, out=slides)
        slides[:2] -= slides[2]
        np.multiply(self._cancelled, slides[0], out=more)
        slides[1] *= self._overcome
        more += slides[1]
        np.square(slides[3], out=pushed)
        np.subtract(1.0, pushed, out=pushed)
        pushed *= more
        return more

    def absorb(self, torque):
        before = self.integral.copy()
        self.integral += np.where(self.gain > 0.0, torque, 0.0)
        np.clip(self.integral, -self._most, self._most, out=self.integral)
        taken = self.integral - before
        self._low_pass.shift(taken)
        return taken

    def saw(self, torque):
        self._beyond[:] = np.sign(torque) * (np.abs(torque) > self._limit)

    def _on(self, reference):
        """The rigid arm's torque on the reference, shape (n,) [N m]; the last result is cached."""
        motion = reference.position, reference.velocity, reference.acceleration
        key = b"".join(x.tobytes() for x in motion)
        if key != self._known[0]:
            terms = self.model.terms(*motion[:2])
            self._known = key, np.array(slow_torque(terms, motion[2]))
        return self._known[1]
