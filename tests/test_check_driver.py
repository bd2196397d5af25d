# SPDX-License-Identifier: Apache-2.0
"""``flexarm check_driver`` on running drivers: the simulator in real time passes, a drive without power does not."""

import pytest
from test_driver_template import RATE, TIMEOUT, check_driver, start_template

from flexarm_msgs.msg import JointTorque


@pytest.mark.real_time
def test_the_simulator_in_real_time_passes(bench):
    bench.start("simulator", {"arm": "R", "rate": RATE, "torque_timeout": TIMEOUT})
    code, output = check_driver(bench)
    assert code == 0, output
    assert "mode" in output and "on a separate clock" in output
    bench.publisher(JointTorque, "joint_torque")
    # Long enough for this publisher to be discovered before the arm would be pushed.
    code, output = check_driver(bench, "--duration", "3")
    assert code == 1 and "joint_torque: a controller sends it; stop it" in output


@pytest.mark.real_time
def test_a_drive_that_ignores_torque_fails_with_a_message(bench, tmp_path):
    start_template(bench, tmp_path / "arm", "--ignore-torque")
    code, output = check_driver(bench)
    assert code == 1, output
    failed = [line for line in output.splitlines() if line.startswith("FAIL")]
    assert [line.split("  ")[2].strip() for line in failed] == ["torque reported", "response"], (
        output
    )
    assert all("torque is ignored" in line for line in failed)


def test_without_a_driver_it_says_so(bench):
    code, output = check_driver(bench, "--timeout", "0.2")
    assert code == 1
    assert output.startswith(
        "flexarm check_driver: waited 0.2 s in vain for arm_state; start the driver"
    )
