# SPDX-License-Identifier: Apache-2.0
"""``flexarm compare``: the baselines' laws, the tuner, the shipped controller files, and the tables of stored rows."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.composite.full_order import at_rest
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import DesignError, FlexarmError
from flexarm_dynamics.linear import linear_plant, sampled, static_torque
from flexarm_studies.comparison import cases, combinations, command, controllers, report, trial
from flexarm_studies.comparison.baselines import FullStateLqr, JointPid, lqr_gain
from flexarm_studies.comparison.tuning import Free, tune
from flexarm_studies.loop import scenario
from flexarm_studies.uncertain import plants

pytestmark = pytest.mark.slow

R, ONE, TWO, LONG = cases.CASES


@pytest.fixture(scope="module")
def two():
    return cases.model_of("two_link")


def reference(q, qd, qdd):
    return SimpleNamespace(position=np.array(q), velocity=np.array(qd), acceleration=np.array(qdd))


# --------------------------------------------------------------------------- PID


def pid(two):
    gains = {"p": [10.0, 4.0], "i": [2.0, 1.0], "d": [3.0, 0.5], "i_clamp": [1.0, 0.05]}
    return JointPid(two, gains | {"velocity": [0.2, 0.1], "acceleration": [0.4, 0.3]})


def test_pid_by_hand(two):
    law, m = pid(two), two.n_modes
    wanted = reference([0.5, -0.2], [1.0, -1.0], [2.0, 4.0])
    q, qd = np.array([0.4, 0.1]), np.array([0.8, -0.5])
    u = law.step(q, qd, np.zeros(m), np.zeros(m), wanted, 0.1)
    # e = 0.1, -0.3; integral 2 * 0.1 * 0.1 = 0.02 and -0.03; de = 0.2, -0.5
    first = 10 * 0.1 + 0.02 + 3 * 0.2 + 0.2 * 1.0 + 0.4 * 2.0
    second = 4 * -0.3 - 0.03 + 0.5 * -0.5 + 0.1 * -1.0 + 0.3 * 4.0
    assert_allclose(u, [first, second], rtol=1e-12)


def test_pid_clamps_and_forgets_its_integral(two):
    law, zero = pid(two), np.zeros(two.n_modes)
    wanted = reference([1.0, 1.0], [0.0, 0.0], [0.0, 0.0])
    for _ in range(50):
        u = law.step(np.zeros(2), np.zeros(2), zero, zero, wanted, 0.1)
    assert_allclose(u, [10.0 + 1.0, 4.0 + 0.05])
    law.reset()
    assert_allclose(law.step(np.zeros(2), np.zeros(2), zero, zero, wanted, 0.0), [10.0, 4.0])


def test_pid_carries_the_weight_of_the_straight_arm():
    arm = cases.model_of("long_reach")
    law = JointPid(arm, controllers.pid_gains(LONG, [1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0]))
    q = cases.ends_of(LONG)[0]
    zero = np.zeros(arm.n_modes)
    u = law.step(q, 0.0 * q, zero, zero, at_rest(q))
    assert np.abs(u[1]) > 50.0
    # The sag moves the masses inwards a little.
    assert_allclose(u, static_torque(arm, q), atol=0.05 * np.abs(u).max())


def test_pid_gains_are_those_of_the_inertia_that_a_joint_turns(two):
    gains = controllers.pid_gains(TWO, [4.0, 0.5, 0.1, 0.5, 1.0, 2.0, 3.0])
    M = two.terms(cases.ends_of(TWO)[1], np.zeros(2)).M
    w = np.array([4.0, 8.0])
    assert_allclose(gains["p"], np.diag(M)[:2] * w**2)
    assert_allclose(gains["d"], np.diag(M)[:2] * w * [1.0, 3.0])
    assert_allclose(gains["velocity"], 0.5 * gains["d"])


# --------------------------------------------------------------------------- shaper


def test_a_shaped_motion_ends_where_it_should_and_its_shaper_is_for_the_closed_loop():
    gains = controllers.pid_gains(R, [4.0, 1.0, 0.0, 0.0, 1.0])
    end = cases.ends_of(R)[1]
    poles = JointPid(cases.model_of("R"), gains).poles(end)
    rings = poles[(poles.imag > 0.0) & (-poles.real < controllers.DAMPED * np.abs(poles))]
    omega = np.sort(np.abs(rings.imag))[: controllers.SHAPED]
    train = controllers.shaper_for(R, gains, "zvd")
    assert_allclose(train.duration, (2.0 * np.pi / omega).sum(), rtol=1e-9)
    later = controllers.shaped_motion(R, gains, "zvd", 0.0)
    same = controllers.shaped_motion(R, gains, "zvd", 1.0)
    assert_allclose(1e-9 * later.times_ns[-1], R.duration + train.duration, atol=1e-8)
    assert_allclose(1e-9 * same.times_ns[-1], R.duration, atol=1e-8)
    assert_allclose(same.positions[-1], end)


def test_no_shaper_where_nothing_rings(monkeypatch):
    gains = controllers.pid_gains(R, [4.0, 1.0, 0.0, 0.0, 1.0])
    monkeypatch.setattr(controllers, "DAMPED", 0.0)
    with pytest.raises(DesignError, match="nothing rings"):
        controllers.shaper_for(R, gains, "zv")


# --------------------------------------------------------------------------- LQR


@pytest.mark.parametrize("case", [R, TWO], ids=lambda s: s.arm)
@pytest.mark.parametrize("decay", [0.0, 1.5])
def test_lqr_stabilises_the_sampled_arm(case, decay):
    arm, end = cases.model_of(case.arm), cases.ends_of(case)[1]
    K = lqr_gain(arm, end, case.rate, [0.1, 10.0, 1.0], decay)
    Phi, Gamma = sampled(*linear_plant(arm, end, coulomb=False), 1.0 / case.rate)
    open_loop = np.abs(np.linalg.eigvals(Phi)).max()
    assert open_loop > 1.0 - 1e-9  # the joints drift
    closed = np.abs(np.linalg.eigvals(Phi - Gamma @ K)).max()
    assert closed < np.exp(-decay / case.rate) - (0.0 if decay else 1e-5)


def test_lqr_asks_for_no_more_than_the_rigid_torque_on_the_bent_arm(two):
    end = cases.ends_of(TWO)[1]
    law = FullStateLqr(two, end, 1000.0, [0.1, 10.0, 1.0])
    wanted = reference(end, [0.3, -0.1], [1.0, 2.0])
    terms = two.terms(wanted.position, wanted.velocity)
    bent = np.linalg.solve(terms.K2, -terms.M[2:, :2] @ wanted.acceleration - terms.f2)
    u = law.step(end, wanted.velocity, bent, 0.0 * bent, wanted)
    stands = terms.M[:2, :2] @ wanted.acceleration + terms.f1 + terms.K1 @ bent
    assert_allclose(u, stands, rtol=1e-9)


def test_lqr_without_solution_is_refused(two):
    with pytest.raises(DesignError, match="Riccati"):
        lqr_gain(two, [0.0, 0.0], 1000.0, [np.nan, 1.0, 1.0])


# --------------------------------------------------------------------------- tuning

BOWL = (Free("a", 0.0, 10.0, 8.0), Free("b", 1e-3, 1e3, 1e2, log=True))


def bowl(values):
    return (values[0] - 3.0) ** 2 + np.log10(values[1] / 0.1) ** 2


def test_tuning_improves_within_its_budget_and_repeats():
    values, best, history = tune(bowl, BOWL, 60, seed=3)
    assert len(history) == 60
    assert history[0] == pytest.approx(25.0 + 9.0)
    assert best == min(history) == pytest.approx(bowl(values))
    assert best < 0.01 < min(history[:20])
    assert tune(bowl, BOWL, 60, seed=3)[2] == history
    assert tune(bowl, BOWL, 60, seed=4)[2] != history


def test_a_converged_search_goes_on_from_the_next_best():
    assert len(tune(bowl, BOWL, 400, seed=0)[2]) == 400


def test_what_can_be_judged_without_simulation_is_judged_first():
    plain, screened = (tune(bowl, BOWL, 9, seed=1, screen=s)[2] for s in (None, bowl))
    assert len(screened) == 9
    assert max(screened[1:3]) < 0.3 < min(plain[1:3])


def test_the_screen_of_pid_is_the_sampled_loop():
    """A damping that makes the sampled elbow unstable is distinguished from one that does not."""
    screen = controllers.CONTROLLERS[controllers.PID].screen
    soft, hard = (screen(TWO, [1.5, z, 0.0, 0.0, 1.0, 1.0, 1.0]) for z in (0.01, 5.0))
    assert soft < 0.0 < hard


def test_a_budget_of_one_is_the_first_guess():
    values, best, history = tune(bowl, BOWL, 1)
    assert_allclose(values, [8.0, 100.0])
    assert history == [best]


@pytest.mark.parametrize("case", cases.CASES, ids=lambda s: s.arm)
def test_first_guesses_are_within_their_ranges(case):
    for candidate in controllers.CONTROLLERS.values():
        for free in candidate.free(case):
            assert free.low <= free.first <= free.high, (candidate.name, free.name)
            assert free.at(free.place) == pytest.approx(free.first, abs=1e-12)


# --------------------------------------------------------------------------- what is run


@pytest.mark.parametrize("case", cases.CASES, ids=lambda s: s.arm)
def test_shipped_controllers_load_and_design(case):
    """Their own check of the sampled full-order poles is part of the design."""
    values = scenario.parameters(case.controller)
    loop = scenario.loop_of(scenario.Scenario(case.arm, values, rate=case.rate))
    law = loop.controller.law
    assert values["observer.type"] == "kalman"
    assert law.feedforward is not None
    assert law.fast.K_f.shape == (loop.model.n_joints, 2 * loop.model.n_modes)
    given = values.get("rate", 1000.0)
    assert given == (1000.0 if case in (R, ONE) else case.rate)


def test_composite_yaml_is_the_nodes_defaults():
    """But for the observer and the feed-forward, which are chosen for the arm."""
    bare, filed = (
        scenario.loop_of(scenario.Scenario("R", values)).controller.law
        for values in ({}, scenario.parameters("composite"))
    )
    assert type(filed.slow) is type(bare.slow)
    assert_allclose(filed.slow.kp, bare.slow.kp)
    assert_allclose(filed.slow.kv, bare.slow.kv)
    assert_allclose(filed.fast.K_f, bare.fast.K_f)
    assert filed.manifold.parameters == bare.manifold.parameters


def test_arms_without_damping_or_noise_get_some_and_others_stay():
    assert cases.arm_of("R").links[0].flexible["y"].damping == (0.005, 0.005)
    assert cases.arm_of("two_link").links == arm_file.load("two_link").links
    quiet, noisy = cases.arm_of("R"), cases.arm_of("R", noisy=True)
    assert {g.noise for g in quiet.gauges} == {0.0}
    assert {g.noise for g in noisy.gauges} == {plants.STRAIN_NOISE}
    assert noisy.joints[0].encoder_counts == plants.COUNTS


def test_combinations_make_sense():
    every = combinations.of(replace(R, depth="full"))
    assert len(set(every)) == len(every)
    assert not [c for c in every if c[0] == "resolved_acceleration" or c[1] == "scheduled_lqr"]
    assert not [c for c in every if c[1] == "none" and c[2] == "reference"]
    assert combinations.shipped(R) in every
    star = combinations.of(LONG)
    own = combinations.shipped(LONG)
    assert all(sum(a != b for a, b in zip(c, own, strict=True)) <= 1 for c in star)
    assert len(star) == 1 + 5 + 4 + 2 + 2


#: Takes 9 N m of the 13.6 that the joint has.
SHORT = replace(R, motion="quintic:to=0.01,duration=0.1", window=0.1, budget=2)


def test_a_baseline_runs_in_the_same_loop():
    candidate = controllers.CONTROLLERS[controllers.PID]
    row = trial.run(SHORT, candidate.setup(SHORT, [f.first for f in candidate.free(SHORT)]))
    assert 0.0 < row["peak_joint_error_rad"] < 0.01
    assert 0.0 < row["peak_torque_Nm"][0] <= 13.56
    length = 4.0 * 0.3048
    settling = SHORT.window if row["settling_s"] is None else row["settling_s"]
    assert row["cost"] == pytest.approx(
        row["rms_tip_mm"] / (10.0 * length) + row["residual_mm"] / length + settling
    )


def test_a_baseline_has_the_shipped_controllers_peak_torque_and_no_more(monkeypatch):
    shipped = controllers.prepared(SHORT, controllers.SHIPPED, ())
    assert "torque_limit" not in shipped.controller
    assert list(controllers.allowed(SHORT)) == trial.run(SHORT, shipped)["peak_torque_Nm"]
    stiff = [60.0, 5.0, 0.3, 0.0, 1.5]  # takes all it can get
    free = trial.run(SHORT, controllers.CONTROLLERS[controllers.PID].setup(SHORT, stiff))
    assert free["peak_torque_Nm"][0] > 3.0
    monkeypatch.setattr(controllers, "allowed", lambda case: (1.5,))
    held = trial.run(SHORT, controllers.prepared(SHORT, controllers.PID, stiff))
    # The motion needs six times as much: the baseline lags behind, and is not refused.
    assert held["peak_torque_Nm"] == pytest.approx([1.5], rel=1e-12)


def test_what_a_baseline_works_out_along_the_motion_it_works_out_once(two):
    seen, calls = {}, []
    law = JointPid(two, pid(two).gains, seen)
    law._along = lambda reference: calls.append(reference) or np.array([0.1, 0.2])
    first, later = (reference([x, 0.0], [0.0, 0.0], [0.0, 0.0]) for x in (0.1, 0.2))
    for point in (first, first, later, first):
        assert_allclose(law.along(point), [0.1, 0.2])
    assert [id(c) for c in calls] == [id(first), id(later)]
    assert_allclose(JointPid(two, law.gains, seen).along(first), [0.1, 0.2])


def test_a_shaped_motion_is_judged_by_the_motion_that_was_asked_for():
    """Stiffly led along another motion, the joint is off by what the motions differ."""
    candidate = controllers.CONTROLLERS["joint PID, ZV shaper"]
    values = [f.first for f in candidate.free(SHORT)]
    setup = candidate.setup(SHORT, values)
    shaped = setup.motion(cases.model_of("R"))
    assert 1e-9 * shaped.times_ns[-1] > 0.3
    row = trial.run(SHORT, setup)
    assert row["peak_joint_error_rad"] > 0.3 * 0.01


def test_what_is_refused_is_a_result():
    row = trial.run(SHORT, controllers.Setup({"slow.kp": [-1.0]}))
    assert row["cost"] == trial.REFUSED
    assert "slow.kp" in row["refused"]


# --------------------------------------------------------------------------- tables


def stored(residual=0.5, settling=0.1):
    row = {
        "peak_joint_error_rad": 0.01, "peak_tip_mm": 20.0, "rms_tip_mm": 8.0, "cost": 1.5,
        "residual_mm": residual, "settling_s": settling, "peak_torque_Nm": [2.0, 1.0],
    }  # fmt: skip
    pid = row | {"residual_mm": 4.0, "settling_s": None, "rms_tip_mm": 7.0}
    lqr = row | {"residual_mm": 1.0, "rms_tip_mm": 7.5}
    fill = {"gains": {"w [rad/s]": 4.0}, "simulations": 3, "first": 9.0, "best": 1.5}
    parts = dict(zip(combinations.PARTS, ("a", "none", "c", "d"), strict=True))
    case = {
        "arm": "two_link",
        "motion": "quintic:to=1",
        "rate_Hz": 1000.0,
        "window_s": 2.0,
        "budget": 3,
    }
    case["combinations"] = [parts | {"row": {"refused": "a pole", "cost": 1e4}}]
    case["controllers"] = {
        controllers.SHIPPED: {"row": row, "noisy": row, **fill, "gains": {}},
        controllers.PID: {"row": pid, "noisy": {"lost": "far off", "cost": 1e3}, **fill},
        "full-state LQR": {"row": lqr, "noisy": lqr, **fill},
    }
    return {"seed": 0, "cases": [case]}


def test_tables_of_stored_rows(tmp_path, flexarm):
    rows, page = tmp_path / "rows.json", tmp_path / "page.md"
    rows.write_text(json.dumps(stored()))
    page.write_text(f"before\n{report.BEGIN}\nold\n{report.END}\nafter\n")
    code, out, _ = flexarm("compare", "--from", rows, "--write", page)
    assert code == 0
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "\nold\n" not in text
    assert "| joint PID | 10 | 20 | 7 | 4 | > 2 | 2; 1 | arm lost |" in text
    assert "| a | none | c | d | refused |" in text
    assert "w [rad/s] = 4" in text
    assert "more than 20 times sooner" in text
    assert "No baseline beats" in text
    assert out.strip() in text


def test_a_baseline_that_is_better_in_both_is_named():
    verdicts = report.verdicts(stored(residual=2.0)["cases"][0])
    assert verdicts[-1].endswith(" residual: full-state LQR.")
    half = stored(residual=2.0)["cases"][0]
    half["controllers"]["full-state LQR"]["row"]["rms_tip_mm"] = 9.0
    assert report.verdicts(half)[-1].startswith("No baseline beats")
    late = report.verdicts(stored(settling=None)["cases"][0])
    assert late[0] == "The shipped controller does not settle within 2 s."


def test_runs_are_merged_and_must_agree():
    one, other = stored(), stored()
    del one["cases"][0]["controllers"][controllers.PID]
    one["cases"][0]["combinations"] = []
    whole = command.merged([one, other])
    assert set(whole["cases"][0]["controllers"]) == set(other["cases"][0]["controllers"])
    assert len(whole["cases"][0]["combinations"]) == 1
    other["cases"][0]["budget"] = 9
    with pytest.raises(FlexarmError, match="budget"):
        command.merged([one, other])


def test_a_file_without_markers_is_refused(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("nothing")
    with pytest.raises(FlexarmError, match="no lines"):
        report.write(stored(), page)


def test_an_interrupted_run_leaves_what_is_done(tmp_path, monkeypatch):
    def interrupted(keep, function, calls, *where):
        found = stored()["cases"][0]["controllers"][controllers.PID]
        keep.append({"sample": "R: joint PID", "found": found})
        yield 1, None
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "gather", interrupted)
    out = tmp_path / "rows.json"
    words = ["--arms", "R", "--controllers", "composite (shipped),joint PID", "--no-combinations"]
    with pytest.raises(KeyboardInterrupt):
        command.main([*words, "--json", str(out)])
    assert list(command.load(out)["cases"][0]["controllers"]) == [controllers.PID]


def test_the_command_runs(tmp_path, capsys, monkeypatch):
    """The whole way with `--quick`, on a motion that is over soon."""
    monkeypatch.setattr(cases, "CASES", (SHORT,))
    monkeypatch.setattr(command, "QUICK_WINDOW", 0.1)
    out = tmp_path / "rows.json"
    words = ["--quick", "--workers", "1", "--no-combinations", "--json", str(out)]
    command.main([*words, "--controllers", "composite (shipped),joint PID, ZV shaper"])
    found = json.loads(out.read_text())
    (case,) = found["cases"]
    assert set(case["controllers"]) == {controllers.SHIPPED, "joint PID, ZV shaper"}
    assert case["controllers"]["joint PID, ZV shaper"]["simulations"] == command.QUICK_BUDGET
    assert "residual_mm" in case["controllers"][controllers.SHIPPED]["row"]
    assert "joint PID, ZV shaper" in capsys.readouterr().out
