# SPDX-License-Identifier: Apache-2.0
"""Shape node: receives `arm_state_estimate` and `controller/state`, publishes `shape` and `shape/joint_states`.

These are markers for RViz and Foxglove, and the joints of the URDF that ``flexarm urdf`` writes, at a rate for the eye.
"""

import numpy as np
from geometry_msgs.msg import Point
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from visualization_msgs.msg import Marker, MarkerArray

from flexarm_control.loop.samples import ArmSample
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.urdf import PieceChain
from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import parameter
from flexarm_msgs.msg import ArmState, CompositeState
from flexarm_ros.node import ARM, OK, ArmNode, run
from flexarm_ros.session import Latest
from flexarm_ros.start import leave

from .amplitudes import Amplitudes
from .drawing import Drawer, Trail

PARAMETERS = (
    ARM,
    parameter("draw_rate", 30.0, "Hz", 0.1, 200.0, read_only=True).described(
        "Pictures per second."
    ),
    parameter("exaggeration", 1.0, "-", 0.0, 1000.0).described(
        "Factor by which deflections are drawn larger; shape/joint_states has them as they are."
    ),
    parameter("pieces", 8, "-", 1, 100, read_only=True).described(
        "Rigid pieces of each flexible link in the URDF, as in flexarm urdf --pieces."
    ),
    parameter("trail", 300, "-", 1, 10000, read_only=True).described(
        "Number of points of the tip's path that are kept."
    ),
    parameter(
        "state_topic",
        "arm_state_estimate",
        choices=("arm_state_estimate", "arm_state"),
        read_only=True,
    ).described("Topic of the states; arm_state: as they are measured."),
)
#: Red, green, blue, opacity.
COLOURS = {
    "beam": (0.12, 0.47, 0.71, 1.0),
    "ghost": (0.5, 0.5, 0.5, 0.5),
    "trail": (0.84, 0.15, 0.16, 0.8),
    "joints": (0.2, 0.2, 0.2, 1.0),
    "tip": (0.84, 0.15, 0.16, 1.0),
    "slow_torque": (1.0, 0.5, 0.05, 1.0),
    "fast_torque": (0.17, 0.63, 0.17, 1.0),
}
#: Shorter arrows are not drawn; relative to the arm's length [-].
SHORTEST = 1e-3


class Markers:
    """A `MarkerArray` of a `Picture`; the messages are made once.

    Parameters
    ----------
    reach : float
        Length of the arm [m].
    joints : int
    """

    def __init__(self, reach, joints):
        self._reach = reach
        width = 0.008 * reach
        self._lines = {
            name: self._marker(name, Marker.LINE_STRIP, size)
            for name, size in (("ghost", 0.4 * width), ("beam", width), ("trail", 0.3 * width))
        }
        self._joints = self._marker("joints", Marker.SPHERE_LIST, 3.0 * width, balls=True)
        self._tip = self._marker("tip", Marker.SPHERE, 3.0 * width, balls=True)
        self._arrows = {
            name: [self._marker(name, Marker.ARROW, 0.7 * width, number=i) for i in range(joints)]
            for name in ("slow_torque", "fast_torque")
        }
        every = [*self._lines.values(), self._joints, self._tip]
        arrows = [marker for of in self._arrows.values() for marker in of]
        self.message = MarkerArray(markers=[*every, *arrows])

    @staticmethod
    def _marker(name, kind, size, number=0, balls=False):
        marker = Marker(ns=name, id=number, type=kind, frame_locked=True)
        marker.pose.orientation.w = 1.0
        marker.scale.x = size
        if balls or kind == Marker.ARROW:
            marker.scale.y, marker.scale.z = (size, size) if balls else (2.0 * size, 3.0 * size)
        c = marker.color
        c.r, c.g, c.b, c.a = COLOURS[name]
        return marker

    def fill(self, picture, trail, header):
        """Write a picture and the tip's path (k, 3) into the message; return it."""
        for marker in self.message.markers:
            marker.header = header
        for name, points in (("ghost", picture.ghost), ("beam", picture.beam), ("trail", trail)):
            self._lines[name].points = _points(points)
            # RViz complains about a line with fewer than two points.
            self._lines[name].action = Marker.ADD if len(points) > 1 else Marker.DELETE
        self._joints.points = _points(picture.joints)
        at = self._tip.pose.position
        at.x, at.y, at.z = picture.tip.tolist()
        for name, arrows in (("slow_torque", picture.slow), ("fast_torque", picture.fast)):
            for marker, ends in zip(self._arrows[name], arrows, strict=True):
                seen = np.linalg.norm(ends[1] - ends[0]) > SHORTEST * self._reach
                marker.action = Marker.ADD if seen else Marker.DELETE
                marker.points = _points(ends)
        return self.message


def _points(array):
    return [Point(x=x, y=y, z=z) for x, y, z in array.tolist()]


class ShapeNode(ArmNode):
    """Watches the loop and draws it."""

    def __init__(self):
        super().__init__("shape", {"": PARAMETERS})

    def build(self):
        self.arm = arm_file.load(self.parameters["arm"])
        arm_model = model.build(self.arm.known)
        self._drawer = Drawer(arm_model)
        self._chain = PieceChain(arm_model, self.parameters["pieces"])
        self._trail = Trail(self.parameters["trail"], 0.002 * self._drawer.reach)
        self._markers = Markers(self._drawer.reach, len(self.arm.joints))
        self._joints = JointState(name=list(self._chain.joint_names))
        self._amplitudes = Amplitudes(arm_model.arm)
        self._sample = ArmSample(len(self.arm.joints), arm_model.n_modes)
        self._slow = self._fast = None
        self._pictures = 0
        self._states = Latest(self.make_subscription, ArmState, self.parameters["state_topic"])
        self._controls = Latest(self.make_subscription, CompositeState, "controller/state")
        few = QoSProfile(depth=1)
        self._shape_pub = self.make_publisher(MarkerArray, "shape", few)
        self._joints_pub = self.make_publisher(JointState, "shape/joint_states", few)
        self.make_timer(1.0 / self.parameters["draw_rate"], self._draw)

    def _draw(self):
        msg, control = self._states.take(), self._controls.take()
        if control is not None:
            self._slow, self._fast = self._torques(control)
        if msg is None or not self.active:
            return
        try:
            delta = self._amplitudes.read(msg, self._sample)
        except MessageError as error:
            self.report(f"not drawn: {error}")
            return
        q = self._sample.position
        picture = self._drawer.picture(
            q, delta, self._slow, self._fast, self.parameters["exaggeration"]
        )
        self._trail.add(picture.tip, msg.session)
        self._shape_pub.publish(self._markers.fill(picture, self._trail.points, msg.header))
        self._joints.header = msg.header
        self._joints.position = self._chain.joint_values(q, delta).tolist()
        self._joints_pub.publish(self._joints)
        self._pictures += 1

    def _torques(self, control):
        """Slow and fast torque; none if the message is of another arm."""
        if list(control.joint_names) != list(self.arm.joint_names):
            self.report(f"torques not drawn: controller/state is of {control.joint_names}")
            return None, None
        return np.array(control.slow_torque), np.array(control.fast_torque)

    def diagnose(self):
        return OK, "", {"pictures": self._pictures}


def main(args=None):
    """Entry point of the process."""
    leave(run(ShapeNode, args))


if __name__ == "__main__":
    main()
