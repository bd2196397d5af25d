# SPDX-License-Identifier: Apache-2.0
"""Serves the topics to Foxglove without a bridge of a ROS installation: a server of foxglove-sdk in the view's process.

Messages are passed on as they came, serialised. The newest message of each topic is sent at the view's rate, so no
publisher waits for Foxglove. The arm's shape is drawn here, because a URDF does not bend.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..recording.recorder import raw_stamp_ns

#: Topic to its type. These are the topics of the layout ``layouts/foxglove.json``.
TOPICS = {
    "arm_state": "flexarm_msgs/msg/ArmState",
    "arm_state_estimate": "flexarm_msgs/msg/ArmState",
    "joint_torque": "flexarm_msgs/msg/JointTorque",
    "controller/state": "flexarm_msgs/msg/CompositeState",
    "observer/state": "flexarm_msgs/msg/ObserverState",
    "joint_states": "sensor_msgs/msg/JointState",
}
#: Topic and frame of the drawing.
SHAPE, FRAME = "/shape", "base_link"
#: For the bent arm, the straight arm and the tip's path: red, green, blue, opacity; thickness over the arm's reach.
LINES = {
    "beam": ((0.11, 0.49, 0.84, 1.0), 0.018),
    "ghost": ((0.68, 0.71, 0.74, 1.0), 0.006),
    "trail": ((0.88, 0.19, 0.19, 1.0), 0.005),
}


@dataclass(frozen=True)
class Source:
    """A topic as it is read: `take` gives the newest serialised message since the last call, or None."""

    topic: str
    kind: str
    take: Callable


class Foxglove:
    """A server on this machine that Foxglove connects to.

    Parameters
    ----------
    name : str
        Shown in Foxglove.
    port : int
        On 127.0.0.1; 0: a free one.
    sources : callable
        Gives the sequence of `Source`; called when a client is interested.
    definition : callable
        Type to its definition as text, with the definitions of the types in it.
    reach : float
        Reach of the arm, for the thickness of lines [m].

    Attributes
    ----------
    url : str
        Address to open in a browser.
    port : int
    """

    def __init__(self, name, port, sources, definition, reach):
        import foxglove
        from foxglove.channels import SceneUpdateChannel

        self._context = foxglove.Context()
        self._server = foxglove.start_server(
            name=name, host="127.0.0.1", port=port, context=self._context
        )
        self.port, self.url = self._server.port, self._server.app_url()
        self._reach = reach
        self._find, self._sources = sources, None
        self._channels = {
            topic: foxglove.Channel(
                f"/{topic}",
                message_encoding="cdr",
                schema=foxglove.Schema(
                    name=kind, encoding="ros2msg", data=definition(kind).encode()
                ),
                context=self._context,
            )
            for topic, kind in TOPICS.items()
        }
        self._shape = SceneUpdateChannel(SHAPE, context=self._context)

    def forward(self):
        """Send what has arrived since the last call; return the number of messages.

        Nothing is read before a client is interested: each reader of a topic costs its publisher a little.
        """
        if self._sources is None:
            if not any(channel.has_sinks() for channel in self._channels.values()):
                return 0
            self._sources = self._find()
        count = 0
        for source in self._sources:
            raw = source.take()
            if raw is not None:
                self._channels[source.topic].log(bytes(raw), log_time=raw_stamp_ns(raw))
                count += 1
        return count

    def draw(self, time_ns, beam, ghost, trail):
        """Send the arm's shape at a time [ns]: points of its lines, each (k, 3) [m]."""
        if not self._shape.has_sinks():
            return
        from foxglove.messages import SceneEntity, SceneUpdate, Timestamp

        stamp = Timestamp(sec=time_ns // 1_000_000_000, nsec=time_ns % 1_000_000_000)
        lines = {"beam": beam, "ghost": ghost, "trail": trail}
        entities = [
            SceneEntity(
                timestamp=stamp, frame_id=FRAME, id=name, lines=[self._line(points, *LINES[name])]
            )
            for name, points in lines.items()
            if len(points) > 1
        ]
        self._shape.log(SceneUpdate(entities=entities), log_time=time_ns)

    def _line(self, points, colour, thickness):
        from foxglove.messages import Color, LinePrimitive, LinePrimitiveLineType, Point3

        return LinePrimitive(
            type=LinePrimitiveLineType.LineStrip,
            thickness=thickness * self._reach,
            points=[Point3(x=float(x), y=float(y), z=float(z)) for x, y, z in np.asarray(points)],
            color=Color(**dict(zip("rgba", colour, strict=True))),
        )

    def close(self):
        """End the server."""
        self._server.stop()
