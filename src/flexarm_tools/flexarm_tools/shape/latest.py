# SPDX-License-Identifier: Apache-2.0
"""The newest message of a topic, when it is asked for: what comes in between wakes nobody and is not deserialised."""

import numpy as np
from rclpy.callback_groups import CallbackGroup
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

from flexarm_ros.messages import StateReader

#: The publisher waits for no reader of this kind: one that looks on never slows the loop.
LOOKING_ON = QoSProfile(
    history=QoSHistoryPolicy.KEEP_LAST, depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT
)


class Unserved(CallbackGroup):
    """Of subscriptions that no executor looks at."""

    def can_execute(self, entity):
        """Whether an executor may take it: never."""
        return False

    def beginning_execution(self, entity):
        """Nothing is begun."""
        return False

    def ending_execution(self, entity):
        """Nothing has ended."""
        pass


class Latest:
    """Looks on at a topic.

    Parameters
    ----------
    create : callable
        ``create_subscription`` of a node, or `ArmNode.make_subscription`.
    kind : type
        Of the messages.
    topic : str
    """

    def __init__(self, create, kind, topic):
        self._subscription = create(
            kind, topic, lambda msg: None, LOOKING_ON, callback_group=Unserved()
        )

    def take(self):
        """The newest message since the last call; None without one."""
        handle, kind = self._subscription.handle, self._subscription.msg_type
        newest = None
        with handle:
            while (taken := handle.take_message(kind, False)) is not None:
                newest = taken[0]
        return newest


class Amplitudes:
    """All modal amplitudes of an arm from states that hold the observed ones.

    Parameters
    ----------
    arm : Arm
    """

    def __init__(self, arm):
        self.reader = StateReader(arm)
        names = arm.mode_names
        self._places = np.array([names.index(n) for n in arm.observed_modes], int)
        self.values = np.zeros(len(names))

    def read(self, msg, sample):
        """Fill a sample; return the amplitudes (m,) [m, rad], zero where the state has none.

        Raises
        ------
        MessageError
        """
        self.reader.read(msg, sample)
        self.values[:] = 0.0
        if sample.amplitude is not None:
            self.values[self._places] = sample.amplitude
        return self.values
