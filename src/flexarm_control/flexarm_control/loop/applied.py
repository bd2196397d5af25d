# SPDX-License-Identifier: Apache-2.0
"""Checks whether the driver applies the torque sent to it, by the torque and controller that it reports.

A driver may refuse, clip or replace the torque. The arm then takes its safe action, for example, while the reference
goes on. Two reports of the driver show this. The torque that it reports as applied must lie between the smallest and
the largest of the last `SENT` torques sent, within `torque_mismatch` times the torque limit; so the delay need not be
known. If the driver confirms its controller (``controller_id``), it must name this one. A contradiction that lasts
`PATIENCE` is a refusal.

A driver names a controller one sample before it applies that controller's torque. It may name this one for the first
time long after the first torque was sent, for example because DDS discovery was slow. Then the torque has to start
again, since the reference may be far away.
"""

import numpy as np

from flexarm_dynamics.parameters import parameter

from .. import kernels

#: The reported torque may be any of this many torques sent last.
SENT = 64
#: A contradiction that lasts this long is a refusal [s]. It is several times the driver's timeout, since a machine that
#: is busy for a moment does not refuse.
PATIENCE = 0.25

PARAMETERS = (
    parameter("torque_mismatch", 0.1, "-", 0.0, 10.0).described(
        "Largest difference between the torque sent and the torque that the driver reports as applied, as a fraction of"
        " the torque limit. A larger one for 0.25 s is a fault. 0.0: not compared."
    ),
)


class Applied:
    """Judges what the driver reports; see the module.

    Parameters
    ----------
    model : ArmModel
    settings : mapping
        Checked values of `PARAMETERS`.
    limit : ndarray, shape (n,)
        Torque limits [N m]; a joint without one is not compared.
    """

    def __init__(self, model, settings, limit):
        self._names, self._kernels = model.joint_names, kernels.compiled()
        self._sent = np.zeros((SENT, model.n_joints))
        self.configure(settings, limit)
        self.forget()
        self.begin(np.zeros(model.n_joints))

    def configure(self, settings, limit):
        """Take a new tolerance and new torque limits."""
        share = settings["torque_mismatch"]
        self._tolerance = np.where(np.isfinite(limit), share * limit, np.inf) if share else None

    def forget(self):
        """Forget whether the driver confirms controllers: it may be another driver."""
        self._confirms = False

    def begin(self, torque):
        """Begin with the first torque (n,) [N m] after an interruption."""
        self._sent[:] = torque
        self._at = 0
        self._other_for = self._wrong_for = self._unconfirmed_for = 0.0

    def note(self, torque):
        """Remember a torque (n,) [N m] that is sent."""
        self._at = (self._at + 1) % SENT
        self._sent[self._at] = torque

    def judge(self, sample, controller_id, dt):
        """Why the driver's report contradicts what this controller sends; empty if it does not.

        Parameters
        ----------
        sample : ArmSample
        controller_id : int
            Id of this controller; 0: unknown, not compared.
        dt : float
            Time since the last sample [s].
        """
        self._other_for = self._other_for + dt if self._is_other(sample, controller_id) else 0.0
        self._unconfirmed_for = 0.0 if self._confirms else self._unconfirmed_for + dt
        if self._other_for > PATIENCE:
            if sample.controller_id:
                return f"the driver applies the torque of another controller ({sample.controller_id}): stop it"
            return (
                "the driver applies no torque of this controller: its log and /diagnostics say why"
            )
        joint = self._mismatch(sample.torque)
        self._wrong_for = 0.0 if joint is None else self._wrong_for + dt
        if self._wrong_for > PATIENCE:
            reported, sent = sample.torque[joint], self._sent[self._at, joint]
            return (
                f"the driver reports {reported:.3g} N m at {self._names[joint]}, sent were {sent:.3g}:"
                " it does not apply the torque, or not as it reports"
            )
        return ""

    def _is_other(self, sample, controller_id):
        """Whether the driver reports another controller, or none."""
        if not controller_id:
            return False
        confirmed = sample.controller_id == controller_id
        self._confirms |= confirmed
        return not confirmed and (self._confirms or sample.controller_id != 0)

    def back_after(self, sample, controller_id):
        """How long the driver applied no torque of this controller [s], if this sample confirms it again; else 0."""
        if not controller_id or sample.controller_id != controller_id:
            return 0.0
        return max(self._other_for, self._unconfirmed_for)

    def _mismatch(self, reported):
        """The joint whose reported torque is none of those sent, or None; unknown torques are not judged."""
        tolerance, last = self._tolerance, self._sent[self._at]
        if tolerance is None or self._kernels.alike(reported, last, tolerance):
            return None
        low, high = self._sent.min(axis=0) - tolerance, self._sent.max(axis=0) + tolerance
        wrong = (reported < low) | (reported > high)  # false for NaN, which means unknown
        return int(np.argmax(wrong)) if wrong.any() else None
