# SPDX-License-Identifier: Apache-2.0
"""Gives the samples of a recording one after the other, and keeps what a controller sent for each. No ROS."""

import numpy as np

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies import tables


class Playback:
    """A recording being played.

    Parameters
    ----------
    recording : Recording
        In the arm's order.

    Attributes
    ----------
    next : int
        Sample that is played next.
    sent : ndarray, shape (s, n)
        Torque that a controller sent for each sample; NaN where it sent none, or none enabled [N m].
    """

    def __init__(self, recording):
        self.recording, self.next = recording, 0
        self.position, self.torque = recording.position, recording.torque
        self.velocity = _velocity(recording)
        known = np.isfinite(recording.strain).any()
        self.strain = recording.strain if known else None
        self.sent = np.full(recording.position.shape, np.nan)

    def __len__(self):
        return len(self.position)

    @property
    def over(self):
        """Whether the last sample has been played."""
        return self.next >= len(self)

    def take(self):
        """Return the number of the sample that is due; then the next one is due."""
        self.next += 1
        return self.next - 1

    def answer(self, number, torque):
        """Keep the `torque` (n,) that a controller sent for a sample, by its `number` [N m]; None: none enabled."""
        if torque is not None and 0 <= number < len(self):
            self.sent[number] = torque

    def summary(self):
        """What was played and answered, ready for JSON."""
        answered = np.isfinite(self.sent).all(axis=1)
        both = answered & np.isfinite(self.torque).all(axis=1)
        apart = self.sent[both] - self.torque[both]
        rms = np.sqrt(np.mean(apart**2, axis=0)).tolist() if both.any() else None
        return {
            "samples": len(self),
            "played": self.next,
            "answered": int(answered.sum()),
            "sent_less_measured_rms_Nm": rms,
        }

    def write(self, path, joint_names):
        """Write a CSV file: measured angle and torque of each joint, and the torque that was sent, by `joint_names`."""
        recording = self.recording
        names, columns = ["t"], [(recording.start + recording.time)[:, None]]
        for what, values in (
            ("position", self.position),
            ("torque", self.torque),
            ("torque_sent", self.sent),
        ):
            names += [f"{joint}_{what}" for joint in joint_names]
            columns.append(values)
        tables.write(names, np.hstack(columns), path)


def _velocity(recording):
    """Measured joint speeds, zero for joints that are held; None if one is unknown."""
    if recording.velocity is None:
        return None
    held = [name in recording.held for name in recording.joint_names]
    velocity = np.where(held, 0.0, recording.velocity) if held else recording.velocity
    return velocity if np.isfinite(velocity).all() else None


def part(recording, begin, duration):
    """The part of a recording that is played: from `begin` s after its start, for `duration` s or, if 0, to its end.

    Raises
    ------
    FlexarmError
        For a part that is not in the recording.
    """
    start, length = recording.start + begin, float(recording.time[-1])
    if begin >= length:
        limit = f"the recording lasts {length:g} s"
        raise FlexarmError("is beyond the end", field="begin", value=begin, limit=limit)
    if not begin and not duration:
        return recording
    return recording.between(start, start + duration if duration else np.inf)
