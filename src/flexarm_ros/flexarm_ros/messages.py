# SPDX-License-Identifier: Apache-2.0
"""Converts messages to arrays and back, without unnecessary copies.

Numbers are cast here: a Python int or numpy scalar assigned to a float64 field is published as garbage.
"""

import os
import struct
from array import array

import numpy as np

from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.shown import listed
from flexarm_msgs.msg import ArmState, CompositeState, JointTorque, ObserverState

from .cdr import Fields

SECOND = 1_000_000_000


def stamp_ns(stamp):
    """Nanoseconds of a builtin_interfaces/Time or Duration."""
    return stamp.sec * SECOND + stamp.nanosec


def set_stamp(stamp, ns):
    """Write nanoseconds into a builtin_interfaces/Time."""
    stamp.sec, stamp.nanosec = divmod(ns, SECOND)


class _Columns:
    """Names and values of one group of arrays, in the arm's order whatever the order of the sender."""

    def __init__(self, field, names):
        self.field, self.names = field, list(names)
        self._order = None
        self._seen = self.names

    def order(self, names):
        """None if `names` are in the arm's order, otherwise an index array."""
        if names == self._seen:
            return self._order
        if sorted(names) != sorted(self.names):
            missing = [n for n in self.names if n not in names]
            unknown = [n for n in names if n not in self.names]
            wrong = [f"missing {listed(missing)}"] if missing else []
            wrong += [f"unknown {listed(unknown)}"] if unknown else []
            raise MessageError(
                f"are not this arm's: {'; '.join(wrong) or 'a name twice'}",
                field=self.field,
                value=list(names),
                limit=listed(self.names),
            )
        self._seen = list(names)
        self._order = (
            None if names == self.names else np.array([names.index(n) for n in self.names])
        )
        return self._order

    @property
    def present(self):
        """Index array of the last names; None if they are in the arm's order."""
        return self._order

    def read(self, field, values, order, out):
        """Copy one array into `out`; an empty one gives False."""
        size = len(values)
        if size == 0:
            return False
        if size != len(self.names):
            limit = f"{len(self.names)} names in {self.field}"
            raise MessageError("values", field=field, value=size, limit=limit)
        values = np.asarray(values)
        out[:] = values if order is None else values[order]
        return True

    def optional(self, names, field, values, out):
        """`out` with the values of an array copied into it; None for an empty one, whose names don't count."""
        if len(values) == 0:
            return None
        self.read(field, values, self.order(names), out)
        return out


class StateReader:
    """Reads `ArmState` messages into an `ArmSample`, in the order of an `arm`'s names."""

    def __init__(self, arm):
        self._joints = _Columns("joint_names", arm.joint_names)
        self._gauges = _Columns("gauge_names", arm.gauge_names)
        self._modes = _Columns("mode_names", arm.observed_modes)
        self._strain = np.zeros(len(arm.gauges))
        self._amplitude = np.zeros(len(arm.observed_modes))
        self._rate = np.zeros(len(arm.observed_modes))
        # Layout of the last message that was read name by name, and where its numbers go.
        self._layout, self._copies = None, ()

    def read(self, msg, sample):
        """Fill `sample`; its stamp, session and sequence are filled even if the rest is refused.

        Raises
        ------
        MessageError
            For names or lengths that are not this arm's, nanoseconds of a second and more, or an unknown trust.
        """
        stamp = msg.header.stamp
        # The answer to a refused message carries the same stamp, so a message must be able to hold it.
        sample.stamp_ns = stamp.sec * SECOND + min(stamp.nanosec, SECOND - 1)
        sample.session, sample.sequence = msg.session, msg.sequence
        sample.controller_id, sample.doubt = msg.controller_id, msg.doubt
        sample.clock_stopped = msg.clock_stopped
        if msg.trust > ArmState.DISTRUSTED:
            limit = "TRUSTED (0), STOP (1) or DISTRUSTED (2)"
            raise MessageError("is no degree of trust", field="trust", value=msg.trust, limit=limit)
        sample.trust = msg.trust
        if stamp.nanosec >= SECOND:
            raise MessageError(
                "is no part of a second",
                field="header.stamp.nanosec",
                value=stamp.nanosec,
                limit=f"below {SECOND}",
            )
        layout = msg.layout if type(msg) is Fields else None
        if layout is not None and layout is self._layout:
            self._copy(msg.doubles, sample)
            return
        self._layout = None
        self._read_arrays(msg, sample)
        if layout is not None:
            self._layout, self._copies = layout, self._planned(layout)

    def _read_arrays(self, msg, sample):
        """Fill the arrays of a sample, with a check of all names and lengths."""
        joints = self._joints
        order = joints.order(msg.joint_names)
        if not joints.read("joint_position", msg.joint_position, order, sample.position):
            raise MessageError("is empty", field="joint_position")
        sample.velocity_known = joints.read(
            "joint_velocity", msg.joint_velocity, order, sample.velocity
        )
        if not joints.read("joint_torque", msg.joint_torque, order, sample.torque):
            sample.torque[:] = np.nan
        sample.strain = self._gauges.optional(msg.gauge_names, "strain", msg.strain, self._strain)
        modes, names = self._modes, msg.mode_names
        sample.amplitude = modes.optional(
            names, "modal_amplitude", msg.modal_amplitude, self._amplitude
        )
        sample.rate = modes.optional(names, "modal_rate", msg.modal_rate, self._rate)

    def _planned(self, layout):
        """What `_copy` needs for a message of this layout, the names of which have just been read."""
        arrays = {
            "joint_position": self._joints,
            "joint_velocity": self._joints,
            "joint_torque": self._joints,
            "strain": self._gauges,
            "modal_amplitude": self._modes,
            "modal_rate": self._modes,
        }
        places, ends, at = [], [], 0
        for name, columns in arrays.items():
            place = np.arange(layout.arrays[name].start, layout.arrays[name].stop)
            order = columns.present if place.size else None
            places.append(place if order is None else place[order])
            ends.append(slice(at, at := at + place.size) if place.size else None)
        flat = np.zeros(at)
        return np.concatenate(places), flat, [None if e is None else flat[e] for e in ends]

    def _copy(self, doubles, sample):
        """As `_read_arrays`, from the numbers of a message with the same layout as the last one."""
        places, flat, (position, velocity, torque, strain, amplitude, rate) = self._copies
        doubles.take(places, out=flat, mode="clip")
        sample.position[:] = position
        sample.velocity_known = velocity is not None
        if velocity is not None:
            sample.velocity[:] = velocity
        sample.torque[:] = np.nan if torque is None else torque
        sample.strain, sample.amplitude, sample.rate = strain, amplitude, rate


def _floats(msg, field, size):
    """Size an array field and return a view of it to write into.

    The view shows the message's own array, which the setter makes. After another assignment to the field, the view
    would show the old array.
    """
    setattr(msg, field, array("d", bytes(8 * size)))
    return np.frombuffer(getattr(msg, field)) if size else np.zeros(0)


class StateWriter:
    """An `ArmState` message whose arrays are written in place."""

    def __init__(self, arm):
        self.message = msg = ArmState()
        msg.header.frame_id = "base_link"
        msg.joint_names = list(arm.joint_names)
        msg.gauge_names = list(arm.gauge_names)
        msg.mode_names = list(arm.observed_modes)
        self._views = {}

    def head(self, stamp, session, sequence, controller_id=0):
        """Write stamp [ns], session, sequence, and the id of the controller whose torque acts."""
        msg = self.message
        set_stamp(msg.header.stamp, stamp)
        msg.session, msg.sequence, msg.controller_id = session, sequence, controller_id

    def trust(self, trust, doubt):
        """Write whether the state may be trusted, `ArmState.TRUSTED` and so on, and which sensor is in doubt."""
        self.message.trust, self.message.doubt = trust, doubt

    def write(self, field, values):
        """Write an array field; None leaves it empty: not known."""
        size = 0 if values is None else len(values)
        view = self._views.get(field)
        if view is None or view.size != size:
            view = self._views[field] = _floats(self.message, field, size)
        if size:
            view[:] = values


class TorqueWriter:
    """A `JointTorque` message whose torque is written in place.

    Parameters
    ----------
    arm : Arm
    controller_id : int, optional
        Tells two controllers of one arm apart; never 0. If not given, it is random at each start.
    """

    def __init__(self, arm, controller_id=None):
        if controller_id is None:
            controller_id = int.from_bytes(os.urandom(4), "little") or 1
        self.message = msg = JointTorque()
        msg.joint_names = list(arm.joint_names)
        msg.controller_id = controller_id
        self.torque = _floats(msg, "torque", len(arm.joints))

    def answer(self, sample, enabled, torque):
        """Fill in the answer to a sample; a disabled one carries zeros."""
        msg = self.message
        set_stamp(msg.header.stamp, sample.stamp_ns)
        msg.session, msg.sequence = sample.session, sample.sequence
        msg.mode = JointTorque.ENABLED if enabled else JointTorque.DISABLED
        self.torque[:] = torque if enabled else 0.0
        return msg


class TorqueReader:
    """Reads `JointTorque` messages for an `arm`."""

    #: A value beyond this can't be a torque [N m].
    HUGE = 1e9

    def __init__(self, arm):
        self._joints = _Columns("joint_names", arm.joint_names)
        self._torque = np.zeros(len(arm.joints))

    def read(self, msg):
        """The torques (n,) [N m], or None if the message has the mode DISABLED.

        Raises
        ------
        MessageError
            For wrong names or lengths, an unknown mode, or values that are not finite.
        """
        if msg.mode == JointTorque.DISABLED:
            return None
        if msg.mode != JointTorque.ENABLED:
            limit = "DISABLED (0) or ENABLED (1)"
            raise MessageError("is no mode", field="mode", value=msg.mode, limit=limit)
        if not self._joints.read(
            "torque", msg.torque, self._joints.order(msg.joint_names), self._torque
        ):
            raise MessageError("is empty", field="torque")
        torque = self._torque
        if torque.dot(torque) < self.HUGE:  # a quick check, true for nearly all torques
            return torque
        if not np.abs(torque).max() < self.HUGE:
            i = int(np.argmin(np.abs(self._torque) < self.HUGE))
            raise MessageError(
                "N m is no torque",
                field=f"torque of {self._joints.names[i]}",
                value=float(self._torque[i]),
                limit=f"finite, below {self.HUGE:g}",
            )
        return self._torque


class CompositeStateWriter:
    """A `CompositeState` message for an `ArmController`."""

    def __init__(self, model):
        self.message = msg = CompositeState()
        msg.joint_names, msg.mode_names = list(model.joint_names), list(model.mode_names)
        n, m = model.n_joints, model.n_modes
        self._arrays = {
            name: _floats(msg, name, size)
            for name, size in (
                ("reference_position", n),
                ("reference_velocity", n),
                ("reference_acceleration", n),
                ("position_error", n),
                ("velocity_error", n),
                ("slow_torque", n),
                ("fast_torque", n),
                ("torque", n),
                ("quasi_steady_amplitude", m),
                ("fast_deviation", 2 * m),
            )
        }

    def fill(self, sample, controller, compute_time, parameters_set=""):
        """Copy the controller's values; `compute_time` in seconds, `parameters_set` as `Designs.last_change`."""
        msg, a = self.message, self._arrays
        set_stamp(msg.header.stamp, sample.stamp_ns)
        msg.session, msg.sequence = sample.session, sample.sequence
        msg.supervisor_state = int(controller.state)
        for name, values in controller.view().items():
            a[name][:] = values
        msg.saturated = controller.saturated
        msg.rejected_reason = controller.reason
        msg.accepted_trajectory_id = controller.trajectory_id
        msg.judged_trajectory, msg.judged_reason = controller.judged
        msg.compute_time = float(compute_time)
        msg.parameters_set = parameters_set
        return msg


class ObserverStateWriter:
    """An `ObserverState` message."""

    def __init__(self, arm):
        self.message = msg = ObserverState()
        msg.mode_names, msg.gauge_names = list(arm.observed_modes), list(arm.gauge_names)

    def fill(self, sample, name, observer, strain, health=None):
        """Copy the observer's values; without `health` (gauges,), every finite gauge is good."""
        msg = self.message
        set_stamp(msg.header.stamp, sample.stamp_ns)
        msg.session, msg.sequence = sample.session, sample.sequence
        msg.observer = name
        msg.innovation = array("d", observer.innovation)
        msg.covariance_diagonal = array("d", observer.covariance_diagonal)
        if strain is None:
            health = [ObserverState.GAUGE_MISSING] * len(msg.gauge_names)
        elif health is None:
            good, missing = ObserverState.GAUGE_GOOD, ObserverState.GAUGE_MISSING
            health = np.where(np.isfinite(strain), good, missing).tolist()
        msg.gauge_health = array("B", health)
        msg.converged = observer.converged
        return msg


#: Longest name of a trajectory that `controller/state` repeats, in bytes.
MAX_NAME = 64


def trajectory_name(raw):
    """`header.frame_id` of a serialised `JointTrajectory`, at most `MAX_NAME` bytes; empty if unreadable."""
    try:
        (length,) = struct.unpack_from("<I" if raw[1] & 1 else ">I", raw, 4 + 8)
    except (struct.error, IndexError):
        return ""
    name = bytes(raw[16 : 16 + min(max(length - 1, 0), MAX_NAME)])
    return name.decode(errors="ignore").replace("\0", "")


def trajectory_points(raw):
    """Number of points of a serialised `JointTrajectory`, without reading them.

    `raw` is XCDR1 with its encapsulation header: the stamp, frame_id, joint_names, the number of points.

    Raises
    ------
    struct.error, IndexError
        If the bytes end before this number.
    """
    unpack = struct.Struct("<I" if raw[1] & 1 else ">I").unpack_from

    def number(at):
        """The first aligned uint32 from an offset on, and the offset after it."""
        at += -at % 4
        return unpack(raw, at)[0], at + 4

    length, at = number(4 + 8)
    names, at = number(at + length)
    for _ in range(names):
        length, at = number(at)
        at += length
    return number(at)[0]
