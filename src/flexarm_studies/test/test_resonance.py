# SPDX-License-Identifier: Apache-2.0
"""From recordings to shapers: windows, families of modes, recommendations, what a trajectory excites."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp

from flexarm_control.motions import shapers
from flexarm_control.motions.profiles import quintic, sample
from flexarm_control.shaping import modes
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.parameters import check_all
from flexarm_studies.resonance import effect, recommendation, retiming, time_law, windows
from flexarm_studies.resonance import study as studies
from flexarm_studies.resonance.answer import Answer
from flexarm_studies.resonance.families import dependence, families
from flexarm_studies.resonance.fit import Fit, Mode
from flexarm_studies.resonance.recommendation import Spread, recommend
from flexarm_studies.resonance.time_law import Move

RATE = 100.0


def rung(hertz=3.0, damping=0.01, joint=True, seed=0):
    """A table: a joint that moves three times, and what an accelerometer reads, which rings after each."""
    time = np.arange(int(24.0 * RATE)) / RATE
    position, values = np.zeros(time.size), np.zeros(time.size)
    omega = 2.0 * np.pi * hertz
    for k, at in enumerate((2.0, 9.0, 16.0)):
        position += (0.5 + 0.1 * k) * np.clip((time - at) / 0.4, 0.0, 1.0)
        since = np.maximum(time - at - 0.4, 0.0)
        values += np.where(
            time > at + 0.4, np.exp(-damping * omega * since) * np.sin(omega * since), 0.0
        )
    values += 0.01 * np.random.default_rng(seed).standard_normal(time.size)
    table = np.column_stack([time, position, values])
    return ("t,shoulder_position,tip_x_linear_acceleration", table) if joint else (
        "t,tip_x_linear_acceleration", table[:, [0, 2]]
    )  # fmt: skip


def written(path, header, table):
    np.savetxt(path, table, "%.9g", ",", header=header, comments="")
    return path


@pytest.mark.parametrize("joint", [True, False])
def test_an_accelerometer_alone_gives_the_mode_and_the_lines_to_paste(joint, tmp_path, result):
    """With joints that stand, or by the envelope of what is read."""
    found = result("resonance", written(tmp_path / "a.csv", *rung(joint=joint)))
    assert len(found["windows"]) == 3
    for window in found["windows"]:
        (mode,) = window["modes"]
        assert mode["frequency_hz"] == pytest.approx(3.0, abs=3.0 * mode["frequency_half_width_hz"])
        assert mode["damping"] == pytest.approx(0.01, rel=0.2)
    chosen = found["recommendation"]
    assert chosen["met"] and chosen["residual"] <= 0.05
    assert f"    shaper.type: {chosen['shaper']}" in found["yaml"]


def test_the_text_a_named_window_a_figure_and_a_trajectory(tmp_path, flexarm):
    table = written(tmp_path / "a.csv", *rung())
    made = sample(quintic([0.0], [0.5], 0.4), 21)
    motion = written(tmp_path / "m.csv", "t,q1,qd1,qdd1", np.column_stack(made))
    words = [
        "resonance",
        table,
        "--window",
        "9.5:15",
        "--trajectory",
        motion,
        "--figure",
        tmp_path / "f.png",
    ]
    code, out, err = flexarm(*words)
    assert code == 0, err
    assert "9.50 to" in out and "16." not in out.split("modes")[0].replace("9.5", "")
    assert "shaper.frequencies: [3.0" in out.replace("[2.99", "[3.0")
    assert (tmp_path / "f.png").stat().st_size > 10_000
    rows = [
        line for line in out.split("what it leaves of each mode")[1].splitlines() if " s " in line
    ]
    left = {line.split()[0]: float(line.split()[-1]) for line in rows}
    assert left["zv"] < 0.3 * left["none"] and left["ei"] < 0.1 * left["none"]
    best = out.split("best for this trajectory: ")[1].split(",")[0]
    assert f"    shaper.type: {best}" in out and left[best] < 0.06 * left["none"]


REFUSED = [
    (["--window", "1"], "--window"),
    (["--window", "100:120"], "window 100:120: has no samples"),
    (["--band", "5:2"], "--band"),
    (["--residual", "0"], "--residual"),
    (["--residual", "nan"], "--residual"),
    (["--margin", "-1"], "--margin"),
    (["--channels", "smell"], "--channels"),
    (["--channels", "strain"], "no channel that may ring"),
    (["--move", "1:0:1"], "move: velocity"),
    (["--trajectory", "none.csv"], "none.csv"),
    (["--figure", "f.txt"], "--figure"),
    (["--band", "30:40"], "nothing rings freely"),
]


@pytest.mark.parametrize("words, message", REFUSED)
def test_what_can_not_be_used_is_refused_by_name(words, message, tmp_path, flexarm):
    code, out, err = flexarm("resonance", written(tmp_path / "a.csv", *rung()), *words)
    assert (code, out) == (1, "") and message in err


# Windows ---------------------------------------------------------------------------------------


def test_an_envelope_that_falls_is_a_window_from_after_the_blow_until_the_next_one():
    _, table = rung(joint=False)
    parts = windows.falling(table[:, 1:], 1.0 / RATE)
    begins = [p.start / RATE for p in parts]
    assert begins == pytest.approx([2.4, 9.4, 16.4], abs=0.6)
    assert all(
        stop <= begin
        for stop, begin in zip([p.stop / RATE for p in parts], [9.5, 16.5, 24.1], strict=True)
    )


@pytest.mark.parametrize("seed", range(3))
def test_noise_has_no_window_that_rings(seed):
    noise = np.random.default_rng(seed).standard_normal((2000, 3))
    named = [("a", "b", "c"), ("strain",) * 3, noise, 0.0, 0.01, np.zeros((2000, 0)), ()]
    assert windows.modes_of(windows.Channels(*named), windows.falling(noise, 0.01)) == []


# Families --------------------------------------------------------------------------------------


def window(configuration, *modes):
    """A window with modes of frequency, damping and amplitude."""
    made = [Mode(f, 0.01 * f, z, 0.1 * z, np.atleast_1d(a)) for f, z, a in modes]
    empty = np.zeros((2, 1))
    return windows.Window(
        0.0,
        1.0,
        np.array(configuration, float),
        Fit(tuple(made), np.ones(1), np.zeros(2), empty, empty),
    )


def test_modes_of_several_windows_are_joined_and_two_of_one_window_never():
    rings = [
        window([0.0], (3.0, 0.01, 1.0), (3.3, 0.01, 0.1)),
        window([0.5], (3.05, 0.02, 1.0), (15.0, 0.01, 0.1)),
    ]
    found = families(rings, ["strain"])
    assert [f.windows for f in found] == [(0, 1), (0,), (1,)]
    assert found[0].frequencies == pytest.approx((2.97, 3.0805))
    assert found[0].dampings == pytest.approx((0.01, 0.015, 0.02))
    assert sum(f.part for f in found) == pytest.approx(1.0) and found[0].part > 0.98


def test_an_accelerometers_amplitudes_are_taken_as_deflections():
    rings = [window([0.0], (2.0, 0.01, 1.0), (20.0, 0.01, 10.0))]
    _, high = families(rings, ["linear_acceleration"])
    assert high.part == pytest.approx(0.01, rel=0.05)  # a tenth of the deflection


def test_a_frequency_that_goes_with_a_joint_is_distinguished_from_one_that_does_not():
    rng = np.random.default_rng(0)
    places = rng.uniform(-1.0, 1.0, (10, 2))
    going = [window(q, (3.0 + 0.4 * q[0], 0.01, 1.0)) for q in places]
    law = dependence(families(going, ["strain"])[0], going)
    assert law.counts and law.slope == pytest.approx([0.4, 0.0], abs=1e-6)
    assert law.at(np.array([1.0, 0.0])) == pytest.approx(3.4)
    staying = [window(q, (3.0 + 0.1 * rng.standard_normal(), 0.01, 1.0)) for q in places]
    assert not dependence(families(staying, ["strain"])[0], staying).counts
    assert dependence(families(going[:3], ["strain"])[0], going[:3]) is None


# Recommendation --------------------------------------------------------------------------------


def spread(low, high, damping=0.01, part=1.0):
    return Spread(low, high, (damping, damping, damping), part)


def test_the_narrower_the_spread_the_quicker_the_shaper():
    made = [recommend([spread(3.0 / w, 3.0 * w)]) for w in (1.01, 1.05, 1.15, 1.3)]
    chosen = [m.chosen for m in made]
    assert [c.delay for c in chosen] == sorted(c.delay for c in chosen)
    assert all(c.residual <= 0.05 for c in chosen) and chosen[0].kind == "zv"
    enough = [
        [c for c in m.candidates if c.kind in shapers.SHAPERS and c.residual <= 0.05] for m in made
    ]
    kinds = [min(found, key=lambda c: c.delay).kind for found in enough]
    assert kinds[2] in ("zvd", "ei") and kinds[3] in ("2hump_ei", "zvdd")


def test_the_residual_is_that_of_the_shaper_over_the_whole_spread():
    made = recommend([spread(2.7, 3.3)])
    for candidate in made.candidates:
        if candidate.kind in shapers.SHAPERS:
            train = shapers.impulses(candidate.kind, 3.0, 0.01)
            worst = max(train.residual(2.0 * np.pi * f, 0.01) for f in np.linspace(2.7, 3.3, 41))
            assert candidate.residual == pytest.approx(worst) and candidate.delay == train.duration


def test_a_mode_that_hardly_takes_part_is_not_paid_for():
    quiet = recommend([spread(2.95, 3.05), spread(17.0, 19.0, part=1e-3)]).chosen
    loud = recommend([spread(2.95, 3.05), spread(17.0, 19.0, part=0.5)]).chosen
    assert quiet.modes == (0,) and loud.modes == (0, 1) and loud.delay > quiet.delay


def test_where_no_shaper_meets_it_the_best_is_named_and_that_it_does_not(tmp_path):
    made = recommend([spread(1.0, 6.0)], 0.01)
    assert not made.met and made.chosen.residual == min(
        c.residual for c in made.candidates if c.kind in (*shapers.SHAPERS, "robust")
    )


def vibration(acceleration, duration, hertz, damping):
    """Amplitude that a motion leaves in a pendulum at its base, by integration of its equation."""
    omega = 2.0 * np.pi * hertz
    made = solve_ivp(
        lambda t, y: [y[1], -2.0 * damping * omega * y[1] - omega**2 * y[0] - acceleration(t)],
        (0.0, duration), [0.0, 0.0], rtol=1e-9, atol=1e-12, max_step=0.01,
    )  # fmt: skip
    x, v = made.y[:, -1]
    damped = omega * np.sqrt(1.0 - damping**2)
    return np.hypot(x, (v + damping * omega * x) / damped)


@pytest.mark.parametrize("kind, count", [("jerk_limited", 1), ("snap_limited", 2)])
def test_a_smoothing_leaves_what_integration_finds(kind, count):
    width = 0.2
    box = recommendation.box(width, count)
    omega, damping = 2.0 * np.pi * 3.0, 0.02
    pole = omega * complex(-damping, np.sqrt(1.0 - damping**2))

    # A step of the speed is an impulse of acceleration: x = exp(p t) / omega_d at its end.
    def kernel(t):
        hat = np.clip(np.minimum(t, 2.0 * width - t) / width**2, 0.0, None)
        return np.where((t >= 0.0) & (t <= width), 1.0 / width, 0.0) if count == 1 else hat

    left = vibration(kernel, count * width, 3.0, damping)
    assert left * omega * np.sqrt(1.0 - damping**2) == pytest.approx(
        abs(box(np.array([pole]))[0]), rel=1e-3
    )


def test_the_least_exciting_law_keeps_limits_and_leaves_what_integration_finds():
    move, mode = Move(0.5, 1.0, 4.0), spread(2.8, 3.2)
    duration, (worst,) = time_law.least_exciting_duration(move, [mode.poles()], [0.05], 1.0)
    assert worst <= 0.05 and move.duration < duration < move.duration + 0.35
    acceleration, _ = time_law.solve(move, [mode.poles()], [0.05], duration)
    time = np.linspace(0.0, duration, len(acceleration))
    speed = np.concatenate(
        [[0.0], np.cumsum((acceleration[1:] + acceleration[:-1]) / 2.0 * np.diff(time))]
    )
    assert (
        np.abs(acceleration).max() <= 4.0 + 1e-9
        and speed.min() > -1e-9
        and speed.max() < 1.0 + 1e-9
    )
    assert speed[-1] == pytest.approx(0.0, abs=1e-9)
    assert (
        np.trapezoid(speed, time) == pytest.approx(0.5, rel=0.01)
        if hasattr(np, "trapezoid")
        else True
    )
    for hertz in (2.8, 2.93, 3.2):
        left = vibration(lambda t: np.interp(t, time, acceleration), duration, hertz, 0.01)
        assert left < 0.055 * 4.0 * 4.0 / (2.0 * np.pi * hertz) ** 2


def study_of(rings, n):
    """The study of windows, of an arm of n joints."""
    names = tuple(f"joint{k + 1}" for k in range(n))
    found = windows.Channels(
        ("a",), ("strain",), np.zeros((2, 1)), 0.0, 0.01, np.zeros((2, n)), names
    )
    return studies.of_windows(found, rings, studies.Wishes())


def node_of(made, motion=None):
    """The modes that the node `shaper` makes of the lines to paste."""
    given = yaml.safe_load("\n".join(studies.yaml_lines(made, motion)))["shaper"]["ros__parameters"]
    names = given.pop("joint_names")
    own = {key.removeprefix("shaper."): value for key, value in given.items()}
    return modes.Modes(check_all(modes.PARAMETERS, own, {"joints": len(names)}), len(names)), own


def test_the_lines_are_parameters_of_the_node_and_its_shaper_is_the_one_recommended():
    made = study_of([window([0.0, 0.0], (3.0, 0.01, 1.0)), window([0.1, 0.0], (3.5, 0.02, 1.0))], 2)
    node, own = node_of(made)
    assert "configurations" not in own
    assert node.max_duration == pytest.approx(made.recommendation.chosen.delay, rel=0.01)


def test_where_the_frequency_goes_with_a_joint_the_node_gets_it_by_configuration():
    places = np.column_stack([np.linspace(-1.0, 1.0, 7), np.cos(np.arange(7.0))])
    rings = [window(q, (3.0 + 0.4 * q[0], 0.01, 1.0)) for q in places]
    node, own = node_of(study_of(rings, 2))
    assert np.shape(own["configurations"]) == (14,) and len(own["frequencies"]) == 7
    assert node.at(places[2:3])[0, 0] == pytest.approx(3.0 + 0.4 * places[2, 0], rel=1e-3)


@pytest.mark.parametrize(
    ("channel", "sensor", "where"),
    [("root", "strain", {"gauge": 1}), ("tip_y", "imu", {"axis": "y", "full_scale": 40.0})],
)
def test_the_answer_of_a_sensor_gives_the_lines_of_the_damping_or_why_there_is_none(
    channel, sensor, where
):
    made = study_of([window([0.0, 0.0], (3.0, 0.01, 1.0)), window([0.1, 0.0], (3.1, 0.02, 1.0))], 2)
    own = Answer("b", channel, sensor, 1, 3.0, 0.01, 0.3j, 0.02)
    lines = list(studies.text(replace(made, answers=(own,))))
    first = next(i for i, line in enumerate(lines) if line.startswith("for damping by a sensor"))
    given = yaml.safe_load("\n".join(lines[first + 1 :]))
    shown = {
        "joint": "b",
        "sensor": sensor,
        "frequency": 3.0,
        "damping": 0.01,
        "sensitivity": 0.3,
        "phase": 1.571,
    }
    assert given == {f"damping.{name}": value for name, value in {**shown, **where}.items()}
    damped = replace(own, damping=0.25)  # more than is wanted
    assert any(
        "no damping by it: " in line for line in studies.text(replace(made, answers=(damped,)))
    )


# Trajectories ----------------------------------------------------------------------------------


@pytest.mark.parametrize("fields", [1, 2, 3])
def test_what_a_trajectory_leaves_is_what_integration_finds(fields, tmp_path):
    made = sample(quintic([0.0], [0.5], 0.5), 11 if fields > 1 else 201)
    names = ["t,q1", "t,q1,qd1", "t,q1,qd1,qdd1"][fields - 1]
    path = written(tmp_path / "m.csv", names, np.column_stack(made[: fields + 1]))
    time, change = effect.steps(effect.read(path), 3.0)
    pole = 2.0 * np.pi * 3.0 * complex(-0.01, np.sqrt(1.0 - 1e-4))
    profile = quintic([0.0], [0.5], 0.5)
    wanted = vibration(lambda t: profile.acceleration(t)[0], 0.5, 3.0, 0.01)
    assert effect.left(time, change, [pole])[0, 0] == pytest.approx(wanted, rel=0.02)


def test_for_a_move_the_new_time_law_is_recommended_with_its_lines_where_it_is_the_quickest():
    made = study_of([window([0.0], (3.0, 0.01, 1.0)), window([0.1], (3.3, 0.02, 1.0))], 1)
    rows = studies.of_trajectory(made, retiming.of_move(Move(1.0, 1.5, 6.0)))
    best = effect.recommended(rows, 0.05)
    quickest = min(r["added_s"] for r in rows if r["residual"] <= 0.05 and r["kind"] in effect.NODE)
    assert best["kind"] == "retimed" and best["added_s"] == quickest
    # What the time law predicts is what the motion leaves of the modes.
    ratio = best["amplitude_rad"][0] / rows[0]["amplitude_rad"][0]
    assert 0.005 < ratio < 0.05 and best["residual"] == pytest.approx(ratio, rel=0.3)
    node, own = node_of(made, rows)
    assert own["type"] == "retimed"
    assert own["periods"] == pytest.approx(best["periods"], abs=1e-3)
    assert node.spread == pytest.approx(best["spread"], abs=1e-3)


def test_what_has_no_new_time_law_is_shaped():
    made = study_of([window([0.0], (3.0, 0.01, 1.0)), window([0.1], (3.3, 0.02, 1.0))], 1)
    move = retiming.of_move(Move(0.1, 1.5, 6.0))
    assert move.times.size == 3  # a triangle of speed
    rows = studies.of_trajectory(made, replace(move, velocities=None))
    assert "retimed" not in [row["kind"] for row in rows]
    assert effect.recommended(rows, 0.05)["kind"] != "retimed"


def test_a_trajectory_in_yaml_has_its_own_joints(tmp_path):
    path = tmp_path / "m.yaml"
    points = [
        {"positions": [float(k), 0.0], "time_from_start": {"sec": k, "nanosec": 0}}
        for k in range(3)
    ]
    path.write_text(json.dumps({"joint_names": ["a", "b"], "points": points}))
    assert effect.read(path).positions.shape == (3, 2)
    path.write_text(json.dumps({"joint_names": ["a", "b"], "points": points[:1]}))
    with pytest.raises(FlexarmError, match="is no motion"):
        effect.steps(effect.read(path), 3.0)
