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
        default="0.0",
        help="joint angles where the motion starts, comma separated [rad] (default 0)",
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


def profile_of(options, count):
    """The motion that the options describe, for `count` joints."""
    start = _angles(options.start, count, "from")
    end = _angles(options.to, count, "to")
    if options.profile == "quintic":
        return profiles.quintic(start, end, options.duration)
    travel = [b - a for a, b in zip(start, end, strict=True)]
    return profiles.paper_profile(options.duration, travel, start)


def publish(options, ros_args=None):
    """Publish once, with stamp 0 (now), to a controller that is there."""
    import rclpy
    from rclpy.node import Node
    from trajectory_msgs.msg import JointTrajectory

    from flexarm_ros import qos

    from .lockstep import trajectory_message

    names = arm_file.load(options.arm).joint_names
    message = trajectory_message(names, profile_of(options, len(names)), options.points)
    rclpy.init(args=ros_args)
    try:
        node = Node("publish_trajectory")
        publisher = node.create_publisher(JointTrajectory, options.topic, qos.COMMAND)
        end = time.monotonic() + options.timeout
        while publisher.get_subscription_count() == 0:
            rclpy.spin_once(node, timeout_sec=0.05)
            if time.monotonic() > end:
                raise FlexarmError(
                    f"nobody listens on {publisher.topic_name} for {options.timeout:g} s: start the"
                    " controller, on this ROS_DOMAIN_ID"
                )
        publisher.publish(message)
        if not publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=options.timeout)):
            raise FlexarmError("the controller did not acknowledge the trajectory")
        print(f"published {options.profile}: {len(message.points)} points, {options.duration:g} s")
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


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


if __name__ == "__main__":
    main()
