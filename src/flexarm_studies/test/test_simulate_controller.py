# SPDX-License-Identifier: Apache-2.0
"""Scenarios and ``flexarm simulate --controller``: the plant they build, late torque, metrics, what is refused."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Payload
from flexarm_dynamics.errors import FlexarmError, ParameterError, TrajectoryError
from flexarm_dynamics.models import levels, model
from flexarm_sim.integrators import integrate
from flexarm_sim.plant import Plant
from flexarm_sim.simulator import Simulator
from flexarm_studies.loop.closed_loop import ClosedLoop
from flexarm_studies.loop.metrics import tracking_metrics
from flexarm_studies.loop.scenario import (
    COMPONENTS,
    Scenario,
    loop_of,
    parameters,
    run,
    run_loop,
    trajectory_of,
)  # fmt: skip

#: Short motions, some of which take more torque than the arm has, are accepted.
PAPER = parameters("paper_composite", ["trajectory_torque_margin=0"])
SHORT = {"trajectory": "quintic:to=0.005,duration=0.1", "window": 0.05}


@pytest.fixture(scope="module")
def short():
    """A short run of R, its record and its metrics."""
    scenario = Scenario("R", PAPER, **SHORT)
    return scenario, *run(scenario)


def noisy(data):
    for gauge in data["gauges"]:
        gauge["noise"] = 1e-6


def without_limits(data):
    del data["joints"][0]["limits"]


def same_records(one, other):
    for name in one.__dataclass_fields__:
        assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


# --------------------------------------------------------------------------- the plant


def heavy(arm):
    p = arm.payload
    return replace(arm, payload=Payload(2.0 * p.mass, tuple(map(tuple, 2.0 * np.array(p.inertia)))))


def soft(arm):
    link = arm.links[0]
    return replace(arm, links=(replace(link, stiffness={"y": 0.8 * link.stiffness["y"]}),))


def damped(arm):
    link = arm.links[0]
    y = link.flexible["y"]
    y = replace(y, damping=tuple(5.0 * z for z in y.damping))
    return replace(arm, links=(replace(link, flexible={"y": y}),))


@pytest.mark.parametrize(
    ("option", "by_hand"),
    [
        ({"payload_scale": 2.0}, heavy),
        ({"stiffness_scale": 0.8}, soft),
        ({"damping_scale": 5.0}, damped),
        ({"plant_modes": 3}, lambda arm: arm.with_modes(3)),
        ({"plant_arm": "R"}, lambda arm: arm_file.load("R")),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_each_option_changes_the_plant_alone_as_it_says(option, by_hand):
    arm = arm_file.load("one_link")
    loop = loop_of(Scenario("one_link", PAPER, **option))
    direct = Plant(model.build(levels.simulated(by_hand(arm))), 1e-3)
    unchanged = Plant(model.build(levels.simulated(arm)), 1e-3)
    direct.reset()
    unchanged.reset()
    for k in range(30):
        torque = np.array([2.0 * np.cos(0.3 * k)])
        for plant in (loop.simulator, direct, unchanged):
            plant.advance(torque)
    assert_array_equal(loop.simulator.plant.state, direct.state)
    assert direct.state.size != unchanged.state.size or np.any(direct.state != unchanged.state)
    assert loop.model.arm == arm
    assert loop.controller.model.arm == arm


def test_rate_noise_and_seed_reach_the_simulator(changed_arm):
    path = changed_arm("R", noisy)
    loop = loop_of(Scenario(path, PAPER, noise=True, seed=7, rate=500.0))
    direct = Simulator(loop.simulator.settings | {"arm": path, "plant_arm": ""})
    assert loop.simulator.period_ns == 2_000_000
    assert loop.simulator.settings["seed"] == 7
    assert_array_equal(loop.simulator.strain, direct.strain)
    quiet = loop_of(Scenario(path, PAPER, seed=7)).simulator.strain
    assert_array_equal(quiet, 0.0)
    assert loop.simulator.strain.any()
    other = loop_of(Scenario(path, PAPER, noise=True, seed=8)).simulator.strain
    assert np.any(other != loop.simulator.strain)


def test_the_same_scenario_gives_the_same_samples_and_another_seed_others(changed_arm):
    scenario = Scenario(changed_arm("R", noisy), PAPER, noise=True, seed=3, delay=0.0015, **SHORT)
    record, metrics = run(scenario)
    again, same = run(pickle.loads(pickle.dumps(scenario)))
    through_json, alike = run(Scenario(**json.loads(json.dumps(scenario.as_dict()))))
    same_records(record, again)
    same_records(record, through_json)
    assert metrics == same == alike
    assert np.any(run(replace(scenario, seed=4))[0].torque != record.torque)


# --------------------------------------------------------------------------- late torque


def given(loop, torques):
    """Let the controller of a loop send these torques; None: it is not enabled."""
    torques = iter(torques)

    def step(sample):
        if (torque := next(torques)) is not None:
            loop.controller.torque[:] = torque
        return torque is not None

    loop.controller.step = step


@pytest.mark.parametrize(
    ("delay", "whole", "share"),
    [(0.0, 0, 0.0), (0.001, 1, 0.0), (0.0025, 2, 0.5), (0.0002, 0, 0.2), (0.0038, 3, 0.8)],
)
def test_torque_acts_after_the_delay_to_the_nanosecond(delay, whole, share):
    loop = loop_of(Scenario("R", PAPER, delay=delay))
    sent = [None, None, 3.0, -2.0, 5.0, 1.0, 4.0, -3.0, 2.0, 0.5]
    given(loop, sent)
    at = lambda k: 0.0 if k < 0 or sent[k] is None else sent[k]  # noqa: E731
    for k in range(len(sent)):
        loop.step()
        wanted = (1.0 - share) * at(k - whole) + share * at(k - whole - 1)
        assert_allclose(loop.simulator.torque, wanted, atol=1e-14)


def test_late_torque_moves_the_plant_as_an_independent_integration_does():
    delay, torques = 0.0023, [3.0, -2.0, 5.0, 1.0, -4.0, 2.0]
    loop = loop_of(Scenario("R", PAPER, delay=delay))
    # The arm rests under its safe action until the first torque arrives.
    given(loop, torques)
    for _ in torques:
        loop.step()
    plant_model = loop.simulator.plant_model
    state, now = np.zeros(6), delay
    for k, torque in enumerate(torques):
        end = min((k + 1) * 1e-3 + delay, len(torques) * 1e-3)
        if end <= now:
            break
        acting = np.array([torque])
        times = np.array([now, end])
        state, now = integrate(plant_model, state, lambda t, s, u=acting: u, times)[-1], end
    assert_allclose(loop.simulator.plant.state, state, rtol=1e-8, atol=1e-12)
    assert abs(state[0]) > 1e-6


def test_a_rigid_joint_moves_by_hand_computed_steps_under_late_torque():
    settings = {"arm": "rigid", "plant_arm": "", "initial_position": [0.0, 0.0]}
    sim = Simulator(loop_of(Scenario("R", PAPER)).simulator.settings | settings)
    # Upright: no moment of gravity; stretched: none of speed.
    sim.reset([np.pi / 2, 0.0])
    M = sim.plant_model.mass_matrix(sim.plant.q)
    before, torque, share, h = np.array([0.3, -0.1]), np.array([-0.2, 0.4]), 0.25, 1e-3
    sim.advance(torque, before, share)
    a, b = np.linalg.solve(M, before), np.linalg.solve(M, torque)
    speed = h * (share * a + (1 - share) * b)
    way = h**2 * (0.5 * share**2 * a + share * (1 - share) * a + 0.5 * (1 - share) ** 2 * b)
    assert_allclose(sim.plant.qd, speed, rtol=2e-5)
    assert_allclose(sim.plant.q - [np.pi / 2, 0.0], way, rtol=2e-5)


# --------------------------------------------------------------------------- metrics


@pytest.fixture
def metrics_of(make_record):
    """Makes a record and judges it; the measured position is far off, as no metric looks at it."""

    def judged(arm_model, columns, end=1.0, **options):
        record = make_record(arm_model, **{"position": 9.9, **columns})
        return tracking_metrics(record, arm_model, arm_model, end, **options)

    return judged


def test_a_joints_constant_error_moves_the_tip_along_its_chord(arm_r, metrics_of):
    found = metrics_of(arm_r, {"reference": 1.0, "plant_position": 0.9})
    chord = 2e3 * arm_r.arm.links[0].length * np.sin(0.05)
    assert_allclose(found["peak_joint_error_rad"], [0.1], rtol=1e-12)
    assert_allclose(found["rms_joint_error_rad"], [0.1], rtol=1e-12)
    for name in ("peak", "rms", "final"):
        assert_allclose(found[f"{name}_tip_error_mm"], chord, rtol=1e-12)
    assert found["settling_time_s"] is None
    assert found["residual_tip_rms_mm"] < 1e-12
    assert "static_sag_mm" not in found


def test_samples_before_the_start_count_for_nothing(arm_r, metrics_of):
    early = lambda t: 2.0 * (t < -1e-9)  # noqa: E731
    found = metrics_of(arm_r, {"plant_position": early, "torque": early})
    assert found["peak_joint_error_rad"] == [0.0]
    assert found["peak_torque_Nm"] == [0.0]
    assert found["peak_tip_error_mm"] == 0.0


def test_each_joint_has_its_own_error_and_torque(metrics_of):
    two_link = model.build(arm_file.load("two_link"))
    wave = lambda t: np.array([0.2 * np.sin(np.pi * t), 0.0])  # noqa: E731
    columns = {"time": np.arange(400) * 0.01}  # two whole periods
    columns |= {"reference": wave, "plant_position": [0.0, 0.1], "torque": lambda t: 5.0 * wave(t)}
    found = metrics_of(two_link, columns)
    assert_allclose(found["peak_joint_error_rad"], [0.2, 0.1], rtol=1e-12)
    assert_allclose(found["rms_joint_error_rad"], [0.2 / np.sqrt(2.0), 0.1], rtol=1e-12)
    assert_allclose(found["peak_torque_Nm"], [1.0, 0.0], rtol=1e-12)
    assert_allclose(found["rms_torque_Nm"], [1.0 / np.sqrt(2.0), 0.0], rtol=1e-12)
    assert "case_study" not in found


def test_the_residual_is_the_rms_of_the_deflection_in_the_window_alone(arm_r, metrics_of):
    tip = arm_r.mode_shapes("link1", "y")(1.0)

    def bending(t):
        size = 0.05 if t < 0.995 else 0.002 if t < 2.995 else 0.04
        return [size * np.sin(2 * np.pi * t + 0.3), 0.0]

    columns = {"plant_position": 0.7, "plant_amplitude": bending}
    # two whole periods of 100 samples
    found = metrics_of(arm_r, columns, window=1.99, settle=0.0)
    assert_allclose(found["residual_tip_rms_mm"], abs(tip[0]) * 2.0 / np.sqrt(2.0), rtol=1e-9)
    assert_allclose(found["peak_deflection_mm"], 50.0 * abs(tip[0]), rtol=2e-3)
    assert metrics_of(arm_r, columns, window=3.5)["residual_tip_rms_mm"] is None


@pytest.mark.parametrize(
    ("last_outside", "settled"), [(2.5, 1.51), (1.0, 0.05), (1.03, 0.05), (1.06, 0.07), (0.5, 0.05)]
)
def test_settling_counts_from_the_end_to_the_first_sample_that_stays(
    arm_r, metrics_of, last_outside, settled
):
    reach = arm_r.arm.links[0].length
    off = lambda t: (2e-3 if t < last_outside + 1e-6 else 0.5e-3) / reach  # noqa: E731
    time, never, at_once = (
        metrics_of(arm_r, {"plant_position": off}, tolerance=tolerance)["settling_time_s"]
        for tolerance in (1e-3, 0.4e-3, 3e-3)
    )
    assert time == pytest.approx(settled, rel=1e-9)
    assert never is None and at_once == 0.05


def test_a_record_that_ends_before_the_motion_has_no_settling_time(arm_r, metrics_of):
    found = metrics_of(arm_r, {}, end=5.0)
    assert found["settling_time_s"] is None
    assert found["residual_tip_rms_mm"] is None


def test_the_share_of_saturated_samples(arm_r, metrics_of):
    found = metrics_of(arm_r, {"saturated": lambda t: t < 0 or t >= 3.005})
    assert_allclose(found["saturation_share"], 100 / 401, rtol=1e-12)


def test_under_gravity_errors_about_the_static_sag_are_reported_as_well(metrics_of):
    arm = model.build(replace(arm_file.load("one_link"), gravity=(0.0, -9.81, 0.0)))
    link, payload = arm.arm.links[0], arm.arm.payload
    angle = lambda t: 0.3 * min(t, 1.0)  # noqa: E731
    at_rest = lambda t: arm.static_deflection([angle(t)])  # noqa: E731
    columns = {"reference": angle, "plant_position": angle}
    found = metrics_of(arm, {**columns, "plant_amplitude": at_rest})
    EI, L, g = link.stiffness["y"], link.length, 9.81 * np.cos(0.3)
    beam = g * (link.mass_per_length * L**4 / 8.0 + payload.mass * L**3 / 3.0) / EI
    assert_allclose(found["static_sag_mm"], 1e3 * beam, rtol=0.01)  # two modes of the exact beam
    assert found["peak_tip_error_mm"] > found["static_sag_mm"]  # most of all where it starts, level
    assert found["peak_tip_error_about_sag_mm"] < 0.01
    assert found["rms_tip_error_about_sag_mm"] < 0.005
    assert found["residual_tip_rms_mm"] < 1e-6
    assert found["settling_time_s"] == 0.05
    straight = metrics_of(arm, columns)
    assert_allclose(straight["final_tip_error_mm"], found["static_sag_mm"], rtol=1e-9)
    assert_allclose(straight["residual_tip_rms_mm"], found["static_sag_mm"], rtol=1e-9)
    assert straight["peak_tip_error_mm"] < 1e-9


# --------------------------------------------------------------------------- runs


def test_the_papers_run_has_the_case_studys_figures():
    _, metrics = run(Scenario("R", PAPER | {"observer.type": "true_rates"}, duration=8.0))
    errata = metrics["case_study"]
    assert errata["peak_joint_error_deg"] == pytest.approx(3.457, rel=0.005)
    assert_allclose(np.degrees(metrics["peak_joint_error_rad"]), errata["peak_joint_error_deg"])
    y = 1e3 * 0.3048 * errata["peak_tip_deflection_ft"]
    assert metrics["peak_deflection_mm"] == pytest.approx(y, rel=1e-6)
    assert (metrics["lost"], metrics["state"], metrics["motion_s"]) == (False, "HOLDING", 2.0)
    assert metrics["simulated_s"] == pytest.approx(8.0)


def test_the_true_tip_is_judged_and_not_the_measured_one(changed_arm, short):
    scenario, _, ideal = short

    def coarse(data):
        data["joints"][0]["encoder_counts"] = 400

    record, metrics = run(replace(scenario, arm=changed_arm("R", coarse)))
    error = np.abs(record.reference - record.plant_position)[record.time > -1e-9]
    assert_allclose(metrics["peak_joint_error_rad"], error.max(0))
    assert np.abs(record.position - record.plant_position).max() > 1e-3
    assert metrics["peak_joint_error_rad"] != ideal["peak_joint_error_rad"]


def test_a_loop_that_loses_its_arm_says_why_and_ends_there(changed_arm):
    free = changed_arm("R", without_limits)
    record, metrics = run(
        Scenario(free, PAPER | {"strain_limit": 1.0, "tracking_error_limit": 0.0}, delay=0.1)
    )
    assert metrics["lost"] is True
    assert metrics["reason"].endswith("is bent by more than it is long")
    assert metrics["simulated_s"] == record.time[-1] < 2.0
    assert metrics["settling_time_s"] is None
    json.dumps(metrics, allow_nan=False)


def test_a_controller_that_gives_up_is_a_loss():
    loop = loop_of(Scenario("R", PAPER))
    motion = trajectory_of("quintic:to=0.1,duration=0.1", loop.model, [0.0])
    law = loop.controller.law.slow
    good = law.torque

    def breaks(*args):
        if loop.simulator.time > 0.05:
            raise ZeroDivisionError("no more")
        return good(*args)

    law.torque = breaks
    record = loop.follow(motion, 0.2)
    assert "the control law failed: ZeroDivisionError: no more" in loop.lost
    assert loop.simulator.time == pytest.approx(0.051)
    assert record.time[-1] < 0.05


def test_repeats_go_back_in_between_and_are_each_judged():
    scenario = Scenario("R", PAPER, repeat=3, **SHORT | {"window": 0.3})
    record, metrics, loop = run_loop(scenario)
    assert len(metrics["passes"]) == 3
    assert_allclose(record.reference[np.searchsorted(record.time, -1e-9)], 0.0, atol=1e-6)
    assert_allclose(record.reference[-1], 0.005, rtol=1e-9)
    assert loop.simulator.time > 5 * 0.4
    once = run(replace(scenario, repeat=1))[1]
    assert metrics["passes"][0] == once
    assert metrics["passes"][2]["peak_tip_error_mm"] == metrics["peak_tip_error_mm"]
    assert metrics["peak_tip_error_mm"] != once["peak_tip_error_mm"]


def test_a_motion_that_ends_where_it_starts_is_repeated_at_once():
    there_and_back = {"times": [0.0, 0.1, 0.2], "positions": [[0.0], [0.05], [0.0]]}
    there_and_back["velocities"] = [[0.0]] * 3
    scenario = Scenario("R", PAPER, there_and_back, window=0.05, repeat=2)
    _, metrics, loop = run_loop(scenario)
    assert len(metrics["passes"]) == 2
    assert loop.simulator.time < 2 * 0.26 + 0.02


def test_the_arm_starts_where_the_motion_does():
    given = {"times": [0.0, 0.2], "positions": [[0.6], [0.7]], "velocities": [[0.0], [0.0]]}
    record, _ = run(Scenario("R", PAPER, given, window=0.05))
    assert_allclose(record.plant_position[0], 0.6)
    with pytest.raises(FlexarmError, match="start_tolerance"):
        run(Scenario("R", PAPER | {"initial_position": [0.0]}, given))


def test_a_motion_is_the_same_from_a_line_a_file_and_a_mapping(tmp_path, short):
    scenario, record, _ = short
    s = trajectory_of(scenario.trajectory, model.build(arm_file.load("R")), [0.0])
    mapping = {"times": s.times, "positions": s.positions}
    mapping |= {"velocities": s.velocities, "accelerations": s.accelerations}
    path = tmp_path / "motion.csv"
    rows = np.column_stack([s.times, s.positions, s.velocities, s.accelerations])
    np.savetxt(path, rows, "%.17g", ",", header="t,q1,qd1,qdd1", comments="")
    same_records(record, run(replace(scenario, trajectory=mapping))[0])
    same_records(record, run(replace(scenario, trajectory=str(path)))[0])


MOTION = {"times": [0.0], "positions": [[0.0]]}


@pytest.mark.parametrize(
    ("error", "fields", "message"),
    [
        (TrajectoryError, {"trajectory": "nonsense"}, "nonsense"),
        (TrajectoryError, {"trajectory": {"times": [0.0]}}, r"'times'.*has other fields"),
        (TrajectoryError, {"trajectory": MOTION | {"x": 1}}, r"'x'.*has other fields"),
        (ParameterError, {"repeat": 0}, "repeat"),
        (ParameterError, {"window": -1.0}, "window"),
        (ParameterError, {"duration": np.nan}, "duration"),
        (ParameterError, {"tolerance": np.inf}, "tolerance"),
        (ParameterError, {"controller": PAPER | {"slow.nonsense": 1.0}}, "slow.nonsense: no such"),
        (ParameterError, {"controller": PAPER | {"nonsense": 1.0}}, "nonsense: no such"),
        *(
            (FlexarmError, {"delay": v}, r"^delay: .* s is no usable delay \(from 0 to 1 s\)")
            for v in (-1e-3, 1.5, np.nan)
        ),
    ],
)
def test_a_scenario_that_can_not_be_is_refused_by_its_field(error, fields, message):
    with pytest.raises(error, match=message):
        run(Scenario("R", **{"controller": PAPER, **SHORT, **fields}))


# --------------------------------------------------------------------------- parameters


def test_parameters_come_from_the_section_of_the_node_that_they_belong_to(tmp_path):
    path = tmp_path / "nodes.yaml"
    path.write_text(
        "/**: {ros__parameters: {arm: R, slow: {kp: [4.0]}}}\n"
        "simulator: {ros__parameters: {rate: 500.0, slow: {kp: [9.0]}, torque_limit: [1.0], seed: 5}}\n"
        "controller: {ros__parameters: {torque_limit: [2.0], state_timeout: 9.0, rate: 3.0}}\n"
        "observer: {ros__parameters: {observer: {type: luenberger}, torque_limit: [3.0]}}\n"
    )
    assert parameters(path) == {
        "slow.kp": [4.0],
        "rate": 500.0,
        "torque_limit": [2.0],
        "observer.type": "luenberger",
    }


def test_settings_win_over_the_file():
    found = parameters("paper_slow", ["slow.kp=9", "slow.kv=6", "fast.type=lqr", "torque_limit=2"])
    assert found["fast.type"] == "lqr"
    loop = loop_of(Scenario("R", found))
    assert_array_equal(loop.controller.law.slow.kp, [9.0])
    assert_array_equal(loop.controller.torque_limit, [2.0])


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("slow.kp=9", [9.0]),
        ("slow.kp=9,4.5", [9.0, 4.5]),
        ("slow.kp=[9.0, 4.5]", [9.0, 4.5]),
        ("fast.alpha=4", 4.0),
        ("fast.alpha=1e1", 10.0),
        ("manifold.order=1", 1),
        ("slow.type=none", "none"),
    ],
)
def test_a_setting_is_yaml_or_plain_numbers(setting, value):
    found = parameters("paper_composite", ["manifold.type=corrected", setting])
    assert found[setting.split("=")[0]] == value


def test_parameters_of_components_that_are_not_chosen_stay_out_as_in_the_nodes():
    settings = ["slow.type=none", "fast.type=none"]
    loop = loop_of(Scenario("R", parameters("paper_composite", settings)))
    assert type(loop.controller.law.fast).__name__ == "NoFastLaw"


def test_the_manifold_is_the_one_that_is_asked_for():
    orders = {}
    for settings in ((), ("manifold.type=corrected", "manifold.order=1")):
        loop = loop_of(Scenario("R", parameters("paper_composite", settings)))
        orders[type(loop.controller.law.manifold).__name__] = loop
    assert set(orders) == {"QuasiSteady", "CorrectedManifold"}
    assert orders["CorrectedManifold"].controller.law.manifold.order == 1


def test_types_that_are_not_given_are_those_of_the_nodes():
    pytest.importorskip("rclpy")
    from flexarm_control.nodes import controller, observer

    groups = controller.parameter_groups() | observer.parameter_groups()
    for prefix, slot in COMPONENTS.items():
        declared = {p.name: p for p in groups.get(f"{prefix}.", ())}
        if prefix != "manifold" or declared:
            assert declared["type"].default == slot.type.default


def test_closed_loop_takes_the_observers_common_parameters():
    observer = {"type": "filtered_derivative", "joint_velocity_bandwidth": 123.0}
    slow = {"type": "linear_model_following"}
    loop = ClosedLoop("R", slow, {"type": "none"}, observer)
    assert loop.observer.settings["joint_velocity_bandwidth"] == 123.0
    with pytest.raises(
        ParameterError, match=r"observer\.joint_velocity_bandwidth: 0\.1 rad/s is below"
    ):
        ClosedLoop("R", slow, {"type": "none"}, observer | {"joint_velocity_bandwidth": 0.1})


# --------------------------------------------------------------------------- the command


CONTROLLED = ("--controller", "paper_composite", "--trajectory", SHORT["trajectory"])
METRICS = {
    "lost": bool, "reason": str, "state": str, "motion_s": float, "simulated_s": float,
    "peak_joint_error_rad": list, "rms_joint_error_rad": list,
    "peak_tip_error_mm": float, "rms_tip_error_mm": float, "final_tip_error_mm": float,
    "residual_tip_rms_mm": float, "residual_window_s": list, "settling_time_s": float | None,
    "peak_torque_Nm": list, "rms_torque_Nm": list, "saturation_share": float,
    "peak_deflection_mm": float, "case_study": dict | None,
}  # fmt: skip


def test_json_has_the_scenario_and_every_metric(result, tmp_path):
    out = tmp_path / "new" / "run.csv"
    options = ("--payload-scale", 2, "--delay", 0.001, "--window", 0.1, "--settle-within", 5)
    found = result("simulate", "R", *CONTROLLED, *options, "--out", out)
    assert set(found) == {"scenario", "metrics", "bears", "out", "rows"}
    assert found["bears"]["reason"] == "" and found["bears"]["payload"][0] < 1.0
    assert 0.005 < found["bears"]["delay"] < 0.009  # docs/analysis.md
    assert found["metrics"]["case_study"] is None  # the run is shorter
    assert found["metrics"].keys() == METRICS.keys()
    for name, kind in METRICS.items():
        assert isinstance(found["metrics"][name], kind), name
    scenario = Scenario(**found["scenario"])
    assert (scenario.payload_scale, scenario.delay, scenario.tolerance) == (2.0, 0.001, 0.005)
    record, metrics = run(scenario)
    assert metrics == found["metrics"]
    table = np.genfromtxt(out, delimiter=",", names=True)
    assert table.size == found["rows"] == record.time.size
    assert_allclose(table["q1"], record.plant_position[:, 0], atol=1e-11)
    assert_allclose(table["tau1"], table["tau_slow1"] + table["tau_fast1"], atol=1e-10)
    error = np.hypot(table["tip_x"] - table["tip_ref_x"], table["tip_y"] - table["tip_ref_y"])
    assert_allclose(1e3 * error[table["t"] > -1e-9].max(), metrics["peak_tip_error_mm"], rtol=1e-8)


def test_what_is_printed_names_joints_components_and_figures(flexarm):
    words = (
        "--set",
        "slow.kp=6.25",
        "observer.bandwidth=5000",
        "trajectory_torque_margin=0",
        "--initial",
        "-0.2",
        "--window",
        0.1,
    )
    code, text, _ = flexarm("simulate", "R", *CONTROLLED, *words, "--method", "rk4")
    assert code == 0
    for word in (
        "joint1",
        "lqr",
        "filtered_derivative",
        "HOLDING",
        "settled within 1 mm",
        "the loop bears, at rest where it ended      payload x 0 to",
        "0.2 s in",
    ):
        assert word in text


def test_a_lost_arm_is_exit_code_1_with_the_reason_and_the_figures(flexarm, changed_arm):
    words = ("--controller", "paper_composite", "--trajectory", "paper", "--delay", 0.1, "--json")
    code, out, err = flexarm("simulate", changed_arm("R", without_limits), *words)
    assert code == 1
    assert json.loads(out)["metrics"]["lost"] is True
    assert "the arm was lost: tracking error of joint1 is" in err


def test_noise_that_the_arm_file_does_not_state_is_a_warning(flexarm):
    code, _, err = flexarm("simulate", "R", *CONTROLLED, "--window", 0.05, "--noise")
    assert code == 0 and "--noise: the arm file of R states none" in err


@pytest.mark.parametrize("delay", [0.0, 0.0016, 0.003])
def test_the_controller_measures_the_delay_of_its_loop(delay):
    loop = loop_of(Scenario("R", delay=delay))
    trajectory = trajectory_of("quintic:to=0.2,duration=0.5", loop.model, np.zeros(1))
    for k in range(300):
        sample = loop.estimate(loop.measure())
        sample.torque[:] = loop.simulator.torque
        enabled = loop.controller.step(sample)
        if k == 20:
            loop.controller.offer(trajectory)
        loop._advance(loop.controller.torque if enabled else None)
        loop.controller.learn()
    assert loop.controller.torque_delay.delay == pytest.approx(delay, abs=1e-8)
    assert loop.controller.period == pytest.approx(1e-3)
