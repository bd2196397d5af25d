# SPDX-License-Identifier: Apache-2.0
r"""Stiffness, damping and integral of each joint about the rigid arm's torque on the reference.

.. math::
    \bar u = B^{-1}(x_{ref})\,[\ddot q_{ref} - a(x_{ref})] + K_q e + K_{\dot q}\dot e + w, \qquad
    \dot w = K_w e, \quad |w| \le w_{max}, \qquad e = q_{ref} - q,

what is fed back passing a low pass (`flexarm_control.low_pass`),

with diagonal gains in torque per angle: the slow law that `flexarm design` makes gains for, together with a constant
feedback of the deflections (`fast.type: fixed_gain`) on the manifold of the reference. Gains of (13) multiply the
inertia of the arm file; these do not, so that what is designed for an uncertain arm does not change with what the
file says. The integral leaves no error at rest under a payload, friction or weight that the file does not have. On a
motion that the model explains e is zero, and so is w. w stops at its limit, and does not grow while the torque is
beyond the joint's.

Friction holds a joint where its error is small: the integral moves it on slowly, and a vibration whose torque is less
than the friction is not damped. So a part :math:`\gamma` of the arm file's Coulomb friction, less that of the motion,
which :math:`\bar u` has, is added without the low pass:

.. math:: u_f = \gamma\,f_c\,[\tanh((\dot q + \lambda e)/v_s) - \tanh(\dot q_{ref}/v_s)] .

A joint that sticks beside its place is pushed back as if it moved there at the speed :math:`\lambda e`: without that it
creeps, and the integral grows until it breaks loose. With :math:`\gamma` below 1 friction is left over, whatever the
delay: by itself this moves no joint whose place is where it is. In turn, where the friction is less than :math:`\gamma`
of the file's, small movements grow.

Of a light joint that moves far until the torque answers, little can be cancelled so. Where its error alone decides, the
delay does not turn the torque against it, and nearly all friction can be overcome. So a part :math:`\beta` of the
friction, less what is cancelled already, is added as for a joint that goes back at the speed :math:`\lambda_\beta e`
from where it sticks,

.. math:: u_b = \max(\beta - \gamma, 0)\,f_c
    \,[\tanh((\dot q_{ref} + \lambda_\beta e)/v_s) - \tanh(\dot q_{ref}/v_s)] ,

which the friction itself damps: at an amplitude and frequency at which it is a stiffness k, the friction is a damper of
at least :math:`k/\omega`. Linear loops are judged without these torques; `flexarm design` has loops of joints that
stick, with both (`robust.loop`).

The gains may be several sets, each made for a configuration of its own (`flexarm_control.schedule`). w is a torque, not
an angle: a change of K_w does not move it.
"""

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
            "K_q of joint_pid: torque per joint error; a set for each configuration of the schedule, or one for all."
        ),
        parameter("damping", [0.0], "N m s/rad", -1e9, 1e9, length="joints*").described(
            "K_qd of joint_pid: torque per error of the joint's speed; sets as of stiffness."
        ),
        parameter("integral", [0.0], "N m/(rad s)", 0.0, 1e9, length="joints*").described(
            "K_w of joint_pid: torque per integrated joint error; 0.0: none; sets as of stiffness."
        ),
        parameter("integral_torque", [0.0], "N m", 0.0, 1e9, length="joints").described(
            "Largest torque of joint_pid's integral; 0.0: the torque limit."
        ),
        parameter("friction", [0.0], "-", 0.0, 1.0, length="joints").described(
            "Part of the arm file's Coulomb friction that joint_pid cancels where a joint moves otherwise than its"
            " motion; a joint with less friction than that part may hunt."
        ),
        parameter("return_rate", 0.0, "1/s", 0.0, 1e4).described(
            "Where joint_pid cancels friction, a joint's speed counts as greater by its error times this: one that"
            " sticks beside its place is pushed back."
        ),
        parameter("breakaway", [0.0], "-", 0.0, 1.0, length="joints").described(
            "Part of the arm file's Coulomb friction, with what joint_pid cancels of it, that is overcome where a joint"
            " sticks beside its place."
        ),
        parameter("breakaway_rate", 0.0, "1/s", 0.0, 1e4).described(
            "Speed over error at which a joint goes back from where it sticks, with breakaway."
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
        self._slides, self._more = np.zeros((3, n)), np.zeros(n)

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
        for state in (self.integral, self._error, self._beyond):
            state[:] = 0.0

    def resume(self, other):
        if isinstance(other, JointPid):
            np.clip(other.integral, -self._most, self._most, out=self.integral)
            self.integral *= self.gain > 0.0
            self._low_pass.resume(other._low_pass)

    def advance(self, dt):
        self._low_pass.advance(dt)
        # Where the torque is at its limit, an error that pushes farther has nothing to gain.
        grows = np.where(self._beyond * self._error > 0.0, 0.0, self._error)
        self.integral += dt * self.gain * grows
        np.clip(self.integral, -self._most, self._most, out=self.integral)

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
        """What is cancelled of the friction at joint speeds qd and the present error, beyond that of `expected` speeds.

        All are (n,), in rad/s; what is returned is in N m.
        """
        slides, more = self._slides, self._more
        np.multiply(self._rates, self._error, out=slides[:2])
        slides[0] += qd
        slides[1] += expected
        slides[2] = expected
        slides /= self._smoothing
        np.tanh(slides, out=slides)
        slides[:2] -= slides[2]
        np.multiply(self._cancelled, slides[0], out=more)
        slides[1] *= self._overcome
        more += slides[1]
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
        """The rigid arm's torque on the reference, shape (n,) [N m]; what was asked for last is remembered."""
        motion = reference.position, reference.velocity, reference.acceleration
        key = b"".join(x.tobytes() for x in motion)
        if key != self._known[0]:
            terms = self.model.terms(*motion[:2])
            self._known = key, np.array(slow_torque(terms, motion[2]))
        return self._known[1]
