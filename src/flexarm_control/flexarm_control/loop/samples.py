# SPDX-License-Identifier: Apache-2.0
"""One sample of the arm as plain arrays, on which observers and controllers work, and the order of samples."""

from collections import deque

import numpy as np

from flexarm_dynamics.errors import MAX_MEASUREMENT, MessageError, check_finite

from .. import kernels


class ArmSample:
    """Measurements at one instant, in the arm file's order and SI units.

    Attributes
    ----------
    stamp_ns : int
        Time of measurement [ns].
    session, sequence : int
        Run of the source, and number of the sample in it.
    position, velocity, torque : ndarray, shape (n,)
        Joint position [rad], velocity [rad/s], torque applied until now [N m] (NaN: unknown).
    strain : ndarray, shape (gauges,) or None
        Surface strain [-].
    amplitude, rate : ndarray, shape (m,) or None
        Modal amplitudes [m, rad] and rates [m/s, rad/s]; None if not known.
    velocity_known : bool
        False if the source gave no joint velocity.
    controller_id : int
        Id of the controller whose answer to this state the driver applies; 0: none, or unknown.
    trust : int
        `TRUSTED`; `STOP`: only to be used to bring the arm to rest; `DISTRUSTED`: not to be used.
    doubt : str
        Which sensor is in doubt, and why; empty if none is.
    clock_stopped : bool
        Whether the source's clock stands still until an answer comes or the clock goes on; meanwhile the source sends
        the same sample again.
    """

    #: Values as in ArmState.
    TRUSTED, STOP, DISTRUSTED = range(3)

    __slots__ = (
        "amplitude",
        "clock_stopped",
        "controller_id",
        "doubt",
        "position",
        "rate",
        "sequence",
        "session",
        "stamp_ns",
        "strain",
        "torque",
        "trust",
        "velocity",
        "velocity_known",
    )

    def __init__(self, n_joints, n_modes=0, n_gauges=0):
        self.stamp_ns, self.session, self.sequence = 0, 0, 0
        self.position, self.velocity = np.zeros(n_joints), np.zeros(n_joints)
        self.torque = np.full(n_joints, np.nan)
        self.strain = np.zeros(n_gauges) if n_gauges else None
        self.amplitude = np.zeros(n_modes) if n_modes else None
        self.rate = None
        self.velocity_known = True
        self.controller_id, self.trust, self.doubt = 0, self.TRUSTED, ""
        self.clock_stopped = False

    @property
    def key(self):
        """(session, sequence): equal for a sample that was sent again."""
        return self.session, self.sequence

    def check(self, model):
        """Refuse values that are not finite, or too large for any arm; unknown values are not checked.

        Raises
        ------
        MessageError
        """
        none = self.position[:0]
        if kernels.compiled().below(
            MAX_MEASUREMENT,
            self.position,
            self.velocity if self.velocity_known else none,
            none if self.amplitude is None else self.amplitude,
            none if self.rate is None else self.rate,
        ):
            return
        joints, modes = model.joint_names, model.mode_names
        check_finite(self.position, joints, "joint_position")
        if self.velocity_known:
            check_finite(self.velocity, joints, "joint_velocity")
        if self.amplitude is not None:
            check_finite(self.amplitude, modes, "modal_amplitude")
        if self.rate is not None:
            check_finite(self.rate, modes, "modal_rate")


#: Sequence numbers on the topics are uint32.
WRAP = 2**32


#: The positions are predicted with the time by the numbers and by the stamps. The clock has jumped if the error of the
#: first is below this fraction of the error of the second [-].
JUMP_FITS = 0.25


def clock_jumped(moved, velocity, by_number, by_stamp):
    """Whether the clock jumped, rather than the source stood still, if a stamp is too late for its number.

    The positions show which of the two times has passed: the joints have moved by about velocity times that time.
    Joints at rest show neither; the result is then False.

    Parameters
    ----------
    moved, velocity : ndarray, shape (n,)
        Movement since the last sample [rad], and velocity [rad/s].
    by_number, by_stamp : float
        Time since the last sample, by the numbers of the samples and by their stamps [s].
    """
    short = np.abs(moved - by_number * velocity).max()
    return bool(short < JUMP_FITS * np.abs(moved - by_stamp * velocity).max())


class SampleOrder:
    """Compares each sample with the last one, by number and stamp, never by a clock.

    NEW: the next sample; REPEAT: the last one again; RESTART: of a session not seen before; STALE: an older one of this
    session; JUMP: a later number with a stamp that is not later, since the source's clock went back; FOREIGN: of a
    session that the present one replaced, so that two sources send.
    """

    NEW, REPEAT, RESTART, STALE, JUMP, FOREIGN = range(6)
    #: After this many FOREIGN or STALE samples in a row, the order continues from their session and number.
    ALONE = 200

    def __init__(self):
        self.session, self.sequence, self.stamp_ns = None, -1, 0
        self._left, self._other = deque(maxlen=16), 0

    def judge(self, sample):
        """Class of `sample`, compared with the last one taken."""
        if sample.session != self.session:
            return self._or_restart(self.FOREIGN) if sample.session in self._left else self.RESTART
        ahead = (sample.sequence - self.sequence) % WRAP  # a uint32 wraps after 50 days at 1 kHz
        if ahead >= WRAP // 2:
            return self._or_restart(self.STALE)
        self._other = 0
        if ahead == 0:
            return self.REPEAT
        return self.NEW if sample.stamp_ns > self.stamp_ns else self.JUMP

    def _or_restart(self, verdict):
        self._other += 1
        return verdict if self._other < self.ALONE else self.RESTART

    def two_sources(self, sample):
        """The error that refuses a FOREIGN `sample`."""
        sessions = f"sessions {self.session} and {sample.session}"
        return MessageError(f"two sources send states ({sessions})", hint="stop one of them")

    def take(self, sample):
        """Remember `sample` as the last one."""
        if sample.session != self.session and self.session is not None:
            self._left.append(self.session)
        self._other = 0
        self.session, self.sequence = sample.session, sample.sequence
        self.stamp_ns = sample.stamp_ns
