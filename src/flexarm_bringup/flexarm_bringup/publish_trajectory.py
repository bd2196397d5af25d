"""Publishes the paper's profile or a quintic: ``ros2 run flexarm_bringup publish_trajectory``."""

import argparse
import math
import sys
import time

from flexarm_control import profiles
from flexarm_dynamics import arm_file
from flexarm_dynamics.errors import FlexarmError, TrajectoryError


def add_arguments(parser):
    """Arguments of the command, without ROS."""
    parser.add_argument("profile", choices=("paper", "quintic"), help="which motion")
    parser.add_argument("--arm", default="R", help="arm file, for the joint names (default R)")
    parser.add_argument(
        "--from",
        dest="start",
        help="joint angles where the motion starts, comma separated [rad] (default: where the reference is)",
    )
    parser.add_argument(
        "--to",
        default=str(math.pi / 2),
        help="joint angles where it ends, comma separated [rad] (default 90 deg)",
    )
    parser.add_argument("--duration", type=float, default=2.0, help="[s] (default 2)")
    parser.add_argument(
        "--points", type=int, default=101, help="points of the message (default 101)"
    )
    parser.add_argument("--topic", default="joint_trajectory", help="topic to publish on")
    parser.add_argument(
        "--timeout", type=float, default=10.0, help="longest wait for a controller [s] (default 10)"
    )


def _angles(text, count, what):
    try:
        values = [float(v) for v in text.split(",")]
    except ValueError:
        raise TrajectoryError(f"--{what} {text!r}: write numbers, comma separated") from None
    values = values * count if len(values) == 1 else values
    if len(values) != count or not all(map(math.isfinite, values)):
        raise TrajectoryError(f"--{what} {text!r}: {count} finite angles are wanted, one per joint")
    return values


def profile_of(options, reference):
    """The motion that the options describe, from `reference` unless they say from where."""
    count = len(reference)
    start = _angles(options.start, count, "from") if options.start else list(reference)
    end = _angles(options.to, count, "to")
    if options.profile == "quintic":
        return profiles.quintic(start, end, options.duration)
    travel = [b - a for a, b in zip(start, end, strict=True)]
    return profiles.paper_profile(options.duration, travel, start)


class _Conversation:
    """A node that publishes trajectories and hears what the controller makes of them."""

    def __init__(self, options, ros_args):
        import rclpy
        from trajectory_msgs.msg import JointTrajectory

        from flexarm_msgs.msg import CompositeState
        from flexarm_ros import qos

        self.timeout = options.timeout
        self.context = rclpy.Context()
        rclpy.init(args=ros_args, context=self.context)
        self.node = rclpy.create_node("publish_trajectory", context=self.context)
        self.executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.publisher = self.node.create_publisher(JointTrajectory, options.topic, qos.COMMAND)
        self.state = None
        self.node.create_subscription(CompositeState, "controller/state", self._hear, qos.LINE)

    def _hear(self, msg):
        self.state = msg

    def wait_for(self, condition, otherwise):
        """Serve callbacks until `condition` holds; raise a FlexarmError with `otherwise` when it does not."""
        end = time.monotonic() + self.timeout
        while not condition():
            self.executor.spin_once(timeout_sec=0.05)
            if time.monotonic() > end:
                raise FlexarmError(otherwise)

    def close(self):
        import rclpy

        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def publish(options, ros_args=None):
    """Publish once, with stamp 0 (now), to a controller that is there; say what became of it.

    Raises
    ------
    FlexarmError
        When there is no controller, or it refuses the trajectory.
    """
    from .lockstep import trajectory_message

    names = arm_file.load(options.arm).joint_names
    profile_of(options, [0.0] * len(names))  # says what is wrong with the options before it waits
    line = _Conversation(options, ros_args)
    try:
        line.wait_for(
            lambda: line.state is not None and line.publisher.get_subscription_count(),
            f"no controller answers on {line.publisher.topic_name} and controller/state for"
            f" {options.timeout:g} s: start simulator, observer and controller, on this ROS_DOMAIN_ID",
        )
        before = line.state
        message = trajectory_message(
            names, profile_of(options, before.reference_position), options.points
        )
        if options.profile == "quintic" and not options.start:
            # The controller's own quintic to the last point begins at its reference, moving or not.
            message.points = message.points[-1:]
        line.publisher.publish(message)

        def answered():
            now = line.state
            refused = now.rejected_reason not in ("", before.rejected_reason)
            return now.accepted_trajectory_id != before.accepted_trajectory_id or refused

        last = f"; it last refused: {before.rejected_reason}" if before.rejected_reason else ""
        line.wait_for(
            answered, f"the controller took no notice: a repeat of what it follows?{last}"
        )
        if line.state.accepted_trajectory_id == before.accepted_trajectory_id:
            raise FlexarmError(f"refused: {line.state.rejected_reason}")
        print(
            f"{options.profile}: accepted as trajectory {line.state.accepted_trajectory_id},"
            f" {len(message.points)} points, {options.duration:g} s"
        )
    finally:
        line.close()


def main(args=None):
    """Entry point of the executable."""
    words = list(sys.argv[1:] if args is None else args)
    at = words.index("--ros-args") if "--ros-args" in words else len(words)
    parser = argparse.ArgumentParser(
        prog="publish_trajectory",
        description="Publishes a motion on joint_trajectory once.",
        epilog="example: ros2 run flexarm_bringup publish_trajectory paper --arm R",
    )
    add_arguments(parser)
    try:
        publish(parser.parse_args(words[:at]), words[at:])
    except FlexarmError as error:
        print(f"publish_trajectory: {error}", file=sys.stderr)
        sys.exit(1)
    sys.exit(0)


def entry():
    """Entry point of the process."""
    from flexarm_ros.start import leave_after

    leave_after(main)


if __name__ == "__main__":
    entry()
