# SPDX-License-Identifier: Apache-2.0
"""Lost and late samples: what the network does, the loop over it, and where it breaks; a laboratory's sensing."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from flexarm_control.loop.samples import ArmSample
from flexarm_dynamics.arm.units import FOOT
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.commands import robustness as module
from flexarm_studies.commands.robustness import breaks, levels_of, table
from flexarm_studies.loop.network import TORQUE_TIMEOUT, Network, NetworkedLoop
from flexarm_studies.loop.scenario import Scenario, loop_of, parameters, run, trajectory_of

PERIOD = 2_000_000
SHORT = {"trajectory": "quintic:to=0.05,duration=0.2", "rate": 500.0}


def sent(network, count):
    """Samples that leave one after the other, and what arrives of them: (arrival, sequence)."""
    arrived = []
    for k in range(count):
        sample = ArmSample(1)
        sample.sequence, sample.stamp_ns = k, k * PERIOD
        network.send(sample)
        while got := network.receive((k + 1) * PERIOD - 1):
            arrived.append((got[0], got[1].sequence))
    return arrived


# --------------------------------------------------------------------------- the network


def test_a_share_of_the_samples_is_lost_and_the_same_ones_with_the_same_seed():
    one = sent(Network(loss=0.2, seed=3), 2000)
    assert one == sent(Network(loss=0.2, seed=3), 2000)
    assert one != sent(Network(loss=0.2, seed=4), 2000)
    # 2000 draws: 1600 arrive, give or take 18.
    assert abs(len(one) - 1600) < 72
    assert all(arrival == k * PERIOD for arrival, k in one)
    # Independent: after a lost one the next is lost as often as any.
    lost = np.ones(2000, bool)
    lost[[k for _, k in one]] = False
    assert abs(lost[1:][lost[:-1]].mean() - 0.2) < 0.08


def test_samples_are_late_within_bounds_and_never_out_of_order():
    network = Network(delay=0.003, jitter=0.01)
    arrived = sent(network, 2000)
    arrivals, numbers = np.array(arrived).T
    assert (np.diff(arrivals) >= 0).all() and (np.diff(numbers) > 0).all()
    late = 1e-9 * (arrivals - numbers * PERIOD)
    assert 0.003 <= late.min() < 0.0035 and 0.0115 < late.max() <= 0.013
    assert network.dropped > 0
    assert network.sent == 2000 and network.lost == 0
    # What is not dropped and not lost is still on its way: at most those of 13 ms.
    assert 0 <= 2000 - len(arrived) - network.dropped <= 7


@pytest.mark.parametrize("wrong", [{"loss": 1.1}, {"loss": -0.1}, {"delay": 2.0}, {"jitter": -1.0}])
def test_a_network_refuses_what_can_not_be(wrong):
    with pytest.raises(FlexarmError, match=next(iter(wrong))):
        Network(**wrong)


def networked(network):
    """The default loop of R over a network."""
    loop = loop_of(Scenario("R", jitter=1e-9, **SHORT))
    assert isinstance(loop, NetworkedLoop)
    loop.network = network
    return loop


def positions(loop):
    """The arm's joint angles along the short motion, from its start."""
    motion = trajectory_of(SHORT["trajectory"], loop.model, loop.simulator.position)
    motion = replace(motion, stamp_ns=loop.simulator.stamp_ns + 60_000_000)
    record = loop.follow(motion, 0.25)
    assert not loop.lost
    return record.plant_position[record.time >= -1e-9]


def test_a_sample_that_is_late_does_what_a_torque_does_that_is_late():
    """No loss and the same delay for all: sample by sample the loop that delays its torque, to the last bit."""
    for delay in (0.0, 0.0033):
        late = positions(loop_of(Scenario("R", delay=delay, **SHORT)))
        assert_array_equal(positions(networked(Network(delay=delay))), late)


class OneSample(Network):
    """Lets through what comes until it is closed."""

    closed = False

    def send(self, sample):
        if not self.closed:
            super().send(sample)


def test_a_torque_is_held_until_it_is_too_old_then_the_safe_action_is_taken():
    network = OneSample(delay=0.001)
    loop = networked(network)
    motion = trajectory_of(SHORT["trajectory"], loop.model, loop.simulator.position)
    loop.follow(motion, 0.1)
    loop._answer()
    network.closed = True
    loop._advance(None)
    last = loop.controller.torque[0]
    assert last != 0.0
    measured_ns = loop.simulator.stamp_ns - PERIOD
    applied = []
    for _ in range(30):
        loop._answer()
        loop._advance(None)
        applied.append((1e-9 * (loop.simulator.stamp_ns - measured_ns), loop.simulator.torque[0]))
    for age, torque in applied:
        assert torque == (last if age < TORQUE_TIMEOUT + 1e-9 else 0.0), age
    assert loop.timeouts == 1
    # The controller gives up later, for good.
    for _ in range(250):
        loop._answer()
        loop._advance(None)
    assert not loop.controller.enabled and "no sample for 0.5 s" in loop.controller.reason


# --------------------------------------------------------------------------- where it breaks


@pytest.fixture
def robustness(result):
    """Rows of ``flexarm robustness R`` for a short motion, one run at each level."""
    motion = ("--trajectory", "quintic:to=0.5,duration=0.7", "--window", 0.8)
    few = ("--seeds", 1, "--workers", 1)
    return lambda *words: result("robustness", "R", *few, *motion, *words)


def test_the_default_bears_a_fifth_of_the_samples_lost_and_delays_up_to_10_ms(robustness):
    rows = robustness("--loss", 0.2, "--delay", 10, "--plants", "none")["sweeps"]
    levels = [(r["disturbance"], r["level"]) for r in rows]
    assert levels == [("samples lost", 20.0), ("delay uniform from 0 to", 10.0)]
    for row in rows:
        assert row["stable"] == row["of"] == 1, row["why"]
        assert 0.5 < row["joint error [deg]"] < 2.0 and 0.9 < row["bending [-]"] < 1.1


def test_so_does_the_papers_control_which_breaks_when_nearly_all_are_lost(robustness):
    words = ("--loss", "0.2:0.75:0.95", "--delay", "10", "--plants", "none")
    rows = robustness("--controller", "paper_composite", *words)["sweeps"]
    assert [r["stable"] for r in rows] == [1, 0, 1]
    assert rows[1]["why"]


def test_arms_that_are_not_the_model_are_reported_and_an_interrupted_command_goes_on(
    robustness, tmp_path, monkeypatch
):
    kept = tmp_path / "kept.jsonl"
    words = ("--loss", 0, "--delay", 0, "--plants", "nominal,payload x1.3", "--out", kept)
    found = robustness(*words)
    plants = {row["variant"]: row for row in found["plants"]}
    assert list(plants) == ["nominal", "payload x1.3"] and len(found["sweeps"]) == 2
    exact, heavy = (row["peak_joint_error_deg"] for row in plants.values())
    assert 0.0 < exact < heavy
    kept.write_text("".join(kept.read_text().splitlines(keepends=True)[:-1]))
    ran, at = [], module.at
    monkeypatch.setattr(module, "at", lambda *args: (ran.append(args), at(*args))[1])
    monkeypatch.setattr(module, "on_plant", None)  # not called again
    assert robustness(*words) == found and len(ran) == 1


def row(level, stable, what="samples lost"):
    return {
        "controller": "c", "disturbance": what, "level": level, "unit": "%", "stable": stable, "of": 2,
        "joint error [deg]": 1.0, "bending [-]": None, "tip at rest [mm]": 2.0, "why": "" if stable == 2 else "bent",
    }  # fmt: skip


def test_the_breaking_point_is_the_first_level_that_is_not_stable_in_all_runs():
    rows = [row(0.0, 2), row(10.0, 2), row(20.0, 1), row(30.0, 2), row(5.0, 2, "delay")]
    assert breaks(rows) == [
        "c: samples lost: stable in 2 of 2 runs up to 10 %, breaks at 20 % in 1 of 2: bent",
        "c: delay 5 %, the most tried: 2 of 2 runs stable",
    ]
    assert table(rows)[2].startswith("| c | samples lost | 0 | % | 2 | 2 | 1 | - | 2 |")


def test_levels_are_a_range_or_one():
    assert levels_of("--loss", "0:0.1:0.3", 1.0) == [0.0, 0.1, 0.2, 0.3]
    assert levels_of("--delay", "10", 1000.0) == [10.0]
    for wrong in ("x", "0:0:1", "0:0.1", "0.5:0.1:0.2", "0:0.1:2", "0:1e-9:1", "nan"):
        with pytest.raises(FlexarmError, match="--loss"):
            levels_of("--loss", wrong, 1.0)


# --------------------------------------------------------------------------- a laboratory's sensing


@pytest.mark.parametrize(("controller", "until"), [("paper_lab", 8.0), ("lab", 4.0)])
@pytest.mark.slow
def test_the_case_study_with_a_laboratorys_sensing(controller, until):
    """Half a microstrain, 12 bits, 4096 counts, torque 2 ms late, 500 Hz, no joint velocity."""
    scenario = Scenario(
        "R_lab", parameters(controller), noise=True, delay=0.002, duration=until, seed=1
    )
    record, found = run(scenario)
    assert not found["lost"]
    loop = loop_of(scenario)
    assert (
        loop.simulator.period_ns == PERIOD and not loop.simulator.settings["publish_joint_velocity"]
    )
    late = record.time >= 3.0 - 1e-9
    tip = record.plant_amplitude @ loop.model.mode_shapes("link1", "y")(1.0) / FOOT
    assert np.sqrt(np.mean(tip[late] ** 2)) < 3e-4
    # The estimate is of the state when the torque acts, a sample later.
    rate = np.gradient(record.plant_amplitude[:, 0], 1e-9 * PERIOD)[1:]
    kept = record.time[:-1] >= 0.0
    error = record.rate[:-1, 0][kept] - rate[kept]
    assert np.sqrt(np.mean(error**2)) < 0.05 * np.sqrt(np.mean(rate[kept] ** 2))
