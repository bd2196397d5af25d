# SPDX-License-Identifier: Apache-2.0
"""What bags hold: message types of Jazzy and of flexarm, and the arm's file. No ROS."""

import functools
from pathlib import Path

from ..running.processes import installed

#: Where the wheel for pip has the definitions of flexarm's messages; a workspace has them where colcon installs them.
BESIDE = Path(__file__).parent / "msg"
#: What is written into a bag's metadata (``custom_data``): the arm's name, and the text of its file.
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
