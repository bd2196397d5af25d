# SPDX-License-Identifier: Apache-2.0
"""The payload's estimate in the nodes: a load twice as heavy is weighed in motion, taken over, and reported."""

from pathlib import Path

import pytest
import yaml
from in_process import InProcess

from flexarm_control.motions import profiles
from flexarm_studies.loop import closed_loop
from flexarm_tools.running import lockstep

ARM = Path(__file__).parents[1] / "config" / "arms" / "R.yaml"


def with_twice_the_payload(folder):
    """Arm R's file with twice the payload."""
    data = yaml.safe_load(ARM.read_text())
    data["payload"]["mass"] *= 2.0
    inertia = data["payload"]["inertia"]
    data["payload"]["inertia"] = (
        [2.0 * i for i in inertia] if isinstance(inertia, list) else 2.0 * inertia
    )
    path = folder / "heavy.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    return str(path)


def taken_over(nodes):
    """Payload that the control is made for, once it is another; the parameter; the diagnostics."""
    controller = nodes.nodes["controller"]
    core = controller.core
    nodes.wait_for("another payload", lambda: core.payload_scale != 1.0)
    return core.payload_scale, controller.parameters["payload_scale"], controller.diagnose()[2]


def test_a_heavier_payload_is_weighed_taken_over_and_reported(tmp_path):
    start = closed_loop.TRAJECTORY_START_NS
    with InProcess() as nodes:
        nodes.start_loop(
            {
                "lockstep": True,
                "publish_rates": True,
                "plant_arm": with_twice_the_payload(tmp_path),
            },
            {"observer.type": "true_rates"},
            {"payload_estimate": "online", "slow.type": "model_following"},
            arm="R",
            state_timeout=60.0,
        )
        message = lockstep.trajectory_message(("joint1",), profiles.paper_profile(), 101, start)
        nodes.record(message, 4.0)
        carried, parameter, values = taken_over(nodes)
    assert carried == parameter == pytest.approx(2.0, abs=0.1)
    assert values["payload estimate is"] == "usable"
    assert float(values["payload in use"]) == pytest.approx(carried)
