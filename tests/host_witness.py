# SPDX-License-Identifier: Apache-2.0
"""What one host hears of a loop, told on standard output, a JSON line a message; moves and recovers on request.

A program and not a fixture: Fast DDS looks up a process's addresses once, so each host needs a process of its own.

    [topic, seconds on the steady clock, what is of interest]

Commands on standard input: ``["move", goal, duration]``, ``["recover"]``; its end ends the program.
"""

import json
import select
import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_msgs.msg import ArmState, CompositeState, JointTorque
from flexarm_ros import qos

NODES = ("simulator", "observer", "controller")
#: Reliable; deep enough for a witness that falls behind for seconds.
DEEP = QoSProfile(depth=20_000)


def _diagnostics(message):
    return {s.name: [s.level[0], s.message] for s in message.status if s.name in NODES}


def _trajectory(goal, duration):
    """From where the arm is to rest at a goal [rad], in so long [s]."""
    when = Duration(seconds=duration).to_msg()
    end = JointTrajectoryPoint(
        positions=[goal], velocities=[0.0], accelerations=[0.0], time_from_start=when
    )
    return JointTrajectory(joint_names=["joint1"], points=[end])


def _taken(subscription):
    """What has come on a topic, in order."""
    handle = subscription.handle
    with handle:
        while (taken := handle.take_message(subscription.msg_type, False)) is not None:
            yield taken[0]


#: Topic to type and to what is of interest in a message; nothing is said of a message without.
TOPICS = {
    "arm_state": (ArmState, lambda m: {"sequence": m.sequence, "torque": m.joint_torque[0]}),
    "joint_torque": (JointTorque, lambda m: {"sequence": m.sequence, "mode": m.mode}),
    "controller/state": (
        CompositeState,
        lambda m: {
            "state": m.supervisor_state,
            "reference": m.reference_position[0],
            "error": m.position_error[0],
            "accepted": m.accepted_trajectory_id,
            "reason": m.rejected_reason,
        },
    ),
    "/diagnostics": (DiagnosticArray, _diagnostics),
}


def main():
    """Until standard input ends."""
    rclpy.init()
    quiet = {"start_parameter_services": False, "enable_rosout": False}
    node, tapping = Node("witness", **quiet), Node("witness_taps", **quiet)
    executor = SingleThreadedExecutor()
    executor.add_node(node)  # not the other, whose messages are taken here
    taps = {
        topic: tapping.create_subscription(kind, topic, lambda message: None, DEEP)
        for topic, (kind, _) in TOPICS.items()
    }
    mover = node.create_publisher(JointTrajectory, "joint_trajectory", qos.COMMAND)
    recover = node.create_client(Trigger, "controller/recover")

    def obey(name, *arguments):
        if name == "move":
            mover.publish(_trajectory(*arguments))
        elif recover.service_is_ready():
            recover.call_async(Trigger.Request())

    while True:
        if select.select([sys.stdin], [], [], 0.005)[0]:
            line = sys.stdin.readline()
            if not line:
                break
            obey(*json.loads(line))
        executor.spin_once(timeout_sec=0.0)
        for topic, tap in taps.items():
            for message in _taken(tap):
                if told := TOPICS[topic][1](message):
                    print(json.dumps([topic, time.monotonic(), told]))
        sys.stdout.flush()
    node.destroy_node()
    tapping.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
