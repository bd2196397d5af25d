# SPDX-License-Identifier: Apache-2.0
"""Writes what one host receives of a loop to standard output, a JSON line per message; moves and recovers on request.

A program and not a fixture, because Fast DDS reads a process's addresses once: each host needs its own process.

    [topic, seconds on the steady clock, what is of interest]

Commands on standard input: ``["move", goal, duration]``, ``["recover"]``; its end ends the program.
"""

import json
import select
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_msgs.msg import ArmState, CompositeState, JointTorque
from flexarm_ros.session import Session

NODES = ("simulator", "observer", "controller")


def _diagnostics(message):
    return {s.name: [s.level[0], s.message] for s in message.status if s.name in NODES}


def _trajectory(goal, duration):
    """From where the arm is to rest at a goal [rad], in so long [s]."""
    when = Duration(seconds=duration).to_msg()
    end = JointTrajectoryPoint(
        positions=[goal], velocities=[0.0], accelerations=[0.0], time_from_start=when
    )
    return JointTrajectory(joint_names=["joint1"], points=[end])


#: Topic to type and to what is of interest in a message; a message without it is not written.
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
    with Session("witness") as session:
        for topic, (kind, _) in TOPICS.items():
            session.tap(kind, topic)
        mover = session.publisher(JointTrajectory, "joint_trajectory")

        recovery = None

        def obey(name, *arguments):
            nonlocal recovery
            if name == "move":
                mover.publish(_trajectory(*arguments))
            elif recovery is None or recovery.answer is not None:
                recovery = session.ask(Trigger, "controller/recover")

        while True:
            if select.select([sys.stdin], [], [], 0.005)[0]:
                line = sys.stdin.readline()
                if not line:
                    break
                obey(*json.loads(line))
            session.serve(0.001)
            for topic, tap in session.taps.items():
                for message in tap.messages:
                    if interesting := TOPICS[topic][1](message):
                        print(json.dumps([topic, time.monotonic(), interesting]))
                tap.messages.clear()
            sys.stdout.flush()


if __name__ == "__main__":
    main()
