# SPDX-License-Identifier: Apache-2.0
"""Makes one motion twice for the page, step by step: with the fast control and without it. No ROS."""

import numpy as np

#: Time for which the tip is watched after a motion's end, and minimum time before the next motion [s].
WATCHED, PAUSE = 4.0, 1.0
#: A motion is given up if it does not begin within this time, or still moves this long after the tip was watched [s].
PATIENCE = 10.0
WITH, WITHOUT = "with fast control", "without"


class Pair:
    """Moves to a target and back with the fast control, then without it, and keeps the tip's errors on the ways there.

    Parameters
    ----------
    link : object
        With ``move(target, duration)`` and ``enable_fast(on)``.
    home, target : (n,) array_like
        Joint angles [rad].
    duration : float
        Duration of each motion [s].

    Attributes
    ----------
    curves : dict
        `WITH` and `WITHOUT`: time since the motion began [s] and the tip's error [m], two arrays, when they are known.
    ended : str
        How it ended; empty while it goes on.
    """

    def __init__(self, link, home, target, duration):
        self._link, self._duration = link, float(duration)
        self._steps = [
            (True, target, WITH),
            (True, home, ""),
            (False, target, WITHOUT),
            (True, home, ""),
        ]
        self._began = None
        self._before, self._sent_at = None, 0.0
        self._rows = []
        self.curves, self.ended = {}, ""

    def turn(self, snapshot, error):
        """Evaluate a state, and do the next step.

        Parameters
        ----------
        snapshot : link.Snapshot
        error : float
            Distance of the tip from the rigid arm's at the reference [m].
        """
        if self.ended:
            return
        if snapshot.state in ("FAULT", "STOPPING", "INACTIVE"):
            self._end(f"given up, the controller is {snapshot.state}: {snapshot.reason}")
        elif self._before is None:
            self._send(snapshot)
        elif self._began is None:
            if snapshot.trajectory != self._before:
                self._began = snapshot.time
            elif snapshot.time > self._sent_at + PATIENCE:
                self._end(f"given up, the motion was not taken: {snapshot.reason}")
        else:
            self._watch(snapshot, error)

    def _send(self, snapshot):
        fast, target, _ = self._steps[0]
        self._link.enable_fast(fast)
        self._link.move(target, self._duration)
        self._before, self._sent_at, self._rows = snapshot.trajectory, snapshot.time, []

    def _watch(self, snapshot, error):
        after, name = snapshot.time - self._began, self._steps[0][2]
        self._rows.append((after, error))
        if after < self._duration + (WATCHED if name else PAUSE):
            return
        if snapshot.state != "HOLDING":
            if after > self._duration + WATCHED + PATIENCE:
                self._end("given up, the motion does not end")
            return
        if name:
            self.curves[name] = np.array(self._rows).T
        self._steps.pop(0)
        self._before = self._began = None
        if not self._steps:
            self._end(self._result())

    def _result(self):
        """Result of both, in words: the tip's peak-to-peak swing in the last second that was watched."""
        swings = []
        for name in (WITH, WITHOUT):
            time, error = self.curves[name]
            late = error[time > time[-1] - 1.0]
            swings.append(f"{1e3 * np.ptp(late):.3g} mm {name}")
        return (
            f"{self._duration + WATCHED:g} s after it began the tip's error changes by "
            + ", ".join(swings)
        )

    def _end(self, text):
        self._link.enable_fast(True)
        self.ended = text
