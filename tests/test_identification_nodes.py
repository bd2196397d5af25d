# SPDX-License-Identifier: Apache-2.0
"""``flexarm excite`` on the simulator in lockstep, and ``flexarm identify`` on the bag that it wrote."""

import json

import pytest
from rclpy.node import Node
from std_srvs.srv import SetBool

from flexarm_bringup import cli
from flexarm_dynamics.arm import arm_file
from flexarm_msgs.msg import ArmState, JointTorque
from flexarm_ros import qos
from flexarm_tools.recording.recorder import keep_for_recording
from flexarm_tools.running.processes import arguments, executable

RATE = 100.0
#: What the file that is given says wrongly.
TRUTH, GIVEN = "EI_y: 11.81904468463035", "EI_y: 14.0"


def start_excite(bench, arm, bag, *words):
    """Start ``flexarm excite``."""
    command = [executable("flexarm_bringup", "flexarm"), "excite", str(arm), "--out", str(bag)]
    bench.processes.start("excite", [*command, *words])


def end_excite(bench):
    """Wait for its end; exit code and output."""
    return bench.end_of("excite", 2 * bench.PATIENCE), bench.log("excite")


@pytest.fixture
def arms(tmp_path):
    """An arm with friction, an encoder and noise, and a file of it with the wrong stiffness and friction."""
    text = arm_file.find("one_link").read_text().replace("model: chain ", "model: one_link ")
    text = text.replace("full_scale: 5.0e-3", "full_scale: 5.0e-3, noise: 5.0e-7")
    text = text.replace("encoder_counts: 0 ", "encoder_counts: 65536 ")
    truth, given = tmp_path / "truth.yaml", tmp_path / "given.yaml"
    truth.write_text(text.replace("viscous: 0.0", "viscous: 0.2"))
    assert TRUTH in text and "viscous: 0.0" in text
    given.write_text(text.replace(TRUTH, GIVEN).replace("viscous: 0.0", "viscous: 0.1"))
    return truth, given


@pytest.mark.long
def test_an_arm_is_shaken_recorded_and_identified(bench, arms, tmp_path, capsys):
    truth, given = arms
    own = {"arm": str(truth), "rate": RATE, "lockstep": True, "resend_period": 0.02, "noise": True}
    # No state is lost to a recorder that the machine leaves waiting.
    own |= keep_for_recording("simulator")
    bench.start("simulator", own)
    torques = bench.tap(JointTorque, "joint_torque")
    bag = tmp_path / "bag"
    words = ["--amplitude", "6", "--duration", "3", "--rest", "1", "--kind", "sweep"]
    start_excite(bench, given, bag, *words, "--allow-motion")
    # 400 samples in lockstep can be over before a listener has been discovered: the simulator stands until then.
    bench.wait_for("a torque of excite", lambda: torques.messages)
    bench.call(SetBool, "simulator/pause", data=False)
    code, output = end_excite(bench)
    assert code == 0, output
    # Three seconds and one, while the torque was on; after that it was off.
    assert "400 states in" in output
    assert torques.messages[-1].mode == JointTorque.DISABLED
    options = cli.parser().parse_args(["identify", str(bag), str(given), "--json"])
    options.function(options)
    result = json.loads(capsys.readouterr().out)
    assert result["samples"] > 390 and not result["warnings"]
    found = {r["name"]: r for r in result["parameters"]}
    truth = {
        "joints[0].hub_inertia": 1.3558179483314003,
        "joints[0].friction.viscous": 0.2,
        "links[0].EI_y": 11.81904468463035,
        "links[0].flexible.y.damping[0]": 0.005,
        "payload.mass": 0.04524109910533972,
        "gauges[0].gain": 1.0,
        "gauges[1].gain": 1.0,
    }
    for name, value in truth.items():
        row = found[name]
        # One noise is one draw: half as much again as the interval.
        assert abs(row["value"] - value) < 1.5 * row["half_width"], name
        assert row["half_width"] < 0.1 * value, name
    # The arm still rings: a low strain limit ends it before it has begun.
    other = tmp_path / "other"
    start_excite(bench, given, other, *words, "--allow-motion", "--strain-limit", "1e-5")
    code, output = end_excite(bench)
    assert code == 1 and "beyond its limit 1e-05; take a smaller amplitude" in output
    assert not other.exists()
    assert torques.messages[-1].mode == JointTorque.DISABLED


def test_nothing_moves_before_the_recorder_is_connected(bench):
    arm = {"arm": "one_link", "rate": RATE}
    lockstep = {"lockstep": True, "pause_at": -1.0, "resend_period": 0.02}
    bench.start("simulator", {**arm, **lockstep})
    torques, states = bench.tap(JointTorque, "joint_torque"), bench.tap(ArmState, "arm_state")
    own = {"amplitude": 0.5, "duration": 0.2, "recorder": "late_recorder", "readers": 2}
    bench.processes.start(
        "excite", [executable("flexarm_control", "excite"), *arguments({"arm": "one_link", **own})]
    )
    readers = bench.node.get_subscriptions_info_by_topic
    bench.wait_for("excite to read the states", lambda: len(readers("/arm_state")) == 2)
    seen = len(states.messages)
    bench.wait_for("more states", lambda: len(states.messages) > seen + 50)
    assert not torques.messages
    late = Node("late_recorder", context=bench.node.context)
    try:
        late.create_subscription(
            JointTorque, "joint_torque", lambda message: None, qos.CONTROL_PATH
        )
        bench.wait_for("a torque", lambda: torques.messages)
    finally:
        late.destroy_node()
