# SPDX-License-Identifier: Apache-2.0
"""The lying driver: its gate, its lies, what a run measures; and lies that have to hold."""

import itertools
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from flexarm_control import trajectory
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.singular_perturbation import slow_subsystem
from flexarm_sim.fault_injector import FaultInjector
from flexarm_studies.attack import actions, command, healthy, lies, recoil, report, run
from flexarm_studies.attack.cases import ARMS, Case, arm_of, chosen, observers
from flexarm_studies.attack.driver import ALONE, TORQUE_TIMEOUT, Gate
from flexarm_studies.attack.healthy import healthy_run, motion, plant

ONE, TWO = np.array([1.0]), np.array([2.0])


def answered(gate, sequence, time, torque=ONE, controller=5):
    """A sample is sent, and answered at once; what acts then."""
    gate.sent(sequence, time)
    gate.offer(gate.session, sequence, controller, torque, time)
    return gate.torque(time)


# --------------------------------------------------------------------------- the gate


def test_a_torque_acts_once_the_samples_name_its_controller_and_not_for_longer_than_the_timeout():
    gate = Gate(1)
    assert gate.names(0.0) == 0
    assert answered(gate, 0, 0.0) is None  # unconfirmed
    assert gate.names(0.001) == 5
    assert answered(gate, 1, 0.001) == ONE
    assert answered(gate, 2, 0.002, controller=6) is None
    assert answered(gate, 3, 0.003, controller=6) == ONE
    assert gate.torque(0.003 + TORQUE_TIMEOUT) == ONE
    assert gate.torque(0.0031 + TORQUE_TIMEOUT) is None
    assert gate.names(0.0031 + TORQUE_TIMEOUT) == 0


def test_a_sample_that_is_sent_again_prolongs_nothing_but_in_a_wrong_gate():
    for renews in (False, True):
        gate = Gate(1)
        gate.renews = renews
        for k in range(100):
            time = 1e-3 * k
            answered(gate, min(k, 10), time)
        assert (gate.torque(time) is not None) == renews


def test_a_disabled_torque_another_session_and_an_older_answer_do_not_act():
    gate = Gate(1)
    answered(gate, 0, 0.0)
    assert answered(gate, 1, 0.001) == ONE
    gate.offer(2, 1, 5, TWO, 0.001)
    gate.offer(1, 0, 5, TWO, 0.001)
    gate.offer(1, 7, 5, TWO, 0.001)
    assert gate.torque(0.001) == ONE
    assert answered(gate, 2, 0.002, None) is None
    gate.begin(2)
    assert gate.torque(0.002) is None and gate.names(0.002) == 0


def test_two_torques_for_one_sample_are_a_race_in_which_none_acts():
    gate = Gate(1)
    answered(gate, 0, 0.0)
    assert answered(gate, 1, 0.001) == ONE
    gate.offer(1, 1, 5, ONE, 0.001)  # the same again
    assert gate.torque(0.001) == ONE
    gate.offer(1, 1, 5, TWO, 0.001)
    assert gate.torque(0.001) is None
    assert answered(gate, 2, 0.002) is None
    answered(gate, 3, 0.0011 + ALONE)
    assert answered(gate, 4, 0.0021 + ALONE) == ONE


# --------------------------------------------------------------------------- the lies


@pytest.mark.parametrize("arm", ARMS)
def test_every_lie_is_one_that_the_simulators_node_can_tell_or_an_action(arm):
    arm = arm_file.load(arm)
    for lie in (*lies.LIES.values(), *lies.random_lies(30, 1).values()):
        lines = lie.lines(arm, 1.2, 0.001)
        assert len(FaultInjector(arm, lines).faults) == len(lie.faults)
        assert not lie.action or callable(getattr(actions, lie.action))
        assert lie.faults or lie.action or lie.name == "nothing wrong"
        assert lie.kind in run.OF_KIND and re.compile(lie.says)


def test_an_outlier_counts_beyond_what_other_noise_changes():
    time = 0.01 * np.arange(10.0)

    def trace(torque):
        return SimpleNamespace(
            time=time, torque=np.full((10, 1), torque), since=lambda at: slice(5, None)
        )

    honest = SimpleNamespace(limit=np.ones(1), trace=trace(0.0), other=trace(0.06))
    for noise, torque, outlier in (
        (True, 0.04, 0.04),
        (True, 0.2, 0.14),
        (True, 0.06, 0.0),
        (False, 0.2, 0.2),
    ):
        honest.case = SimpleNamespace(noise=noise)
        assert run._outlier(honest, trace(torque), 0.05) == pytest.approx(outlier)
    assert run._outlier(honest, trace(np.nan), 0.05) == 1.0


def test_an_outlier_is_one_sample():
    arm = arm_file.load("R")
    (line,) = lies.LIES["one encoder sample off by 0.02 rad"].lines(arm, 1.2, 0.001)
    (fault,) = FaultInjector(arm, [line]).faults
    assert [k for k in range(1190, 1210) if fault.acts(1e-3 * k)] == [1200]


def test_random_lies_depend_on_their_seed_alone():
    assert lies.random_lies(9, 1) == lies.random_lies(9, 1) != lies.random_lies(9, 2)
    assert lies.random_lies(0, 1) == {}


def test_a_lie_about_velocities_needs_measured_ones():
    lie = lies.LIES["velocity stuck"]
    arm = arm_of("R", True)
    assert [lie.suits(case, arm) for case in chosen(["R"], ["kalman"])] == [False, True]
    assert len(chosen()) == 2 * len(ARMS) * len(observers())
    with pytest.raises(FlexarmError, match="--observers: 'none' is unknown"):
        chosen(["R"], ["none"])


def test_a_fresh_sample_goes_to_each_lie_of_the_gauges():
    case = Case("R", "kalman", False)
    assert run.case_of(lies.LIES["~/stop"], case) == replace(case, noise=False)
    own = run.case_of(lies.LIES["modal rate 900"], case)
    assert own.rates and own.observer == "true_rates"


# --------------------------------------------------------------------------- what is measured


def row(**values):
    """A row of a lasting lie that holds."""
    measures = dict.fromkeys(("speed", "strain", "excursion", "silent"), 0.0)
    measures |= {f"{name} under torque": 0.0 for name in ("speed", "strain")}
    return {**measures, "named": 0.1, "lost": "", "state": "FAULT", "text": "", **values}


STUCK = lies.LIES["encoder stuck"]


@pytest.mark.parametrize(
    "values, lie, failed",
    [
        ({}, STUCK, []),
        ({"speed": 1.5, "strain": 2.0, "excursion": 0.1, "named": 0.3}, STUCK, []),
        ({"speed": 1.51, "speed under torque": 1.51}, STUCK, ["speed"]),
        ({"speed": 1.51}, STUCK, ["the safe action's speed"]),
        ({"strain": 2.1, "strain under torque": 2.1}, STUCK, ["strain"]),
        ({"strain": 2.1}, STUCK, ["the safe action's strain"]),
        ({"excursion": 0.11, "silent": 0.06}, STUCK, ["excursion", "silent"]),
        ({"named": np.inf}, STUCK, ["named"]),
        ({"named": None}, STUCK, []),
        ({"lost": "far away"}, STUCK, ["arm lost"]),
        ({"state": "READY"}, lies.LIES["two drivers in turn"], ["ends in READY"]),
        ({"text": "a doubt"}, lies.LIES["nothing wrong"], ["alarm: a doubt"]),
        (
            {"step": 2.1, "strain": 1.6},
            lies.LIES["~/stop"],
            ["stop step", "stop strain", "ends in FAULT"],
        ),
        ({"outlier": 0.06}, lies.LIES["one encoder sample off by 0.02 rad"], ["outlier"]),
        ({"returning": 0.2}, lies.LIES["stall of 100 ms"], ["returning"]),
    ],
)
def test_a_row_fails_the_criteria_that_its_measures_exceed(values, lie, failed):
    values = {"step": 0.0, "outlier": None, "returning": None} | values
    judged = run.judged(row(**values), lie)
    assert judged["failed"] == failed
    assert json.loads(json.dumps(judged, allow_nan=False)) == judged


@pytest.fixture(scope="module")
def honest():
    return run.Honest(Case("R", "kalman", False))


def test_the_honest_run_is_the_scale(honest):
    assert honest.problem == ""
    # A quintic over 1 rad in 2 s: 15/16 rad/s.
    assert abs(honest.speed[0] - 0.9375) < 0.01
    assert 5e-5 < honest.strain < 1e-4
    assert abs(honest.low[0]) < 1e-3 and abs(honest.high[0] - 1.0) < 5e-3
    assert honest.static(np.zeros(1)) == 0.0
    # Its largest change of torque is at its end, where the reference's jerk jumps: 0.3 % of the limit.
    steps = np.abs(np.diff(honest.trace.torque[honest.trace.since(0.2)], axis=0)).max()
    assert 0.002 * honest.limit < honest.step == steps < run.KICK * honest.limit


def test_a_loop_that_swings_without_any_lie_is_not_attacked(monkeypatch, honest):
    def swinging(driver):
        trace = replace(honest.trace, velocity=honest.trace.velocity.copy())
        trace.velocity[400] = 5.0
        return trace

    monkeypatch.setattr(run, "drive", swinging)
    found = run.Honest(honest.case)
    assert found.problem == "joint1 swings, up to 5.3 times as fast as the motion"


def test_every_stop_of_a_motion_steps_less_than_twice_as_much_as_the_motion(honest):
    """Near the end of the motion, and after it, the motion's own end is part of the run that is stopped."""
    for moment in (0.75, 1.0):
        row = run.attack(honest, lies.LIES["~/stop"], moment)
        assert row["failed"] == [] and row["step"] < 1.1


def test_what_holds_an_arm_against_gravity_is_no_returning_torque():
    honest = object.__new__(run.Honest)
    honest.model = run.scenarios.loop_of(Case("long_reach", "kalman", True).scenario()).model
    pose = np.array([0.0, 1.2, 0.8, -0.8])
    a, B = slow_subsystem(honest.model.terms(pose, np.zeros(4)))
    assert np.abs(a + B @ honest.static(pose)).max() < 1e-9 * np.abs(a).max()
    assert np.abs(honest.static(pose)).max() > 50.0


def test_a_lie_that_is_named_wrongly_is_not_named(honest):
    lie = replace(lies.LIES["encoder jumps by 0.2 rad"], says="no such word")
    found = run.attack(honest, lie, 0.5)
    assert "named" in found["failed"]
    assert found["named"] is None


# --------------------------------------------------------------------------- lies that have to hold


HOLD = [
    ("nothing wrong", -0.05),
    ("20 % lost, stamps 40 % off", -0.05),
    ("stall of 40 ms", 0.5),
    ("a fault, and recover 20 ms later", 0.5),
    ("controller restarted after 20 ms", 0.5),
    ("two drivers in turn", 1.15),
    ("clock back by 1 s", 1.15),
    ("clock ahead by 10 s", 1.15),
    ("torque spoofed for 20 ms", 1.15),
    ("message repeated for ever", 1.15),
    ("clock ahead by 0.3 s", 0.5),
]


@pytest.mark.slow
@pytest.mark.parametrize("name, moment", HOLD)
def test_a_lie_that_the_loop_withstands_stays_so(honest, name, moment):
    found = run.attack(honest, lies.LIES[name], moment)
    assert found["failed"] == [], found


@pytest.mark.slow
def test_a_healthy_run_has_no_alarm_and_its_arm_is_another():
    case = Case("R", "kalman", False)
    samples, alarms = healthy_run(case, 3)
    assert alarms == "" and samples > 4000
    arms = [plant(case, np.random.default_rng(seed))[0] for seed in (1, 1, 2)]
    assert arms[0] == arms[1] != arms[2]
    assert arms[0].joints[0].friction.coulomb > 0.0
    # Counts and noise are in the file, too: an observer knows its sensors.
    known = case.scenario().arm
    assert all(g.bits and g.noise for g in known.gauges) and known.gauges == arms[0].gauges


def test_of_a_healthy_run_samples_are_lost_and_stamps_are_off():
    driver = healthy.UsualDriver(Case("R", "kalman", False).scenario())
    true, lost, off = driver.loop.measure(), 0, []
    begun = true.stamp_ns
    assert driver._messages(true, 0.1) == [true] and true.stamp_ns == begun
    for _ in range(3000):
        true.stamp_ns = begun
        lost += not driver._messages(true, 1.0)
        off.append((true.stamp_ns - begun) / driver.loop.simulator.period_ns)
    assert lost / 3000 == pytest.approx(0.2, abs=0.03)
    assert -0.4 <= min(off) < -0.39 and 0.39 < max(off) <= 0.4


def test_what_was_prepared_serves_runs_that_begin_the_same_motion_in_the_same_place():
    plans, made = healthy.Plans(), []

    def prepared(case, number, place):
        def prepare(trajectory):
            made.append(trajectory)
            return SimpleNamespace(trajectory=trajectory)

        controller = SimpleNamespace(reference=SimpleNamespace(resting=np.array([place])))
        loop = SimpleNamespace(controller=controller, prepared=prepare)
        return plans.prepared(case, number, loop, f"{case} {number} {place}")

    first, again = prepared("R", 1, 0.0), prepared("R", 1, 0.0)
    assert made == ["R 1 0.0"] and first is not again and first == again
    for case, number, place in (("R", 1, 0.5), ("R", 2, 0.0), ("two_link", 1, 0.0)):
        assert prepared(case, number, place).trajectory == f"{case} {number} {place}"
    prepared("R", 3, 0.0)  # of all but the last four nothing is kept
    prepared("R", 1, 0.0)
    assert made[-1] == "R 1 0.0" and len(made) == 6


def test_a_healthy_arm_moves_there_and_part_of_the_way_back_each_time_otherwise():
    case = Case("R", "kalman", False)
    ways = [motion(case, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert ways[0] == ways[1] != ways[2]
    way, lasts = ways[0]
    (start,), (there,), (same,), (back,) = way["positions"]
    assert start == 0.0 and 0.3 <= there == same <= 1.0 and 0.0 <= back <= 0.7 * there
    assert way["times"][-1] == lasts and (np.diff(way["times"])[[0, 2]] >= 0.9 * run.MOTION).all()


@pytest.mark.slow
def test_short_motions_at_200_hz_with_lost_samples_are_no_alarm(monkeypatch):
    """A seed whose strains were once taken to jump after lost samples: the second mode turns by 2 rad a sample."""
    random = np.random.default_rng(8)
    case = Case("R", "kalman", False)
    arm, payload = plant(case, random)
    own = replace(
        case.scenario(), plant_arm=arm, payload_scale=payload, seed=8, rate=200.0, noise=False
    )
    faults = [f"state drop share={random.choice([0.0, 0.2, 0.4])} seed=8"]
    for _ in range(6):
        begin, lasts = random.uniform(0.3, 5.0), random.uniform(0.006, 0.045)
        faults.append(f"state drop from={begin:.4f} for={lasts:.4f}")
    faults.append(f"state jitter by={random.choice([0.0, 0.4]) / 200.0} seed=8")

    def offer(driver, *_):
        time, place, points = 0, driver.loop.simulator.position.copy(), []
        for _ in range(8):
            time += int(1e9 * random.uniform(0.1, 0.8))
            place = place + random.uniform(-0.25, 0.25, 1)
            points.append((time, place, (), (), ()))
        motion = trajectory.validate(arm.joint_names, arm.joint_names, 0, points)
        driver.loop.controller.offer(motion, driver.loop.controller.prepare(motion))

    monkeypatch.setattr(run, "_offer", offer)
    trace = run.drive(run.driver_of(own, faults, 0.3), until=6.0)
    assert np.ptp(trace.position) > 0.2
    assert not [text for _, text in trace.texts if "jumped" in text]


def test_healthy_runs_take_turns_and_go_on_where_an_interrupted_study_ended(
    tmp_path, monkeypatch, capsys
):
    calls = []

    def short(case, seed):
        calls.append((str(case), seed))
        return 100, "an alarm" if (case.arm, seed) == ("two_link", 1) else ""

    monkeypatch.setattr(healthy, "healthy_run", short)
    out = tmp_path / "runs.jsonl"
    words = ("--arms", "R,two_link", "--observers", "kalman", "--workers", "1", "--json", str(out))
    assert command.attack(options(*words, "--healthy", "600")) == 0
    assert [name[0] for name, _ in calls] == ["R"] * 6
    assert command.attack(options(*words, "--healthy", "800")) == 1
    assert len(calls) == len(set(calls)) == 8
    assert capsys.readouterr().out.splitlines()[-5:] == [
        "800 healthy samples in 8 runs, 1 of them with an alarm",
        "R, kalman, without velocity: 500 samples in 5 runs",
        "R, kalman, with velocity: 100 samples in 1 runs",
        "two_link, kalman, without velocity: 200 samples in 2 runs",
        "two_link, kalman, without velocity, seed 1: an alarm",
    ]
    with out.open("a") as file:
        file.write('{"case": "R, kal')  # cut off by the interruption
    assert len(healthy.stored(out)) == 8
    out.write_text("[1]\n[2]\n")
    with pytest.raises(FlexarmError, match="line 1 is not of healthy runs"):
        healthy.stored(out)


def test_what_no_control_bears_is_no_healthy_run():
    first = [case for case, _ in itertools.islice(healthy.planned(chosen(), 0), 300)]
    assert {case.observer for case in first if case.arm == "long_reach"} == {"filtered_derivative"}
    assert {case.observer for case in first if case.arm == "two_link"} == set(observers())
    with pytest.raises(FlexarmError, match="has no case"):
        command.attack(options("--arms", "long_reach", "--observers", "kalman", "--healthy", "1"))


def test_some_runs_cover_every_lie_under_every_observer_and_on_every_arm():
    todo = command.cover(chosen(), lies.LIES)
    assert set(todo) < set(command.jobs(chosen(), lies.LIES)) and len(todo) < 250
    for lie in lies.LIES.values():
        own = [case for case, other, _ in todo if other == lie]
        assert {case.arm for case in own} == set(ARMS)
        assert lie.rates or {case.observer for case in own} == set(observers())
    assert {case.velocity for case, lie, _ in todo if lie.name == "encoder stuck"} == {False, True}


# --------------------------------------------------------------------------- the command


def options(*words):
    import argparse

    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return parser.parse_args(words)


def test_lies_are_chosen_by_parts_of_their_names(capsys):
    assert command.attack(options("--list", "--lies", "clock,random", "--random", "2")) == 0
    names = [line[13:] for line in capsys.readouterr().out.splitlines()]
    assert names == [n for n in lies.LIES if "clock" in n] + ["random 0.0", "random 0.1"]
    with pytest.raises(FlexarmError, match="names no lie"):
        command.attack(options("--lies", "truth"))


def test_the_table_has_the_worst_of_all_runs_and_the_worst_lie_on_top(tmp_path):
    base = {
        "arm": "R",
        "observer": "kalman",
        "velocity": False,
        "kind": lies.LASTING,
        "moment": 0.5,
    }
    base |= {"torque": 0.5, "safe": 0.2, "outlier": None, "returning": None, "step": 1.0}
    rows = [
        row(**base, lie="a", failed=[]),
        row(**base, lie="b", failed=["speed", "named"]) | {"speed": 3.0, "named": None},
        row(**base, lie="b", failed=["speed"]) | {"speed": 2.0},
    ]
    first, second = report.summary(rows)
    assert (first["lie"], first["runs"], first["held"], first["failed"]) == ("a", 1, 1, {})
    assert (second["speed"], second["named"], second["held"]) == (3.0, report.NEVER, 0)
    assert (first["named"], first["safe"]) == (0.1, 0.2)
    assert second["failed"] == {"speed": 2, "named": 1}
    report.note(tmp_path / "note.md", rows)
    lines = (tmp_path / "note.md").read_text().splitlines()
    assert lines[2].startswith("| b |") and "speed 2; named 1" in lines[2]
    page = tmp_path / "page.md"
    page.write_text("\n".join(("before", *report.MARKERS, "after")))
    report.write(page, report.summary(rows))
    assert "| a |" in page.read_text() and page.read_text().endswith("after")


@pytest.mark.long
def test_bent_links_hardly_turn_a_heavy_joint_and_no_torque_that_may_return_holds_a_light_one(
    honest,
):
    assert recoil.recoil(honest, 0.0) < 0.01
    elbow = run.Honest(Case("two_link", "filtered_derivative", True, noise=False))
    free, held = recoil.recoil(elbow, 0.0)[1], recoil.recoil(elbow)[1]
    assert run.CRITERIA["speed"] < held < free


def test_a_table_of_recoil_has_each_joint_once(tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("\n".join(("before", *recoil.MARKERS, "after")))
    words = ("--recoil", "--arms", "R", "--observers", "kalman", "--write", str(page))
    assert command.attack(options(*words)) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if "joint1" in line]
    assert len(rows) == 1 and rows[0] in page.read_text()


@pytest.mark.long
@pytest.mark.slow
def test_the_command_runs_in_processes_and_its_exit_code_reports(tmp_path, capsys):
    out = tmp_path / "rows.json"
    words = ("--arms", "R", "--observers", "kalman", "--lies", "clock back", "--workers", "1")
    code = command.attack(options(*words, "--json", str(out)))
    rows = json.loads(out.read_text())
    assert [(r["velocity"], r["moment"]) for r in rows] == [
        (v, m) for v in (False, True) for m in (0.5, 1.15)
    ]
    assert code == int(any(r["failed"] for r in rows))
    printed = capsys.readouterr().out
    assert "| clock back by 1 s |" in printed
    assert command.attack(options("--from", str(out))) == code
    assert capsys.readouterr().out == printed
    out.write_text('{"a": 1}')
    with pytest.raises(FlexarmError, match="was not written by --json"):
        command.attack(options("--from", str(out)))
