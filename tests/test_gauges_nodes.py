# SPDX-License-Identifier: Apache-2.0
"""Gauges through the nodes: calibrated at rest and not in motion, lost one by one under a running loop."""

import math
import re

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from harness import Source
from in_process import InProcess
from std_srvs.srv import Trigger

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.strain_map import StrainMap
from flexarm_dynamics.models import model
from flexarm_msgs.msg import CompositeState, JointTorque, ObserverState

#: Few, so that the loop need not run for long.
SAMPLES = 20
BIAS = np.array([20e-6, -35e-6, 5e-6, 3e-6])


@pytest.fixture(scope="module")
def line():
    """Observer and controller of R_lab, and a driver that sends strains alone."""
    with InProcess() as bench:
        own = {"observer.calibration_samples": SAMPLES, "observer.stuck_samples": 10}
        bench.start("observer", {"arm": "R_lab", **own})
        bench.start("controller", {"arm": "R_lab", "fast.type": "none", "state_timeout": 60.0})
        source = Source(bench, "R_lab")
        source.observed = bench.tap(ObserverState, "observer/state")
        yield source


@pytest.fixture
def source(line):
    """The source in a new session at rest, its bridge not balanced, the torque enabled."""
    line.restart()
    line.until_enabled(**READ)
    return line


def read(source, **broken):
    """Strains of the present sample with a bias; `broken` replaces those of some gauges."""
    strain = source.sim.strain + BIAS
    for name, value in broken.items():
        strain[source.sim.arm.gauge_names.index(name)] = value
    return strain.tolist()


READ = {"strain": read, "modal_amplitude": lambda s: []}


def without(**broken):
    return {**READ, "strain": lambda s: read(s, **broken)}


def calibrate(source):
    """Ask once: the answer to a second call may be another one."""
    return source.bench.call(Trigger, "observer/calibrate_gauges")


def test_calibration_waits_for_samples_is_refused_in_motion_and_accepted_at_rest(source):
    answer = calibrate(source)
    assert not answer.success
    assert re.match(
        rf"calibration_samples: \d+ are not enough samples yet \({SAMPLES}\)", answer.message
    )
    # In motion.
    source.restart()
    for k in range(SAMPLES + 1):
        source.sim.advance(np.array([3.0]))
        source.exchange(source.state(**{k: f(source) for k, f in READ.items()}))
    answer = calibrate(source)
    assert not answer.success
    assert re.match(r"velocity of joint1: 0\.\d+ rad/s is not rest \(0\.01\)", answer.message)
    # At rest.
    source.restart()
    for _ in range(SAMPLES):
        source.exchange(source.state(**{k: f(source) for k, f in READ.items()}))
        source.sim.sequence += 1
        source.sim.stamp_ns += source.sim.period_ns
    answer = calibrate(source)
    assert answer.success, answer.message
    reported = [float(v) for v in re.findall(r"(\S+) \(was", answer.message)]
    np.testing.assert_allclose(reported, 1e6 * BIAS, atol=0.006)
    assert "bias: 2.0000e-05  # gauge root" in source.bench.log("observer")
    # From now on the straight arm is known to be straight, though its bridge reads a bias.
    source.until_enabled(**READ)
    estimate = source.bench.tap(type(source.state()), "arm_state_estimate")
    asked = source.sim.sequence
    source.step(**READ)
    source.bench.wait_for(
        "the estimate", lambda: estimate.newest and estimate.newest.sequence == asked
    )
    wrong = StrainMap(model.build(arm_file.load("R_lab"))).amplitudes(BIAS)
    assert np.abs(estimate.newest.modal_amplitude).max() < 0.05 * np.abs(wrong).max()


def test_the_loop_goes_on_without_one_gauge_or_two_and_stops_without_three(source):
    seen = len(source.bench.diagnostics("observer"))
    for lost in ({"root": math.nan}, {"root": math.nan, "middle": 1.0}):
        for _ in range(5):
            torque, state = source.step(**without(**lost))
            assert torque.mode == JointTorque.ENABLED
    expected = {
        "root": ObserverState.GAUGE_MISSING,
        "quarter": ObserverState.GAUGE_GOOD,
        "middle": ObserverState.GAUGE_SATURATED,
        "three_quarter": ObserverState.GAUGE_GOOD,
    }

    def health():
        newest = source.observed.newest
        return newest and dict(zip(newest.gauge_names, newest.gauge_health, strict=True))

    source.bench.wait_for("the gauges' health", lambda: health() == expected)

    noise = np.random.default_rng(0)

    def warned():
        # Gauges without any noise would be named, too: for standing still.
        strain = read(source, root=math.nan, middle=1.0) + noise.normal(0.0, 1e-6, BIAS.size)
        source.step(strain=strain.tolist(), modal_amplitude=[])
        return any(
            s.level == DiagnosticStatus.WARN
            and s.message.startswith("gauge root is missing, left out; gauge middle is saturated")
            for s in source.bench.diagnostics("observer")[seen:]
        )

    source.bench.wait_for("a warning that names both", warned)
    for _ in range(5):  # a reading that is false once is replaced
        torque, state = source.step(**without(root=math.nan, middle=1.0, quarter=math.inf))
        if torque.mode == JointTorque.DISABLED:
            break
    assert torque.mode == JointTorque.DISABLED
    assert state.supervisor_state == CompositeState.FAULT
    assert re.search(
        r"strain of root: nan .* without root \(missing\), quarter \(missing\), middle \(saturated\) the gauges"
        r" \(three_quarter\) can't give link1_y_mode1, link1_y_mode2",
        source.bench.log("observer"),
    )
    source.recover()
    source.until_enabled(most=3, **READ)


def test_the_health_numbers_are_those_of_the_message():
    from flexarm_control.observers import gauge_health as g

    m = ObserverState
    assert (g.GOOD, g.MISSING, g.STUCK, g.SATURATED, g.SUSPECT) == (
        m.GAUGE_GOOD,
        m.GAUGE_MISSING,
        m.GAUGE_STUCK,
        m.GAUGE_SATURATED,
        m.GAUGE_SUSPECT,
    )
