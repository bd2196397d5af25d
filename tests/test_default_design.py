# SPDX-License-Identifier: Apache-2.0
"""Nodes with an arm file and no other parameter: they make the arm's design, once, and agree on it."""

import signal
import threading
from collections import deque

import numpy as np
import pytest
from in_process import InProcess
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool

from flexarm_control.motions import profiles
from flexarm_control.nodes.controller_report import HUNTS, SWINGS, Report
from flexarm_control.robust import cache, default
from flexarm_dynamics.arm import arm_file
from flexarm_ros.node import WARN
from flexarm_studies.loop.closed_loop import TRAJECTORY_START_NS
from flexarm_studies.random_arms import generator
from flexarm_tools.recording import recorder
from flexarm_tools.running import lockstep

#: A design that is quickly made.
QUICK = {"rate": 500.0, "design.effort": 0.1}
PATIENT = {"state_timeout": 60.0, "design_process": False}


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """Where the designs are kept that tests have made."""
    return tmp_path_factory.mktemp("designs")


@pytest.fixture(scope="module")
def searched():
    """A search for gains that runs once for equal tasks: what is kept of designs is tested, and not the search."""
    found, real = {}, default.design

    def once(*task):
        key = cache.key(*task)
        if key not in found:
            found[key] = real(*task)
        return found[key]

    return once


@pytest.fixture(autouse=True)
def designs(kept, searched, monkeypatch):
    monkeypatch.setattr(cache, "cache_directory", lambda: kept)
    monkeypatch.setattr(default, "design", searched)


@pytest.fixture
def no_designs(designs, tmp_path, monkeypatch):
    """No design was made before."""
    monkeypatch.setattr(cache, "cache_directory", lambda: tmp_path)


@pytest.fixture
def path(tmp_path):
    """File of an arm that is not shipped."""
    file = tmp_path / "arm.yaml"
    file.write_text(generator.arm(0).text)
    return str(file)


@pytest.fixture
def made(monkeypatch):
    """Counts the designs that are made."""
    count, real = [], default.design
    monkeypatch.setattr(default, "design", lambda *a: count.append(a) or real(*a))
    return count


def test_an_arm_file_is_all_that_the_nodes_need(path):
    model = arm_file.load(path)
    with InProcess() as nodes:
        nodes.start("simulator", {"arm": path, "rate": 500.0, "lockstep": True})
        nodes.start("observer", {"arm": path, **QUICK})
        nodes.start("controller", {"arm": path, **QUICK, **PATIENT})
        control, watch = (nodes.nodes[k].parameters.values() for k in ("controller", "observer"))
        designed = nodes.nodes["controller"].design.parameters
        assert designed["slow.type"] == "joint_pid"
        for name, value in designed.items():
            assert (watch if name.startswith("observer.") else control)[name] == value, name
        assert "designed: slow joint_pid, fast fixed_gain" in nodes.log("controller")
        assert "designed: observer filtered_derivative" in nodes.log("observer")
        profile = profiles.quintic(0.0, 0.5, 1.0)
        message = lockstep.trajectory_message(model.joint_names, profile, 51, TRAJECTORY_START_NS)
        nodes.record(message, 2.0)
        assert nodes.nodes["controller"].core.state.name == "HOLDING"
        error = nodes.nodes["controller"].core.position_error.copy()
    assert abs(error[0]) < 2e-3


def test_each_parameter_given_by_hand_stays_and_a_design_is_made_once(path, no_designs, made):
    with InProcess() as nodes:
        for key, own in {"plain": {}, "damped": {"slow.damping": [3.0]}}.items():
            nodes.start("controller", {"arm": path, **QUICK, **PATIENT, **own}, key=key)
        first, second = (nodes.nodes[k].parameters.values() for k in ("plain", "damped"))
        assert {k for k in first if first[k] != second[k]} == {"slow.damping"}
        assert second["slow.damping"] == [3.0] and len(made) == 1
        assert nodes.nodes["damped"].core.law.slow.parameters["damping"] == [3.0]


def delayed(nodes, path, periods, noise=False, **control):
    """Start simulator, observer and controller; each torque comes so many periods late."""
    nodes.start("simulator", {"arm": path, "rate": 500.0, "lockstep": True, "noise": noise})
    sim = nodes.nodes["simulator"].sim
    advance, way = sim.advance, deque([None] * periods)

    def late(torque):
        way.append(None if torque is None else torque.copy())
        advance(way.popleft())

    sim.advance = late
    nodes.start("observer", {"arm": path, **QUICK})
    nodes.start("controller", {"arm": path, **QUICK, **PATIENT, **control})


def test_with_noise_the_delay_is_measured_and_the_arm_is_on_its_motion_in_time(path):
    joints, profile = arm_file.load(path).joint_names, profiles.quintic(0.0, 0.8, 0.5)
    begin = TRAJECTORY_START_NS + 300_000_000  # the noise at rest is enough to measure the delay
    message = lockstep.trajectory_message(joints, profile, 51, begin)
    cases = {
        "at once": (0, False, {}),
        "known": (1, True, {}),
        "left out": (1, True, {"motion_delay": 0.0}),
    }
    position = {}
    for name, (periods, noise, own) in cases.items():
        with InProcess() as nodes:
            delayed(nodes, path, periods, noise, **own)
            samples = nodes.record(message, 1.2)
            values = nodes.nodes["controller"].diagnose()[2]
        assert values["torque delay p50 [ms]"] == f"{2 * periods:.3f}"
        position[name] = recorder.to_record(samples, begin, path).position
    known, left_out = (
        np.abs(position[name] - position["at once"]).max() for name in ("known", "left out")
    )
    assert known < 0.1 * left_out


@pytest.mark.parametrize("periods", [0, 2, 8])
def test_the_delay_of_the_loop_is_measured_and_compared_with_what_the_design_bears(path, periods):
    with InProcess() as nodes:
        delayed(nodes, path, periods)
        bears = nodes.nodes["controller"].design.bears_delay
        assert 0.004 < bears < 0.016
        profile = profiles.quintic(0.0, 0.1, 0.5)
        names = arm_file.load(path).joint_names
        message = lockstep.trajectory_message(names, profile, 51, TRAJECTORY_START_NS)
        nodes.record(message, 0.2)
        level, text, values = nodes.nodes["controller"].diagnose()
        parts = nodes.nodes["controller"], nodes.nodes["controller"].core
        found = nodes.nodes["controller"].design
        warned = [
            Report(*parts, found._replace(**marks)).diagnose()[:2]
            for marks in ({"comes_back": False}, {"hunts": True})
        ]
        del parts
    assert warned == [(WARN, SWINGS), (WARN, HUNTS)]
    assert values["speed of the design"] == "1"
    assert float(values["torque delay p50 [ms]"]) == pytest.approx(2.0 * periods, abs=1e-3)
    assert float(values["torque delay max [ms]"]) == pytest.approx(2.0 * periods, abs=1e-3)
    assert values["designed for a delay of [ms]"] == "3.000"
    assert values["bears a delay of [ms]"] == f"{1e3 * bears:.3f}"
    if 0.002 * periods > bears:
        assert level == WARN and "torque acts 16.000 ms after its measurement" in text
        assert "start with design.delay 0.016" in text
    else:
        assert "torque acts" not in text


def test_states_at_another_rate_than_the_designs_are_a_warning(path):
    with InProcess() as nodes:
        nodes.start("simulator", {"arm": path, "rate": 1000.0, "lockstep": True, "pause_at": 0.05})
        nodes.start("observer", {"arm": path, **QUICK})
        nodes.start("controller", {"arm": path, **QUICK, **PATIENT})
        nodes.call(SetBool, "simulator/pause", data=False)
        nodes.wait_for("samples", lambda: nodes.nodes["simulator"].sim.sequence > 40)
        level, text, _ = nodes.nodes["controller"].diagnose()
    assert level == WARN and "1000 states per second, the control is designed for 500" in text


def test_a_node_that_is_configured_anew_takes_its_design_again(path, made):
    with InProcess() as nodes:
        nodes.start("controller", {"arm": path, **QUICK, **PATIENT})
        node = nodes.nodes["controller"]
        before, designs = node.parameters.values(), len(made)
        changed = [Parameter("slow.damping", value=[3.0])]
        assert node.set_parameters_atomically(changed).successful
        for trigger in ("deactivate", "cleanup", "configure", "activate"):
            assert getattr(node, f"trigger_{trigger}")() == TransitionCallbackReturn.SUCCESS
        assert node.parameters.values() == before | {"slow.damping": [3.0]}
        assert len(made) == designs
        del node


def test_laws_chosen_by_hand_and_the_papers_arms_need_no_design(path, made):
    with InProcess() as nodes:
        chosen = {"slow.type": "model_following", "fast.type": "none"}
        nodes.start("controller", {"arm": path, **PATIENT, **chosen}, key="chosen")
        nodes.start("observer", {"arm": path, **chosen}, key="watch")
        nodes.start("controller", {"arm": "R", **PATIENT}, key="R")
        assert nodes.nodes["R"].parameters["fast.type"] == "lqr"
        assert nodes.nodes["watch"].parameters["observer.bandwidth"] == 1000.0
    assert not made


def test_what_no_gains_hold_is_no_configuration(path):
    with InProcess() as nodes:
        own = {"design.gain": [0.001, 1000.0], "design.configurations": [0.5], "autostart": False}
        nodes.start("controller", {"arm": path, **QUICK, **PATIENT, **own})
        nodes.nodes["controller"].trigger_configure()
        failure = nodes.nodes["controller"].failure
        assert "no gains hold all of it" in failure and "grow at" in failure
        assert not hasattr(nodes.nodes["controller"], "core")


def test_while_a_design_is_made_the_node_says_so_and_answers(path, no_designs, monkeypatch):
    go_on, answers = threading.Event(), []
    real = default.design

    def slow(*task):
        assert go_on.wait(30.0)
        return real(*task)

    monkeypatch.setattr(default, "design", slow)
    with InProcess() as nodes:
        nodes.start("controller", {"arm": path, **PATIENT, **QUICK, "autostart": False})

        def diagnostics(array):
            answers.append(array.status[0])
            go_on.set()

        nodes.nodes["controller"]._diagnostics.publish = diagnostics
        nodes.nodes["controller"].trigger_configure()
        assert answers[0].level == WARN and "designing the control of" in answers[0].message
        assert "1 s so far" in answers[0].message
        assert "no torque meanwhile" in nodes.log("controller")
        assert not nodes.nodes["controller"].failure and nodes.nodes["controller"].design


def test_a_node_that_designs_serves_and_ends(bench, tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(generator.arm(3).text)
    # A search that takes minutes.
    bench.start("controller", {"arm": str(path), "design.effort": 100.0})
    bench.wait_for("the log", lambda: "so far: no torque meanwhile" in bench.log("controller"))
    assert bench.lifecycle("controller") == "configuring"
    assert bench.stop("controller", signal.SIGINT) == 0


@pytest.mark.parametrize(
    ("speed", "slowed", "comes_back", "hunts", "shown"),
    [
        (0.7, False, True, False, "0.7"),
        (0.7, False, True, True, f"0.7; {HUNTS}"),
        (0.35, True, True, False, "0.35, lowered because of the torque limits"),
        (
            0.35,
            True,
            False,
            False,
            "0.35, lowered because of the torque limits; at the torque limits the arm may swing: give motions more"
            " time",
        ),
    ],
)
def test_what_is_wrong_with_a_design_is_shown(speed, slowed, comes_back, hunts, shown):
    found = default.Default({}, 0.003, 0.01, 0.4, speed, slowed, comes_back, hunts)
    with InProcess() as nodes:
        nodes.start("controller", {"arm": "R"})
        plain = nodes.nodes["controller"].diagnose()[2]
        parts = nodes.nodes["controller"], nodes.nodes["controller"].core, found
        values = Report(*parts).diagnose()[2]
        del parts
    assert "speed of the design" not in plain
    assert values["speed of the design"] == shown
