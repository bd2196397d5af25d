# SPDX-License-Identifier: Apache-2.0
"""Plants that are not the controller's model: what differs, strain feedback, the runs, and who wins."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError, ModelError
from flexarm_dynamics.models import model
from flexarm_studies import workers
from flexarm_studies.comparison import cases, command
from flexarm_studies.comparison.controllers import Setup
from flexarm_studies.random_arms import generator
from flexarm_studies.store import Store, gather
from flexarm_studies.uncertain import baselines, limits, plants, report, runs
from flexarm_studies.uncertain.trial import ArmTask, loop_of

R = cases.CASES[0]


@pytest.fixture(scope="module")
def arm():
    return cases.arm_of("R")


# --------------------------------------------------------------------------- plants


def test_friction_holds_a_clamped_beam_up_to_its_closed_form():
    """EI times the square of the wave number is the moment at the root per deflection of the tip of any mode."""
    beam = arm_file.load("one_link")
    none = replace(beam.payload, mass=0.0, inertia=np.zeros((3, 3)))
    joint = replace(beam.joints[0], friction=replace(beam.joints[0].friction, coulomb=0.1))
    plant = model.build(replace(beam, payload=none, joints=(joint,)))
    length, stiffness = beam.links[0].length, beam.links[0].stiffness["y"]
    for mode, root in zip(limits.ringing(plant, np.zeros(1)), (1.8751041, 4.6940911), strict=True):
        moment = stiffness * (root / length) ** 2
        assert mode.reached
        assert mode.held == pytest.approx(0.1 / moment / np.sqrt(2.0) / length, rel=1e-6)
        assert mode.frequency == pytest.approx(
            root**2 * np.sqrt(stiffness / beam.links[0].mass_per_length) / length**2 / 2.0 / np.pi
        )


def test_no_torque_reaches_the_bending_along_a_joints_axis():
    case = generator.arm(25)  # it turns about one axis and bends across both
    plant = model.build(case.read())
    modes = limits.ringing(plant, np.zeros(1))
    hidden = [mode for mode in modes if not mode.reached]
    assert 2 * len(hidden) == len(modes)
    assert all(mode.held == np.inf for mode in hidden)
    u = np.linalg.inv(plant.terms(np.zeros(1), np.zeros(1)).M)[1:, 0]
    assert np.sum(np.abs(u) > 1e-9 * np.abs(u).max()) == len(modes) - len(hidden)


def test_the_nominal_plant_is_the_model_but_for_its_sensors(arm):
    plant = plants.plant_of(arm, plants.VARIANTS["nominal"])
    assert plant == arm
    assert plants.plant_of(cases.arm_of("R", True), plants.VARIANTS["nominal"]) != cases.arm_of(
        "R", True
    )


def test_every_other_plant_differs_from_the_nominal_one_or_its_loop_does(arm):
    nominal = plants.VARIANTS["nominal"]
    for name, variant in plants.VARIANTS.items():
        if name != "nominal":
            assert plants.plant_of(arm, variant) != plants.plant_of(arm, nominal), name


def test_modes_friction_sensors_and_the_accurate_level_are_what_they_say(arm):
    def plant(name):
        return plants.plant_of(arm, plants.VARIANTS[name])

    modes = {n: len(plant(n).modes) for n in ("nominal", "one mode more", "two modes more")}
    assert list(modes.values()) == [2, 3, 4]
    stiff = plant("geometric stiffening")
    assert len(stiff.modes) == 2 and stiff.foreshortening and stiff.model == "chain"
    friction = plant("friction").joints[0].friction
    assert_allclose([friction.coulomb, friction.viscous], 0.02 * 13.558, rtol=1e-4)
    assert {g.noise for g in plant("noise and counts").gauges} == {plants.STRAIN_NOISE}
    assert plant("noise and counts").joints[0].encoder_counts == plants.COUNTS
    assert plant("exact").joints[0].encoder_counts == 0


def test_a_delay_and_a_rate_are_the_loops(arm):
    task = ArmTask("R", arm, "quintic:to=0.01,duration=0.1")
    setup = Setup({"rate": 1000.0})
    late = loop_of(task, setup, plants.VARIANTS["delay 2 ms"])
    assert len(late._on_the_way) == 1 + 2 and late.simulator.period_ns == 1_000_000
    noisy = loop_of(task, setup, plants.VARIANTS["noisy"])
    assert noisy.simulator.period_ns == 2_000_000 and not noisy.source[0]


def test_only_plants_that_can_be_are_tried():
    bare = arm_file.load("R")  # without damping: three times nothing is nothing
    assert not {"damping x0.3", "damping x3"} & set(plants.names_for(bare))
    joints = tuple(replace(j, limits=replace(j.limits, torque=float("inf"))) for j in bare.joints)
    free = replace(bare, joints=joints)
    assert "friction" not in plants.names_for(free)
    with pytest.raises(ModelError, match="torque limit of joint1"):
        plants.plant_of(free, plants.VARIANTS["friction"])
    assert plants.names_for(arm_file.load("rigid"), ("exact", "damping x3")) == ("exact",)


# --------------------------------------------------------------------------- strain feedback


@pytest.mark.parametrize("name", ["R", "two_link", "long_reach"])
def test_the_moment_that_a_gauge_shows_is_that_on_the_joint(name):
    """A force on the tip: the innermost gauge's moment is about that of the force on the joint, with its sign."""
    known = model.build(cases.arm_of(name))
    n = known.n_joints
    rows = baselines.moment_rows(known)
    for i in np.flatnonzero(np.abs(rows).max(axis=1)):
        link = known.arm.links[i].name
        columns = [k for k, mode in enumerate(known.arm.modes) if mode.link == link]
        # Bent as a turn of this joint bends the link: inertia forces along its motion.
        M = known.terms(np.zeros(n), np.zeros(n))
        bent = -np.linalg.solve(M.K2, M.M[n:, i])
        moment = rows[i, columns] @ bent[columns]
        # Accelerated forwards, the links outside hold the joint back.
        assert moment < 0.0
        held = M.M[i, i] - known.arm.joints[i].inertia
        assert 0.3 < -moment / held < 1.2, (name, i)


def test_strain_feedback_by_hand():
    known = model.build(cases.arm_of("two_link"))
    n, m = known.n_joints, known.n_modes
    gains = {"p": [3.0, 2.0], "i": [0.0, 0.0], "d": [1.0, 1.0], "i_clamp": [1.0, 1.0]}
    gains |= {"velocity": [0.0, 0.0], "acceleration": [0.0, 0.0]}
    plain = baselines.Pid(known, gains)
    law = baselines.StrainPid(known, gains | {"moment": 0.5, "moment_rate": 0.1})
    at = SimpleNamespace(position=np.array([0.1, 0.2]), velocity=np.zeros(n))
    at.acceleration = np.array([1.0, -2.0])
    still = baselines.reference_deflection(known, at)
    delta, rate = still + 1e-3, np.full(m, 2e-3)
    q, qd = np.array([0.0, 0.1]), np.array([0.3, 0.0])
    rows = baselines.moment_rows(known)
    added = 0.5 * rows @ np.full(m, 1e-3) + 0.1 * rows @ rate
    expected = plain.step(q, qd, delta, rate, at).copy() + added
    assert_allclose(law.step(q, qd, delta, rate, at), expected, rtol=1e-12)


def test_the_linear_loop_of_strain_feedback_is_that_of_the_law():
    task = baselines.Task(cases.task_of(R))
    n, m = task.model.n_joints, task.model.n_modes
    gains = baselines.strain_gains(task, [8.0, 1.0, 0.0, 0.7, 0.3])
    K = baselines.pid_feedback(task, gains, task.nominal[-1])
    law, q = baselines.StrainPid(task.model, gains), np.array([0.01])
    at = SimpleNamespace(position=np.zeros(n), velocity=np.zeros(n), acceleration=np.zeros(n))
    delta, rate = np.array([1e-3, -2e-3]), np.array([0.1, 0.05])
    u = law.step(q, np.array([0.2]), delta, rate, at)
    assert_allclose(u, -K @ np.concatenate([q, delta, [0.2], rate]), rtol=1e-9)
    # Of a plant with a mode more, that the gauges see, too.
    more = baselines.pid_feedback(task, gains, task.plants[0])
    assert more.shape == (n, 2 * (n + m + 1)) and np.abs(more[0, n + m]) > 0.0


def test_an_arm_whose_gauges_show_no_moment_is_refused_strain_feedback(arm):
    bare = replace(arm, gauges=())
    with pytest.raises(FlexarmError, match="no gauge"):
        baselines.strain_pid(ArmTask("bare", bare, "paper:duration=2"))


# --------------------------------------------------------------------------- LQG


def test_the_noise_in_the_torque_of_an_lqg_is_that_of_its_samples():
    task = baselines.Task(cases.task_of(R))
    values = [f.first for f in baselines._lqr_free(task)]
    K, given = baselines.lqr_gain(task, values), baselines.kalman_parameters(task, values)
    share = baselines.lqg_noise(task, K, given)
    # The same loop, sample by sample.
    own, L = task.nominal[2], baselines.kalman_gain(task, 2, given)
    loop = baselines._lqg_loop(task, task.plants[5], own, L, K, 0)
    N, M = len(task.plants[5].Phi), len(own.Phi)
    rng, s, torque = np.random.default_rng(0), np.zeros(len(loop)), []
    root = np.linalg.cholesky(baselines.reading_covariance(task))
    for _ in range(40000):
        s = loop @ s
        s[N : N + M] += L @ root @ rng.normal(size=len(root))
        torque.append(s[-1])
    assert_allclose(share, np.std(torque) / task.model.arm.torque_limits[0], rtol=0.05)


def test_a_tuned_lqg_is_stable_on_its_set_and_no_noisier_than_a_design():
    task = baselines.Task(cases.task_of(R))
    K, given, slowest = baselines.lqr(task)
    assert slowest < 0.0
    assert baselines.lqg_noise(task, K, given) < 1.5 * baselines.NOISIEST
    setup = baselines.full_state_lqr(cases.task_of(R))
    assert setup.controller["publish_joint_velocity"] is False


# --------------------------------------------------------------------------- runs and who wins


def test_a_setup_is_made_once_for_all_plants_and_a_refusal_refuses_all(arm):
    made = []

    def make(case):
        made.append(case.name)
        raise FlexarmError("no gains hold", field="x")

    found = runs.rows(ArmTask("R", arm, "paper"), "R", "pid", make, ["nominal", "friction"])
    assert made == ["R"]
    assert [r["sample"] for r in found] == ["R/pid/nominal", "R/pid/friction"]
    assert all("no gains hold" in r["refused"] for r in found)


def row(controller, variant, settling, peak=1.0, **more):
    found = {"controller": controller, "variant": variant, "settling_s": settling}
    return found | {"peak_joint_error_deg": peak, "residual_tip": 1e-4} | more


ROWS = [
    row("designed", "nominal", 0.10, 2.0),
    row("designed", "friction", 0.50, 3.0),
    row("designed", "noisy", 0.20, 3.0),
    row("pid", "nominal", 0.30, 0.5),
    row("pid", "friction", None, 0.6),
    row("pid", "noisy", 0.4, 0.5, lost="far off"),
    row("lqr", "nominal", 0.105, 1.0),
    row("lqr", "friction", 0.3, 1.0),
    row("lqr", "noisy", 0.9, 1.0),
]


def test_nominal_median_and_worst_by_hand():
    cells = {words: (found, won) for words, found, won in report.rows_of(ROWS)}
    settling = {over: cells[f"settling time [s], {over}"] for over in report.OVER}
    assert settling["nominal"][1] == ["designed", "lqr"]  # 5 ms is no difference
    assert settling["median"][0]["designed"][1] == 0.5  # of two the worse one
    assert settling["worst"][0]["pid"][2] == report.LOST and settling["worst"][1] == ["designed"]
    assert cells["peak joint error [deg], worst"][0]["pid"][2] == report.LOST
    assert cells["peak joint error [deg], nominal"][1] == ["pid"]
    table = report.table(ROWS)
    assert table[0] == "|  | designed | pid | lqr | best |"
    assert "| settling time [s], worst | 0.5 | lost | 0.9 | designed |" in table
    assert "| lost | 0 of 3 | 1 of 3 | 0 of 3 |  |" in table


def test_the_sentences_state_where_a_baseline_wins_and_why_runs_were_lost():
    lines = report.verdicts(ROWS)
    assert lines[0] == "A baseline wins 3 of 9 rows:"
    assert "  - peak joint error [deg], nominal: pid (0.5) before designed (2)" in lines
    assert "designed settles last on friction: 0.5 s." in lines
    assert "pid settles last on noisy: lost." in lines
    assert "pid lost in 1 runs: far off" in lines
    without = report.verdicts([r for r in ROWS if r["controller"] == "designed"])
    assert without == ["designed settles last on friction: 0.5 s."]


# --------------------------------------------------------------------------- where it is computed


def double(x):
    return [{"sample": x, "twice": 2 * x}]


def test_a_cluster_that_is_not_there_and_processes(tmp_path):
    found = dict(workers.results(double, [(1,), (2,)], 1, workers.PROCESSES))
    assert found == {0: double(1), 1: double(2)}
    with pytest.raises(FlexarmError, match="--scheduler"):
        list(workers.results(double, [(1,)], 1, "nowhere://x"))


def test_what_is_kept_is_there_again(tmp_path):
    spec, path = command.Specification(0, []), tmp_path / "kept.jsonl"
    list(gather(Store(path, spec), double, [(1,), (2,)], 1))
    assert Store(path, spec).results[2]["twice"] == 4
    with pytest.raises(FlexarmError, match="another specification"):
        Store(path, command.Specification(1, []))


@pytest.mark.long
def test_compare_judges_on_uncertain_plants_and_goes_on(tmp_path, monkeypatch, capsys):
    short = replace(R, motion="quintic:to=0.1,duration=0.5")
    monkeypatch.setattr(cases, "CASES", (short,))
    out, kept = tmp_path / "rows.json", tmp_path / "kept.jsonl"
    words = ["--arms", "R", "--controllers", "shipped,pid", "--plants", "nominal,payload x1.3"]
    words += ["--no-combinations", "--workers", "1", "--json", str(out), "--out", str(kept)]
    command.main(words)
    (case,) = command.load(out)["cases"]
    rows = {(r["controller"], r["variant"]): r for r in case["plants"]}
    assert len(rows) == 4 and case["controllers"] == {}
    own = [rows["shipped", v]["peak_joint_error_deg"] for v in ("nominal", "payload x1.3")]
    assert 0.0 < own[0] < own[1]
    text = capsys.readouterr().out
    assert "### R, uncertain plants" in text and "Median and worst of 1 plants" in text
    monkeypatch.setattr(command, "on_plants", None)  # not called again
    command.main(words)
    assert capsys.readouterr().out == text


def test_the_numbers_of_a_row_have_six_digits(monkeypatch):
    monkeypatch.setattr(
        runs.trial,
        "run",
        lambda *_, **__: {"settling_s": 0.123456789, "settled": True, "rest": None},
    )
    make = lambda case: SimpleNamespace(found={"decay": 12345.6789})  # noqa: E731
    (row,) = runs.rows(SimpleNamespace(name="arm"), 3, "own", make, ["exact"])
    assert (row["settling_s"], row["decay"]) == (0.123457, 12345.7)
    assert row["settled"] is True and row["rest"] is None and row["sample"] == "3/own/exact"
