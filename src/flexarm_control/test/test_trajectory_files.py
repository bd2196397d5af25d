# SPDX-License-Identifier: Apache-2.0
"""Trajectory files: what is written is read back bit by bit, and what can't be used is refused by its place."""

import numpy as np
import pytest
import yaml

from flexarm_control.motions.profiles import quintic, sample
from flexarm_control.trajectory import files, validate
from flexarm_dynamics.errors import TrajectoryError

NAMES = ("shoulder", "elbow")
S = 10**9  # [ns]


def trajectory(fields=3):
    points = sample(quintic([0.1, -1e-7], [1.0 / 3.0, 2.0], np.pi), 7)
    rows = [
        (round(t * S), *(list(v) if i < fields else [] for i, v in enumerate(values)), [])
        for t, *values in zip(*points, strict=True)
    ]
    return validate(NAMES, NAMES, 0, rows)


@pytest.mark.parametrize("suffix", files.SUFFIXES)
@pytest.mark.parametrize("fields", [1, 2, 3])
def test_what_is_written_is_read_back_bit_by_bit(tmp_path, suffix, fields):
    path, written = tmp_path / f"motion{suffix}", trajectory(fields)
    files.write(path, written)
    assert files.read(path, NAMES).repeats(written)


def test_yaml_may_be_what_ros_prints_or_a_person_writes(tmp_path):
    path = tmp_path / "motion.yml"
    path.write_text(
        "header: {stamp: {sec: 5, nanosec: 0}, frame_id: ''}\n"
        "joint_names: [elbow, shoulder]\n"
        "points:\n"
        "- positions: [1, 2e-3]\n"
        "  velocities: []\n"
        "  accelerations: []\n"
        "  effort: []\n"
        "  time_from_start: {sec: 1, nanosec: 500000000}\n"
        "---\n"
    )
    read = files.read(path, NAMES)
    np.testing.assert_array_equal(read.positions, [[2e-3, 1.0]])
    assert read.velocities is None and read.times_ns.tolist() == [1_500_000_000]
    assert read.stamp_ns == 0


def test_yaml_is_the_text_of_the_message(tmp_path):
    """Numbers are numbers to any YAML 1.1 reader, such as `ros2 topic pub`: 1e-07 alone would be text."""
    path = tmp_path / "motion.yaml"
    files.write(path, trajectory())
    message = yaml.safe_load(path.read_text())
    assert list(message) == ["joint_names", "points"]
    assert message["points"][0]["positions"] == [0.1, -1e-7]
    assert message["points"][-1]["time_from_start"] == {"sec": 3, "nanosec": 141592654}


def test_csv_columns_may_be_in_any_order_with_blanks_and_empty_lines(tmp_path):
    path = tmp_path / "motion.csv"
    path.write_text("q2, t, q1\n\n2.0, 0.5, 1.0\n\n4.0, 1.5, 3.0\n")
    read = files.read(path, NAMES)
    np.testing.assert_array_equal(read.positions, [[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_array_equal(read.times, [0.5, 1.5])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"motion\.csv: empty: give a header t,q1\.\.q2"),
        ("t,q1,q2\n", r"motion\.csv:1: no points below the header"),
        ("t,q1\n0,0\n", r"motion\.csv:1: no column q2: wanted t,q1\.\.q2"),
        ("q1,q2\n0,0\n", r"motion\.csv:1: no column t"),
        ("t,q1,q2,qd1\n0,0,0,0\n", r"motion\.csv:1: no column qd2"),
        ("t,q1,q2,q3\n0,0,0,0\n", r"motion\.csv:1: unknown column 'q3'.*shoulder, elbow"),
        ("t,q1,q2,q1\n0,0,0,0\n", r"motion\.csv:1: column q1 is there 2 times"),
        ("t,q1,q2\n0,0\n", r"motion\.csv:2: 2 values for 3 columns"),
        ("t,q1,q2\n0,0,0\n1,0,x\n", r"motion\.csv:3: q2 is 'x', not a number"),
        ("t,q1,q2\n0,nan,0\n", r"motion\.csv:2: q1 is 'nan', not finite"),
        ("t,q1,q2\n1e10,0,0\n", r"motion\.csv:2: t is 1e\+10 s"),
        ("t,q1,q2\n0,0,0\n\n0,1,0\n", r"line 4\.time_from_start is 0 s, not later than line 2"),
        ("t,q1,q2,qdd1,qdd2\n0,0,0,0,0\n", r"line 2 has accelerations but no velocities"),
        ("t,q1,q2,qd1,qd2\n1,0,0,1,0\n", r"last point's velocity of joint shoulder is 1\.0 rad/s"),
        ("t,q1,q2\n0,9,0\n", r"line 2: position of joint shoulder is 9 rad, beyond its limit of 4"),
    ],
)
def test_a_csv_that_cant_be_used_is_refused_naming_line_and_column(tmp_path, text, message):
    path = tmp_path / "motion.csv"
    path.write_text(text)
    with pytest.raises(TrajectoryError, match=message):
        files.read(path, NAMES, position_high=[4.0, 4.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"motion\.yaml: 0 trajectories"),
        ("a: [", r"motion\.yaml:\d: not YAML"),
        ("[1]", r"motion\.yaml: the file is \[1\]: give header, joint_names, points"),
        ("joint_name: [a]", r"has 'joint_name': known are"),
        ("joint_names: [a]\npoints: 3", r"points is 3: give a list"),
        ("joint_names: [shoulder]\npoints: []", r"motion\.yaml: joint_names lacks 'elbow'"),
        ("{joint_names: [shoulder, elbow], points: []}", r"motion\.yaml: empty trajectory"),
        ("{joint_names: [a], points: [{position: [0]}]}", r"points\[0\] has 'position'"),
        ("{joint_names: [a], points: [{positions: 0}]}", r"points\[0\]\.positions is 0: give a l"),
        (
            "{joint_names: [a], points: [{positions: [0, x]}]}",
            r"points\[0\]\.positions\[1\] is 'x'",
        ),
        ("{joint_names: [a], points: [{positions: [on]}]}", r"points\[0\]\.positions\[0\] is True"),
        (
            "{joint_names: [a], points: [{positions: [0], time_from_start: {sec: 0.5}}]}",
            r"points\[0\]\.time_from_start\.sec is 0\.5: give an integer",
        ),
    ],
)
def test_a_yaml_that_cant_be_used_is_refused_naming_point_and_field(tmp_path, text, message):
    path = tmp_path / "motion.yaml"
    path.write_text(text)
    with pytest.raises(TrajectoryError, match=message):
        files.read(path, NAMES)


def test_a_file_that_is_not_there_or_of_another_kind_is_refused(tmp_path):
    with pytest.raises(TrajectoryError, match=r"none\.csv: No such file"):
        files.read(tmp_path / "none.csv", NAMES)
    with pytest.raises(TrajectoryError, match=r"motion\.txt: a trajectory's file ends in \.csv"):
        files.read(tmp_path / "motion.txt", NAMES)
    with pytest.raises(TrajectoryError, match=r"ends in \.csv"):
        files.write(tmp_path / "motion", trajectory())
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(TrajectoryError, match=r"binary\.csv: not a text file"):
        files.read(tmp_path / "binary.csv", NAMES)
