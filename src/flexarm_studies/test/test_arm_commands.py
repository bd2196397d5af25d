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

from flexarm_bringup import cli
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models.chain import Chain
from flexarm_studies import tables

DATA = Path(__file__).resolve().parents[3] / "tests" / "data"
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


def flexarm(*words):
    """Run a command in this process; its exit code."""
    with pytest.raises(SystemExit) as stop:
        cli.main([str(w) for w in words])
    return stop.value.code


def table(path):
    """A CSV file as a structured array."""
    return np.genfromtxt(path, delimiter=",", names=True)


def torque_file(path, times, *columns):
    """Write a torque table; its path."""
    names = ["t", *(f"tau{i + 1}" for i in range(len(columns)))]
    np.savetxt(
        path, np.column_stack([times, *columns]), delimiter=",", header=",".join(names), comments=""
    )
    return path


@pytest.fixture
def two_link(tmp_path):
    """The arm of the reference data, and its torques."""
    arm = tmp_path / "arm.yaml"
    arm.write_text(TWO_LINK)
    t = np.arange(0.0, 4.0005, 1e-3)
    torque = torque_file(tmp_path / "tau.csv", t, np.sin(np.pi * t), 0.4 * np.sin(1.6 * np.pi * t))
    return arm, torque


@pytest.mark.parametrize(
    ("options", "angle", "tip"),
    [
        ((), 7.6e-3, 4e-3),
        (("--foreshortening",), 1e-3, 1e-4),
        (("--finite-slope", "--modes", "3"), 5e-5, 2e-5),
    ],
)
def test_a_simulated_table_is_that_of_independent_codes(two_link, tmp_path, options, angle, tip):
    arm, torque = two_link
    assert flexarm("simulate", arm, "--torque", torque, *options, "--out", tmp_path / "o.csv") == 0
    got, truth = table(tmp_path / "o.csv"), table(DATA / "two_link_torque.csv")
    np.testing.assert_allclose(got["t"], truth["t"], atol=1e-12)
    assert np.abs(got["q1"] - truth["theta1"]).max() < angle
    assert np.abs(got["link2_base_angle"] - truth["alpha2"]).max() < angle
    for ours, theirs in (("tip", "tip"), ("link1_tip", "elbow"), ("link2_tip", "tip")):
        distance = np.hypot(
            got[f"{ours}_x"] - truth[f"{theirs}_x"], got[f"{ours}_y"] - truth[f"{theirs}_y"]
        )
        assert distance.max() < tip
    assert np.abs(got["link1_defl_y"] - truth["defl1"]).max() < max(angle, tip)
    np.testing.assert_allclose(got["tau1"], np.sin(np.pi * truth["t"]), atol=1e-5)


def test_a_repeated_time_is_a_step_and_the_last_row_is_held(tmp_path):
    parameters = json.loads((DATA / "parameters.json").read_text())["one_link_pulse"]
    T = parameters["T"]
    times = [0.0, 0.5, 0.5, 1.0, 1.0]
    torque = torque_file(tmp_path / "tau.csv", times, [T, T, -T, -T, 0.0])
    arm = tmp_path / "arm.yaml"
    arm.write_text(
        f"name: pulse\njoints: [{{name: j, hub_inertia: {parameters['Jh']}}}]\nlinks:\n"
        f"- {{name: link1, length: {parameters['L']}, mass_per_length: {parameters['rhoA']},"
        f" EI_y: {parameters['EI']}, flexible: {{y: {{modes: 2, shape: loaded}}}}}}\n"
        f"payload: {{mass: {parameters['Mp']}, inertia: [0, 0, {parameters['Jp']}, 0, 0, 0]}}\n"
    )
    # Steps that do not end where the torque jumps.
    words = (
        "--torque",
        torque,
        "--step",
        "0.0007",
        "--foreshortening",
        "--out",
        tmp_path / "o.csv",
    )
    assert flexarm("simulate", arm, *words) == 0
    got, truth = table(tmp_path / "o.csv"), table(DATA / "one_link_pulse.csv")
    distance = np.hypot(got["tip_x"] - truth["tip_x"], got["tip_y"] - truth["tip_y"])
    assert distance.max() < 2e-5
    assert np.abs(got["q1"] - truth["theta1"]).max() < 1e-6


def test_torques_of_a_prescribed_motion_bring_the_motion_about(tmp_path):
    t = np.arange(0.0, 2.0005, 0.01)
    s = np.clip(t / 1.5, 0.0, 1.0)
    smooth = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
    motion = np.column_stack([t, 0.5 * smooth, -0.3 * smooth])
    np.savetxt(tmp_path / "q.csv", motion, delimiter=",", header="t,q1,q2", comments="")
    out = ("--rate", "1000", "--out")
    assert (
        flexarm(
            "simulate", "two_link", "--prescribed", tmp_path / "q.csv", *out, tmp_path / "a.csv"
        )
        == 0
    )
    a = table(tmp_path / "a.csv")
    assert a["t"][-1] == 2.0  # as long as the motion
    np.testing.assert_allclose(a["q1"][::10], motion[:, 1], atol=1e-12)
    torque_file(tmp_path / "tau.csv", a["t"], a["tau1"], a["tau2"])
    words = ("--torque", tmp_path / "tau.csv", "--duration", "2", *out, tmp_path / "b.csv")
    assert flexarm("simulate", "two_link", *words) == 0
    b = table(tmp_path / "b.csv")
    for name in ("q1", "q2", "link1_y_mode1", "link2_y_mode2", "tip_x", "tip_y"):
        assert np.abs(a[name] - b[name]).max() < 2e-6, name


def test_a_link_spun_up_past_its_bending_frequency_returns_to_straight_with_foreshortening(
    tmp_path, capsys
):
    first = Chain(arm_file.load("one_link")).frequencies(locked=True)[0]
    t = np.arange(0.0, 7.0005, 0.01)
    s = np.clip(t / 5.0, 0.0, 1.0)
    turned = (
        3.0
        * first
        * (
            5.0 * (s**2 / 2.0 + (np.cos(2.0 * np.pi * s) - 1.0) / (4.0 * np.pi**2))
            + np.maximum(t - 5.0, 0.0)
        )
    )
    np.savetxt(
        tmp_path / "q.csv", np.column_stack([t, turned]), delimiter=",", header="t,q1", comments=""
    )
    words = ("simulate", "one_link", "--prescribed", tmp_path / "q.csv", "--duration", "7")
    out = tmp_path / "o.csv"
    assert flexarm(*words, "--foreshortening", "--out", out) == 0
    bent = np.abs(table(out)["link1_defl_y"])
    assert 0.05 < bent.max() < 0.15
    assert bent[-50:].max() < 1e-3
    capsys.readouterr()
    assert flexarm(*words, "--out", tmp_path / "none.csv") == 1
    assert "or --foreshortening where links spin fast" in capsys.readouterr().err
    assert not (tmp_path / "none.csv").exists()


def test_columns_are_as_documented(capsys):
    assert flexarm("simulate", "two_link", "--duration", "0.02", "--initial", "0.1,-0.2") == 0
    header, *rows = capsys.readouterr().out.split()
    expected = "t q1 q2 qd1 qd2 tau1 tau2 link1_y_mode1 link1_y_mode2 link2_y_mode1 link2_y_mode2 tip_x tip_y tip_z"
    for link in ("link1", "link2"):
        expected += "".join(
            f" {link}_{c}" for c in ("tip_x", "tip_y", "tip_z", "base_angle", "defl_y", "defl_z")
        )
    assert header.split(",") == expected.split()
    assert len(rows) == 3
    values = dict(zip(header.split(","), map(float, rows[0].split(",")), strict=True))
    assert values["link1_base_angle"] == pytest.approx(0.1)
    assert values["link2_base_angle"] == pytest.approx(-0.1)
    assert values["tip_x"] == pytest.approx(0.5 * np.cos(0.1) + 0.5 * np.cos(-0.1), rel=1e-10)


def test_a_spatial_arm_has_no_base_angles_and_falls_under_gravity(capsys):
    assert flexarm("simulate", "long_reach", "--duration", "0.1", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert not [c for c in result["columns"] if c.endswith("base_angle")]
    column = result["columns"].index("tip_z")
    assert result["rows"][-1][column] < result["rows"][0][column] - 0.01


@pytest.mark.parametrize("name", ["R", "P3", "one_link", "two_link", "long_reach", "rigid"])
def test_every_shipped_arm_is_simulated_shown_and_has_frequencies(name, tmp_path, capsys):
    assert flexarm("simulate", name, "--duration", "0.05", "--out", tmp_path / "o.csv") == 0
    assert np.isfinite(table(tmp_path / "o.csv")["tip_x"]).all()
    assert flexarm("frequencies", name, "--shapes") == 0
    capsys.readouterr()
    assert flexarm("show", name, "--plot", tmp_path / "arm.png", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert (tmp_path / "arm.png").stat().st_size > 10_000
    arm = arm_file.load(name)
    assert shown["modes"] == list(arm.mode_names)
    assert len(shown["frequencies_hz"]["locked"]) == len(arm.modes)
    assert [j["name"] for j in shown["joints"]] == list(arm.joint_names)


def test_frequencies_are_those_of_the_exact_beam(two_link, capsys):
    truth = json.loads((DATA / "frequencies.json").read_text())["two_link"]
    for angle in (0, 60, -60, 90):
        words = ("--at", f"-0.3,{np.radians(angle)}")
        assert flexarm("frequencies", two_link[0], *words, "--json") == 0
        found = json.loads(capsys.readouterr().out)
        for case in ("locked", "free"):
            exact = np.array(truth[f"q2={angle} {case}"]["rad_s"])
            np.testing.assert_allclose(found[case]["rad_s"][:2], exact[:2], rtol=1e-2)
            np.testing.assert_allclose(
                np.array(found[case]["Hz"]) * 2.0 * np.pi, found[case]["rad_s"], rtol=1e-12
            )
        assert (
            flexarm("frequencies", two_link[0], *words, "--modes", "5", "--json", "--locked") == 0
        )
        found = json.loads(capsys.readouterr().out)
        assert "free" not in found
        exact = truth[f"q2={angle} locked"]["rad_s"]
        np.testing.assert_allclose(found["locked"]["rad_s"][:4], exact, rtol=1e-5)


def test_show_warns_of_what_matters(capsys):
    assert flexarm("show", "long_reach") == 0
    out = capsys.readouterr().out
    assert "upper sags by 7." in out and "--finite-slope" in out
    assert flexarm("show", "long_reach", "--finite-slope") == 0
    assert "sags by" not in capsys.readouterr().out
    assert flexarm("show", "R") == 0
    assert "link1 has no damping in y" in capsys.readouterr().out


REFUSED = [
    ("t,tau1,tau2\n0,0,0\n1,x,0\n", r"tau.csv:3: tau1: 'x' is not a number"),
    ("t,tau1,tau2\n0,0,0\n1,nan,0\n", r"tau.csv:3: tau1: nan is not finite"),
    ("t,tau1,tau2\n0,0,0\n2,0,0\n\n1,0,0\n", r"tau.csv:5: t = 1 comes after 2"),
    (
        "t,tau1\n0,0\n",
        r"tau.csv:1: columns are t,tau1, wanted t,tau1,tau2: one per joint (joint1, joint2)",
    ),
    ("t,tau1,tau2\n0,0\n", r"tau.csv:2: 2 values for 3 columns"),
    ("t,tau1,tau2\n", r"tau.csv: no rows"),
    ("", r"tau.csv: empty; its first line must be t,tau1,tau2"),
]


@pytest.mark.parametrize(("content", "message"), REFUSED)
def test_a_torque_table_that_is_wrong_is_refused_by_line_and_column(
    tmp_path, capsys, content, message
):
    (tmp_path / "tau.csv").write_text(content)
    words = ("--torque", tmp_path / "tau.csv", "--out", tmp_path / "o.csv")
    assert flexarm("simulate", "two_link", *words) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "o.csv").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("two_link", "--initial", "1"), "--initial: 1 is the wrong number of angles (2)"),
        (("two_link", "--initial", "a,b"), "--initial: 'a,b' is no list of finite numbers"),
        (("two_link", "--initial", "nan,1"), "--initial: 'nan,1' is no list of finite numbers"),
        (("two_link", "--step", "0"), "--step: 0.0 is out of range (finite, above 0)"),
        (("two_link", "--rate", "nan"), "--rate: nan is out of range"),
        (("two_link", "--duration", "-1"), "--duration: -1.0 is out of range"),
        (("two_link", "--duration", "1e9"), "makes 100000000000 rows (10000000 rows)"),
        (("two_link", "--modes", "0"), "0 modes; from 1 to 20"),
        (("R", "--foreshortening"), "model: 'paper_appendix' of R supports neither foreshortening"),
        (("nothing",), "'nothing' is neither a file nor a shipped arm"),
        (("two_link", "--torque", "none.csv"), "none.csv"),
    ],
)
def test_wrong_options_are_refused_saying_what_is_wanted(words, message, capsys):
    assert flexarm("simulate", *words) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "words", "message"),
    [
        ("t,q1\n0,0\n0,1\n1,1\n2,2\n3,3\n", (), "t = 0 is there twice; joints can't jump"),
        ("t,q1\n0,0\n1,1\n", (), "2 rows; at least 4"),
        ("t,q1\n0,0\n1,1\n2,0\n3,1\n", ("--duration", "4"), "is longer than the motion"),
        ("t,q1\n0,0\n1,1\n2,0\n3,1\n", ("--initial", "1"), "starts where its table does"),
    ],
)
def test_a_motion_that_can_not_be_followed_is_refused(tmp_path, capsys, content, words, message):
    (tmp_path / "q.csv").write_text(content)
    assert flexarm("simulate", "one_link", "--prescribed", tmp_path / "q.csv", *words) == 1
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_the_commands_need_no_ros(tmp_path):
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
        assert (
            np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) >= 0.0).all()
        )
        assert values.shape == (times.size, 1)


def test_steps_are_linear_between_rows_and_jump_at_a_repeated_time():
    drive = tables.Steps(np.array([0.0, 1.0, 1.0, 2.0]), np.array([[0.0], [2.0], [5.0], [7.0]]))
    assert drive.right_of(0.5)[0] == drive.left_of(0.5)[0] == 1.0
    assert (drive.left_of(1.0)[0], drive.right_of(1.0)[0]) == (2.0, 5.0)
    assert (drive.right_of(-1.0)[0], drive.left_of(3.0)[0]) == (0.0, 7.0)
