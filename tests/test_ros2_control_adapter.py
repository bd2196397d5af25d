# SPDX-License-Identifier: Apache-2.0
"""The adapter between ros2_control's topics and flexarm's: names and orders, and efforts that end in time."""

import math

import numpy as np
import pytest
from harness import Bench
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from flexarm_msgs.msg import ArmState, JointTorque
from flexarm_ros.messages import set_stamp, stamp_ns
from flexarm_tools.running.processes import arguments, executable

PARAMETERS = {
    "arm": "two_link",
    "joint_names": ["shoulder", "elbow"],
    "effort_joints": ["joint2", "joint1"],
    "gauge_names": ["link2_root", "link2_middle", "link1_root", "link1_middle"],
    "safe_damping": [2.0, 0.5],
    "torque_timeout": 1.0,  # [s] busy machines are late
    "strain_timeout": 1.0,
}
TICK = 5_000_000  # [ns]


class Arm:
    """What is on the other side: a broadcaster, a strain amplifier, an effort controller."""

    def __init__(self, bench):
        self.bench, self.stamp = bench, 5 * 10**9
        words = {
            k: str(v).replace("'", '"') if isinstance(v, list) else v for k, v in PARAMETERS.items()
        }
        file = bench.processes.logs.parent / "adapter.yaml"
        lines = "".join(f"    {k}: {v}\n" for k, v in words.items())
        file.write_text(f"driver:\n  ros__parameters:\n{lines}")
        command = [executable("flexarm_bringup", "ros2_control_adapter"), *arguments(file=file)]
        bench.processes.start("adapter", command)
        self.states = bench.tap(ArmState, "arm_state")
        self.efforts = bench.tap(Float64MultiArray, "effort_controller/commands")
        self._joints = bench.publisher(JointState, "joint_states")
        self._strain = bench.publisher(Float64MultiArray, "strain")
        self.torques = bench.publisher(JointTorque, "joint_torque")

    def sample(self, velocity=(0.0, 0.0), strain=(3e-6, 4e-6, 1e-6, 2e-6)):
        """Publish samples until one comes back as a state; that state."""
        seen = len(self.states.messages)

        def received():
            self.stamp += TICK
            if strain is not None:
                self._strain.publish(Float64MultiArray(data=list(strain)))
            message = JointState(name=["elbow", "other", "shoulder"], position=[0.2, 9.0, 0.1])
            set_stamp(message.header.stamp, self.stamp)
            message.velocity = [velocity[1], 0.0, velocity[0]]
            self._joints.publish(message)
            new = self.states.messages[seen:]
            whole = [m for m in new if strain is None or np.isfinite(m.strain).all()]
            return whole and whole[-1]

        return self.bench.wait_for("the state", received)

    def efforts_are(self, *expected, **measured):
        """Wait until the effort controller receives this."""

        def right():
            self.sample(**measured)
            return list(self.efforts.newest.data) == pytest.approx(list(expected))

        self.bench.wait_for(f"efforts {expected}", right)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    with Bench(tmp_path_factory.mktemp("adapter") / "log") as bench:
        yield Arm(bench)


def answer(state, torque, **changes):
    fields = {"session": state.session, "sequence": state.sequence, "mode": JointTorque.ENABLED}
    fields |= {"joint_names": ["joint1", "joint2"], "torque": torque, "controller_id": 1}
    return JointTorque(**{**fields, **changes})


def test_a_state_has_the_arm_files_names_and_order(arm):
    state = arm.sample(velocity=(0.3, -0.4))
    assert list(state.joint_names) == ["joint1", "joint2"]
    assert list(state.joint_position) == [0.1, 0.2]
    assert list(state.joint_velocity) == [0.3, -0.4]
    assert list(state.strain) == [1e-6, 2e-6, 3e-6, 4e-6]
    assert list(state.modal_amplitude) == []
    assert stamp_ns(state.header.stamp) % TICK == 0
    later = arm.sample()
    assert later.session == state.session and later.sequence > state.sequence


def test_without_torque_the_efforts_damp_each_joint_and_go_back_to_zero_at_rest(arm):
    # In the effort controller's order; the damping of the second joint would be 8 N m, its limit is 2.
    arm.efforts_are(2.0, -0.6, velocity=(0.3, -16.0))
    arm.efforts_are(0.0, 0.0)


def test_a_torque_becomes_efforts_in_the_controllers_order_until_it_is_late(arm):
    def right():
        arm.torques.publish(answer(arm.sample(velocity=(0.1, 0.0)), [1.5, -100.0]))
        return list(arm.efforts.newest.data) == pytest.approx([-2.0, 1.5])

    arm.bench.wait_for("the torque, clipped", right)
    assert arm.sample().joint_torque[0] == pytest.approx(1.5)
    arm.efforts_are(0.0, -0.2, velocity=(0.1, 0.0))  # no more torque: the safe action
    arm.bench.wait_for("a refusal", lambda: _refuse(arm))


def _refuse(arm):
    arm.torques.publish(answer(arm.sample(), [math.nan, 0.0]))
    return "torque of joint1: nan" in arm.bench.log("adapter")


def test_strains_that_stop_are_missing_and_not_the_last_ones(arm):
    arm.sample()
    arm.bench.wait_for("NaN", lambda: np.isnan(arm.sample(strain=None).strain).all())


def test_the_last_efforts_of_an_adapter_that_is_stopped_are_zero(arm):
    arm.efforts_are(0.0, -0.6, velocity=(0.3, 0.0))
    seen = len(arm.efforts.messages)
    assert arm.bench.stop("adapter", 2) == 0
    arm.bench.wait_for("the last efforts", lambda: len(arm.efforts.messages) > seen)
    arm.bench.wait_for("zero", lambda: list(arm.efforts.newest.data) == [0.0, 0.0])
