# SPDX-License-Identifier: Apache-2.0
"""The command line: wrong usage, options of `publish`, progress."""

import argparse
import io

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.motions import profiles, shapers
from flexarm_control.trajectory import files
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError, TrajectoryError
from flexarm_dynamics.models import model
from flexarm_studies.progress import Progress
from flexarm_tools import publish_trajectory


def options(*words):
    parser = argparse.ArgumentParser()
    publish_trajectory.add_arguments(parser)
    return parser.parse_args(words)


def profile(*words, reference=(0.0,)):
    return publish_trajectory.profile_of(options(*words), list(reference))


# --------------------------------------------------------------------------- usage


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["dance"],
        ["demo", "--fast"],
        ["demo", "extra"],
        ["publish"],
        ["publish", "cubic"],
        ["publish", "paper", "--duration", "long"],
        ["publish", "paper", "--points", "1.5"],
        ["publish", "paper", "--to"],
        ["run", "flexarm_sim"],
    ],
)
def test_wrong_usage_exits_2_and_says_how(words, flexarm):
    code, _, err = flexarm(*words)
    assert code == 2 and "usage: flexarm" in err


def test_an_error_is_one_line_and_exits_1(monkeypatch, capsys, flexarm):
    def refuse(options, ros_args=None):
        raise TrajectoryError("no such motion")

    monkeypatch.setattr(publish_trajectory, "publish", refuse)
    assert flexarm("publish", "paper") == (1, "", "flexarm publish: no such motion\n")
    with pytest.raises(SystemExit) as end:
        publish_trajectory.main(["paper"])
    assert end.value.code == 1
    assert capsys.readouterr().err == "publish_trajectory: no such motion\n"


def test_an_interrupt_exits_130(monkeypatch, flexarm):
    def interrupt(options):
        raise KeyboardInterrupt

    monkeypatch.setattr(publish_trajectory, "publish", interrupt)
    assert flexarm("publish", "paper")[0] == 130


def test_ros_arguments_are_passed_on_apart(monkeypatch):
    seen = []
    monkeypatch.setattr(publish_trajectory, "publish", lambda o, r: seen.append((o.to, r)))
    ros = ["--ros-args", "-r", "__ns:=/left"]
    for words in (["quintic", "--to", "1.0", *ros], ["paper"]):
        with pytest.raises(SystemExit) as end:
            publish_trajectory.main(words)
        assert end.value.code == 0
    assert seen == [("1.0", ros), (None, [])]


# --------------------------------------------------------------------------- publish: the motion


def test_without_options_it_is_the_papers_motion():
    motion = profile("paper")
    assert motion.duration == 2.0
    assert_allclose([motion.position(0.0), motion.position(2.0)], [[0.0], [np.pi / 2]], rtol=1e-15)
    assert_allclose(motion.velocity(1.0), [np.pi / 2], rtol=1e-12)  # 90 deg/s at half time


@pytest.mark.parametrize("kind", ["paper", "quintic"])
def test_a_motion_goes_from_where_to_where_and_for_as_long_as_given(kind):
    motion = profile(kind, "--from", "0.5", "--to", "-1.25", "--duration", "3.5")
    assert_allclose([motion.position(0.0), motion.position(3.5)], [[0.5], [-1.25]], rtol=1e-12)
    assert_allclose([motion.velocity(0.0), motion.velocity(3.5)], 0.0, atol=1e-12)


def test_a_motion_starts_at_the_reference_unless_it_is_given_another_start():
    assert_allclose(profile("quintic", reference=[0.7]).position(0.0), [0.7])
    assert_allclose(profile("paper", reference=[0.7]).position(2.0), [np.pi / 2])
    assert_allclose(profile("quintic", "--from", "0", reference=[0.7]).position(0.0), [0.0])


def test_one_angle_stands_for_all_joints_and_a_list_for_each():
    motion = profile("quintic", "--from=0", "--to=-1,2", reference=[9.0, 9.0])
    assert_allclose(motion.position(0.0), [0.0, 0.0])
    assert_allclose(motion.position(2.0), [-1.0, 2.0])


@pytest.mark.parametrize(
    ("words", "field", "value"),
    [
        (["--to", "ninety"], "--to", "ninety"),
        (["--to", ""], "--to", ""),
        (["--to", "1,"], "--to", "1,"),
        (["--to", "1,2"], "to", "1.0;2.0"),
        (["--to", "nan"], "--to", "nan"),
        (["--from", "inf"], "--from", "inf"),
        (["--from", "0;1"], "--from", "0;1"),
        (["--duration", "0"], "duration", 0.0),
        (["--duration", "-2"], "duration", -2.0),
    ],
)
@pytest.mark.parametrize("kind", ["paper", "quintic"])
def test_an_unusable_option_is_refused_naming_it(kind, words, field, value):
    with pytest.raises(FlexarmError) as error:
        profile(kind, *words)
    assert (error.value.field, error.value.value) == (field, value)


def test_smooth_and_shaped_motions_are_their_families_and_shapers():
    motion = profile("smooth", "--to", "1.0", "--duration", "1.5", "--smoothness", "5")
    expected = profiles.smooth(0.0, 1.0, 1.5, 5)
    assert_allclose(motion.acceleration(0.4), expected.acceleration(0.4), rtol=1e-14)
    arm = model.build(arm_file.load("R"))
    shaped = profile("quintic", "--to", "1.0", "--shaper", "zvd", "--shape-modes", "1")
    shaper = shapers.for_arm(arm, [1.0], "zvd", 1)
    assert shaped.duration == pytest.approx(2.0 + shaper.duration, rel=1e-14)
    expected = shaper.apply(profiles.quintic(0.0, 1.0, 2.0))
    assert_allclose(shaped.position(1.1), expected.position(1.1), rtol=1e-14)


def test_a_line_leads_the_tip_from_where_the_reference_is():
    arm = model.build(arm_file.load("two_link"))
    words = ("line", "--arm", "two_link", "--tip=0.3,0.5,0", "--duration", "2")
    motion = profile(*words, reference=(0.2, 1.2))
    assert_allclose(motion.position(0.0), [0.2, 1.2], atol=1e-12)
    tip = arm.tip_position(motion.position(2.0), np.zeros(4))
    assert_allclose(tip, [0.3, 0.5, 0.0], atol=1e-8)


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (["smooth", "--smoothness", "1"], "smoothness"),
        (["quintic", "--torque-limit", "3"], "quintic"),
        (["paper", "--shape-modes", "1"], "shape-modes"),
        (["line"], "line"),
        (["line", "--tip", "1,2"], "tip"),
        (["line", "--tip", "1"], "tip"),  # one number stands for all joints, but not for x, y and z
        (["line", "--tip", "3,0,0"], "tip path"),
        (["least-exciting", "--torque-limit", "-1"], "torque_limit[0]"),
    ],
)
def test_options_become_the_settings_of_their_families(words, field):
    """Each is refused by the family, by the setting's name."""
    with pytest.raises(FlexarmError) as error:
        profile(*words)
    assert error.value.field == field


def test_a_motion_is_written_to_a_file_and_described_without_ros(tmp_path, flexarm):
    path = tmp_path / "motion.yaml"
    code, out, _ = flexarm("publish", "smooth", "--to", "-0.5", "--out", path, "--dry-run")
    assert code == 0 and "smooth: 2 s" in out and "401 points" in out
    assert "joint1: 0 to -0.5 rad, at most 0.5469 rad/s" in out  # 35/16 of the mean
    assert "J left at the end" in out
    read = files.read(path, ["joint1"])
    expected = profiles.sample(profiles.smooth(0.0, -0.5, 2.0, 3), 401)
    assert_allclose(read.positions, expected.positions, rtol=1e-15)
    assert_allclose(read.accelerations, expected.accelerations, rtol=1e-15)


def test_a_torque_that_will_be_clipped_is_reported(flexarm):
    code, out, _ = flexarm("publish", "paper", "--duration", "1", "--dry-run")
    assert code == 0 and "of 13.5582: it will be clipped" in out


def test_a_file_of_another_kind_is_refused(flexarm):
    code, _, err = flexarm("publish", "paper", "--out", "motion.txt")
    assert code == 1 and "'motion.txt' has the wrong suffix (.csv" in err


# --------------------------------------------------------------------------- progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_writes_a_line_per_step_where_there_is_no_terminal():
    out = io.StringIO()
    show = Progress(out)
    show.step("first", 1, 2)
    show.fraction(0.5)
    show.step("last")
    show.done()
    assert [line.split(" s ", 1)[1] for line in out.getvalue().splitlines()] == [
        "[1/2] first",
        "last",
    ]


def test_progress_fills_a_bar_on_a_terminal_and_ends_each_step_full():
    out = Terminal()
    show = Progress(out)
    show.step("first", 1, 2)
    show.fraction(0.5)
    show.fraction(7.0)
    show.step("last", 2, 2)
    show.done()
    assert 25 * "#" not in out.getvalue()
    lines = out.getvalue().split("\n")
    assert len(lines) == 3
    assert "[" + 12 * "#" + 12 * "." + "] [1/2] first" in lines[0]
    for line, label in zip(lines, ("first", "last"), strict=False):
        assert line.endswith(f"[{24 * '#'}] [{'1' if label == 'first' else '2'}/2] {label}")
