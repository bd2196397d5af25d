# SPDX-License-Identifier: Apache-2.0
"""Trajectory files: what is written is read back bit by bit, and what can't be used is refused by its place."""

import numpy as np
import pytest
import yaml

from flexarm_control.motions.profiles import quintic, rows, sample
from flexarm_control.trajectory import files, validate
from flexarm_dynamics.errors import NOT_GIVEN, TrajectoryError

NAMES = ("shoulder", "elbow")


def trajectory(fields=3):
    points = rows(sample(quintic([0.1, -1e-7], [1.0 / 3.0, 2.0], np.pi), 7))
    points = [(*row[: 1 + fields], *[[]] * (4 - fields)) for row in points]
    return validate(NAMES, NAMES, 0, points)


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
    ("text", "field", "value"),
    [
        ("", ":1", NOT_GIVEN),
        ("t,q1,q2\n", ":1", NOT_GIVEN),
        ("t,q1\n0,0\n", ":1", "q2"),
        ("q1,q2\n0,0\n", ":1", "t"),
        ("t,q1,q2,qd1\n0,0,0,0\n", ":1", "qd2"),
        ("t,q1,q2,q3\n0,0,0,0\n", ":1", "q3"),
        ("t,q1,q2,q1\n0,0,0,0\n", ":1", "q1"),
        ("t,q1,q2\n0,0\n", ":2", 2),
        ("t,q1,q2\n0,0,0\n1,0,x\n", ":3: q2", "x"),
        ("t,q1,q2\n0,nan,0\n", ":2: q1", "nan"),
        ("t,q1,q2\n1e10,0,0\n", ":2: t", 1e10),
        ("t,q1,q2\n0,0,0\n\n0,1,0\n", ": line 4.time_from_start", 0.0),
        ("t,q1,q2,qdd1,qdd2\n0,0,0,0,0\n", ": line 2", NOT_GIVEN),
        ("t,q1,q2,qd1,qd2\n1,0,0,1,0\n", ": line 2.velocities of joint shoulder", 1.0),
        ("t,q1,q2\n0,9,0\n", ": line 2.positions of joint shoulder", 9.0),
    ],
)
def test_a_csv_that_cant_be_used_is_refused_naming_line_and_column(tmp_path, text, field, value):
    path = tmp_path / "motion.csv"
    path.write_text(text)
    with pytest.raises(TrajectoryError) as error:
        files.read(path, NAMES, position_high=[4.0, 4.0])
    assert (error.value.field, error.value.value) == (f"{path}{field}", value)


def test_a_refused_csv_is_written_out_with_lines_for_points(tmp_path):
    path = tmp_path / "motion.csv"
    path.write_text("t,q1,q2\n1,0,0\n\n1,1,0\n")
    with pytest.raises(TrajectoryError) as error:
        files.read(path, NAMES)
    assert str(error.value) == (
        f"{path}: line 4.time_from_start: 1.0 s is not later than line 2 at 1 s; times must strictly increase"
    )


@pytest.mark.parametrize(
    ("text", "field", "value"),
    [
        ("", "", 0),
        ("a: [", ":2", NOT_GIVEN),
        ("[1]", "", [1]),
        ("joint_name: [a]", "", "joint_name"),
        ("joint_names: [a]\npoints: 3", ": points", 3),
        ("joint_names: [shoulder]\npoints: []", ": joint_names", "elbow"),
        ("{joint_names: [shoulder, elbow], points: []}", ": points", NOT_GIVEN),
        ("{joint_names: [a], points: [{position: [0]}]}", ": points[0]", "position"),
        ("{joint_names: [a], points: [{positions: 0}]}", ": points[0].positions", 0),
        ("{joint_names: [a], points: [{positions: [0, x]}]}", ": points[0].positions[1]", "x"),
        ("{joint_names: [a], points: [{positions: [on]}]}", ": points[0].positions[0]", True),
        (
            "{joint_names: [a], points: [{positions: [0], time_from_start: {sec: 0.5}}]}",
            ": points[0].time_from_start.sec",
            0.5,
        ),
    ],
)
def test_a_yaml_that_cant_be_used_is_refused_naming_point_and_field(tmp_path, text, field, value):
    path = tmp_path / "motion.yaml"
    path.write_text(text)
    with pytest.raises(TrajectoryError) as error:
        files.read(path, NAMES)
    assert (error.value.field, error.value.value) == (f"{path}{field}", value)


def test_a_file_that_is_not_there_or_of_another_kind_is_refused(tmp_path):
    with pytest.raises(TrajectoryError, match=r"none\.csv: No such file"):
        files.read(tmp_path / "none.csv", NAMES)
    with pytest.raises(TrajectoryError, match=r"motion\.txt' has the wrong suffix \(\.csv"):
        files.read(tmp_path / "motion.txt", NAMES)
    with pytest.raises(TrajectoryError, match="wrong suffix"):
        files.write(tmp_path / "motion", trajectory())
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(TrajectoryError, match=r"binary\.csv' is no text file"):
        files.read(tmp_path / "binary.csv", NAMES)
