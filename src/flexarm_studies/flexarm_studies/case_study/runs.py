# SPDX-License-Identifier: Apache-2.0
"""Makes the runs of the paper's case study and their summaries, with the same objects that the nodes call."""

import math
from dataclasses import dataclass

import numpy as np

from flexarm_control import trajectory
from flexarm_control.composite import assembly
from flexarm_control.motions import profiles
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model

from ..loop import closed_loop, metrics, scenario
from ..loop.scenario import Scenario

DURATION = 8.0  # [s] from the start of the trajectory
FINAL = np.array([math.pi / 2])


@dataclass(frozen=True)
class Run:
    """One run of the case study.

    Attributes
    ----------
    arm, gain : str
        Arm file, and the factor of the bracket of (17): m11 or h11.
    control : str
        ``slow`` or ``composite``.
    rates : str
        ``true``: the simulator's own; ``observer``: reconstructed from the gauges.
    """

    arm: str
    gain: str
    control: str
    rates: str = "true"

    @property
    def model(self):
        """Name in the summary: arm and gain."""
        return f"{self.arm}_{self.gain}"

    @property
    def name(self):
        """Name of the run's directory."""
        return f"{self.model}_{self.control}" + ("_observer" if self.rates == "observer" else "")

    @property
    def file(self):
        """Controller file of the run."""
        return "paper_composite" if self.control == "composite" else "paper_slow"

    @property
    def controller(self):
        """Parameters of the controller beyond its file."""
        return {"arm": self.arm, "slow.gain": self.gain, "state_timeout": 60.0}

    @property
    def observer(self):
        """Parameters of the observer beyond its file."""
        return {"arm": self.arm} | ({"observer.type": "true_rates"} if self.rates == "true" else {})

    @property
    def simulator(self):
        """Parameters of the simulator."""
        return {
            "arm": self.arm,
            "publish_rates": self.rates == "true",
            "level": "first_order",  # the paper's equations
        }


RUNS = (
    Run("P3", "h11", "slow"),
    Run("P3", "h11", "composite"),
    Run("P3", "m11", "slow"),
    Run("P3", "m11", "composite"),
    Run("R", "m11", "slow"),
    Run("R", "m11", "composite"),
    Run("R", "m11", "composite", "observer"),
)


def law_of(run, arm_model):
    """The run's composite control, from its controller file."""
    return assembly.control(arm_model, scenario.parameters(run.file) | {"slow.gain": run.gain})


def run_without_ros(run, recorder=None):
    """The run in one process, with the objects that the nodes call; the `recorder` is that of `scenario.run_loop`.

    Returns
    -------
    Record
    """
    values = scenario.parameters(run.file) | {"slow.gain": run.gain, "level": "first_order"}
    if run.rates == "true":
        values["observer.type"] = "true_rates"
    loop = scenario.loop_of(Scenario(run.arm, values))
    motion = paper_trajectory(loop.model.joint_names)
    if recorder is None:
        return loop.run(motion, DURATION)
    with recorder(loop, run.arm, values["observer.type"]):
        return loop.run(motion, DURATION)


def paper_trajectory(joint_names, points=101):
    """The paper's motion as the controller reads it from a topic, starting at the common instant."""
    s = profiles.sample(profiles.paper_profile(), points)
    rows = zip(s.times, s.positions, s.velocities, s.accelerations, strict=True)
    return trajectory.validate(
        joint_names,
        joint_names,
        closed_loop.TRAJECTORY_START_NS,
        [(round(t * 1e9), p, v, a, ()) for t, p, v, a in rows],
    )


def continuous(run):
    """The run's metrics in the continuous loop: full state, no sampling, no sensors."""
    arm_model = model.build(arm_file.load(run.arm))
    times = np.arange(0, round(DURATION * 1000) + 1) * 1e-3
    record = closed_loop.continuous_loop(
        arm_model, law_of(run, arm_model), profiles.paper_profile(), times
    )
    return metrics.case_study_metrics(record, arm_model)


def summarise(run, record, timing):
    """The run's entry in ``summary.json``; every value is computed from this run."""
    arm_model = model.build(arm_file.load(run.arm))
    return {
        "model": run.model,
        "control": run.control,
        "rates": run.rates,
        **metrics.linear_metrics(arm_model, law_of(run, arm_model), FINAL),
        **metrics.case_study_metrics(record, arm_model, until=DURATION),
        "wall_seconds": timing.wall_seconds,
        "simulated_seconds": timing.simulated_seconds,
    }
