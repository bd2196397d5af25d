# SPDX-License-Identifier: Apache-2.0
"""Relays the control path's messages through three processes, without control: the cost of the middleware alone.

Each of three plain nodes answers the message that it gets with a ready-made one of the same type and size, and sends
the same side messages. Nothing is computed. ``python -m flexarm_tools.running.relay ROLE ARM [COUNT|SPIN]``: for a
source, COUNT is the number of round trips. For the others, SPIN is how they are served: ``executor``, by rclpy's
executor, or ``line``, like the real nodes.
"""

import statistics
import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_msgs.msg import ArmState, JointTorque
from flexarm_ros import qos
from flexarm_ros.messages import (
    CompositeStateWriter,
    ObserverStateWriter,
    StateWriter,
    TorqueWriter,
    set_stamp,
)
from flexarm_ros.spin import ControlPath, spin
from flexarm_sim.simulator import Simulator

from .processes import Processes, own_domain


def filled_state(arm):
    """An `ArmState` of the size that the control path has."""
    writer = StateWriter(arm)
    for field in ("joint_position", "joint_velocity", "joint_torque"):
        writer.write(field, [0.0] * len(arm.joints))
    writer.write("strain", [0.0] * len(arm.gauges))
    for field in ("modal_amplitude", "modal_rate"):
        writer.write(field, [0.0] * len(arm.observed_modes))
    return writer.message


def _answer(incoming, outgoing):
    outgoing.header.stamp = incoming.header.stamp
    outgoing.session = incoming.session
    outgoing.sequence = incoming.sequence


def _relay(name, taken, answer, topic, beside, beside_topic):
    """A node that answers each state on the topic `taken` with two ready-made messages.

    The message `beside` is sent only if its topic has subscribers, as in the real nodes.
    """
    node = Node(f"relay_{name}")
    answers = node.create_publisher(type(answer), topic, qos.CONTROL_PATH)
    others = node.create_publisher(type(beside), beside_topic, qos.CONTROL_PATH)

    def relay(incoming):
        _answer(incoming, answer)
        answers.publish(answer)
        if others.get_subscription_count():
            _answer(incoming, beside)
            others.publish(beside)

    node.control_path = ControlPath(
        node.create_subscription(ArmState, taken, relay, qos.CONTROL_PATH)
    )
    return node


def observer(arm):
    """Node in the observer's place."""
    state = ObserverStateWriter(arm).message
    state.gauge_health = bytes(len(arm.gauges))
    estimate = filled_state(arm)
    return _relay("observer", "arm_state", estimate, "arm_state_estimate", state, "observer/state")


def controller(arm):
    """Node in the controller's place."""
    torque, state = TorqueWriter(arm, 0).message, CompositeStateWriter(model.build(arm)).message
    return _relay(
        "controller", "arm_state_estimate", torque, "joint_torque", state, "controller/state"
    )


class Source(Node):
    """Node in the simulator's place; prints the median and mean round trip when done [s]."""

    def __init__(self, arm, count):
        super().__init__("relay_source")
        self.count, self.times = count, []
        self.state = filled_state(arm)
        self._ns = Simulator.START_NS
        self.pub = self.create_publisher(ArmState, "arm_state", qos.CONTROL_PATH)
        self.create_subscription(JointTorque, "joint_torque", self.relay, qos.CONTROL_PATH)
        self.create_timer(0.1, self.resend)

    def resend(self):
        """Send again until the others are there."""
        if not self.times:
            self.pub.publish(self.state)

    def relay(self, msg):
        """Send the next message."""
        if msg.sequence != self.state.sequence:
            return
        self.times.append(time.perf_counter())
        if len(self.times) > self.count:
            gaps = [b - a for a, b in zip(self.times, self.times[1:], strict=False)]
            print(statistics.median(gaps), statistics.fmean(gaps), flush=True)
            raise SystemExit
        self._ns += 1_000_000
        set_stamp(self.state.header.stamp, self._ns)
        self.state.sequence += 1
        self.pub.publish(self.state)


def main():
    """Entry point of one relay process."""
    role, arm = sys.argv[1], arm_file.load(sys.argv[2])
    rclpy.init()
    try:
        if role == "source":
            node = Source(arm, int(sys.argv[3]))
        else:
            node = {"observer": observer, "controller": controller}[role](arm)
        if sys.argv[3:] == ["line"]:
            spin([node], [])
        else:
            rclpy.spin(node)
    except (SystemExit, KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


def measure(arm, log_directory, count=3000, recorder=None):
    """Mean wall time per round trip of a bare relay [s].

    Parameters
    ----------
    arm : str
        Arm file, for the sizes of the messages.
    log_directory : Path
    count : int
        Round trips.
    recorder : callable, optional
        ``recorder(processes)``, a context manager with `poll`: another reader, as in the run that is compared.
    """
    with own_domain() as domain, Processes(domain, log_directory) as processes:
        for role in ("observer", "controller"):
            processes.start_module(f"relay_{role}", "flexarm_tools.running.relay", role, arm)
        if recorder is None:
            source = processes.start_module("relay_source", __name__, "source", arm, str(count))
            source.wait(120)
        else:
            with recorder(processes) as listener:
                source = processes.start_module("relay_source", __name__, "source", arm, str(count))
                while source.poll() is None:
                    time.sleep(listener.POLL_PERIOD)
                    listener.poll()
        del processes.running["relay_source"]
        return float(processes.log("relay_source").split()[-1])


if __name__ == "__main__":
    from flexarm_ros.start import leave_after

    leave_after(main)
