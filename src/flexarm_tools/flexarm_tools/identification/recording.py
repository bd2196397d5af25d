# SPDX-License-Identifier: Apache-2.0
"""Reads a recorded motion: a bag or a CSV file."""

from pathlib import Path

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.identification.recording import from_messages, read_csv


def read_bag(path, arm, namespace=""):
    """Read a rosbag2 directory with ``arm_state`` and, better, ``joint_torque``.

    Raises
    ------
    FlexarmError
        For a bag that can't be read or has no such topic.
    """
    from rosbags.rosbag2 import Reader

    from ..recording.types import typestore

    store, messages = typestore(), {"arm_state": [], "joint_torque": []}
    topics = {f"{namespace.rstrip('/')}/{name}".replace("//", "/"): name for name in messages}
    topics = {t if t.startswith("/") else f"/{t}": name for t, name in topics.items()}
    try:
        with Reader(path) as reader:
            there = [c for c in reader.connections if c.topic in topics]
            for connection, _, raw in reader.messages(connections=there) if there else ():
                kind = connection.msgtype
                messages[topics[connection.topic]].append(store.deserialize_cdr(raw, kind))
            heard = sorted({c.topic for c in reader.connections})
    except FlexarmError:
        raise
    except Exception as error:  # what rosbags says of a broken bag is of many kinds
        raise FlexarmError(f"{path}: can't be read as a bag: {error}") from None
    if not messages["arm_state"]:
        raise FlexarmError(
            f"{path}: no arm_state in the bag (topics: {', '.join(heard) or 'none'})"
        )
    return from_messages(messages["arm_state"], messages["joint_torque"], arm)


def read(path, arm, namespace=""):
    """Read a bag's directory or a CSV file, by what `path` is."""
    path = Path(path)
    if not path.exists():
        raise FlexarmError(f"{path}: no such file or bag")
    if path.is_dir():
        return read_bag(path, arm, namespace)
    if path.suffix in (".mcap", ".db3"):
        return read_bag(path.parent, arm, namespace)
    return read_csv(path, arm)
