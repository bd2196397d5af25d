# SPDX-License-Identifier: Apache-2.0
"""Reads one recorded run column by column: the samples of a bag's topics on one time axis."""

from functools import cached_property

import numpy as np

from flexarm_dynamics.arm.strain_map import StrainMap
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model

from . import timeline

#: Names of the numbers in `CompositeState`, in order.
STATES = ("INACTIVE", "READY", "TRACKING", "HOLDING", "STOPPING", "FAULT")
INACTIVE, READY, TRACKING, HOLDING, STOPPING, FAULT = range(6)
ALL = slice(None)
#: A sample without an answer takes over the last answered sample's state, if that is not older than this [s].
HOLD = 0.5
#: Gaps in the amplitudes of up to this many samples are interpolated.
BRIDGED = 5
ENABLED = 1  # `JointTorque.ENABLED`


class Run:
    """The recording of one arm.

    Parameters
    ----------
    contents : Contents
        Of `bag.read`.
    label : str
        Its name on the page.

    Attributes
    ----------
    time : ndarray, shape (k,)
        Time of each sample [s]; see `start_at`.
    notes : list of str
    model : ArmModel or None
    """

    def __init__(self, contents, label):
        self.contents, self.label, self.notes = contents, label, list(contents.notes)
        self.arm, self.model = contents.arm, None
        if self.arm is not None:
            self.model = model.build(self.arm.known)
        self.base = "arm_state" if "arm_state" in contents.tables else "arm_state_estimate"
        table = contents.tables[self.base]
        self.timeline = timeline.arrange(table.stamp, table.session, table.sequence)
        self.time, self._rows = self.timeline.time, {}
        self._note()

    def _note(self):
        """Note what is missing."""
        missing = [t for t in ("arm_state", "joint_torque", "controller/state") if not self.has(t)]
        for topic in missing:
            without = {
                "arm_state": "measurements are taken from arm_state_estimate",
                "joint_torque": "it is unknown when torque was enabled",
                "controller/state": "no reference, no tracking error, no supervisor, no slow and fast torque",
            }
            self.notes.append(f"{topic} is not in the bag: {without[topic]}")
        if self.arm is None:
            self.notes.append(
                "the bag does not name its arm: give --arm for limits, predicted frequencies, deflections in mm and the"
                " animation"
            )
        for at, size in self.timeline.jumps[:5]:
            self.notes.append(
                f"the stamps jump by {size:+.4g} s at {self.time[at]:.3f} s while the sequence goes on"
            )
        if len(self.timeline.jumps) > 5:
            self.notes.append(f"… and {len(self.timeline.jumps) - 5} more times")
        if self.sessions > 1:
            self.notes.append(
                f"the source started {self.sessions} times: its sessions are drawn one after the other, without gaps"
            )

    # Contents ----------------------------------------------------------------------------------

    @property
    def joint_names(self):
        """Joint names in the order of the arm file."""
        return self.contents.names["joint_names"]

    @property
    def gauge_names(self):
        """Gauge names in the order of the arm file."""
        return self.contents.names["gauge_names"]

    @property
    def mode_names(self):
        """Mode names in the order of the arm file."""
        return self.contents.names["mode_names"]

    @property
    def sessions(self):
        """How often the source started."""
        return int(self.timeline.epoch.max()) + 1

    @property
    def period(self):
        """Time between two samples [s]; NaN for a single sample."""
        return self.timeline.period

    def has(self, topic, field=None):
        """Whether the bag has a topic, and some number in a field of it."""
        table = self.contents.tables.get(topic)
        return table is not None and (field is None or field in table.known)

    def start_at(self, index):
        """Put time zero at a sample."""
        self.time = self.timeline.time - self.timeline.time[index]

    # Columns -----------------------------------------------------------------------------------

    def column(self, topic, field, j=None, part=ALL):
        """Values of a field in each sample, NaN where the topic has none; None if there is no such field.

        Parameters
        ----------
        topic, field : str
        j : int, optional
            Which joint, gauge or mode: shape (k,); not given: all of them, shape (k, width).
        part : slice, optional
            Samples to take; all by default.
        """
        if not self.has(topic, field):
            return None
        values = self.contents.tables[topic].columns[field]
        values = values if j is None else values[:, j]
        rows = self._rows_of(topic)[part]
        out = np.full((rows.size, *values.shape[1:]), np.nan)
        out[rows >= 0] = values[rows[rows >= 0]]
        return out

    def _rows_of(self, topic):
        """Row of each sample in a topic's table, -1 for none."""
        if topic == self.base:
            return self.timeline.rows
        if topic not in self._rows:
            base, table = self.contents.tables[self.base], self.contents.tables[topic]
            wanted = timeline.keys(base.stamp, base.session, base.sequence)[self.timeline.rows]
            given = timeline.keys(table.stamp, table.session, table.sequence)
            self._rows[topic] = timeline.match(wanted, given)
        return self._rows[topic]

    @cached_property
    def state(self):
        """The supervisor's state in each sample, -1 where unknown, shape (k,) int8.

        A sample without an answer takes over the state before, for `HOLD` at most.
        """
        state = self.column("controller/state", "supervisor_state")
        if state is None:
            return np.full(self.time.size, -1, np.int8)
        last = self._last_answer
        return np.where(last >= 0, state[last], -1).astype(np.int8)

    @cached_property
    def reason(self):
        """Index into `contents.reasons` for each sample, -1 for none, shape (k,)."""
        table = self.contents.tables.get("controller/state")
        if table is None:
            return np.full(self.time.size, -1)
        rows, last = self._rows_of("controller/state"), self._last_answer
        return np.where(last >= 0, table.reason[rows[last]], -1)

    @cached_property
    def _last_answer(self):
        """For each sample, the last one so far that has a `controller/state`; -1 if it is too long ago; shape (k,)."""
        here = np.arange(self.time.size)
        known = self._rows_of("controller/state") >= 0
        last = np.maximum.accumulate(np.where(known, here, -1))
        epoch, time = self.timeline.epoch, self.timeline.time
        fresh = (last >= 0) & (epoch[last] == epoch) & (time - time[last] <= HOLD)
        return np.where(fresh, last, -1)

    @property
    def unanswered(self):
        """Samples without a torque between the first and the last that has one; None without the topic."""
        if not self.has("joint_torque"):
            return None
        answered = np.flatnonzero(self._rows_of("joint_torque") >= 0)
        if not answered.size:
            return None
        return int(answered[-1] - answered[0] + 1 - answered.size)

    def position(self, j, part=ALL):
        """Measured joint angle [rad]."""
        return self.column(self.base, "joint_position", j, part)

    def reference(self, j, part=ALL):
        """Reference joint angle [rad]; None if there is no reference."""
        values = self.column("controller/state", "reference_position", j, part)
        if values is None:
            return None
        state = self.state[part]
        return np.where((state >= READY) & (state <= STOPPING), values, np.nan)

    def error(self, j, part=ALL):
        """Reference minus measurement [rad]; None without a reference."""
        reference = self.reference(j, part)
        return None if reference is None else reference - self.position(j, part)

    @cached_property
    def amplitude_source(self):
        """Source of the modal amplitudes: a topic, ``strain``, or an empty string."""
        for topic in ("arm_state_estimate", "arm_state"):
            if self.has(topic, "modal_amplitude"):
                return topic
        return "strain" if self._strain_map is not None else ""

    @cached_property
    def _strain_map(self):
        """The arm file's map from strains to amplitudes; None without one."""
        if self.model is None or not self.arm.gauges or not self.has(self.base, "strain"):
            return None
        try:
            return StrainMap(self.model)
        except FlexarmError as error:
            self.notes.append(f"strains can't be mapped to amplitudes: {error}")
            return None

    def amplitude(self, j, part=ALL):
        """Amplitude of a mode, from the observer if possible [m, rad]; None without a source."""
        if not self.amplitude_source:
            return None
        if self.amplitude_source == "strain":
            return self._mapped(part)[:, j]
        return self.column(self.amplitude_source, "modal_amplitude", j, part)

    def _mapped(self, part):
        """Amplitudes mapped from the strains, shape (part, modes)."""
        strain_map, strain = self._strain_map, self.column(self.base, "strain", part=part)
        mapped = (strain - strain_map.bias) @ strain_map.inverse.T
        out = np.full((len(mapped), len(self.mode_names)), np.nan)
        for i, name in enumerate(strain_map.mode_names):
            out[:, self.mode_names.index(name)] = mapped[:, i]
        return out

    def deflections(self, part=ALL):
        """Amplitudes of all modes, shape (part, m): 0 for a mode without a source, NaN where a sample lacks it.

        Gaps of at most `BRIDGED` samples are interpolated.
        """
        size, count = self.time[part].size, len(self.mode_names)
        out = np.zeros((size, count))
        for j in np.flatnonzero(self._known_modes):
            out[:, j] = bridged(self.amplitude(j, part), BRIDGED)
        return out

    @cached_property
    def _known_modes(self):
        """Modes that have a source, shape (m,) bool."""
        if not self.amplitude_source:
            return np.zeros(len(self.mode_names), bool)
        if self.amplitude_source == "strain":
            return np.isin(self.mode_names, self._strain_map.mode_names)
        columns = self.contents.tables[self.amplitude_source].columns["modal_amplitude"]
        return np.array([np.isfinite(columns[:, j]).any() for j in range(columns.shape[1])])

    @property
    def bent_known(self):
        """Samples whose deflections are known, shape (k,) bool."""
        known = np.ones(self.time.size, bool)
        for j in np.flatnonzero(self._known_modes):  # no table of all samples in memory
            known &= np.isfinite(bridged(self.amplitude(j), BRIDGED))
        return known

    def positions(self, part=ALL):
        """Joint angles, shape (part, n) [rad]."""
        return self.column(self.base, "joint_position", part=part)

    def references(self, part=ALL):
        """Reference angles, shape (part, n) [rad]; None without a reference."""
        if not self.has("controller/state", "reference_position"):
            return None
        return np.column_stack([self.reference(j, part) for j in range(len(self.joint_names))])


def bridged(values, most):
    """A series in which gaps of at most `most` samples are interpolated linearly, shape (k,)."""
    holes = np.isnan(values)
    if not holes.any() or holes.all():
        return values
    here, known = np.arange(values.size), np.flatnonzero(~holes)
    starts, ends = timeline.stretches(holes)
    short = (ends - starts <= most) & (starts > 0) & (ends < values.size)
    inside = np.zeros(values.size + 1, int)
    np.add.at(inside, starts[short], 1)
    np.add.at(inside, ends[short], -1)
    fill = np.cumsum(inside)[:-1] > 0
    out = values.copy()
    out[fill] = np.interp(here[fill], known, values[known])
    return out
