# SPDX-License-Identifier: Apache-2.0
"""Running nodes: malformed messages and parameters over DDS, in lockstep; afterwards they must still hold an arm."""

import sys
import tempfile
import time
from array import array
from pathlib import Path
from random import Random

from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter as RosParameter
from std_srvs.srv import SetBool, Trigger

from flexarm_dynamics.arm import arm_file
from flexarm_msgs.msg import ArmState, CompositeState, JointTorque
from flexarm_ros.messages import set_stamp
from flexarm_ros.session import plain

from . import odd
from .files import Parameters, declared
from .messages import good_state, good_torque, spoil_state, spoil_torque
from .tally import Tally
from .trajectories import good_points, spoil_points

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import harness

NODES = ("simulator", "observer", "controller")
#: Fractions of the messages that go to each topic; the rest are parameters.
FRACTIONS = {
    "arm_state": 0.35,
    "arm_state_estimate": 0.2,
    "joint_torque": 0.2,
    "joint_trajectory": 0.15,
}
#: Timeout of each wait [s].
PATIENCE = 180.0
#: After this many messages, which get no answer, a service call checks that the node is alive.
AT_ONCE = 5
#: Number of times that a state without an answer is sent again.
MAX_TRIES = 20


class Nodes:
    """Three nodes, and this program, which sends them malformed messages."""

    def __init__(self, bench, seed):
        self.bench, self.random = bench, Random(f"{seed} nodes")
        self.description = arm_file.load("R")
        bench.start_loop(
            arm="R",
            simulator={"lockstep": True, "pause_at": -1.0},
            controller={"state_timeout": 3600.0},
        )
        self.arm = harness.Arm(bench, joints=self.description.joint_names)
        self.wait("the controller to be ready", self.arm.ready)
        self.given = self._parameters()
        self.session = 0

    def wait(self, what, condition):
        """Wait for a condition; unread messages are dropped."""

        def holds():
            for tap in self.bench.taps.values():
                del tap.messages[:-50]
            return condition()

        return self.bench.wait_for(what, holds)

    def alive(self, *nodes):
        """Each node answers a service."""
        self.bench.processes.check()
        for node in nodes or NODES:
            assert self.bench.lifecycle(node) == "active", f"{node} is not active"

    # Messages that are answered by the next node -----------------------------------------------------

    def states(self, topic, count, tally):
        """Send states to the observer or the controller; each must be answered by a torque."""
        publisher = self.bench.publisher(ArmState, topic, 2)  # the tap is a reader, too
        self.session += 10**6  # earlier numbers are late samples, which get no answer
        for k in range(count):
            msg = good_state(self.random, self.description)
            set_stamp(msg.header.stamp, 10**9 + 10**6 * k)
            if self.random.random() < 0.7:
                spoil_state(self.random, msg)
            # The answer shows that it was read; this number identifies it.
            msg.session, msg.sequence = self.session, k
            if self.random.random() < 0.02:
                msg.session += 1 + k  # the source has restarted
            publisher.publish(msg)
            key, tries = (msg.session, msg.sequence), [time.monotonic()]

            def answered(key=key, tries=tries, msg=msg):
                if harness.answers(self.arm.torques, *key) or len(tries) > MAX_TRIES:
                    return True
                if time.monotonic() > tries[-1] + 0.5:  # replaced: only the newest one is kept
                    tries.append(time.monotonic())
                    publisher.publish(msg)
                return False

            self.wait(f"an answer to {topic} {k}", answered)
            if k % AT_ONCE == 0 and self.arm.state.supervisor_state == CompositeState.FAULT:
                self.bench.call(Trigger, "controller/recover")
            answers = harness.answers(self.arm.torques, *key)
            tally.inputs += 1
            if not answers:
                tally.failures += 1
                tally.first.setdefault("silence", f"{topic} {k}: no torque answers it: {msg}")
            for answer in answers:
                finite = all(abs(u) < 1e9 for u in answer.torque)
                tally.refused += answer.mode == JointTorque.DISABLED
                if not finite:
                    tally.failures += 1
                    tally.first.setdefault(
                        "torque", f"{topic} {k}: a torque of {list(answer.torque)}"
                    )
                break

    # Messages without an answer ------------------------------------------------------------------------

    def torques(self, count, tally):
        """Send torques to the simulator, for its session or another one."""
        publisher = self.bench.publisher(JointTorque, "joint_torque", 2)
        for k in range(count):
            msg = spoil_torque(self.random, good_torque(self.random, self.description))
            if self.random.random() < 0.5 and self.arm.measured.newest is not None:
                newest = self.arm.measured.newest
                msg.session, msg.sequence = newest.session, newest.sequence
            publisher.publish(msg)
            self._sometimes(k, "simulator")
            tally.inputs += 1

    def trajectories(self, count, tally):
        """Send trajectories to the controller."""
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        joints = list(self.description.joint_names)
        for k in range(count):
            msg = JointTrajectory(joint_names=joints)
            for point in spoil_points(self.random, good_points(self.random, joints)):
                try:
                    out = JointTrajectoryPoint()
                    sec, nanosec = divmod(int(point[0]), 10**9)
                    fields = [array("d", values) for values in point[1:]]
                except Exception:  # what no message holds can't be sent
                    continue
                if len(fields) != 4:
                    continue
                # rclpy does not check; the conversion to C does, and its error can't be caught.
                sec = (sec + 2**31) % 2**32 - 2**31
                out.time_from_start.sec, out.time_from_start.nanosec = sec, nanosec
                out.positions, out.velocities, out.accelerations, out.effort = fields
                msg.points.append(out)
            if self.random.random() < 0.3:
                msg.joint_names = odd.names(self.random, joints)
            if self.random.random() < 0.2:
                msg.header.stamp.sec = odd.unsigned(self.random) - 2**31
            self.bench.publisher(JointTrajectory, "joint_trajectory").publish(msg)
            self._sometimes(k, "controller")
            tally.inputs += 1

    def _sometimes(self, k, node):
        if k % AT_ONCE == AT_ONCE - 1:
            self.alive(node)

    # Parameters ------------------------------------------------------------------------------------------

    def _parameters(self):
        """Values of the controller's and observer's own parameters that may be changed."""
        wanted = {"observer": [], "controller": []}
        for prefix, group in declared().items():
            node = "observer" if prefix == "observer." else "controller"
            if prefix == "simulator ":
                continue
            for p in group:
                if not p.read_only and (p.kind not in ("string_array",)):
                    wanted[node].append(prefix.replace("controller ", "") + p.name)
        out = {}
        for node, names in wanted.items():
            # If one of the names is not declared, the answer contains no values.
            answer = self.bench.call(GetParameters, f"{node}/get_parameters", names=names)
            for name, value in zip(names, answer.values, strict=True):
                out[node, name] = plain(value)
        return out

    def parameters(self, count, tally):
        """Set declared parameters to values of any type and size."""
        groups = {k.replace(" ", ""): v for k, v in declared().items()}
        for _ in range(count):
            prefix = self.random.choice(tuple(groups))
            node = {"simulator": "simulator", "observer.": "observer"}.get(prefix, "controller")
            parameter = self.random.choice(groups[prefix])
            name = parameter.name if prefix in NODES else prefix + parameter.name
            value = Parameters.value(self.random, parameter)
            if not _sendable(value):
                continue
            try:
                request = [RosParameter(name, value=value).to_parameter_msg()]
            except Exception:  # what no message holds can't be sent
                continue
            answer = self.bench.call(SetParameters, f"{node}/set_parameters", parameters=request)
            result = answer.results[0]
            tally.inputs += 1
            tally.refused += not result.successful
            if not result.successful and not result.reason:
                tally.failures += 1
                tally.first.setdefault("reason", f"{name}: refused without a reason")

    # The end -----------------------------------------------------------------------------------------------

    def prove(self):
        """Check that the same processes hold the arm and follow a motion, with their initial parameters."""
        self.alive()
        for node in ("observer", "controller"):
            mine = {
                name.replace(".", "__"): v for (of, name), v in self.given.items() if of == node
            }
            answer = self.bench.set_atomically(node, **mine)
            assert answer.successful, f"{node}: {answer.reason}"
        self.bench.call(SetBool, "simulator/pause", data=False)
        answer = self.bench.call(Trigger, "simulator/reset")
        session, again = int(answer.message.split()[-1]), [0.0]

        def healthy():
            state = self.arm.state
            if state.session != session or state.supervisor_state == CompositeState.FAULT:
                if time.monotonic() > again[0]:
                    again[0] = time.monotonic() + 2.0
                    self.bench.call(Trigger, "controller/recover")
                return False
            return self.arm.ready()

        self.wait(f"torque in session {session}", healthy)
        n, before, again = (
            len(self.description.joints),
            self.arm.state.accepted_trajectory_id,
            [0.0],
        )
        point = (1.0, [0.3] * n, [0.0] * n, [0.0] * n)
        message = harness.trajectory(self.description.joint_names, point)

        def arrived():
            state = self.arm.state
            if state.accepted_trajectory_id == before and time.monotonic() > again[0]:
                again[0] = time.monotonic() + 1.0
                self.arm.publish_trajectory(message)
            there = all(abs(q - 0.3) < 1e-9 for q in state.reference_position)
            return there and state.supervisor_state == CompositeState.HOLDING

        self.wait("a healthy motion to end", arrived)


def _sendable(value):
    """Whether a message can hold a value. rclpy does not check all; the rest fails in C, and can't be caught."""
    if isinstance(value, list):
        return all(
            type(v) is type(value[0]) and not isinstance(v, list) and _sendable(v) for v in value
        )
    if type(value) is int:
        return -(2**63) <= value < 2**63
    return type(value) in (bool, float, str)


def fuzz(count, seed, say):
    """Send `count` messages to running nodes; return a `Tally` of each kind, and call `say` with it."""
    tallies = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, harness.Bench(folder) as bench:
        bench.patience = max(bench.patience, PATIENCE)
        nodes = Nodes(bench, seed)

        def part(name, fraction, action):
            tally, started = Tally(f"DDS {name}"), time.perf_counter()
            tallies.append(tally)
            try:
                action(max(1, round(fraction * count)), tally)
            except Exception as error:
                tally.failures += 1
                tally.first["died"] = (
                    f"{tally.name} {tally.inputs}: {type(error).__name__}: {error}"
                )
            tally.seconds = time.perf_counter() - started
            say(tally)

        part("trajectories", FRACTIONS["joint_trajectory"], nodes.trajectories)
        part("parameters", 1.0 - sum(FRACTIONS.values()), nodes.parameters)
        # Stop the node that would answer as well as this program.
        bench.change("controller", "deactivate")
        part("torques", FRACTIONS["joint_torque"], nodes.torques)
        bench.change("controller", "activate")
        bench.change("simulator", "deactivate")
        part("states", FRACTIONS["arm_state"], lambda n, t: nodes.states("arm_state", n, t))
        part(
            "estimates",
            FRACTIONS["arm_state_estimate"],
            lambda n, t: nodes.states("arm_state_estimate", n, t),
        )
        bench.change("simulator", "activate")
        part("afterwards", 0.0, lambda n, t: nodes.prove())
    return tallies
