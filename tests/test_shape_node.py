# SPDX-License-Identifier: Apache-2.0
"""The node `shape` draws what the topics say: markers, and joint states of the URDF."""

import numpy as np
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.urdf import PieceChain
from flexarm_dynamics.models import model
from flexarm_msgs.msg import ArmState, CompositeState
from flexarm_ros.messages import StateWriter
from flexarm_tools.running.processes import arguments, executable


def test_markers_and_joint_states_are_of_the_state_that_came(bench):
    own = {"arm": "two_link", "state_topic": "arm_state", "pieces": 4, "draw_rate": 100.0}
    command = [executable("flexarm_bringup", "shape"), *arguments(own)]
    bench.processes.start("shape", command)
    shapes = bench.tap(MarkerArray, "shape")
    joints = bench.tap(JointState, "shape/joint_states")
    publisher = bench.publisher(ArmState, "arm_state")
    controls = bench.publisher(CompositeState, "controller/state")
    arm_model = model.build(arm_file.load("two_link"))
    q, delta = np.array([0.4, -0.2]), np.array([0.03, 0.0, -0.01, 0.0])
    writer = StateWriter(arm_model.arm)
    writer.head(1_500_000_000, session=7, sequence=3)
    writer.write("joint_position", q)
    writer.write("modal_amplitude", delta)
    state = writer.message
    control = CompositeState(joint_names=list(state.joint_names))
    control.slow_torque, control.fast_torque = [2.0, 0.0], [0.0, 0.5]
    tip = arm_model.tip_position(q, delta)

    def drawn():
        # As a running loop does: again and again.
        controls.publish(control)
        publisher.publish(state)
        if not shapes.messages or not joints.messages:
            return None
        markers = {(m.ns, m.id): m for m in shapes.newest.markers}
        return markers if markers["fast_torque", 1].action == 0 else None

    markers = bench.wait_for("a picture with torques", drawn)
    at = markers["tip", 0].pose.position
    np.testing.assert_allclose([at.x, at.y, at.z], tip, atol=1e-12)
    assert markers["beam", 0].header == state.header
    up = markers["slow_torque", 0].points
    # 2 of 5 N m, about z.
    assert up[1].z > 0.0 and markers["fast_torque", 0].action == 2
    chain = PieceChain(arm_model, 4)
    assert joints.newest.name == list(chain.joint_names)
    np.testing.assert_array_equal(joints.newest.position, chain.joint_values(q, delta))
    # It looks on: the loop's publishers wait for no such reader.
    (info,) = bench.node.get_subscriptions_info_by_topic("/arm_state")
    assert info.qos_profile.reliability.name == "BEST_EFFORT"
    assert info.qos_profile.depth in (0, 1)
