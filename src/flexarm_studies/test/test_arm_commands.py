# SPDX-License-Identifier: Apache-2.0
"""``flexarm simulate``, ``frequencies`` and ``show``, as typed, against the reference data."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_dynamics.models import levels
from flexarm_dynamics.models.chain import Chain
from flexarm_studies import tables

DATA = Path(__file__).resolve().parents[3] / "tests" / "data"
FALLING = """name: falling
gravity: [0, -9.81, 0]
joints:
- {name: j1, hub_inertia: 0.1}
- {name: j2, hub_inertia: 0.05, motor_mass: 0.5}
links:
- {name: l1, length: 1.0, mass_per_length: 0.6, EI_y: 80.0, flexible: {y: {modes: 3, shape: loaded}}}
- {name: l2, length: 0.8, mass_per_length: 0.4, EI_y: 40.0, flexible: {y: {modes: 3, shape: loaded}}}
payload: {mass: 0.3}
"""

TWO_LINK = """
name: reference
joints:
  - {name: j1, hub_inertia: 0.05}
  - {name: j2, hub_inertia: 0.05, motor_mass: 0.5}
links:
  - {name: link1, length: 1.0, mass_per_length: 0.2, EI_y: 8.0, flexible: {y: {modes: 2, shape: loaded}}}
  - {name: link2, length: 1.0, mass_per_length: 0.2, EI_y: 8.0, flexible: {y: {modes: 2, shape: loaded}}}
payload: {mass: 0.2}
"""


@pytest.fixture
def simulated(flexarm, tmp_path):
    """Runs ``flexarm simulate``, which must succeed: its table as a structured array."""

    def run(*words):
        out = tmp_path / "o.csv"
        code, _, err = flexarm("simulate", *words, "--out", out)
        assert code == 0, err
        return np.genfromtxt(out, delimiter=",", names=True)

    return run


@pytest.fixture
def table_file(tmp_path):
    """Writes a table with the columns t, <prefix>1, <prefix>2 ...; its path."""

    def write(prefix, times, *columns):
        path, names = tmp_path / f"{prefix}.csv", [f"{prefix}{i + 1}" for i in range(len(columns))]
        tables.write(["t", *names], np.column_stack([times, *columns]), path)
        return path

    return write


@pytest.fixture
def two_link(tmp_path):
    """The arm of the reference data."""
    path = tmp_path / "arm.yaml"
    path.write_text(TWO_LINK)
    return path


@pytest.mark.parametrize(
    ("options", "angle", "tip"),
    [
        (("--modes", "3"), 5e-5, 2e-5),
        (("--foreshortening",), 1e-3, 1e-4),
        (("--finite-slope", "--modes", "3"), 5e-5, 2e-5),
        (("--level", "first_order"), 7.6e-3, 4e-3),
    ],
)
def test_a_simulated_table_is_that_of_independent_codes(
    two_link, simulated, table_file, options, angle, tip
):
    t = np.arange(0.0, 4.0005, 1e-3)
    torque = table_file("tau", t, np.sin(np.pi * t), 0.4 * np.sin(1.6 * np.pi * t))
    got = simulated(two_link, "--torque", torque, *options)
    truth = np.genfromtxt(DATA / "two_link_torque.csv", delimiter=",", names=True)
    np.testing.assert_allclose(got["t"], truth["t"], atol=1e-12)
    assert np.abs(got["q1"] - truth["theta1"]).max() < angle
    assert np.abs(got["link2_base_angle"] - truth["alpha2"]).max() < angle
    for ours, theirs in (("tip", "tip"), ("link1_tip", "elbow"), ("link2_tip", "tip")):
        off = [got[f"{ours}_{axis}"] - truth[f"{theirs}_{axis}"] for axis in "xy"]
        assert np.hypot(*off).max() < tip
    assert np.abs(got["link1_defl_y"] - truth["defl1"]).max() < max(angle, tip)
    np.testing.assert_allclose(got["tau1"], np.sin(np.pi * truth["t"]), atol=1e-5)


def test_a_repeated_time_is_a_step_and_the_last_row_is_held(tmp_path, simulated, table_file):
    p = json.loads((DATA / "parameters.json").read_text())["one_link_pulse"]
    T = p["T"]
    torque = table_file("tau", [0.0, 0.5, 0.5, 1.0, 1.0], [T, T, -T, -T, 0.0])
    arm = tmp_path / "arm.yaml"
    arm.write_text(
        f"name: pulse\njoints: [{{name: j, hub_inertia: {p['Jh']}}}]\nlinks:\n"
        f"- {{name: link1, length: {p['L']}, mass_per_length: {p['rhoA']},"
        f" EI_y: {p['EI']}, flexible: {{y: {{modes: 2, shape: loaded}}}}}}\n"
        f"payload: {{mass: {p['Mp']}, inertia: [0, 0, {p['Jp']}, 0, 0, 0]}}\n"
    )
    # Steps that do not end where the torque jumps.
    got = simulated(arm, "--torque", torque, "--step", "0.0007")
    truth = np.genfromtxt(DATA / "one_link_pulse.csv", delimiter=",", names=True)
    distance = np.hypot(got["tip_x"] - truth["tip_x"], got["tip_y"] - truth["tip_y"])
    assert distance.max() < 2e-5
    assert np.abs(got["q1"] - truth["theta1"]).max() < 1e-6


def test_torques_of_a_prescribed_motion_bring_the_motion_about(simulated, table_file):
    t = np.arange(0.0, 2.0005, 0.01)
    s = np.clip(t / 1.5, 0.0, 1.0)
    smooth = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
    motion = table_file("q", t, 0.5 * smooth, -0.3 * smooth)
    a = simulated("two_link", "--prescribed", motion, "--rate", "1000")
    assert a["t"][-1] == 2.0  # as long as the motion
    np.testing.assert_allclose(a["q1"][::10], 0.5 * smooth, atol=2e-12)
    torque = table_file("tau", a["t"], a["tau1"], a["tau2"])
    b = simulated("two_link", "--torque", torque, "--duration", "2", "--rate", "1000")
    for name in ("q1", "q2", "link1_y_mode1", "link2_y_mode2", "tip_x", "tip_y"):
        assert np.abs(a[name] - b[name]).max() < 2e-6, name


def test_a_link_spun_up_past_its_bending_frequency_returns_to_straight(
    flexarm, simulated, table_file, tmp_path
):
    first = Chain(arm_file.load("one_link")).frequencies(locked=True)[0]
    t = np.arange(0.0, 7.0005, 0.01)
    s = np.clip(t / 5.0, 0.0, 1.0)
    spun_up = s**2 / 2.0 + (np.cos(2.0 * np.pi * s) - 1.0) / (4.0 * np.pi**2)
    motion = table_file("q", t, 3.0 * first * (5.0 * spun_up + np.maximum(t - 5.0, 0.0)))
    words = ("one_link", "--prescribed", motion, "--duration", "7")
    for options in ((), ("--foreshortening",)):
        bent = np.abs(simulated(*words, *options)["link1_defl_y"])
        assert 0.05 < bent.max() < 0.15
        assert bent[-50:].max() < 1e-3
    first_order = ("--level", "first_order", "--out", tmp_path / "none.csv")
    code, _, err = flexarm("simulate", *words, *first_order)
    assert code == 1 and "take level finite_slope" in err
    assert (
        err.count("level first_order of one_link leaves out some") == 2
    )  # when it does, and in the end
    assert not (tmp_path / "none.csv").exists()


def test_a_falling_arm_is_simulated_as_it_falls_and_first_order_reports_what_it_leaves_out(
    flexarm, tmp_path
):
    """Two links under gravity alone: by default as at the finest level; first order names its error."""
    path = tmp_path / "falling.yaml"
    path.write_text(FALLING)
    found = {}
    for level in ("auto", "first_order", "stiffening", "finite_slope"):
        words = ("--level", level, "--duration", "2", "--json", "--out", tmp_path / f"{level}.csv")
        code, out, _ = flexarm("simulate", path, *words)
        found[level] = json.loads(out)
        assert code == 0
    tip = {k: np.array([d["last"][f"tip_{axis}"] for axis in "xy"]) for k, d in found.items()}
    assert found["auto"]["level"] == "finite_slope" and not found["auto"]["warnings"]
    assert found["auto"]["last"] == found["finite_slope"]["last"]
    assert np.linalg.norm(tip["stiffening"] - tip["finite_slope"]) < 2e-6
    (warning,) = found["first_order"]["warnings"]
    assert "level first_order of falling leaves out some 0.2" in warning
    off = 1e3 * np.linalg.norm(tip["first_order"] - tip["finite_slope"])
    assert 0.5 < off / found["first_order"]["left_out_mm"] < 20.0


def test_columns_are_as_documented(flexarm):
    _, out, _ = flexarm("simulate", "two_link", "--duration", "0.02", "--initial", "0.1,-0.2")
    header, *rows = out.split()
    expected = "t q1 q2 qd1 qd2 tau1 tau2 link1_y_mode1 link1_y_mode2 link2_y_mode1 link2_y_mode2 tip_x tip_y tip_z"
    for link in ("link1", "link2"):
        expected += "".join(
            f" {link}_{c}" for c in ("tip_x", "tip_y", "tip_z", "base_angle", "defl_y", "defl_z")
        )
    expected += "".join(f" link{i}_{place}_strain" for i in (1, 2) for place in ("root", "middle"))
    assert header.split(",") == expected.split()
    assert len(rows) == 3
    values = dict(zip(header.split(","), map(float, rows[0].split(",")), strict=True))
    assert values["link1_base_angle"] == pytest.approx(0.1)
    assert values["link2_base_angle"] == pytest.approx(-0.1)
    assert values["tip_x"] == pytest.approx(0.5 * np.cos(0.1) + 0.5 * np.cos(-0.1), rel=1e-10)


def test_joints_that_are_prescribed_to_stand_carry_links_at_rest_and_gauges_show_their_sag(
    simulated, table_file
):
    arm = levels.simulated(arm_file.load("long_reach"))
    built, q, t = Chain(arm), [0.3, -0.4, 0.5], np.linspace(0.0, 0.5, 6)
    q += [0.1] * (built.n_joints - len(q))
    got = simulated("long_reach", "--prescribed", table_file("q", t, *(0.0 * t + x for x in q)))
    delta = built.static_deflection(np.array(q))
    assert np.abs(delta).max() > 1e-3
    wanted = gauge_rows(built, arm.gauges) @ delta
    for gauge, strain in zip(arm.gauges, wanted, strict=True):
        read = got[f"{gauge.name}_strain"]
        np.testing.assert_allclose(read, gauge.gain * strain + gauge.bias, rtol=1e-6, atol=1e-12)


def test_a_recorded_motion_is_prescribed_as_it_was_measured(simulated, table_file, tmp_path):
    t = np.arange(0.0, 1.0005, 0.01)
    angle = 0.3 * np.sin(np.pi * t) ** 4
    same = simulated("one_link", "--prescribed", table_file("q", t, angle), "--rate", "100")
    (tmp_path / "m.yaml").write_text(
        "columns:\n- {column: 1, quantity: time, unit: ms}\n"
        "- {column: 2, quantity: position, joint: joint1, unit: deg, sign: -1}\n"
    )
    path = tmp_path / "run.csv"
    np.savetxt(path, np.column_stack([1e3 * t, -np.degrees(angle)]), "%.17g", ",")
    words = ("one_link", "--prescribed", path, "--mapping", tmp_path / "m.yaml")
    got = simulated(*words, "--smooth", "1000")
    assert len(got["t"]) == t.size  # at the recording's rate, as long as it
    np.testing.assert_allclose(got["root_strain"], same["root_strain"], atol=1e-12)
    noisy = np.column_stack([1e3 * t, -np.degrees(np.round(angle / 1e-3) * 1e-3)])  # an encoder
    np.savetxt(path, noisy, "%.17g", ",")
    rms = [
        np.std(simulated(*words, *smooth)["tau1"] - same["tau1"])
        for smooth in ((), ("--smooth", "1000"))
    ]
    assert rms[0] < 0.2 * rms[1]


def test_a_spatial_arm_has_no_base_angles_and_falls_under_gravity(result):
    found = result("simulate", "long_reach", "--duration", "0.1")
    assert not [c for c in found["columns"] if c.endswith("base_angle")]
    column = found["columns"].index("tip_z")
    assert found["rows"][-1][column] < found["rows"][0][column] - 0.01


@pytest.mark.parametrize("name", ["R", "P3", "one_link", "two_link", "long_reach", "rigid"])
def test_every_shipped_arm_is_simulated_shown_and_has_frequencies(
    name, tmp_path, flexarm, simulated, result
):
    assert np.isfinite(simulated(name, "--duration", "0.05")["tip_x"]).all()
    assert flexarm("frequencies", name, "--shapes")[0] == 0
    shown = result("show", name, "--plot", tmp_path / "arm.png")
    assert (tmp_path / "arm.png").stat().st_size > 10_000
    arm = arm_file.load(name)
    assert shown["modes"] == list(arm.mode_names)
    assert len(shown["frequencies_hz"]["locked"]) == len(arm.modes)
    assert [j["name"] for j in shown["joints"]] == list(arm.joint_names)


@pytest.mark.parametrize("angle", [0, 60, -60, 90])
def test_frequencies_are_those_of_the_exact_beam(two_link, result, angle):
    truth = json.loads((DATA / "frequencies.json").read_text())["two_link"]
    truth = {case: truth[f"q2={angle} {case}"]["rad_s"] for case in ("locked", "free")}
    words = ("frequencies", two_link, "--at", f"-0.3,{np.radians(angle)}")
    found = result(*words)
    for case, exact in truth.items():
        np.testing.assert_allclose(found[case]["rad_s"][:2], exact[:2], rtol=1e-2)
        hertz = np.array(found[case]["Hz"])
        np.testing.assert_allclose(hertz * 2.0 * np.pi, found[case]["rad_s"], rtol=1e-12)
    found = result(*words, "--modes", "5", "--locked")
    assert "free" not in found
    np.testing.assert_allclose(found["locked"]["rad_s"][:4], truth["locked"], rtol=1e-5)


def test_show_warns_of_what_matters(flexarm):
    _, out, _ = flexarm("show", "long_reach")
    assert "upper sags by 7." in out and "(simulated: finite_slope)" in out
    assert "sags by" not in flexarm("show", "long_reach", "--finite-slope")[1]
    assert "link1 has no damping in y" in flexarm("show", "R")[1]


@pytest.mark.slow
def test_the_commands_need_no_ros():
    """In a process of its own in which rclpy and the messages can't be imported."""
    code = (
        "import sys\n"
        "for name in ('rclpy', 'flexarm_msgs', 'flexarm_ros', 'std_msgs'): sys.modules[name] = None\n"
        "from flexarm_bringup import cli\n"
        "for line in sys.argv[1:]:\n"
        "    try:\n"
        "        cli.main(line.split())\n"
        "    except SystemExit as stop:\n"
        "        assert not stop.code, line\n"
    )
    lines = ("simulate rigid --duration 0.1", "frequencies two_link", "show two_link")
    done = subprocess.run(
        [sys.executable, "-c", code, *lines], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr


@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(content=st.text(alphabet="t,au12q\n\r.-+e0 nif\x00\"'", max_size=80))
def test_any_text_as_a_table_is_read_or_refused(tmp_path, content):
    path = tmp_path / "any.csv"
    path.write_bytes(b"t,tau1\n0,0\n" + content.encode())
    try:
        times, values = tables.read(str(path), "tau", ["joint1"])
    except tables.TableError as error:
        assert str(error).startswith(str(path))
    else:
        assert np.isfinite(times).all() and np.isfinite(values).all()
        assert (np.diff(times) >= 0.0).all() and values.shape == (times.size, 1)


def test_steps_are_linear_between_rows_and_jump_at_a_repeated_time():
    drive = tables.Steps(np.array([0.0, 1.0, 1.0, 2.0]), np.array([[0.0], [2.0], [5.0], [7.0]]))
    assert drive.right_of(0.5)[0] == drive.left_of(0.5)[0] == 1.0
    assert (drive.left_of(1.0)[0], drive.right_of(1.0)[0]) == (2.0, 5.0)
    assert (drive.right_of(-1.0)[0], drive.left_of(3.0)[0]) == (0.0, 7.0)
