# SPDX-License-Identifier: Apache-2.0
"""What changes the motion that an arm is held to: how it ends, its torque's largest step, and the largest strain.

Each event on each shipped arm, beside the motion without it; the table of docs/safety.md. ``FLEXARM_WRITE_DOCS=1``
measures all of it and writes it; otherwise only `USUAL` rows are measured.
"""

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from flexarm_control.loop.supervisor import State
from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_studies.loop import scenario
from flexarm_studies.loop.scenario import Scenario, parameters

pytestmark = [pytest.mark.slow, pytest.mark.long]

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "safety.md"
MARKS = "<!-- stops: begin -->", "<!-- stops: end -->"
#: Until the observer has converged [s]; from rest on until the end of a run [s].
BEFORE, AFTER = 0.3, 0.3
#: A joint is at rest [rad/s].
AT_REST = 0.02
#: Longest run after the motion's start [s].
LONGEST = 8.0
ONE, TWO = "quintic:to=1,duration=2", "quintic:to=1.047;1.047,duration=2"
SPATIAL = "quintic:from=0;1.2;0.8;-0.8,to=1.0472;0.1528;1.8472;0.2472,duration=4"

#: Column of the table to arm, controller file (none: the defaults), motion and its duration [s].
ARMS = {
    "`R`": ("R", "", ONE, 2.0),
    "`R`, `composite`": ("R", "composite", ONE, 2.0),
    "`one_link`": ("one_link", "", ONE, 2.0),
    "`R_lab`, `lab`": ("R_lab", "lab", ONE, 2.0),
    "`two_link`": ("two_link", "two_link", TWO, 2.0),
    "`long_reach`": ("long_reach", "long_reach", SPATIAL, 4.0),
}
#: Row of the table to the moments of `~/stop`, as fractions of the motion.
STOPS = {
    "`~/stop` with its first sample": (0.0,),
    **{f"`~/stop` after {100 * f:.0f} %": (f,) for f in (0.02, 0.05, 0.15, 0.3, 0.5, 0.7, 0.85, 0.97)},
    "`~/stop` after 50, 60 and 70 %": (0.5, 0.6, 0.7),
}  # fmt: skip
WRITES = bool(os.environ.get("FLEXARM_WRITE_DOCS"))
USUAL = ("`~/stop` after 15 %", "`~/stop` after 97 %", "`~/stop` after 50, 60 and 70 %")


@dataclass
class Run:
    """What was measured."""

    torque: np.ndarray  # (k, n) [N m]
    strain: float  # largest on any gauge [-]
    state: State
    speed: float  # largest of a joint at the end [rad/s]
    reason: str
    end: int  # samples until the motion's end

    @property
    def steps(self):
        """Largest change of a joint's torque at each sample, (k - 1,) [N m]."""
        return np.abs(np.diff(self.torque, axis=0)).max(axis=1)


#: Of a stop's step of torque over the motion's own, where it is more than twice: links with finite slopes swing
#: otherwise than the controller's model of first order, and the fast control answers.
MAX_STEP = {"long_reach": 2.3}


class Bench:
    """One arm with its motion, which is prepared once."""

    def __init__(self, name):
        arm, file, self.motion, self.duration = ARMS[name]
        self.scenario = Scenario(arm, parameters(file) if file else {}, self.motion)
        self.plan = None

    def started(self):
        """A loop whose controller has accepted the motion, standing."""
        loop = scenario.loop_of(self.scenario)
        trajectory = scenario.trajectory_of(self.motion, loop.model, loop.simulator.position)
        loop.simulator.reset(trajectory.positions[0])
        for _ in range(round(BEFORE / (1e-9 * loop.simulator.period_ns))):
            loop.step()
        if self.plan is None:
            self.plan = loop.prepared(trajectory)
            assert not loop.unprepared
        assert loop.controller.offer(trajectory, self.plan).accepted
        return loop

    def run(self, moments=()):
        """Move, and stop at fractions of the motion."""
        loop = self.started()
        controller, period = loop.controller, 1e-9 * loop.simulator.period_ns
        stops = {1 + round(f * self.duration / period) for f in moments}
        rows = gauge_rows(loop.model, loop.model.arm.gauges)
        torque, strain, rested, k = [], 0.0, 0, 0
        speed = np.inf
        while (rested < AFTER / period or speed > AT_REST) and k < LONGEST / period:
            sent = loop.step()
            assert sent is not None, controller.reason
            torque.append(sent.copy())
            k += 1
            strain = max(strain, np.abs(rows @ loop.simulator.plant.delta).max())
            if k in stops:
                assert controller.brake("stop")
            rested = rested + 1 if controller.state == State.HOLDING else 0
            speed = np.abs(loop.simulator.plant.qd).max()
        end = round(self.duration / period)
        return Run(np.array(torque), strain, controller.state, speed, controller.reason, end)


@pytest.fixture(scope="module")
def measured():
    """What was measured: column to rows of the table."""
    return {}


@pytest.mark.parametrize("name", ARMS)
def test_a_stop_takes_little_more_torque_and_strain_than_the_motion_itself(name, measured):
    bench = Bench(name)
    own = bench.run()
    assert own.state == State.HOLDING
    step, strain = own.steps.max(), own.strain
    ends = own.steps[own.end - 3 : own.end + 3].max()
    assert ends <= 2.0 * own.steps[: own.end - 3].max()
    cells = {
        "the motion itself": f"{step:.2g} N m, {1e6 * strain:.0f} µ",
        "its end": f"{ends / step:.1f}, 1.0",
    }
    for row in STOPS if WRITES else USUAL:
        run = bench.run(STOPS[row])
        assert run.state == State.HOLDING, (row, run.reason)
        assert run.speed <= AT_REST, row
        assert run.steps.max() <= MAX_STEP.get(name.strip("`"), 2.0) * step, row
        assert run.strain <= 1.5 * strain, row
        cells[row] = f"{run.steps.max() / step:.1f}, {run.strain / strain:.1f}"
    measured[name] = cells


def test_the_table_of_the_document_is_what_was_measured(measured):
    if set(measured) != set(ARMS):
        pytest.skip("only some of the arms were run")
    rows = measured[next(iter(ARMS))]
    lines = [f"| event | {' | '.join(ARMS)} |", "|---|" + "---|" * len(ARMS)]
    lines += [f"| {row} | {' | '.join(measured[arm][row] for arm in ARMS)} |" for row in rows]
    table, text = "\n".join(lines), DOCUMENT.read_text(encoding="utf-8")
    before, rest = text.split(MARKS[0])
    inside, after = rest.split(MARKS[1])
    if WRITES:
        DOCUMENT.write_text(f"{before}{MARKS[0]}\n{table}\n{MARKS[1]}{after}", encoding="utf-8")
        return
    # The last digit may be another machine's; the bounds are tested above.
    inside, table = (dict(map(_masked, t.strip().splitlines())) for t in (inside, table))
    assert table.items() <= inside.items(), "run it again with FLEXARM_WRITE_DOCS=1"
    assert [row for row in inside if row in STOPS] == [*STOPS]


def _masked(line):
    """First cell of a row of the table, and the others without their numbers."""
    row, _, cells = line.removeprefix("| ").partition(" | ")
    return row, re.sub(r"\d[\d.e+-]*(?=[, ])", "#", cells)
