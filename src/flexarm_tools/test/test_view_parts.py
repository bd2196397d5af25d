# SPDX-License-Identifier: Apache-2.0
"""Parts of `flexarm view` that need neither nodes nor a browser: gains, histories, options, what is written."""

import argparse
import json
import math
import struct
from types import SimpleNamespace

import numpy as np
import pytest

from flexarm_control.nodes.controller import parameter_groups
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.models import model
from flexarm_ros.parameters import descriptor
from flexarm_tools.shape.drawing import Drawer
from flexarm_tools.view import command, gains
from flexarm_tools.view.link import laws_in_use
from flexarm_tools.view.page import WINDOW, History, header, legend, reachable, segments, span
from flexarm_tools.view.pair import WITH, WITHOUT, Pair

TWO_LINK = arm_file.load("two_link")


def found(**values):
    """Gains of a controller with the node's own declarations and these values (dots as double underscores)."""
    declared = {prefix + p.name: p for prefix, group in parameter_groups().items() for p in group}
    given = {name.replace("__", "."): value for name, value in values.items()}
    ranges, hints, owners = {}, {}, {}
    for name in given:
        d = descriptor(declared[name])
        owners[name] = gains.owners_of(d.additional_constraints, TWO_LINK)
        r = d.floating_point_range
        ranges[name] = (
            (r[0].from_value, r[0].to_value) if r else gains.range_of(d.additional_constraints)
        )
        hints[name] = d.description
    ranges = {name: span for name, span in ranges.items() if span}
    return gains.of_parameters(given, ranges, hints, laws_in_use(given), owners)


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
        "fast.alpha [1/s]",
        "slow.kp joint1 [1/s^2]",
        "slow.kp joint2 [1/s^2]",
        "slow.kv joint1 [1/s]",
        "slow.kv joint2 [1/s]",
        "fast.configuration joint1 [rad]",
        "fast.configuration joint2 [rad]",
    ]
    _, _, kp, kv, *_, angle = out
    assert (kp.low, kp.high) == (0.0, 12.0)
    assert (kv.low, kv.high) == (0.0, 1.0)
    assert (angle.low, angle.high) == (-3.2, 3.2)
    # A law that is not installed here: all there are.
    values["slow__type"] = "of_somebody_else"
    assert "slow.tip_kp" in [g.name for g in found(**values)]


def test_a_number_without_an_owner_or_a_unit_has_its_index():
    values = {"fast.K": [1.0, 2.0]}
    out = gains.of_parameters(values, {"fast.K": (0.0, 9.0)}, {}, owners={"fast.K": ("one",)})
    assert [g.label for g in out] == ["fast.K[0]", "fast.K[1]"]
    assert gains.unit_of("A gain [N m (each)]") == "N m (each)"
    assert gains.owners_of("from 0.0 to 1.0; length 3, or one value for all", TWO_LINK) == ()


def test_an_axis_fits_what_is_drawn_and_zero_is_a_line():
    nothing = [np.full(2, np.nan)]
    assert span(nothing, 0.2) == pytest.approx((-0.1, 0.1))
    assert span([np.zeros(5)], 0.2) == pytest.approx((-0.1, 0.1))
    assert span([np.array([0.0, 10.0]), np.array([-2.0, np.nan])], 0.2) == pytest.approx(
        (-3.2, 11.2)
    )
    # It stays while what is drawn fits and is not lost in it.
    assert span([np.array([0.0, 4.0])], 0.2, (-3.0, 11.0)) == (-3.0, 11.0)
    assert span([np.array([0.0, 1.0])], 0.2, (-3.0, 11.0)) == pytest.approx((-0.1, 1.1))
    assert span([np.array([0.0, 12.0])], 0.2, (-3.0, 11.0)) == pytest.approx((-1.2, 13.2))


def test_a_plan_is_the_way_through_the_points():
    rows = command.between([0.0, 1.0], [[1.0, 1.0], [1.0, 3.0]])
    np.testing.assert_allclose(rows[[0, command.PIECES, -1]], [[0, 1], [1, 1], [1, 3]])
    drawer = Drawer(model.build(TWO_LINK))
    ghost, way = drawer.plan(rows)
    np.testing.assert_allclose(ghost, drawer.picture(rows[-1]).ghost)
    np.testing.assert_allclose(way[0], drawer.picture(rows[0]).tip, atol=1e-12)
    assert way.shape == (len(rows), 3)


class Loop:
    """Stands in for the nodes: a motion lasts as long as it is asked to, and the tip swings without fast control."""

    def __init__(self):
        self.time, self.fast, self.motions, self.until = 0.0, True, [], 0.0
        self.taken, self.state = True, None

    def move(self, target, duration):
        if self.taken:
            self.motions.append((tuple(target), self.fast))
            self.until = self.time + duration

    def enable_fast(self, on):
        self.fast = on

    def snapshot(self):
        self.time += 0.1
        moving = "TRACKING" if self.time < self.until else "HOLDING"
        return SimpleNamespace(
            time=self.time, state=self.state or moving, reason="why", trajectory=len(self.motions)
        )

    def run(self, pair):
        for _ in range(2000):
            now = self.snapshot()
            pair.turn(now, 0.0 if self.fast else 0.01 + 0.005 * math.sin(10.0 * now.time))
            if pair.ended:
                return pair
        raise AssertionError("the pair does not end")


def test_a_motion_is_made_with_and_without_the_fast_control():
    loop = Loop()
    pair = loop.run(Pair(loop, (0.0,), (1.0,), 2.0))
    there, back = ((1.0,), (0.0,))
    assert loop.motions == [(there, True), (back, True), (there, False), (back, True)]
    assert loop.fast
    for curve in pair.curves.values():
        assert curve[0, 0] < 0.2 and curve[0, -1] >= 6.0
    assert np.ptp(pair.curves[WITH][1]) == 0.0
    assert np.ptp(pair.curves[WITHOUT][1]) == pytest.approx(0.01, rel=0.02)
    assert "changes by 0 mm with fast control, 9." in pair.ended


@pytest.mark.parametrize(
    ("state", "taken", "why"),
    [("FAULT", True, "is FAULT: why"), (None, False, "the motion was not taken: why")],
)
def test_a_pair_is_given_up_with_the_reason_and_the_fast_control_on(state, taken, why):
    loop = Loop()
    loop.state, loop.taken = state, taken
    pair = loop.run(Pair(loop, (0.0,), (1.0,), 2.0))
    assert pair.ended.startswith("given up") and why in pair.ended
    assert loop.fast and not pair.curves


def raw_state(seconds, name=b"joint1"):
    """The beginning of a serialised message with a header."""
    return b"\0\1\0\0" + struct.pack("<iI", seconds, 7) + name


def test_foxglove_gets_the_newest_messages_once_it_asks_and_the_shape():
    pytest.importorskip("foxglove")
    from websockets.sync.client import connect

    from flexarm_tools.view import foxglove

    waiting, asked = [raw_state(5)], []

    def sources():
        asked.append(True)
        take = lambda: waiting.pop() if waiting else None  # noqa: E731
        return [foxglove.Source("arm_state", foxglove.TOPICS["arm_state"], take)]

    server = foxglove.Foxglove("arm", 0, sources, lambda kind: f"# {kind}", 1.0)
    try:
        assert f"127.0.0.1%3A{server.port}" in server.url
        assert server.forward() == 0 and not asked  # without a client nothing is read
        protocol = ["foxglove.sdk.v1"]
        with connect(f"ws://127.0.0.1:{server.port}", subprotocols=protocol) as client:
            texts = [json.loads(client.recv(timeout=10)) for _ in range(2)]
            channels = {c["topic"]: c for c in texts[1]["channels"]}
            assert set(channels) == {"/shape", *(f"/{topic}" for topic in foxglove.TOPICS)}
            state = channels["/arm_state"]
            assert (state["encoding"], state["schemaEncoding"]) == ("cdr", "ros2msg")
            assert state["schema"] == "# flexarm_msgs/msg/ArmState"
            wanted = [
                {"id": i, "channelId": channels[topic]["id"]}
                for i, topic in enumerate(("/arm_state", "/shape"))
            ]
            client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            client.send(json.dumps({"op": "no such thing"}))  # answered once the first is done
            client.recv(timeout=10)
            assert server.forward() == 1 and asked
            message = client.recv(timeout=10)
            assert message[5:13] == struct.pack("<Q", 5_000_000_007) and message[13:] == raw_state(
                5
            )
            server.draw(5_000_000_007, np.zeros((3, 3)), np.zeros((2, 3)), np.zeros((0, 3)))
            shape = client.recv(timeout=10)
            assert b"beam" in shape and b"ghost" in shape and b"trail" not in shape
    finally:
        server.close()


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
