# SPDX-License-Identifier: Apache-2.0
"""The default control of the three nodes on the paper's arm, in lockstep at 1 kHz: samples of the loop without ROS.

Its figures over the whole motion are tested without ROS, in `test_beyond_the_paper`.
"""

import numpy as np
import pytest
from in_process import InProcess

from flexarm_control.motions import profiles
from flexarm_dynamics.arm.units import POUND_FORCE_FOOT
from flexarm_studies.case_study import runs as case_study
from flexarm_studies.loop import closed_loop
from flexarm_tools.recording import recorder
from flexarm_tools.running import lockstep

#: Past the end of the motion, which takes 2 s [s].
DURATION = 2.3
LIMIT = [3.2 * POUND_FORCE_FOOT]


def without_ros(feedforward):
    """The same run in one loop, under what the nodes have by default."""
    loop = closed_loop.ClosedLoop(
        "R",
        {"type": "linear_model_following"},
        {"type": "lqr"},
        {"type": "true_rates"},
        {"publish_rates": True},
        {"feedforward": feedforward, "torque_limit": LIMIT},
        {"type": "corrected"},
    )
    return loop.run(case_study.paper_trajectory(loop.model.joint_names), DURATION)


@pytest.mark.parametrize("feedforward", ["model", "preview"])
def test_nodes_give_every_sample_of_the_loop_without_ros(feedforward):
    start = closed_loop.TRAJECTORY_START_NS
    with InProcess() as nodes:
        nodes.start_loop(
            {"lockstep": True, "publish_rates": True},
            {"observer.type": "true_rates"},
            {"torque_limit": LIMIT, "feedforward": feedforward},
            arm="R",
            state_timeout=60.0,
        )
        message = lockstep.trajectory_message(("joint1",), profiles.paper_profile(), 101, start)
        samples = nodes.record(message, DURATION)
    found, alone = recorder.to_record(samples, start, "R"), without_ros(feedforward)
    assert np.ptp(found.position) > 1.0
    for name in ("time", "reference", "position", "amplitude", "torque", "fast_torque"):
        ours, theirs = getattr(found, name), getattr(alone, name)
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-9, err_msg=name)
