# SPDX-License-Identifier: Apache-2.0
"""Random arms: what is drawn, how a run is judged, what the baselines are tuned for, and the table."""

import argparse
import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose

from flexarm_control.composite.assembly import control
from flexarm_control.robust.default import Default
from flexarm_control.robust.design import design
from flexarm_control.robust.settings import Settings
from flexarm_control.trajectory import specs
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import DesignError, FlexarmError
from flexarm_dynamics.models import model
from flexarm_dynamics.models.fixed_step import substeps
from flexarm_studies.random_arms import command, generator, report, study
from flexarm_studies.uncertain import baselines, plants, trial
from flexarm_studies.uncertain.controllers import CONTROLLERS

#: One of each layout, with and without gravity.
COUNT = 2 * len(generator.LAYOUTS)


@pytest.fixture(scope="module")
def drawn():
    return list(generator.arms(COUNT, seed=5))


# --------------------------------------------------------------------------- designs


@pytest.mark.long
def test_an_arm_with_light_hubs_has_gains_by_a_low_pass():
    # Without it, modes beyond the loop's reach leave the joints next to no stiffness.
    case = generator.arm(5)
    places = tuple(tuple(q.tolist()) for q in baselines.task_of(case).places[1:2])
    found = design(case.read(), Settings(500.0, 0.002, effort=0.3, configurations=places))
    assert np.isfinite(found.sampling.torque_corner) and found.decay > 0.05
    law = control(model.build(found.arm), found.parameters())
    for part in (law.slow, law.fast):
        assert part.parameters["bandwidth"] == pytest.approx(found.sampling.torque_corner, rel=1e-5)


# --------------------------------------------------------------------------- the generator


def test_seed_and_number_decide_an_arm(drawn):
    assert generator.arm(3, seed=5) == drawn[3]
    assert list(generator.arms(2, seed=5, start=7)) == drawn[7:9]
    assert generator.arm(3, seed=6).arm != drawn[3].arm


def test_every_layout_is_drawn_with_and_without_gravity(drawn):
    found = {
        (len(d.arm["links"]), "z" in d.arm["links"][0]["flexible"], any(d.arm["gravity"]))
        for d in drawn
    }
    assert found == {(n, s, g) for n in (1, 2, 3, 4) for s in (False, True) for g in (False, True)}


def test_arms_survive_yaml(drawn):
    for case in drawn:
        assert yaml.safe_load(case.text) == case.arm
        assert case.read() == arm_file.parse(yaml.safe_dump(case.arm))


def test_arms_are_within_the_bounds(drawn):
    for case in drawn:
        arm, data = case.read(), case.arm
        reach = arm.reach
        assert 0.999 * generator.REACH[0] < reach < 1.001 * generator.REACH[1]
        mass = sum(link.mass for link in arm.links)
        assert 0.0 < arm.payload.mass < 1.01 * generator.PAYLOAD[1] * mass
        damping = {z for link in arm.links for f in link.flexible.values() for z in f.damping}
        assert all(0.999e-3 < z < 1.001e-2 for z in damping)
        assert len(arm.gauges) == len(arm.modes)
        assert all("motor_mass" in joint for joint in data["joints"][1:])


def test_motions_are_two_locked_periods_of_60_to_90_degrees_within_the_limits(drawn):
    for case in drawn:
        arm_model = model.build(case.read())
        motion = specs.from_spec(case.motion, arm_model)  # refused beyond the limits
        turn = np.degrees(np.abs(np.array(motion.positions[-1]) - motion.positions[0]))
        assert np.all((turn > 59.9) & (turn < 90.1))
        ends = motion.positions[0], motion.positions[-1]
        slowest = min(arm_model.frequencies(np.array(q), locked=True)[0] for q in ends)
        assert_allclose(case.period, 2.0 * np.pi / slowest, rtol=1e-6)
        assert 0.49 < 1.0 / case.period < 15.1
        assert_allclose(1e-9 * motion.times_ns[-1], 2.0 * case.period, atol=1e-3)


def test_torque_limits_are_what_the_motion_needs_and_a_half_to_twice(drawn):
    for case in drawn:
        arm_model = model.build(case.read())
        family, settings = specs.parse(case.motion)
        profile = specs.motion(family, settings, arm_model, np.zeros(arm_model.n_joints))
        need = np.zeros(arm_model.n_joints)
        for t in np.linspace(0.0, profile.duration, 61):
            q, qd, qdd = (profile.derivative(k, t) for k in range(3))
            terms = arm_model.terms(q, qd)
            torque = terms.M[: q.size, : q.size] @ qdd + terms.f1
            need = np.maximum(need, np.abs(torque))
        ratio = arm_model.arm.torque_limits / need
        assert np.all((ratio > 1.49) & (ratio < 2.01)), case.name


# --------------------------------------------------------------------------- a run, judged


def arm_like_r():
    """A planar arm of one link, as R."""
    return generator.arm(0, seed=5)


def record_of(make_record, case, plant, rest):
    """A record of the motion whose joints come to rest at an angle `rest` (n,) [rad] off its end."""
    wanted = specs.from_spec(case.motion, plant)
    end = 1e-9 * wanted.times_ns[-1]
    time = np.arange(0.0, end + trial.window_of(case) + 1e-3, 2e-3)
    reference = trial.positions(wanted, time)
    bent = plant.static_deflection(reference[-1])
    late = np.exp(-np.maximum(time - end, 0.0) / (0.5 * case.period))[:, None]
    record = make_record(
        plant,
        time,
        reference=0.0,
        plant_amplitude=bent,
    )
    return replace(record, reference=reference, plant_position=reference + rest + 0.1 * late), end


def test_a_run_is_judged_by_where_the_plant_itself_would_rest(make_record):
    case = arm_like_r()
    plant = model.build(plants.plant_of(case.read(), plants.VARIANTS["payload x1.3"]))
    record, end = record_of(make_record, case, plant, 0.0)
    found = trial.judged(case, plant, record, end)
    # 0.1 rad e^(-t/half a period) moves the tip by 0.1 % of the reach after ln(100) half periods.
    assert_allclose(found["settling_periods"], 0.5 * np.log(100.0), rtol=0.02)
    assert found["settled"] and found["at_rest"] and found["rest_tip"] < 1e-4
    assert_allclose(found["peak_joint_error_deg"], np.degrees(0.1), rtol=1e-6)
    record, end = record_of(make_record, case, plant, np.radians(0.2))
    found = trial.judged(case, plant, record, end)
    assert not found["settled"] and found["settling_s"] is None and not found["at_rest"]
    assert_allclose(found["rest_joint_deg"], 0.2, rtol=0.01)


def test_the_plant_is_more_than_the_model_and_its_sensors_ideal_unless_noisy():
    arm = arm_like_r().read()
    plant = plants.plant_of(arm, plants.VARIANTS["payload x0.7"])
    assert plant.finite_slope and plant.foreshortening
    assert len(plant.modes) == len(arm.modes) + 1
    assert_allclose(plant.payload.mass, 0.7 * arm.payload.mass)
    assert not any(g.bits for g in plant.gauges) and not any(j.encoder_counts for j in plant.joints)
    noisy = plants.plant_of(arm, plants.VARIANTS["noisy"])
    assert noisy.gauges == arm.gauges and noisy.joints == arm.joints


@pytest.mark.long
@pytest.mark.parametrize(
    ("implicit", "losses", "steps", "lost"),
    [(True, 1, [1, 3], False), (True, 2, [1, 3], True), (False, 1, [1], True)],
    ids=["the method's fault", "lost", "explicit"],
)
def test_a_run_that_is_lost_is_lost_in_shorter_steps_too(
    implicit, losses, steps, lost, monkeypatch
):
    followed, tried, counts = trial._followed, [], []

    def loses_at_first(case, setup, variant, seed, shorter):
        loop, *found = followed(case, setup, variant, seed, shorter)
        tried.append(shorter)
        loop.lost = "the strain jumped" if len(tried) <= losses else ""
        loop.simulator.plant.implicit = implicit
        counts.append(loop.simulator.plant.substeps)
        return loop, *found

    monkeypatch.setattr(trial, "_followed", loses_at_first)
    case = arm_like_r()
    found = trial.run(case, CONTROLLERS["default"](case), plants.VARIANTS["exact"])
    assert tried == steps and ("lost" in found) == lost
    assert [n / counts[0] for n in counts] == steps


@pytest.mark.long
@pytest.mark.slow
def test_a_baseline_that_is_tuned_for_the_arm_settles_on_it_and_the_same_every_time():
    case = arm_like_r()
    setup = CONTROLLERS["lqr"](case)
    found = trial.run(case, setup, plants.VARIANTS["exact"])
    assert "lost" not in found and found["settled"] and found["settling_periods"] < 3.0
    again = trial.run(case, CONTROLLERS["lqr"](case), plants.VARIANTS["exact"])
    assert again == found


@pytest.mark.long
@pytest.mark.slow
def test_a_designed_controller_runs():
    case = arm_like_r()
    setup = CONTROLLERS["designed_preview"](case)
    assert setup.controller["feedforward"] == "preview" and setup.law is None
    found = trial.run(case, setup, plants.VARIANTS["exact"])
    assert "lost" not in found and "refused" not in found and found["peak_joint_error_deg"] < 5.0


def test_a_design_that_is_refused_is_a_result():
    case = generator.arm(1, seed=5)  # a yaw joint reaches no vertical bending
    found = trial.run(case, CONTROLLERS["default"](case), plants.VARIANTS["exact"])
    assert list(found) == ["refused"] and "can't reach" in found["refused"]


# --------------------------------------------------------------------------- baselines


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 2])
def test_a_pid_is_stable_on_what_it_is_tuned_for(number):
    task = baselines.Task(generator.arm(number, seed=5))
    gains, _ = baselines.pid(task, "zvd")
    K = baselines.pid_feedback(task, gains, task.plants[0])
    assert all(baselines.poles(p, K, gains["i"]).real.max() < 0.0 for p in task.plants)
    # With thirty times the gains it is not: the judge can fail.
    assert any(baselines.poles(p, 30.0 * K, gains["i"]).real.max() > 0.0 for p in task.plants)


def test_a_sampled_loop_is_that_of_its_samples(drawn):
    task = baselines.Task(drawn[2])
    plant, n = task.plants[0], task.model.n_joints
    gains = baselines.pid_gains(task, [task.omega, 1.0, 0.1, 2.0, 0.5])
    K = baselines.pid_feedback(task, gains, plant)
    rng = np.random.default_rng(0)
    for late in (0, 1):
        x, last, held = rng.normal(size=len(plant.Phi)), rng.normal(size=n), np.zeros(n)
        s = np.concatenate([x, last, held])
        for _ in range(3):
            held = held - gains["i"] * (plant.X @ x)[:n] / baselines.RATE
            u = -K @ (plant.X @ x) + held
            x, last = plant.Phi @ x + plant.Gamma @ (last if late else u), u
            s = baselines.pid_loop(plant, K, gains["i"], late) @ s
        assert_allclose(s, np.concatenate([x, last, held]), rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_the_settling_time_of_the_linear_arm_is_about_that_of_the_run():
    case = arm_like_r()
    task = baselines.Task(case)
    _, periods = baselines.pid(task, "zvd")
    found = trial.run(case, CONTROLLERS["pid_zvd"](case), plants.VARIANTS["payload x1.3"])
    assert periods < 4.0 and found["settled"]
    assert abs(found["settling_periods"] - periods) < 1.5


def test_what_no_torque_reaches_is_left_out():
    task = baselines.Task(generator.arm(1, seed=5))  # yaw alone: bending along z is out of reach
    states = 2 * (task.model.n_joints + task.model.n_modes)
    assert task.nominal[-1].X.shape == (states, states - task.model.n_modes)


# --------------------------------------------------------------------------- many runs, and the table


def test_runs_are_kept_and_not_run_again(tmp_path, monkeypatch):
    calls = []

    def run(case, setup, variant, seed):
        calls.append(case.name)
        return {"refused": "why not"}

    monkeypatch.setattr(trial, "run", run)
    path = tmp_path / "runs.jsonl"
    args = (5, [0, 3], ["default"], ["exact", "noisy"], path, 1)
    rows = study.run(*args)
    assert len(calls) == 4 and len(path.read_text().splitlines()) == 5
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    assert [r["sample"] for r in study.run(*args)] == [r["sample"] for r in rows]
    assert len(calls) == 5
    with pytest.raises(FlexarmError, match="another specification"):
        study.run(6, *args[1:])


def test_designs_of_a_file_are_run_and_missing_ones_made_and_added(tmp_path, monkeypatch):
    made, ran = [], []

    def design_of(case):
        made.append(case.name)
        if case.name.endswith("_1"):
            raise DesignError("has no stable gains", field="controller of it")
        return Default({"slow.stiffness": [7.0]}, 0.002, 0.01, 0.4, 1.0, False, True, False)

    def run(case, setup, variant, seed):
        ran.append((case.name, setup.controller["feedforward"], setup.controller["slow.stiffness"]))
        return {"lost": "why not"}

    monkeypatch.setattr(study, "design_of", design_of)
    monkeypatch.setattr(trial, "run", run)
    path = tmp_path / "designs.jsonl"

    def runs(numbers):
        both = ["designed", "designed_preview"]
        return study.run(5, numbers, both, ["exact"], workers=1, designs=path)

    first, second, refused, _ = runs([0, 1])
    name = generator.arm(0, seed=5).name
    assert ran == [(name, "model", [7.0]), (name, "preview", [7.0])]
    assert first["decay"] == second["decay"] == 0.4
    assert refused["refused"] == "controller of it: has no stable gains"
    # A changed line of the file is what runs; only the arm that is not in it gets a design.
    path.write_text(path.read_text().replace("7.0", "8.0"))
    runs([0, 2])
    assert ran[2] == (name, "model", [8.0]) and ran[-1][2] == [7.0]
    assert made == [generator.arm(n, seed=5).name for n in (0, 1, 2)]
    # Another seed has other arms, and a file of runs is none of designs.
    with pytest.raises(FlexarmError, match="another specification"):
        study.run(6, [0], ["designed"], ["exact"], workers=1, designs=path)
    path.write_text(path.read_text().replace("parameters", "gains"))
    with pytest.raises(FlexarmError, match="not a file of designs"):
        runs([0])
    # Controllers that have no design make none.
    study.run(5, [3], ["pid_zvd"], [], workers=1, designs=tmp_path / "none.jsonl")
    assert len(made) == 3


def row(number, controller, settling, **more):
    found = {
        "number": number,
        "arm": f"arm_{number}",
        "controller": controller,
        "variant": "exact",
        "peak_joint_error_deg": 1.0 + number,
        "settling_s": settling,
        "settling_periods": settling,
        "settled": settling is not None,
        "at_rest": True,
        "residual_tip": 1e-4,
    }
    return json.loads(json.dumps(found | more))


def test_the_table_counts():
    rows = [
        row(0, "default", 1.0),
        row(1, "default", 4.0),
        row(2, "default", None, lost="joint2 is 3.1 rad off its reference"),
        {"number": 3, "controller": "default", "variant": "exact", "refused": "no gains hold"},
        row(0, "lqr", 2.0),
        row(0, "pid_ei", 1.5),
        row(1, "lqr", 2.0),
    ]
    table = dict(zip(("default", "lqr", "pid_ei"), report.rows_of(rows), strict=True))
    # works, refused, lost, settled, within 3 periods, periods until settled, at rest, no later than the best baseline
    assert table["default"][2:10] == (2, 1, 1, 2, 1, "4 (never)", 2, 1)
    assert table["default"][10] == "1.5° (2°)"
    assert table["lqr"][9] is None
    assert any("lost in 1 runs: joint is … rad off" in line for line in report.reasons(rows))


def test_what_is_wanted_of_designs_is_counted():
    def runs(variant, settling, residual=1e-4, **more):
        own = row(0, "designed", settling, variant=variant, residual_tip=residual, decay=0.3)
        return [own | more, row(0, "pid_zvd", 2.0, variant=variant), row(0, "lqr", 4.0)]

    rows = [
        *runs("exact", 0.3),
        *runs("payload x0.7", 1.0),
        *runs("payload x1.3", 1.0, residual=2e-4),  # more than the best baseline's
        *runs(
            "stiffness x0.9", 2.5, at_rest=False, rest_joint_deg=0.1
        ),  # later than the best baseline
        *runs("stiffness x1.1", None, at_rest=False, rest_joint_deg=0.1),
        *runs("noisy", 1.0, residual=2.9e-4, noise_tip=1e-4),
    ]
    names, table = report.reached(rows)
    assert names == ["designed"]
    assert [cell.split(" (")[0] for _, _, cell in table] == [
        "6 of 6", "0 of 1", "1 of 1", "3 of 4", "2 of 4", "1 of 4", "1 of 1",
    ]  # fmt: skip
    (found,) = (
        line[2] for line in report.reached(runs("noisy", 1.0, 3.1e-4, noise_tip=1e-4))[1][1:]
    )
    assert found == "0 of 1 (0 %)"
    assert [cells[1:] for cells in report.beaten(rows)] == [
        ("payload x1.3", "designed", "1", "2", "2.0e-04", "1.0e-04"),
        ("stiffness x0.9", "designed", "2.5", "2", "1.0e-04", "1.0e-04"),
        ("stiffness x1.1", "designed", "never", "2", "1.0e-04", "1.0e-04"),
    ]
    lost = row(0, "designed", None, variant="payload x0.7", decay=0.3, lost="joint1 is 9 rad off")
    (cells,) = report.beaten([lost, row(0, "pid_zvd", 2.0, variant="payload x0.7")])
    assert cells[3] == "lost" and report.BEATEN in report.text(rows, 0)
    # A baseline that never settles is better than an arm that is lost, and no better than one that never settles.
    never = row(0, "pid_zvd", None, variant="payload x0.7")
    assert len(list(report.beaten([lost, never]))) == 1
    late = row(0, "designed", None, variant="payload x0.7", decay=0.3)
    assert not list(report.beaten([late, never]))


def test_a_share_of_less_than_all_is_not_100_percent():
    assert report._share([True] * 599 + [False]) == "599 of 600 (99.8 %)"
    assert report._share([True] * 600) == "600 of 600 (100 %)"


@pytest.mark.long
def test_what_noise_alone_makes_is_measured_beside_a_noisy_run():
    case = arm_like_r()
    setup = CONTROLLERS["pid"](case)
    alone = trial.run(case, setup, plants.VARIANTS["noise and counts"])["noise_tip"]
    assert 0.0 < alone < 1e-3
    assert "noise_tip" not in trial.run(case, setup, plants.VARIANTS["exact"])
    # The sensors' noise is all there is: with ideal ones an arm that is held does not move.
    q = specs.from_spec(case.motion, model.build(case.read())).positions[-1]
    still = trial.of_noise_alone(case, setup, plants.VARIANTS["exact"], np.array(q))
    assert still < 0.1 * alone


def test_arms_that_miss_are_listed_with_what_they_miss():
    rows = [
        row(n, "designed", settling, arm=f"planar1_0_{n}", decay=0.3, **more)
        for n, settling, more in (
            (0, 1.0, {}),
            (1, 4.0, {}),
            (2, None, {"lost": "joint1 is too fast"}),
            (3, 1.0, {"at_rest": False, "rest_joint_deg": 0.0312}),
        )
    ]
    found = {arm: cells for arm, _, _, *cells in report.missed(rows)}
    assert found == {"planar1_0_1": ["4"], "planar1_0_2": ["lost"], "planar1_0_3": ["1 (0.031°)"]}


def test_arms_that_vibrate_with_noise_are_listed_with_what_limits_them():
    rows = []
    for n, noisy in ((0, 2e-4), (1, 2.9e-4), (25, 4e-4)):
        arm = {"arm": generator.arm(n).name, "decay": 0.3}
        rows.append(row(n, "designed", 1.0, residual_tip=1e-5, **arm))
        more = {"variant": "noisy", "residual_tip": noisy, "noise_tip": 1e-4 if n else 1e-5}
        rows.append(row(n, "designed", 1.0, **more, **arm))
    loud = {arm: cells for arm, _, *cells in report.loud(rows, 0)}
    assert list(loud) == ["planar1g_0_0", "spatial1g_0_25"]
    for cells in loud.values():
        assert len(cells) == len(report.LOUDER) - 2
    assert loud["planar1g_0_0"][:3] == ["2.0e-04", "1.0e-05", "1.0e-05"]
    assert loud["planar1g_0_0"][-1] is None
    # An arm that turns about one axis and bends across both: no torque reaches one direction.
    assert loud["spatial1g_0_25"][-1] == pytest.approx(loud["spatial1g_0_25"][-2], rel=0.01)
    assert report.LOUD in report.text(rows, 0)
    assert report.LOUD not in report.text(rows[2:4], 0)


def test_arms_are_chosen_by_their_numbers(tmp_path, capsys):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    chosen = ["--seed", "5", "--arms", "8,0-1"]
    command.arms(parser.parse_args([*chosen, "--files", str(tmp_path)]))
    assert {p.stem for p in tmp_path.iterdir()} == {generator.arm(n, 5).name for n in (0, 1, 8)}
    for wrong in ("4-2", "x", "1,", "-1"):
        with pytest.raises(FlexarmError, match="is no list of numbers"):
            command.arms(parser.parse_args(["--arms=" + wrong, "--files", str(tmp_path)]))


def test_the_table_of_designs_has_the_decay_of_every_arm_once():
    rows = [
        {"controller": "designed", "number": n, "arm": f"planar{links}_0_{n}", "decay": d}
        for n, (links, d) in enumerate(((1, 0.4), (1, 0.2), (2, 0.04)))
        for _ in range(2)
    ]
    rows.append({"controller": "pid", "number": 0, "arm": "planar1_0_0"})
    (found,) = report.decays(rows)
    assert found == ("designed", 3, pytest.approx(0.3), 0.2, 0.04, 1)


def test_steps_are_short_enough_for_friction_on_a_light_hub():
    slow, light = (
        model.build(plants.plant_of(generator.arm(number).read(), plants.VARIANTS["exact"]))
        for number in (4, 14)
    )
    assert trial.longest_step(slow, np.zeros(3)) == trial.STEP
    step = trial.longest_step(light, np.zeros(4))
    hubs = np.diag(np.linalg.inv(light.terms(np.zeros(4), np.zeros(4)).M))[:4]
    moved = light.friction_table()[:, 1] * hubs * step**2
    assert step < 0.7 * trial.STEP and moved.max() == pytest.approx(trial.KICK)


def test_dop853_is_taken_where_modes_and_friction_allow_long_steps():
    """Arm 26 hunted by 0.09 deg on its light second hub, in steps that its modes allow."""
    steady, light = (
        model.build(plants.plant_of(generator.arm(number).read(), plants.VARIANTS["exact"]))
        for number in (17, 26)
    )
    assert trial._explicit_substeps(steady, 2e-3) <= trial.EXPLICIT
    assert substeps(light, 2e-3, undamped=True) <= trial.EXPLICIT
    assert trial._explicit_substeps(light, 2e-3) > trial.EXPLICIT
