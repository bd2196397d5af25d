# SPDX-License-Identifier: Apache-2.0
"""Records an arm's topics as serialised messages, and writes them as a bag."""

import struct
from pathlib import Path

import numpy as np
from rclpy.serialization import deserialize_message

from flexarm_msgs.msg import ArmState, CompositeState, JointTorque, ObserverState
from flexarm_studies.loop.metrics import Record

from ..running.processes import ProcessError
from .types import ARM_NAME, ARM_TEXT, typestore

TOPICS = {
    "arm_state": ArmState,
    "arm_state_estimate": ArmState,
    "joint_torque": JointTorque,
    "controller/state": CompositeState,
    "observer/state": ObserverState,
}

#: Topics that each node publishes.
PUBLISHERS = {
    "simulator": ("arm_state",),
    "observer": ("arm_state_estimate", "observer/state"),
    "controller": ("joint_torque", "controller/state"),
}


#: Messages that a publisher keeps for a recorder that falls behind.
KEPT = 1000


def keep_for_recording(node):
    """Parameters of a node whose messages are recorded.

    On the control path a publisher keeps the newest sample alone. A recorder that falls behind on a busy machine gets
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
        Whose `poll` collects them.
    topics : sequence of str
        Of `TOPICS`.
    """

    def __init__(self, session, topics=tuple(TOPICS)):
        self._taps = {topic: session.tap(TOPICS[topic], topic, raw=True) for topic in topics}

    @property
    def raw(self):
        """Topic to the list of serialised messages, in the order of arrival."""
        return {topic: tap.messages for topic, tap in self._taps.items()}

    def messages(self):
        """Topic to the list of messages."""
        return {
            topic: [deserialize_message(raw, TOPICS[topic]) for raw in tap.messages]
            for topic, tap in self._taps.items()
        }

    def complete(self):
        """Whether every topic has a message."""
        return all(self.raw.values())

    @property
    def latest_ns(self):
        """Stamp of the newest torque [ns]; 0 before the first."""
        newest = self._taps["joint_torque"].newest
        return raw_stamp_ns(newest) if newest else 0

    def samples(self, begin_ns, end_ns):
        """One serialised message per stamp and topic; of one that was sent again, the last.

        Parameters
        ----------
        begin_ns, end_ns : int
            First and last stamp.

        Returns
        -------
        dict
            Topic to {stamp_ns: bytes}, in order.

        Raises
        ------
        ProcessError
            When a topic lacks a sample that another one has.
        """
        kept = {}
        for topic, messages in self.raw.items():
            by_stamp = {raw_stamp_ns(raw): raw for raw in messages}
            kept[topic] = {s: r for s, r in sorted(by_stamp.items()) if begin_ns <= s <= end_ns}
        stamps = set().union(*kept.values())
        for topic, messages in kept.items():
            if len(messages) != len(stamps):
                raise ProcessError(
                    f"recording: {len(stamps) - len(messages)} of {len(stamps)} samples of {topic} were"
                    " lost: is the machine out of memory or shared memory (df /dev/shm)?"
                )
        return kept


def to_record(samples, start_ns):
    """A `Record` of `Recorder.samples`; time zero at `start_ns`."""
    messages = {
        topic: [deserialize_message(raw, TOPICS[topic]) for raw in samples[topic].values()]
        for topic in ("arm_state", "arm_state_estimate", "controller/state")
    }

    def table(topic, field):
        rows = [getattr(m, field) for m in messages[topic]]
        width = max(map(len, rows))
        # Rates are empty until the observer has converged.
        return np.array([r if len(r) else [np.nan] * width for r in rows])

    stamps = [m.header.stamp for m in messages["arm_state"]]
    time = np.array([(s.sec * 10**9 + s.nanosec - start_ns) * 1e-9 for s in stamps])
    control, estimate = "controller/state", "arm_state_estimate"
    return Record(
        time=time,
        reference=table(control, "reference_position"),
        reference_velocity=table(control, "reference_velocity"),
        position=table("arm_state", "joint_position"),
        velocity=table(estimate, "joint_velocity"),
        amplitude=table(estimate, "modal_amplitude"),
        rate=table(estimate, "modal_rate"),
        quasi_steady=table(control, "quasi_steady_amplitude"),
        slow_torque=table(control, "slow_torque"),
        fast_torque=table(control, "fast_torque"),
        torque=table(control, "torque"),
    )


class BagWriter:
    """A rosbag2 bag with MCAP storage that is written message by message.

    Parameters
    ----------
    path : Path
        Directory of the bag; must not exist.
    arm : str, optional
        Shipped name or path of the arm file: its name and its text go into the bag's metadata (``custom_data``), so
        that a reader of the bag knows the arm.
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
        from flexarm_dynamics.arm import arm_file

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
            self.add(topic, f"flexarm_msgs/msg/{TOPICS[topic].__name__}")
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
    with BagWriter(path, arm) as bag:
        rows = sorted(
            ((stamp, i, topic) for i, topic in enumerate(samples) for stamp in samples[topic]),
        )
        for topic in samples:
            bag.add(topic, f"flexarm_msgs/msg/{TOPICS[topic].__name__}")
        for stamp, _, topic in rows:
            bag.write(topic, stamp, samples[topic][stamp])
