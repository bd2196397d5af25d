# SPDX-License-Identifier: Apache-2.0
"""The simulated arm as the hardware of ros2_control's topics: plain JointState messages, as it sends them."""

import math
import re

import numpy as np
import pytest
from in_process import InProcess
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from flexarm_control.motions import profiles

#: As the interface has them in its URDF, and the node here.
COMMANDS, STATES = "robot_joint_commands", "robot_joint_states"


class Controllers:
    """Stands for a controller manager with the interface: a command, then the state that comes back."""

    def __init__(self, arm, **parameters):
        self.bench = InProcess()
        lockstep = {"arm": arm, "lockstep": True, "rate": 1000.0, "command_rate": 125.0}
        self.node = self.bench.start("hardware", {**lockstep, **parameters})
        self.states = self.bench.tap(JointState, STATES)
        self.strains = self.bench.tap(Float64MultiArray, "strain")
        self.commands = self.bench.publisher(JointState, COMMANDS)
        self.bench.wait_for("the first state", lambda: self.states.messages, patience=1.0)

    def send(self, **fields):
        """Send a command; the state after it."""
        before = len(self.states.messages)
        self.commands.publish(JointState(**fields))
        self.bench.wait_for("a state", lambda: len(self.states.messages) > before, patience=1.0)
        return self.states.newest

    def __enter__(self):
        return self

    def __exit__(self, *_):
        node, self.node = self.node, None
        del node
        self.bench.close()


def test_positions_move_the_joints_and_the_links_bend_and_swing_on():
    motion, position, strain = profiles.quintic(0.0, 0.6, 0.6), [], []
    with Controllers("one_link") as manager:
        for k in range(1, 200):
            wanted = motion.position(min(k / 125, 0.6))
            state = manager.send(name=["joint1"], position=[float(wanted[0])])
            position.append(state.position[0])
            strain.append(manager.strains.newest.data[0])
        assert state.name == ["joint1"]
        assert state.header.stamp.sec + 1e-9 * state.header.stamp.nanosec == pytest.approx(
            1 + 199 / 125
        )
    assert position[-1] == pytest.approx(0.6, abs=0.02)
    strain = np.abs(strain)
    assert strain.max() > 1e-4  # it bends as it is moved
    assert strain[-40:].max() > 1e-5  # and after the end


def test_joints_come_in_any_order_and_with_others_of_the_robot():
    with Controllers("two_link", rate=500.0, bandwidth=5.0) as manager:
        for _ in range(60):
            state = manager.send(
                name=["gripper", "joint2", "joint1"], position=[9.0, 0.2, 0.1], velocity=[]
            )
    assert state.position[1] > state.position[0] > 0.0


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"name": ["joint1"], "position": [math.nan]}, "position: .* is not finite"),
        ({"name": ["other"], "position": [0.1]}, "'joint1' is missing"),
        ({"name": ["joint1"], "position": [0.1, 0.2]}, "position: 2 values"),
        ({"name": ["joint1"]}, "give position, velocity or effort"),
    ],
)
def test_a_command_that_can_not_be_used_is_refused_and_the_last_one_goes_on(fields, text):
    with Controllers("one_link") as manager:
        manager.send(name=["joint1"], position=[0.1])
        count = len(manager.states.messages)
        manager.commands.publish(JointState(**fields))
        state = manager.send(name=["joint1"], position=[0.1])
        assert len(manager.states.messages) == count + 1
        assert np.isfinite(state.position[0])
        log = manager.bench.log("hardware")
        assert "command refused, the last one goes on" in log
        assert re.search(text, log)


def test_faults_on_purpose_are_in_the_states():
    faults = ["joint_position bias by=0.25"]
    with Controllers("one_link", allow_faults=True, faults=faults) as manager:
        state = manager.send(name=["joint1"], position=[0.0])
    assert state.position[0] == pytest.approx(0.25, abs=1e-3)
