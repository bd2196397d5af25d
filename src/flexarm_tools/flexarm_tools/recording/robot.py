# SPDX-License-Identifier: Apache-2.0
"""Reads topics of any robot: `sensor_msgs/JointState` and `sensor_msgs/Imu`, and strains of `ArmState`. No ROS."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.recordings import streams

from .bag import KINDS, Source, bag_path
from .serialised import Decoder

JOINTS, IMU = "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu"
STATE = KINDS["arm_state"]
#: Fields with numbers after the joint names in a message, to what they are.
_FIELDS = {"position": "position", "velocity": "velocity", "effort": "torque"}


def kinds(path):
    """The types of the messages in a bag at a `path`, a set.

    Raises
    ------
    FlexarmError
        If it is not a bag.
    """
    source = Source(bag_path(Path(path)), [])
    for _ in source.messages(lambda topic, kind: False):
        pass
    return set(source.topics.values())


def read(path, namespace=""):
    """A `Recording` of the joint states and IMUs in a bag.

    Parameters
    ----------
    path : str or Path
    namespace : str
        Topics of other namespaces are left out; empty: all are taken.

    Raises
    ------
    FlexarmError
        If it is not a bag, has none of these topics, or has none that can be used.
    """
    inside, notes = f"/{namespace.strip('/')}/", []
    source = Source(bag_path(Path(path)), notes)
    raw = {}
    for topic, kind, message in source.messages(lambda topic, kind: _wanted(topic, kind, inside)):
        raw.setdefault((topic, kind), []).append(message)
    if not raw:
        there = ", ".join(sorted(source.topics)) or "none"
        problem = f"neither {JOINTS} nor {IMU} is in the bag; topics in it: {there}"
        raise FlexarmError(problem, field=str(path), hint="record them with `ros2 bag record`")
    made = streams.join(
        [of_messages(topic, kind, found, notes) for (topic, kind), found in raw.items()]
    )
    return replace(made, notes=(*notes, *made.notes))


def of_messages(topic, kind, messages, notes):
    """A `Stream` of serialised messages.

    Parameters
    ----------
    topic : str
    kind : str
        `JOINTS`, `IMU` or, for its strains, `STATE`.
    messages : list of bytes
    notes : list of str
        List to which it adds what was left out.

    Raises
    ------
    FlexarmError
        For joint states without names, or without a position of each joint.
    """
    decoder = Decoder(kind)
    groups = sorted(decoder.groups(messages), key=lambda g: g[0][0])
    if decoder.broken:
        notes.append(f"{topic}: {decoder.broken} messages can't be read, and are left out")
    if not groups:
        raise FlexarmError("has no message that can be read", field=topic)
    return {JOINTS: _joints, IMU: _imu, STATE: _strains}[kind](topic, groups)


def _wanted(topic, kind, inside):
    return kind in (JOINTS, IMU) and (inside == "//" or topic.startswith(inside))


def _stamps(layout, block):
    """Stamps of messages with a header, shape (k,) [s]."""
    seconds = layout.column(block, "header.stamp.sec").astype(float)
    return seconds + 1e-9 * layout.column(block, "header.stamp.nanosec")


def _in_order(parts):
    """Join the arrays of several groups, each with its rows in the whole, in the order of these rows."""
    rows = np.concatenate([r for r, _ in parts])
    values = np.concatenate([v for _, v in parts])
    return values[np.argsort(rows)]


def _joints(topic, groups):
    """A `Stream` of joint states; messages with other joints than the first are left out."""
    names = groups[0][1].names["name"]
    if not names:
        raise FlexarmError("has no joint names in its first message", field=topic)
    groups = [g for g in groups if sorted(g[1].names["name"]) == sorted(names)]
    time = _in_order([(rows, _stamps(layout, block)) for rows, layout, block in groups])
    signals = {}
    for field, quantity in _FIELDS.items():
        parts = []
        for rows, layout, block in groups:
            values = layout.column(block, field)
            if values.shape[1] == len(names):
                have = layout.names["name"]
                parts.append((rows, values[:, [have.index(n) for n in names]]))
        if len(parts) == len(groups):
            signals[quantity] = _in_order(parts)
    if "position" not in signals:
        raise FlexarmError("has messages without a position of each joint", field=topic)
    return streams.of_joints(topic, time, names, **signals)


def _imu(topic, groups):
    """A `Stream` of an IMU; values that it marks as not measured (covariance -1) are left out."""
    time = _in_order([(rows, _stamps(layout, block)) for rows, layout, block in groups])
    found = []
    for field in ("linear_acceleration", "angular_velocity"):
        parts = []
        for rows, layout, block in groups:
            values = np.column_stack([layout.column(block, f"{field}.{axis}") for axis in "xyz"])
            unknown = layout.column(block, f"{field}_covariance")[:, 0] == -1.0
            parts.append((rows, np.where(unknown[:, None], np.nan, values)))
        found.append(_in_order(parts))
    return streams.of_imu(topic, time, *found)


def _strains(topic, groups):
    """A `Stream` of an arm's strains; messages with other gauges than the first are left out."""
    names = groups[0][1].names["gauge_names"]
    groups = [
        g
        for g in groups
        if g[1].names["gauge_names"] == names and g[1].numbers["strain"][2] == len(names)
    ]
    if not names or not groups:
        raise FlexarmError("has no strains", field=topic)
    time = _in_order([(rows, _stamps(layout, block)) for rows, layout, block in groups])
    strain = _in_order([(rows, layout.column(block, "strain")) for rows, layout, block in groups])
    return streams.Stream(topic, time, {"strain": strain}, {"gauge": names})
