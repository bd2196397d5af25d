# SPDX-License-Identifier: Apache-2.0
"""The torque ends in the middle of a move: what the safe action makes of the arm.

``FLEXARM_WRITE_DOCS=1`` writes the table of docs/safety.md.
"""

import os
import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_dynamics.models import model
from flexarm_sim.plant import Plant
from flexarm_studies import markdown
from flexarm_studies.loop import scenario

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "safety.md"
MARKS = "<!-- safe actions: begin -->", "<!-- safe actions: end -->"
WRITES = bool(os.environ.get("FLEXARM_WRITE_DOCS"))
#: Of a driver: the last torque acts for so long yet [s].
TORQUE_TIMEOUT = 0.05
#: The arm is watched for so long [s].
AFTER = 1.5
#: Arm to its move and the moments at which it is broken off, the middle one first [s].
MOVES = {
    "R": ("quintic:to=1.57,duration=2", (1.0, 0.3, 0.6, 1.4, 1.7)),
    "two_link": ("quintic:to=1.047;1.047,duration=2", (1.0, 0.3, 0.6, 1.4, 1.7)),
    "long_reach": (
        "quintic:from=0;1.2;0.8;-0.8,to=1.0472;0.1528;1.8472;0.2472,duration=2",
        (1.0, 1.5),
    ),
}
#: A joint that is slower has stopped, though the links swing on [degrees/s].
SLOW = 2.0


@dataclass
class Stopped:
    """What a safe action made of a moving arm."""

    rest: float  # from when on every joint is slower than `SLOW` [s]
    turned: float  # largest of a joint, under the safe action [degrees]
    strain: float  # largest on any gauge, over the motion's own
    gained: float  # largest gain of mechanical energy in a sample, over the first one's
    exactly: bool  # whether all joints rest to the last bit at the end


@cache
def moved(name):
    """States and torques at the moments of the move of an arm, and the largest strain of all of it."""
    arm, (motion, moments) = arm_file.load(name), MOVES[name]
    values = {} if name == "R" else scenario.parameters(name)
    values |= {"feedforward": "none"} | ({"manifold.type": "quasi_steady"} if name == "R" else {})
    loop = scenario.loop_of(scenario.Scenario(arm, values, motion))
    trajectory = scenario.trajectory_of(motion, loop.model, loop.simulator.position)
    loop.simulator.reset(trajectory.positions[0])
    plant, rows, found, strain = loop.simulator.plant, gauge_rows(loop.model, arm.gauges), {}, 0.0
    for _ in range(round(0.3 / plant.period)):
        loop.step()
    assert loop.controller.offer(trajectory).accepted
    for k in range(1, round(2.0 / plant.period)):
        loop.step()
        strain = max(strain, np.abs(rows @ plant.delta).max(initial=0.0))
        if any(abs(k * plant.period - moment) < 1e-9 for moment in moments):
            found[round(k * plant.period, 9)] = plant.state.copy(), loop.controller.torque.copy()
    assert loop.controller.enabled
    return found, strain, plant.period


def broken_off(name, moment, **joint):
    """The controller is killed at a moment of the arm's move: a `Stopped`; with changes to each joint."""
    found, own, period = moved(name)
    (state, torque), arm = found[moment], arm_file.load(name)
    arm = replace(arm, joints=tuple(replace(j, **joint) for j in arm.joints))
    plant, rows = Plant(model.build(arm), period), gauge_rows(model.build(arm), arm.gauges)
    plant.state[:] = state
    for _ in range(round(TORQUE_TIMEOUT / period)):
        plant.advance(torque)
    begin, energies = plant.q.copy(), [plant.model.energy(plant.state)]
    speeds, turned, strain = [], 0.0, 0.0
    for _ in range(round(AFTER / period)):
        plant.advance_safely()
        speeds.append(np.rad2deg(np.abs(plant.qd).max()))
        energies.append(plant.model.energy(plant.state))
        turned = max(turned, np.rad2deg(np.abs(plant.q - begin).max()))
        strain = max(strain, np.abs(rows @ plant.delta).max(initial=0.0))
    fast = np.flatnonzero(np.array(speeds) > SLOW)
    rest = (fast[-1] + 1) * period if fast.size else 0.0
    scale = max(abs(energies[0]), np.ptp(energies))
    gained = np.diff(energies).max() / scale
    return Stopped(rest, turned, strain / own, gained, speeds[-1] == 0.0)


#: Row of the table to arm, changes, and the most of rest [s], turn [degrees] and strain [-].
ACTIONS = {
    "`R` | `brake`, 13.6 N m": ("R", {"safe_action": "brake"}, 0.2, 8.0, 7.5),
    "`R` | `damp`, as in its file": ("R", {}, 0.8, 32.0, 2.3),
    "`R` | `damp`, all of the torque at once": (
        "R", {"damp_torque": 13.558, "damp_time": 0.0}, 0.2, 8.0, 7.5,
    ),
    "`two_link` | `damp`, as in its file": ("two_link", {}, 1.1, 4.0, 1.8),
    "`two_link` | `damp`, without numbers in its file": (
        "two_link", {"damp_torque": None, "damp_time": None}, AFTER, 40.0, 1.4,
    ),
    "`long_reach`, under gravity | `brake`": ("long_reach", {}, 1.0, 8.0, 4.0),
}  # fmt: skip


@pytest.fixture(scope="module")
def measured():
    """Rows of the table."""
    return {}


@pytest.mark.long
@pytest.mark.parametrize(
    "row", [pytest.param(r, marks=pytest.mark.slow) if "long" in r else r for r in ACTIONS]
)
def test_a_safe_action_stops_every_joint_within_its_time_way_and_strain(row, measured):
    name, joint, rest, turned, strain = ACTIONS[row]
    found = [broken_off(name, moment, **joint) for moment in MOVES[name][1]]
    # Under gravity, too: the energy of its field is part of the sum.
    assert max(s.gained for s in found) < (1e-6 if name == "long_reach" else 1e-9)
    assert max(s.rest for s in found) <= rest
    assert max(s.turned for s in found) <= turned
    assert max(s.strain for s in found) <= strain
    assert all(s.exactly for s in found) == ("`brake`" in row)
    cells = [
        f"{unit % getattr(found[0], what)}, {unit % max(getattr(s, what) for s in found)}"
        for what, unit in (("rest", "%.2f s"), ("turned", "%.1f°"), ("strain", "%.1f"))
    ]
    measured[row] = " | ".join(cells)


@pytest.mark.slow
def test_the_table_of_the_document_is_what_was_measured(measured):
    if set(measured) != set(ACTIONS):
        pytest.skip("only some of the rows were run")
    head = "| arm | safe action | every joint below 2 °/s after | joint turns further by | strain, over the move's |"
    lines = [head, "|---|---|---|---|---|", *(f"| {row} | {measured[row]} |" for row in ACTIONS)]
    if WRITES:
        markdown.write_between(DOCUMENT, *MARKS, "\n".join(lines))
        return
    inside = DOCUMENT.read_text(encoding="utf-8").split(MARKS[0])[1].split(MARKS[1])[0]
    # The last digit may be another machine's; the bounds are tested above.
    shown, wanted = (re.sub(r"\d+\.\d+", "#", text.strip()) for text in (inside, "\n".join(lines)))
    assert shown == wanted, "run it again with FLEXARM_WRITE_DOCS=1"
