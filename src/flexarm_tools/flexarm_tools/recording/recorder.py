# SPDX-License-Identifier: Apache-2.0
"""Records an arm's topics as serialised messages, and writes them as a bag."""

import struct
from pathlib import Path

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_msgs import msg
from flexarm_studies.loop.metrics import Record

from ..running.processes import ProcessError
from . import bag
from .types import ARM_NAME, ARM_TEXT, typestore

#: Topic to the class of its messages.
TOPICS = {topic: getattr(msg, kind.rsplit("/", 1)[1]) for topic, kind in bag.KINDS.items()}
#: Topics that each node publishes.
PUBLISHERS = {
    "simulator": ("arm_state",),
    "observer": ("arm_state_estimate", "observer/state"),
    "controller": ("joint_torque", "controller/state"),
}


#: Messages that a publisher keeps for a recorder that falls behind: ten seconds with a sample each millisecond.
KEPT = 10_000


def keep_for_recording(node):
    """Parameters of a node whose messages are recorded.

    On the control path a publisher keeps only the newest sample. A recorder that falls behind on a busy machine gets
    what it missed only while the publisher still has it.
    """
    return {f"qos_overrides./{topic}.publisher.depth": KEPT for topic in PUBLISHERS[node]}


def raw_stamp_ns(raw):
    """Stamp of a serialised message that begins with a header (CDR, little endian) [ns]."""
    sec, nanosec = struct.unpack_from("<iI", raw, 4)
    return sec * 1_000_000_000 + nanosec


class Recorder:
    """Collects the serialised messages of an arm's topics until they are read.

    Parameters
    ----------
    session : Session
        Its `poll` collects them.
    topics : sequence of str
        Of `TOPICS`.
    """

    def __init__(self, session, topics=tuple(TOPICS)):
        self._taps = {topic: session.tap(TOPICS[topic], topic, raw=True) for topic in topics}

    @property
    def raw(self):
        """Topic to the list of serialised messages, in the order of arrival."""
        return {topic: tap.messages for topic, tap in self._taps.items()}

    def complete(self):
        """Whether every topic has a message."""
        return all(self.raw.values())

    @property
    def latest_ns(self):
        """Stamp of the newest torque [ns]; 0 before the first."""
        newest = self._taps["joint_torque"].newest
        return raw_stamp_ns(newest) if newest else 0

    def between(self, begin_ns, end_ns):
        """One message per stamp from `begin_ns` to `end_ns`; if it was sent again, the last one.

        Returns
        -------
        dict
            Topic to {stamp_ns: bytes}, in order.
        """
        kept = {}
        for topic, messages in self.raw.items():
            by_stamp = {raw_stamp_ns(raw): raw for raw in messages}
            kept[topic] = {s: r for s, r in sorted(by_stamp.items()) if begin_ns <= s <= end_ns}
        return kept

    def samples(self, begin_ns, end_ns):
        """As `between`, from `begin_ns` to `end_ns`, with the same samples of all topics.

        Raises
        ------
        ProcessError
            If a topic lacks a sample that another topic has.
        """
        kept = self.between(begin_ns, end_ns)
        stamps = set().union(*kept.values())
        for topic, messages in kept.items():
            if len(messages) != len(stamps):
                raise ProcessError(
                    "samples were lost",
                    field=f"recording of {topic}",
                    value=len(stamps) - len(messages),
                    limit=f"of {len(stamps)}",
                    hint="is the machine out of memory or shared memory (df /dev/shm)?",
                )
        return kept


def to_record(samples, start_ns, arm):
    """A `Record` of `Recorder.samples`, time zero at `start_ns`; `arm` is its file's shipped name or path."""
    raw = {topic: list(rows.values()) for topic, rows in samples.items()}
    tables = bag.from_messages(raw, arm_file.load(arm)).tables
    measured, estimate, control = (
        {name: np.array(values) for name, values in tables[topic].columns.items()}
        for topic in ("arm_state", "arm_state_estimate", "controller/state")
    )
    return Record(
        time=(tables["arm_state"].stamp - start_ns) * 1e-9,
        reference=control["reference_position"],
        reference_velocity=control["reference_velocity"],
        position=measured["joint_position"],
        velocity=estimate["joint_velocity"],
        amplitude=estimate["modal_amplitude"],
        rate=estimate["modal_rate"],  # NaN until the observer has converged
        quasi_steady=control["quasi_steady_amplitude"],
        slow_torque=control["slow_torque"],
        fast_torque=control["fast_torque"],
        torque=control["torque"],
    )


class BagWriter:
    """A rosbag2 bag with MCAP storage that is written message by message.

    Parameters
    ----------
    path : Path
        Directory of the bag; must not exist.
    arm : str, optional
        Shipped name or path of the arm file: its name and its text go into the bag's metadata (``custom_data``), so a
        reader of the bag knows the arm.
    namespace : str
        In front of the topics' names.
    """

    def __init__(self, path, arm="", namespace=""):
        from rosbags.rosbag2 import StoragePlugin, Writer

        self._store, self._connections = typestore(), {}
        self._before = f"/{namespace.strip('/')}" if namespace.strip("/") else ""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        if arm:
            self.put_arm(arm)

    def put_arm(self, arm):
        """Put the arm file into the metadata; possible until the bag is closed."""
        path = arm_file.find(arm)
        self._writer.set_custom_data(ARM_NAME, path.stem)
        self._writer.set_custom_data(ARM_TEXT, path.read_text(encoding="utf-8"))

    def add(self, topic, kind):
        """Add a topic that is not in `TOPICS`, with its type, such as ``trajectory_msgs/msg/JointTrajectory``."""
        self._connections[topic] = self._writer.add_connection(
            f"{self._before}/{topic}", kind, typestore=self._store
        )

    def write(self, topic, time_ns, raw):
        """Write a serialised message."""
        if topic not in self._connections:
            self.add(topic, bag.KINDS[topic])
        self._writer.write(self._connections[topic], time_ns, raw)

    def close(self):
        """Write index and metadata."""
        self._writer.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def write_bag(path, samples, arm=""):
    """Write `Recorder.samples` as a rosbag2 bag with MCAP storage, log times from the stamps.

    Parameters
    ----------
    path : Path
        Directory of the bag; must not exist.
    samples : dict
        Topic to {stamp_ns: bytes}.
    arm : str, optional
        See `BagWriter`.
    """
    with BagWriter(path, arm) as writer:
        rows = sorted(
            ((stamp, i, topic) for i, topic in enumerate(samples) for stamp in samples[topic]),
        )
        for topic in samples:
            writer.add(topic, bag.KINDS[topic])
        for stamp, _, topic in rows:
            writer.write(topic, stamp, samples[topic][stamp])
