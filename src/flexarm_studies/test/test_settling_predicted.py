# SPDX-License-Identifier: Apache-2.0
"""What a design predicts of the time until the tip settles, against simulated arms that are not its model."""

import numpy as np
import pytest

from flexarm_control.robust.design import design
from flexarm_control.robust.settings import Settings
from flexarm_control.robust.settling import ANGLE, residuals
from flexarm_control.robust.uncertain import Uncertainty
from flexarm_dynamics.models.model import build
from flexarm_studies.comparison.controllers import Setup
from flexarm_studies.random_arms import generator
from flexarm_studies.uncertain import trial
from flexarm_studies.uncertain.baselines import RATE, task_of
from flexarm_studies.uncertain.plants import DELAY, VARIANTS


@pytest.mark.long
@pytest.mark.parametrize("number", [9, 33])
def test_the_tip_settles_when_the_design_predicts(number):
    """One link with finite slopes, a mode more and friction, a slow arm and a quick one; within half a locked period.

    The linear arm at rest knows neither the configurations on the way nor the motion's own bending.
    """
    case = generator.arm(number)
    start, middle, end = (tuple(q.tolist()) for q in task_of(case).places)
    places = (middle, start, end)
    found = design(case.read(), Settings(RATE, DELAY, configurations=places, effort=0.3))
    assert np.abs(task_of(case).profile.angle).max() == pytest.approx(ANGLE, rel=0.21)
    last = len(found.sets) - 1
    predicted = residuals(
        build(case.read().known), found.configurations[last], found.sampling, Uncertainty()
    )
    setup = Setup(found.parameters() | {"rate": RATE})
    for name, one in zip(
        ("payload x0.7", "payload x1.3", "stiffness x0.9"), predicted[::3], strict=True
    ):
        run = trial.run(case, setup, VARIANTS[name])
        assert run["settling_periods"] == pytest.approx(one.settling(found.sets[last]), abs=0.5), (
            name
        )


def test_a_motion_begins_with_the_full_torque():
    case = generator.arm(0)
    loop = trial.loop_of(case, Setup({"rate": RATE, "stability_margin": -1e6}), VARIANTS["exact"])
    authority, torque = loop.controller._authority, 1e-3 * np.ones(1)
    authority.begin(np.zeros(1), False)
    authority.send(torque, 1.0 / RATE, 1.0 / RATE)
    assert authority.torque == pytest.approx(torque)
