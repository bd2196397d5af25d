# SPDX-License-Identifier: Apache-2.0
"""Reads an arm's topics from a bag of any length, as columns of numbers.

The columns are kept in files, so memory holds only a block of messages at a time. A bag may come from anywhere: topics
may be missing or in a namespace, names in another order, arrays empty, the file truncated. What can't be used is left
out, and a note reports it.
"""

import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.shown import listed

from . import mcap
from .serialised import Decoder
from .types import ARM_NAME, ARM_TEXT

#: Fields of each topic, and the names that give their order; None: a single number.
_STATE = {
    "joint_position": "joint_names",
    "joint_velocity": "joint_names",
    "joint_torque": "joint_names",
    "strain": "gauge_names",
    "modal_amplitude": "mode_names",
    "modal_rate": "mode_names",
}
FIELDS = {
    "arm_state": _STATE,
    "arm_state_estimate": _STATE,
    "joint_torque": {"torque": "joint_names", "mode": None},
    "controller/state": {
        "reference_position": "joint_names",
        "reference_velocity": "joint_names",
        "slow_torque": "joint_names",
        "fast_torque": "joint_names",
        "torque": "joint_names",
        "quasi_steady_amplitude": "mode_names",
        "supervisor_state": None,
        "saturated": None,
        "compute_time": None,
    },
    "observer/state": {"gauge_health": "gauge_names", "converged": None},
}
#: Topic to the type of its messages.
KINDS = {
    "arm_state": "flexarm_msgs/msg/ArmState",
    "arm_state_estimate": "flexarm_msgs/msg/ArmState",
    "joint_torque": "flexarm_msgs/msg/JointTorque",
    "controller/state": "flexarm_msgs/msg/CompositeState",
    "observer/state": "flexarm_msgs/msg/ObserverState",
}
#: Columns that every table has beside its fields, and their types.
_HEAD = {"stamp": np.int64, "session": np.int64, "sequence": np.int64, "reason": np.int32}
#: Number of messages, or of bytes, that are read before they are put into columns.
BLOCK, BLOCK_BYTES = 40_000, 32_000_000
#: Number of different reasons of refusal that are kept.
MAX_REASONS = 500


@dataclass
class Table:
    """One topic's messages as columns.

    Attributes
    ----------
    stamp, session, sequence : ndarray, shape (k,)
        [ns], [-], [-]; in the order of the bag.
    columns : dict
        Field to an array (k, width), NaN where a message has none; float64.
    known : set
        Fields of which some message has a value.
    reason : ndarray of int, shape (k,)
        Index into the bag's `reasons`; -1 where there is no such field.
    """

    stamp: np.ndarray
    session: np.ndarray
    sequence: np.ndarray
    columns: dict
    known: set
    reason: np.ndarray


@dataclass
class Contents:
    """The content of a bag for one arm.

    Attributes
    ----------
    path : Path
    namespace : str
        Such as ``/left``; empty if there is none.
    arm : Arm or None
    names : dict
        ``joint_names``, ``gauge_names`` and ``mode_names``, in the order of the columns.
    tables : dict
        Topic to `Table`, for topics that have a message.
    reasons : list of str
    notes : list of str
        What was left out, and why.
    unknown : dict
        ``gauge_names`` and the like to a list of names that the arm does not have; their values are left out.
    """

    path: Path
    namespace: str
    arm: object
    names: dict
    tables: dict
    reasons: list
    notes: list = field(default_factory=list)
    unknown: dict = field(default_factory=dict)


class _Columns:
    """Columns to which rows are appended, each in a nameless file; it vanishes when nothing refers to it."""

    def __init__(self):
        self._files = {}

    def __contains__(self, name):
        return name in self._files

    def append(self, name, values):
        if name not in self._files:
            file = tempfile.TemporaryFile(prefix="flexarm-")  # noqa: SIM115
            self._files[name] = file, values.dtype
        self._files[name][0].write(np.ascontiguousarray(values).tobytes())

    def pad(self, name, rows, width):
        """Write NaN for the messages before the first one that shows the width."""
        if name not in self._files and rows:
            self.append(name, np.full((rows, width), np.nan))

    def array(self, name, width):
        """What was appended under a name, shape (k, width), or (k,) for no width."""
        file, kind = self._files[name]
        shape = (-1,) if width is None else (-1, width)
        with file:  # a memory map stays when its file is closed
            file.flush()
            if file.tell():
                return np.memmap(file, kind, "r").reshape(shape)
        return np.zeros(0, kind).reshape(shape) if width else np.zeros((0, 0))


def read(path, arm=None, namespace=None, progress=lambda fraction: None):
    """Read a bag.

    Parameters
    ----------
    path : str or Path
        The bag's folder, a folder with a folder ``bag`` in it, or a file .mcap or .db3.
    arm : Arm or str, optional
        Arm or arm file; the bag's own if not given.
    namespace : str, optional
        Namespace of the wanted arm; not given: all arms in the bag.
    progress : callable
        Called with the fraction that has been read.

    Returns
    -------
    list of Contents
        One for each namespace.

    Raises
    ------
    FlexarmError
        If it is not a bag, has none of the topics, or belongs to another arm.
    """
    path, notes = bag_path(Path(path)), []
    if isinstance(arm, str):
        arm = arm_file.load(arm) if arm else None
    known = arm_of(path, notes) if arm is None else arm
    source = Source(path, notes)
    readers, block, count, size = {}, {}, 0, 0
    for topic, kind, raw in source.messages(lambda t, k: _wanted(t, k, namespace)):
        block.setdefault((topic, kind), []).append(raw)
        count, size = count + 1, size + len(raw)
        if count % BLOCK == 0 or size > BLOCK_BYTES:
            _flush(block, readers, known)
            size = 0
            progress(count / max(source.count, count))
    _flush(block, readers, known)
    if not count:
        raise _nothing(path, source, namespace)
    found = [readers[space].contents(path, space, notes) for space in sorted(readers)]
    return [c for c in found if _enough(c, len(found))]


def from_messages(raw, arm):
    """The `Contents` of serialised messages in memory.

    Parameters
    ----------
    raw : dict
        Topic to list of bytes.
    arm : Arm
    """
    reader = _Reader(arm)
    for topic, messages in raw.items():
        if messages:
            reader.take(topic, messages)
    return reader.contents("the recording", "", [])


def bag_path(path):
    """The bag to which a `path` refers.

    Raises
    ------
    FlexarmError
        If there is none.
    """
    if not path.exists():
        raise FlexarmError("no such file or folder", field=str(path))
    if path.is_dir() and not _is_bag(path) and _is_bag(path / "bag"):
        return path / "bag"
    if path.is_dir() and not _is_bag(path):
        inside = sorted(p.parent for p in path.glob("**/metadata.yaml"))[:8]
        hint = f"there are {', '.join(map(str, inside))}" if inside else ""
        problem = "is no bag: neither metadata.yaml nor a .mcap file is in it"
        raise FlexarmError(problem, field=str(path), hint=hint)
    if path.is_file() and path.name == "metadata.yaml":
        return path.parent
    if path.is_file() and path.suffix not in (".mcap", ".db3"):
        raise FlexarmError("is no bag", field=str(path), limit="a folder, a .mcap or a .db3 file")
    return path


def _is_bag(path):
    return (path / "metadata.yaml").is_file() or any(path.glob("*.mcap"))


def arm_of(path, notes):
    """The arm in a bag's metadata; None if there is none."""
    place = (path if path.is_dir() else path.parent) / "metadata.yaml"
    try:
        data = yaml.safe_load(place.read_text(encoding="utf-8"))
        custom = data["rosbag2_bagfile_information"].get("custom_data") or {}
        text, name = custom.get(ARM_TEXT), str(custom.get(ARM_NAME, "arm"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError, LookupError, TypeError, AttributeError):
        return None
    if not text:
        return None
    try:
        return arm_file.parse(str(text), name)
    except FlexarmError as error:
        notes.append(f"the arm file in the bag can't be used ({error}): give one with --arm")
        return None


def _wanted(topic, kind, namespace):
    """(namespace, topic of the control path) of a bag's topic, None for any other."""
    for name, wanted in KINDS.items():
        if topic.endswith(f"/{name}") and kind == wanted:
            before = topic[: -len(name) - 1]
            if namespace is None or before.strip("/") == namespace.strip("/"):
                return before, name
    return None


class Source:
    """The messages of a bag, up to where it is truncated.

    Parameters
    ----------
    path : Path
        As of `bag_path`.
    notes : list of str
        List to which it adds what was left out.

    Attributes
    ----------
    topics : dict
        Topic to the type of its messages, once they are read.
    count : int
        Number of the wanted messages; 0 if the bag does not have it.
    """

    def __init__(self, path, notes):
        self.path, self.notes, self.topics, self.count = path, notes, {}, 0

    def messages(self, wanted):
        """Yield (topic, type, bytes) of the topics for which ``wanted(topic, type)`` is true.

        Raises
        ------
        FlexarmError
            If it can't be read as a bag.
        """
        given, problem = 0, None
        try:
            for item in self._by_index(wanted):
                given += 1
                yield item
            return
        except GeneratorExit:
            raise
        except FlexarmError:
            raise
        except Exception as error:  # rosbags raises many types for a broken bag
            problem = str(error) or type(error).__name__
        yield from self._up_to_the_break(wanted, given, problem)

    def _by_index(self, wanted):
        from rosbags.rosbag2 import Reader

        if self.path.is_dir() and not (self.path / "metadata.yaml").is_file():
            raise FileNotFoundError("metadata.yaml is missing: the recording was not closed")
        with Reader(self.path) as reader:
            self.topics = {c.topic: c.msgtype for c in reader.connections}
            there = [c for c in reader.connections if wanted(c.topic, c.msgtype)]
            self.count = sum(c.msgcount for c in there)
            for connection, _, raw in reader.messages(connections=there) if there else ():
                yield connection.topic, connection.msgtype, raw

    def _up_to_the_break(self, wanted, given, problem):
        files = sorted(self.path.glob("*.mcap")) if self.path.is_dir() else [self.path]
        if not files or files[0].suffix != ".mcap":
            hint = "`ros2 bag reindex` may repair it"
            raise FlexarmError(
                f"can't be read as a bag: {problem}", field=str(self.path), hint=hint
            )
        count = 0
        for file in files:
            for topic, kind, raw in mcap.messages(file):
                self.topics.setdefault(topic, kind)
                if wanted(topic, kind):
                    count += 1
                    if count > given:
                        yield topic, kind, raw
        if count:
            self.notes.append(f"the bag is broken ({problem}); read as far as it goes")


def _nothing(path, source, namespace):
    """The error for a bag without any wanted message."""
    if any(_wanted(t, k, None) for t, k in source.topics.items()) and namespace is None:
        hint = "record while the nodes run, with `flexarm record`"
        return FlexarmError("the bag is empty", field=str(path), hint=hint)
    where = "" if namespace is None else f" in namespace {namespace}"
    there = ", ".join(sorted(source.topics)) or "none"
    return FlexarmError(
        f"no topic of an arm{where} in the bag ({', '.join(FIELDS)}, in messages of flexarm_msgs);"
        f" topics in it: {there}",
        field=str(path),
        hint="record with `flexarm record`",
    )


def _enough(contents, others):
    """Whether there are states of an arm; refuse a bag without them."""
    if "arm_state" in contents.tables or "arm_state_estimate" in contents.tables:
        return True
    if others > 1:
        return False
    there = ", ".join(contents.tables) or "none that can be read"
    raise FlexarmError(
        f"neither arm_state nor arm_state_estimate has a message, only {there}",
        field=str(contents.path),
        hint="record them as well, with `flexarm record`",
    )


def _flush(block, readers, arm):
    """Put messages, by topic and type, into the columns of their arms, by namespace."""
    for (topic, kind), messages in block.items():
        namespace, name = _wanted(topic, kind, None)
        if namespace not in readers:
            readers[namespace] = _Reader(arm)
        readers[namespace].take(name, messages)
    block.clear()


class _Reader:
    """Columns of one arm."""

    def __init__(self, arm):
        self.arm, self.names = arm, {}
        self._columns, self._decoders, self._others = _Columns(), {}, ()
        self._known, self._reasons, self._foreign, self._rows = {}, {}, {}, {}
        self._unknown = {}
        if arm is not None:
            from flexarm_dynamics.models import model

            self.names = {
                "joint_names": tuple(arm.joint_names),
                "gauge_names": tuple(arm.gauge_names),
                "mode_names": tuple(model.build(arm.known).mode_names),
            }

    def take(self, topic, messages):
        """Put some messages of a topic into columns."""
        if topic not in self._decoders:
            self._decoders[topic] = Decoder(KINDS[topic])
        groups = [
            g for g in self._decoders[topic].groups(messages) if self._ours(topic, g[1], len(g[0]))
        ]
        for name in ("joint_names", "gauge_names", "mode_names"):
            if not self.names.get(name):
                self.names[name] = next(
                    (g[1].names[name] for g in groups if g[1].names.get(name)), ()
                )
        k = len(messages)
        read = np.zeros(k, bool)
        head = {name: np.full(k, -1, kind) for name, kind in _HEAD.items()}
        fields = {f: self._room(k, names) for f, names in FIELDS[topic].items()}
        for rows, layout, block in groups:
            read[rows] = True
            self._head(head, rows, layout, block)
            for name, names in FIELDS[topic].items():
                self._field(topic, name, names, fields[name], rows, layout, block)
        for name, values in head.items():
            self._columns.append((topic, name), values[read])
        for name, values in fields.items():
            if values.ndim == 1 or values.shape[1]:
                self._columns.pad((topic, name), self._rows.get(topic, 0), values.shape[-1])
                self._columns.append((topic, name), values[read])
        self._rows[topic] = self._rows.get(topic, 0) + int(read.sum())

    def _room(self, k, names):
        return np.full(k if names is None else (k, len(self.names[names])), np.nan)

    def _head(self, head, rows, layout, block):
        column = layout.column
        sec = column(block, "header.stamp.sec").astype(np.int64)
        head["stamp"][rows] = sec * 10**9 + column(block, "header.stamp.nanosec")
        head["session"][rows] = column(block, "session")
        head["sequence"][rows] = column(block, "sequence")
        if "rejected_reason" in layout.texts:
            texts, which = layout.text(block, "rejected_reason")
            numbers = [self._number_of(text) for text in texts]
            head["reason"][rows] = np.array(numbers)[which]

    def _number_of(self, text):
        if text not in self._reasons and len(self._reasons) >= MAX_REASONS:
            text = "(more reasons than are kept)"
        return self._reasons.setdefault(text, len(self._reasons))

    def _field(self, topic, name, names, out, rows, layout, block):
        if name not in layout.numbers:
            return
        values = layout.column(block, name)
        if names is None:
            out[rows] = values
        else:
            have, wanted = layout.names[names], self.names[names]
            if values.shape[1] == 0 or values.shape[1] != len(have):
                return
            for j, n in enumerate(have):
                if n in wanted:
                    out[rows, wanted.index(n)] = values[:, j]
                else:
                    self._unknown.setdefault(names, set()).add(n)
        self._known.setdefault(topic, set())
        if np.isfinite(values).any():
            self._known[topic].add(name)

    def _ours(self, topic, layout, count):
        """Whether the joints of a layout are those of this arm."""
        have, wanted = layout.names.get("joint_names"), self.names.get("joint_names")
        if have is None or not wanted or sorted(have) == sorted(wanted):
            return True
        self._others = have
        self._foreign[topic] = self._foreign.get(topic, 0) + count
        return False

    def contents(self, path, namespace, notes):
        """What was read, as `Contents`."""
        tables, notes, get = {}, list(notes), self._columns.array
        for topic, decoder in self._decoders.items():
            if decoder.broken:
                notes.append(f"{topic}: {decoder.broken} messages can't be read, and are left out")
            if topic in self._foreign:
                notes.append(
                    f"{topic}: {self._foreign[topic]} messages have other joint_names, and are left out"
                )
            head = {name: get((topic, name), None) for name in _HEAD}
            if not head["stamp"].size:
                continue
            columns = {
                f: get((topic, f), None if names is None else len(self.names[names]))
                for f, names in FIELDS[topic].items()
                if (topic, f) in self._columns
            }
            tables[topic] = Table(columns=columns, known=self._known.get(topic, set()), **head)
        if self._foreign and not {"arm_state", "arm_state_estimate"} & set(tables):
            raise FlexarmError(
                f"are not those of arm {self.arm.name}",
                field=f"{path}: joint_names",
                value=list(self._others),
                limit=listed(self.names["joint_names"]),
                hint="give the right one with --arm",
            )
        unknown = {names: sorted(found) for names, found in self._unknown.items()}
        reasons = list(self._reasons)
        return Contents(path, namespace, self.arm, self.names, tables, reasons, notes, unknown)
