# SPDX-License-Identifier: Apache-2.0
"""What `flexarm latency` makes of the windows that it measured."""

import argparse
import os
import time
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.latency import command as latency
from benchmarks.latency import measure, processor
from benchmarks.latency import redesign as latency_redesign
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.loop import scenario
from flexarm_studies.loop.scenario import parameters

CASE = measure.CASES[1]


def window(milliseconds, missed=0, enabled=None):
    times = [1e-3 * t for t in milliseconds]
    enabled = len(times) if enabled is None else enabled
    taken = {"simulator": 0.2, "observer": 0.3}
    found = {"latencies": times, "enabled": enabled, "missed": missed, "lost": 0}
    return {**found, "processor": taken}


def test_ratios_are_taken_round_by_round():
    # The machine slows down threefold in the second round: the loop costs 1.5 of the relay in each.
    relay = {"windows": [window([1.0, 1.0, 2.0]), window([3.0, 3.0, 6.0]), window([1.0, 1.0, 2.0])]}
    loop = {"windows": [window([1.5, 1.5, 3.0]), window([4.5, 4.5, 9.0]), window([1.5, 1.5, 3.0])]}
    loop["mathematics"] = {"controller": 1e-4, "law": 4e-5}
    bare, row = measure.summary(CASE, {"relay": relay, "three processes": loop})
    assert bare["latency_ms"]["p50"] == pytest.approx(1.0)
    assert row["latency_ms"]["p50"] == pytest.approx(1.5)
    assert row["ratio"]["p50"] == pytest.approx(1.5)
    assert row["ratio"]["p99"] == pytest.approx(1.5)
    assert row["controller_share"] == pytest.approx(0.1)
    cells = measure.table([bare, row]).splitlines()[-1].split(" | ")
    assert cells[1:3] == ["three processes", "1.50"]
    assert cells[-4:] == ["0.100", "10 %", "0.040", "4 % |"]


def test_processor_time_is_compared_with_the_relays_round_by_round():
    # Two samples in each window, of which one may be missed.
    three, one = ("simulator", "observer", "controller"), ("simulator", "observer_controller")
    relay = [{**window([1.0] * 2), "processor": dict.fromkeys(three, s)} for s in (2e-4, 6e-4)]
    loop = [{**window([1.0], 1), "processor": dict.fromkeys(one, s)} for s in (3e-4, 9e-4)]
    taken, ratio = processor.summary(loop, relay)
    assert taken == {name: pytest.approx(0.3) for name in one}
    assert ratio == pytest.approx(1.0)
    rows = [{"case": "R", "chain": "in one", "processor_ms": taken, "processor_ratio": ratio}]
    (line,) = processor.table(rows).splitlines()[2:]
    assert line == "| R | in one | 0.30 | 0.30 both |  | 0.60 | 1.00 |"


def test_processor_time_is_that_of_the_process():
    before = time.process_time()
    found = processor.spent(os.getpid())
    assert before <= found <= time.process_time()


def test_redesigning_is_compared_within_each_round():
    found = {
        latency_redesign.NOTHING: [window([1.0]), window([3.0]), window([1.0])],
        latency_redesign.ALPHA: [window([1.1]), window([3.3]), window([5.0])],
    }
    rows = latency_redesign.summary(CASE, found)
    assert rows[0]["ratio"] == pytest.approx({"p50": 1.0, "p95": 1.0, "p99": 1.0})
    assert rows[1]["latency_ms"]["p99"] == pytest.approx(3.3)
    assert rows[1]["ratio"]["p99"] == pytest.approx(1.1)
    text = latency_redesign.table(rows).splitlines()
    assert text[-1] == "| R, 500 Hz | `fast.alpha` set | 3.30 | 3.30 | 3.30 | 1.10 | 1.10 | 1.10 |"
    assert all(line.count("|") == text[0].count("|") for line in text)


def test_redesigning_needs_a_case_at_500_hz():
    with pytest.raises(FlexarmError, match="at 500 Hz; have it among the --rates"):
        latency.latency(options("--redesign", "--rates", "200", "--arms", "R"))


@pytest.mark.parametrize("name", latency_redesign.REDESIGNS)
def test_what_is_set_meanwhile_are_designs_that_are_accepted(name):
    case = next(c for c in measure.CASES if c.arm == name and c.rate == 500.0)
    given = parameters(case.file) if case.file else {}
    values = latency_redesign.values_of(case)
    for alpha, grid in zip(*values.values(), strict=True):
        given |= alpha  # stays in the node when the grid is set
        scenario.loop_of(scenario.Scenario(name, given, rate=case.rate))
        scenario.loop_of(scenario.Scenario(name, {**given, **grid}, rate=case.rate))


def test_missed_samples_count_with_those_answered():
    found = {"relay": {"windows": [window([1.0] * 6, missed=2), window([1.0] * 2, 0, enabled=0)]}}
    (row,) = measure.summary(CASE, found)
    assert row["missed"] == pytest.approx(0.2)
    assert row["enabled"] == pytest.approx(0.75)


def test_a_window_without_an_answer_is_an_error_that_names_it():
    found = {"relay": {"windows": [window([1.0]), window([])]}}
    with pytest.raises(FlexarmError, match="R, 500 Hz: no torque came back in a window of relay"):
        measure.summary(CASE, found)


def options(*words):
    parser = argparse.ArgumentParser()
    latency.add_arguments(parser)
    return parser.parse_args(words)


def test_options_choose_the_cases():
    assert [c.name for c in latency.chosen(options())] == [
        *(f"R, {rate} Hz" for rate in (200, 500, 1000)),
        "long_reach, 500 Hz x 0.25",
    ]
    at_rest = latency.chosen(options("--at-rest", "--arms", "long_reach"))
    assert [c.name for c in at_rest] == ["long_reach, 1000 Hz"]
    quick = latency.chosen(options("--quick", "--arms", "R"))
    assert [c.rate for c in quick] == [500.0]
    with pytest.raises(FlexarmError, match=r"is not measured \(R, 200 Hz"):
        latency.chosen(options("--arms", "two_link"))


def row(chain, median, missed):
    taken = {"case": "R", "processor_ms": {"simulator": 0.2}, "processor_ratio": 1.0}
    return {"chain": chain, "latency_ms": {"p50": median}, "missed": missed, **taken}


@pytest.mark.parametrize(
    ("load", "median", "missed", "words"),
    [
        (0.2, 0.7, 0.04, ""),
        (3.0, 0.7, 0.04, "3.0 processes per CPU"),
        (0.2, 2.5, 0.04, "relay 2.5 ms"),
        (0.2, 0.7, 0.45, "45 % of the relay's samples"),
    ],
)
def test_a_busy_machine_is_known_by_its_load_and_by_the_relay(load, median, missed, words):
    everything = [{"rows": [row("relay", median, missed), row("three processes", 9.0, 0.9)]}]
    found = latency.too_busy(load, everything)
    assert words in found and bool(found) == bool(words)


def test_a_busy_machine_writes_no_table_unless_forced(tmp_path, monkeypatch, capsys):
    file = tmp_path / "page.md"
    page = f"{latency.BEGIN}\nold\n{latency.END}\n"
    file.write_text(page)

    def measured(everything, cases, options, title, of):
        everything.append({"rows": [row("relay", 2.5, 0.45)]})
        return "new"

    monkeypatch.setattr(latency, "_table_of", measured)
    with pytest.raises(FlexarmError, match="is not written: the machine was too busy; see --force"):
        latency.latency(options("--quick", "--arms", "R", "--write", str(file)))
    assert file.read_text() == page and "too busy" in capsys.readouterr().out
    latency.latency(options("--quick", "--arms", "R", "--force", "--write", str(file)))
    assert "new" in file.read_text()


def test_motions_of_the_cases_are_those_of_their_arms():
    from flexarm_dynamics.arm import arm_file

    for case in measure.CASES:
        joints = arm_file.load(case.arm).joints
        for ends in (case.begin, case.end):
            assert len(ends) == len(joints)
            for joint, angle in zip(joints, ends, strict=True):
                low, high = joint.limits.position
                assert low <= angle <= high
        assert np.abs(np.subtract(case.end, case.begin)).max() > 0.5


@pytest.mark.long
def test_relay_and_loop_answer_in_real_processes():
    """As `flexarm latency` starts them, without its motion and its rounds; how fast is not asked."""
    case = replace(CASE, window=0.2)
    found = measure.measure(
        case, 1, ("relay", "three processes"), "executor", False, lambda _: None
    )
    for chain in found.values():
        assert len(chain["windows"][0]["latencies"]) > 10
        assert all(taken > 0.0 for taken in chain["windows"][0]["processor"].values())
    assert found["three processes"]["windows"][0]["enabled"] > 10
    assert found["three processes"]["mathematics"]["controller"] > 0.0
