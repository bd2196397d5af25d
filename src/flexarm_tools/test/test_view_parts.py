# SPDX-License-Identifier: Apache-2.0
"""Parts of `flexarm view` that need neither nodes nor a browser: gains, histories, options, what is written."""

import argparse
import math

import numpy as np
import pytest

from flexarm_control.nodes.controller import parameter_groups
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import ParameterError
from flexarm_ros.parameters import descriptor
from flexarm_tools.view import command, gains
from flexarm_tools.view.link import laws_in_use
from flexarm_tools.view.page import WINDOW, History, header, legend, reachable, segments


def found(**values):
    """Gains of a controller with the node's own declarations and these values (dots as double underscores)."""
    declared = {prefix + p.name: p for prefix, group in parameter_groups().items() for p in group}
    given = {name.replace("__", "."): value for name, value in values.items()}
    ranges, hints = {}, {}
    for name in given:
        d = descriptor(declared[name])
        r = d.floating_point_range
        ranges[name] = (
            (r[0].from_value, r[0].to_value) if r else gains.range_of(d.additional_constraints)
        )
        hints[name] = d.description
    ranges = {name: span for name, span in ranges.items() if span}
    return gains.of_parameters(given, ranges, hints, laws_in_use(given))


def test_gains_are_every_number_that_the_laws_in_use_declare_with_alpha_first():
    values = {
        "slow__type": "model_following",
        "slow__kp": [2.0, 3.0],
        "slow__kv": [0.0, 3.0],
        "slow__tip_kp": 1.0,
        "fast__type": "lqr",
        "fast__alpha": 2.0,
        "fast__configuration": [0.5, -0.8],
    }
    out = found(**values)
    assert [g.label for g in out] == [
        "fast.alpha",
        "slow.kp[0]",
        "slow.kp[1]",
        "slow.kv[0]",
        "slow.kv[1]",
        "fast.configuration[0]",
        "fast.configuration[1]",
    ]
    by_label = {g.label: g for g in out}
    assert (by_label["slow.kp[1]"].low, by_label["slow.kp[1]"].high) == (0.0, 12.0)
    assert (by_label["slow.kv[0]"].low, by_label["slow.kv[0]"].high) == (0.0, 1.0)
    assert (by_label["fast.configuration[1]"].low, by_label["fast.configuration[1]"].high) == (
        -3.2,
        3.2,
    )
    assert "[1/s]" in by_label["fast.alpha"].hint
    # A law that is not installed here: all there are.
    values["slow__type"] = "of_somebody_else"
    assert "slow.tip_kp" in [g.label for g in found(**values)]


def test_a_slider_stays_within_the_declared_range():
    assert gains.span(400.0, 0.0, 1000.0) == (0.0, 1000.0)
    assert gains.span(1.0, 1.0, 1000.0) == (1.0, 4.0)


def test_a_range_is_read_from_a_descriptors_text():
    assert gains.range_of("from -1.5 to 1e6; length joints, or one value for all") == (-1.5, 1e6)
    assert gains.range_of("one of lqr, none") is None


def test_changes_of_elements_make_whole_values():
    values = {"slow.kp": [1.0, 2.0], "fast.alpha": 3.0}
    wanted = gains.changed(
        values, {("slow.kp", 1): 5.0, ("fast.alpha", None): 4.0, ("slow.kp", 0): 6.0}
    )
    assert wanted == {"slow.kp": [6.0, 5.0], "fast.alpha": 4.0}
    assert values["slow.kp"] == [1.0, 2.0]


def test_a_history_keeps_its_window_and_one_session():
    history = History(2)
    assert all(len(column) == 2 for column in history.columns())
    for t in (0.0, 1.0, 1.0, WINDOW + 0.5):
        history.add(t, [t, -t])
    x, one, other = history.columns()
    np.testing.assert_allclose(x, [0.5 - WINDOW, 0.0])
    np.testing.assert_allclose(one, [1.0, WINDOW + 0.5])
    np.testing.assert_allclose(other, -one)
    history.add(0.25, [0.0, 0.0], session=1)
    assert np.isnan(history.columns()[1]).all()


def test_what_nodes_say_is_text_and_no_markup():
    assert "<script>" not in header("FAULT", "<script>alert(1)</script>")
    assert "<b onload" not in legend(["<b onload=x>"], 1)
    assert "#c92a2a" in header("FAULT", "")


def test_a_line_is_its_parts_and_a_joint_without_ends_turns_once():
    points = np.arange(9.0).reshape(3, 3)
    assert segments(points).shape == (2, 2, 3) and segments(points)[1, 0].tolist() == [3, 4, 5]
    arm = arm_file.load("long_reach")
    assert reachable(arm.joints[1]) == (-1.5, 1.5)
    assert reachable(arm_file.load("R").joints[0]) == (-math.pi, math.pi)
    np.testing.assert_allclose(command.first_target(arm, np.zeros(4)), [command.STEP, 0, 0, 0])


def options(*words):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return parser.parse_args(words)


def test_arm_and_controller_belong_together_unless_both_are_given():
    path, arm = command.files(None, None)
    assert (path.stem, arm) == ("two_link", "two_link")
    path, arm = command.files(None, "R")
    assert (path.stem, arm) == ("composite", "R")
    assert command.files(None, "results/mine.yaml") == (None, "results/mine.yaml")
    path, arm = command.files("long_reach", None)
    assert (path.stem, arm) == ("long_reach", "long_reach")
    path, arm = command.files("composite", "one_link")
    assert (path.stem, arm) == ("composite", "one_link")


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--attach", "--controller", "composite"], "run already"),
        (["--attach", "--lockstep"], "run already"),
        (["R", "--namespace", "left"], "only with --attach"),
        (["R", "--rate", "0"], "from 0.1 to 100"),
        (["R", "--controller", "nowhere"], "neither a file nor shipped"),
    ],
)
def test_options_that_do_not_go_together_are_refused(words, why):
    with pytest.raises(ParameterError, match=why):
        command.check(options(*words))


def test_the_urdf_command_writes_a_file(tmp_path, flexarm):
    path = tmp_path / "arm.urdf"
    code, out, _ = flexarm("urdf", "two_link", "--pieces", "3", "--out", path)
    # Two joints of the arm, and four small ones for each link.
    assert code == 0 and "10 joints" in out
    assert path.read_text().count('type="continuous"') == 2
