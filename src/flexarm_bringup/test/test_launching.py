# SPDX-License-Identifier: Apache-2.0
"""What the launch files start, from their arguments; with a stand-in for `launch`, which is not on PyPI."""

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from flexarm_bringup import launching
from flexarm_dynamics.errors import ParameterError
from flexarm_studies.loop import parameter_files

FILES = {
    "arm": (launching.ONE_ARM, launching.one_arm),
    "two_arms": (launching.TWO_ARMS, launching.two_arms),
    "driver": (launching.BESIDE_A_DRIVER, launching.beside_a_driver),
    "case_study": (launching.CASE_STUDY, launching.case_study),
}
LAUNCH = Path(__file__).resolve().parents[1] / "launch"


def values(arguments, **given):
    """Values of arguments: the defaults, but for what is given."""
    assert set(given) <= set(arguments)
    return {name: argument.default for name, argument in arguments.items()} | given


def merged(start):
    """Parameters that a node gets beside its file."""
    parts = (part for part in start.parameters if isinstance(part, dict))
    return {k: v for part in parts for k, v in part.items()}


class Record(SimpleNamespace):
    """Stands for any class of launch: keeps what it was made with."""

    def __init__(self, *args, **kwargs):
        super().__init__(args=args, **kwargs)

    def perform(self, context):
        """As a LaunchConfiguration."""
        return context[self.args[0]]


@pytest.fixture
def launch(monkeypatch):
    """A stand-in for launch and launch_ros."""
    classes = {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument", "OpaqueFunction"],
        "launch.substitutions": ["LaunchConfiguration"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
    }
    for name, inside in classes.items():
        module = ModuleType(name)
        for kind in inside:
            setattr(module, kind, type(kind, (Record,), {}))
        monkeypatch.setitem(sys.modules, name, module)


def test_every_launch_file_is_one_of_these():
    assert {p.name for p in LAUNCH.iterdir()} >= {f"{name}.launch.py" for name in FILES}
    assert len(list(LAUNCH.glob("*.launch.py"))) == len(FILES)


@pytest.mark.parametrize("name", FILES)
def test_a_launch_file_declares_described_arguments_and_starts_nodes_by_default(launch, name):
    arguments, starts = FILES[name]
    (made,) = runpy.run_path(str(LAUNCH / f"{name}.launch.py"))[
        "generate_launch_description"
    ]().args
    *declared, nodes = made
    assert [d.args[0] for d in declared] == list(arguments)
    assert all(len(d.description) > 15 and isinstance(d.default_value, str) for d in declared)
    assert all(d.default_value in d.choices for d in declared if hasattr(d, "choices"))
    context = {d.args[0]: d.default_value for d in declared}
    actions = nodes.function(context)
    assert [a.executable for a in actions] == [s.executable for s in starts(values(arguments))]
    assert {"observer", "controller"} <= {a.executable for a in actions}
    assert all(a.ros_arguments == ["--log-level", "info"] for a in actions)


def test_one_arm_is_four_nodes_in_a_namespace_with_one_file():
    given = {"controller": "two_link", "namespace": "left", "lockstep": "true"}
    starts = launching.one_arm(values(launching.ONE_ARM, **given))
    assert [s.executable for s in starts] == ["simulator", "observer", "controller", "goals"]
    assert {s.namespace for s in starts} == {"left"}
    assert {s.parameters[0] for s in starts} == {str(parameter_files.find("two_link"))}
    # The arm is the file's; in lockstep the simulator does not wait to be unpaused.
    assert [merged(s) for s in starts] == [{"lockstep": True, "pause_at": -1.0}, {}, {}, {}]


def test_with_simulator_false_leaves_the_simulator_out_and_an_arm_goes_to_every_node():
    given = {
        "with_simulator": "false",
        "with_goals": "false",
        "arm": "one_link",
        "log_level": "debug",
    }
    starts = launching.one_arm(values(launching.ONE_ARM, **given))
    assert [s.executable for s in starts] == ["observer", "controller"]
    assert [merged(s) for s in starts] == [{"arm": "one_link"}] * 2
    assert {s.log_level for s in starts} == {"debug"}


def test_an_arm_of_ones_own_has_no_controller_file_and_a_shipped_one_has_its_own():
    for arm, file in (("my_arm.yaml", None), ("two_link", "two_link"), ("P3", "composite")):
        for start in launching.one_arm(values(launching.ONE_ARM, arm=arm)):
            first = [str(parameter_files.find(file))] if file else []
            assert start.parameters[: len(first)] == first and merged(start)["arm"] == arm
            assert len([p for p in start.parameters if isinstance(p, str)]) == len(first)


def test_two_arms_have_all_their_nodes_in_namespaces_of_their_own():
    given = {"right_controller": "two_link", "right_namespace": "r"}
    starts = launching.two_arms(values(launching.TWO_ARMS, **given))
    assert [(s.namespace, s.executable) for s in starts] == [
        (side, node)
        for side in ("left", "r")
        for node in ("simulator", "observer", "controller", "goals")
    ]
    files = {s.namespace: s.parameters[0] for s in starts}
    assert files["left"].endswith("composite.yaml") and files["r"].endswith("two_link.yaml")
    with pytest.raises(ParameterError, match="share their topics"):
        launching.two_arms(values(launching.TWO_ARMS, right_namespace="/left"))


def test_beside_a_driver_the_controller_may_wait_and_the_driver_is_started_where_it_is_named():
    starts = launching.beside_a_driver(values(launching.BESIDE_A_DRIVER, autostart="false"))
    assert [(s.executable, merged(s)) for s in starts] == [
        ("observer", {}),
        ("controller", {"autostart": False}),
        ("goals", {}),
    ]
    given = {"driver_package": "my_driver", "driver_parameters": "mine.yaml", "namespace": "n"}
    driver, *_ = launching.beside_a_driver(values(launching.BESIDE_A_DRIVER, **given))
    assert (driver.package, driver.executable, driver.namespace) == ("my_driver", "driver", "n")
    assert driver.parameters == [str(parameter_files.find("composite")), "mine.yaml"]


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"controller": "nonsense"}, "neither a file nor shipped"),
        ({"lockstep": "True"}, r"lockstep: 'True' is not one of the choices \(true, false\)"),
        ({"log_level": "loud"}, "log_level: 'loud' is not one of the choices"),
    ],
)
def test_a_value_that_cannot_be_used_is_refused(given, reason):
    with pytest.raises(ParameterError, match=reason):
        launching.one_arm(values(launching.ONE_ARM, **given))


def test_the_shape_is_drawn_where_it_is_asked_for():
    given = {"controller": "two_link", "namespace": "left", "with_shape": "true"}
    shape = launching.one_arm(values(launching.ONE_ARM, **given))[-1]
    assert (shape.package, shape.executable, shape.namespace) == (
        "flexarm_bringup",
        "shape",
        "left",
    )
    assert shape.parameters[0].endswith("two_link.yaml")
    assert [s.executable for s in launching.one_arm(values(launching.ONE_ARM))].count("shape") == 0
