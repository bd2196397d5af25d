# SPDX-License-Identifier: Apache-2.0
"""Provides what bags contain: message types of Jazzy and of flexarm, and the arm's file. No ROS."""

import functools
from pathlib import Path

from ..running.processes import installed

#: Folder of the definitions of flexarm's messages in the wheel for pip; in a workspace, colcon installs them elsewhere.
BESIDE = Path(__file__).parent / "msg"
#: Keys in a bag's metadata (``custom_data``): for the arm's name, and for the text of its file.
ARM_NAME, ARM_TEXT = "flexarm.arm", "flexarm.arm_file"


@functools.cache
def typestore():
    """Jazzy's types with flexarm's beside them, for `rosbags`; the same one each time."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for name in ("ArmState", "JointTorque", "CompositeState", "ObserverState"):
        path = BESIDE / f"{name}.msg"
        if not path.is_file():
            path = installed("share", "flexarm_msgs", "msg", path.name)
        store.register(get_types_from_msg(path.read_text(), f"flexarm_msgs/msg/{name}"))
    return store
