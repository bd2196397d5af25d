# SPDX-License-Identifier: Apache-2.0
"""Shapes streams of set points, such as those of MoveIt Servo, sample by sample.

The shaper is the same as for trajectories (`shaped_motion`), used as a filter. Each output is the weighted sum of
inputs a constant phase of the mode earlier, joined by lines. Outputs are between the largest and the smallest input.
"""

from bisect import bisect_right

import numpy as np

from flexarm_dynamics.errors import MessageError


class _Filter:
    """One stage: a memory of inputs over the phase of its mode."""

    def __init__(self, stage):
        self._cycles, self._amplitudes = stage.cycles, stage.amplitudes
        self.mode = stage.mode

    def reset(self, value):
        self._phases, self._values = [0.0], [value]

    def step(self, advance, value):
        """The output for an input (n,) that comes `advance` periods after the previous one."""
        now = self._phases[-1] + advance
        self._phases.append(now)
        self._values.append(value)
        drop = bisect_right(self._phases, now - self._cycles[-1]) - 1
        if drop > 0:
            del self._phases[:drop], self._values[:drop]
        delayed = zip(self._cycles, self._amplitudes, strict=True)
        return sum(amplitude * self._at(now - cycle) for cycle, amplitude in delayed)

    def _at(self, phase):
        i = bisect_right(self._phases, phase)
        if i == 0:
            return self._values[0]
        if i == len(self._phases):
            return self._values[-1]
        before, after = self._phases[i - 1], self._phases[i]
        x = (phase - before) / (after - before)
        return (1.0 - x) * self._values[i - 1] + x * self._values[i]


class StreamShaper:
    """Shapes a stream of positions or velocities of n joints.

    Parameters
    ----------
    modes : Modes
    joint_names : sequence of str

    Attributes
    ----------
    started : bool
        Whether it has had a first value.
    output : (n,) ndarray
        The last shaped value, once started.
    """

    def __init__(self, modes, joint_names):
        self._modes, self._names = modes, tuple(joint_names)
        self._filters = [_Filter(stage) for stage in modes.stages]
        self.started, self._settling = False, 0.0

    def check(self, values):
        """An input as (n,) finite floats.

        Raises
        ------
        MessageError
            If there is not one finite number for each joint in `values`.
        """
        found = np.array(values, float)
        if found.shape != (len(self._names),):
            limit = f"{len(self._names)} joints"
            raise MessageError("values", field="data", value=found.size, limit=limit)
        bad = np.flatnonzero(~np.isfinite(found))
        if bad.size:
            where = f"data of joint {self._names[bad[0]]}"
            raise MessageError("is not finite", field=where, value=float(found[bad[0]]))
        return found

    def begin(self, value):
        """Start at a value (n,), as if it had always been there."""
        value = np.array(value, float)
        for each in self._filters:
            each.reset(value)
        self.started, self._last, self.output, self._settling = True, value, value, 0.0
        return value

    def settled(self):
        """Whether the output has reached the last input."""
        return self._settling <= 0.0

    def steps_to(self, value):
        """Whether an input (n,) differs from the last one."""
        return not np.array_equal(value, self._last)

    def step(self, value, period, configuration=None):
        """Return the shaped value for an input.

        Parameters
        ----------
        value : (n,) ndarray
            Checked input.
        period : float
            Time since the previous input, above 0 [s].
        configuration : (n,) array_like, optional
            Joint positions, for a stream of velocities [rad]; if not given, the last output.
        """
        if not self.started:
            return self.begin(value)
        self._settling = (
            self._modes.max_duration if self.steps_to(value) else self._settling - period
        )
        self._last = value
        if self._modes.varies:
            where = self.output if configuration is None else configuration
            frequencies = self._modes.at(np.asarray(where, float)[None])[0]
        else:
            frequencies = self._modes.mean_frequencies
        for each in self._filters:
            value = each.step(period * frequencies[each.mode], value)
        self.output = value
        return value
