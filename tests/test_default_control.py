# SPDX-License-Identifier: Apache-2.0
"""The default control of the three nodes on the paper's arm, in lockstep at 1 kHz, by its figures."""

import pytest
from in_process import InProcess

from flexarm_control.motions import profiles
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.units import POUND_FORCE_FOOT
from flexarm_dynamics.models.model import build
from flexarm_studies.loop import closed_loop, metrics
from flexarm_tools.recording import recorder
from flexarm_tools.running import lockstep


@pytest.mark.parametrize(
    ("feedforward", "error", "residual"), [("model", 0.2, 1e-5), ("preview", 0.03, 2e-6)]
)
def test_nodes_track_like_a_rigid_arm_and_do_not_ring(feedforward, error, residual):
    start = closed_loop.TRAJECTORY_START_NS
    with InProcess() as nodes:
        nodes.start_loop(
            {"lockstep": True, "publish_rates": True},
            {"observer.type": "true_rates"},
            {"torque_limit": [3.2 * POUND_FORCE_FOOT], "feedforward": feedforward},
            arm="R",
            state_timeout=60.0,
        )
        message = lockstep.trajectory_message(("joint1",), profiles.paper_profile(), 101, start)
        samples = nodes.record(message, 8.0)
    record = recorder.to_record(samples, start, "R")
    found = metrics.case_study_metrics(record, build(arm_file.load("R")), until=8.0)
    assert found["peak_joint_error_deg"] <= error
    assert found["residual_tip_rms_ft"] <= residual
    assert found["peak_torque_lbf_ft"]["total"] <= 3.2
