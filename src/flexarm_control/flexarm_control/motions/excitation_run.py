# SPDX-License-Identifier: Apache-2.0
"""Excites an arm sample by sample: waits for rest, applies an `ExcitationTorque`, stops at a limit."""

from enum import Enum

import numpy as np

from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.parameters import parameter

from ..loop.samples import SampleOrder
from . import excitation_torque
from .excitation_torque import ExcitationTorque

LIMITS = (
    parameter("travel", 1.0, "rad", 0.001, 100.0).described(
        "The excitation stops when a joint is farther from its start; the arm file's limits apply too."
    ),
    parameter("strain_limit", 0.0, "-", 0.0, 0.1).described(
        "The excitation stops when a gauge reads more, without its bias; 0: four fifths of its full scale."
    ),
    parameter("hold_frequency", 0.2, "Hz", 0.0, 10.0).described(
        "Frequency of the soft, damped spring that keeps the joints near their start; 0: none. Keep it well"
        " below the first bending frequency."
    ),
    parameter("settle", 0.2, "s", 0.0, 60.0).described(
        "Time for which the arm must be at rest before the excitation begins."
    ),
)
PARAMETERS = (*excitation_torque.PARAMETERS, *LIMITS)
#: At rest a joint moves by at most this [rad] plus two encoder counts.
REST = 0.005
#: Default limit of a gauge's reading, as a fraction of its full scale [-].
FULL_SCALE_FRACTION = 0.8
#: Time constant of the filtered difference of joint angles, as a fraction of the spring's 1/omega [-].
FILTER = 0.1
#: Damping ratio of the spring.
DAMPING = 0.7


class Stage(Enum):
    """Stage of an excitation."""

    SETTLING = "waiting for rest"
    SHAKING = "shaking"
    DONE = "complete"
    STOPPED = "stopped"


class ExcitationRun:
    """One excitation; `step` for each sample.

    Parameters
    ----------
    model : ArmModel
    settings : mapping
        Values of `PARAMETERS`.

    Attributes
    ----------
    stage : Stage
    reason : str
        Why it was stopped; empty otherwise.
    torque : ndarray, shape (n,)
        Torque of the last sample [N m]; zero when not enabled.
    """

    def __init__(self, model, settings):
        self.model, arm = model, model.arm
        self.settings = dict(settings)
        names = {p.name for p in excitation_torque.PARAMETERS}
        self._shape = {k: v for k, v in self.settings.items() if k in names}
        # Impossible settings are refused before the arm moves.
        ExcitationTorque(model, self._shape)
        self.stage, self.reason = Stage.SETTLING, ""
        self.torque = np.zeros(model.n_joints)
        self._order, self._enabled = SampleOrder(), False
        self._limits, self._max_torque = arm.position_limits.T, arm.torque_limits
        self._bias = np.array([g.bias for g in arm.gauges])
        limit = self.settings["strain_limit"]
        self._strain = np.array([limit or FULL_SCALE_FRACTION * g.full_scale for g in arm.gauges])
        counts = np.array([j.encoder_counts or np.inf for j in arm.joints])
        self._rest = REST + 4.0 * np.pi / counts
        self._first = self._begin = self._before = None
        self._speed = np.zeros(model.n_joints)

    @property
    def duration(self):
        """Duration of the excitation [s]; until it begins, that for the straight arm."""
        if self._begin is None:
            return ExcitationTorque(self.model, self._shape).duration
        return self._push.duration

    def step(self, sample):
        """Take a sample; return whether to answer it with `torque`, enabled.

        Parameters
        ----------
        sample : ArmSample
        """
        judged = self._order.judge(sample)
        if judged == SampleOrder.REPEAT:
            return self._enabled
        if judged == SampleOrder.STALE:
            return False
        if judged == SampleOrder.RESTART and self._order.session is not None:
            self.stop("the source of arm_state was restarted")
        elif judged == SampleOrder.JUMP:
            self.stop("the clock of arm_state went back")
        elif judged == SampleOrder.FOREIGN:
            self.stop("two sources send arm_state: stop one of them")
        self._order.take(sample)
        if self.stage is Stage.SETTLING:
            self._settle(sample)
        self._enabled = self.stage is Stage.SHAKING and self._shake(sample)
        if not self._enabled:
            self.torque[:] = 0.0
        return self._enabled

    def stop(self, reason):
        """Stop the excitation, unless it has ended."""
        if self.stage in (Stage.SETTLING, Stage.SHAKING):
            self.stage, self.reason = Stage.STOPPED, reason
            self._enabled = False

    def _settle(self, sample):
        """Wait until the arm has been at rest for long enough; then plan the torque about its position."""
        if self._first is None:
            self._first = (sample.stamp_ns, sample.position.copy())
        moved = np.abs(sample.position - self._first[1])
        if self._beyond(sample, self._first[1]):
            return
        if (moved > self._rest).any():
            j = int(np.argmax(moved - self._rest))
            self.stop(
                f"{self.model.joint_names[j]} moved by {moved[j]:.3g} rad before the excitation: bring the arm to"
                " rest first"
            )
        elif sample.stamp_ns - self._first[0] >= 1e9 * self.settings["settle"]:
            try:
                self._push = ExcitationTorque(self.model, self._shape, sample.position)
            except FlexarmError as error:
                self.stop(str(error))
                return
            self._begin, self._start = sample.stamp_ns, sample.position.copy()
            self._before = (sample.stamp_ns, sample.position.copy())
            self.stage = Stage.SHAKING

    def _shake(self, sample):
        """Set the torque of this sample; return False at the end or at a limit."""
        time = 1e-9 * (sample.stamp_ns - self._begin)
        if time >= self._push.duration:
            self.stage = Stage.DONE
            return False
        if self._beyond(sample, self._start):
            return False
        self.torque[:] = self._push.torque(time)
        self._hold(sample)
        np.clip(self.torque, -self._max_torque, self._max_torque, out=self.torque)
        return True

    def _hold(self, sample):
        """Add the soft spring's torque."""
        omega = 2.0 * np.pi * self.settings["hold_frequency"]
        if omega == 0.0:
            return
        step = 1e-9 * (sample.stamp_ns - self._before[0])
        if sample.velocity_known:
            self._speed[:] = sample.velocity
        elif step > 0.0:
            gain = step / (step + FILTER / omega)
            self._speed += gain * ((sample.position - self._before[1]) / step - self._speed)
        self._before = (sample.stamp_ns, sample.position.copy())
        pull = omega**2 * (sample.position - self._start) + 2.0 * DAMPING * omega * self._speed
        self.torque -= self._push.inertia * pull

    def _beyond(self, sample, start):
        """Stop at a limit; return whether one is exceeded."""
        names, q = self.model.joint_names, sample.position
        if not np.isfinite(q).all():
            self.stop(f"the position of {names[int(np.argmin(np.isfinite(q)))]} is not finite")
            return True
        low, high = self._limits
        outside = np.maximum(
            np.maximum(low - q, q - high), np.abs(q - start) - self.settings["travel"]
        )
        if (outside > 0.0).any():
            j = int(np.argmax(outside))
            self.stop(
                f"{names[j]} came to {q[j]:.4g} rad, from {start[j]:.4g} rad: beyond travel"
                f" {self.settings['travel']:g} rad or the limits {low[j]:g} to {high[j]:g} rad; take less amplitude"
            )
            return True
        if sample.strain is None:
            return False
        strained = np.abs(sample.strain - self._bias)
        over = strained > self._strain
        if over.any():
            g = int(np.argmax(over))
            self.stop(
                f"strain of {self.model.arm.gauge_names[g]} came to {strained[g]:.3g}, beyond its limit"
                f" {self._strain[g]:.3g}; take a smaller amplitude"
            )
        return bool(over.any())
