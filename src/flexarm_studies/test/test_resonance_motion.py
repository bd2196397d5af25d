# SPDX-License-Identifier: Apache-2.0
"""Measuring by a small motion: its bounds, an arm behind a position loop, and arms that do what they should not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.linear import linear_plant
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import check_all
from flexarm_sim.position_loop import PARAMETERS, PositionLoop
from flexarm_studies.resonance.motion import STEP, SWEEP, Arm, Bounds, check, design, measure


def modes_of(name):
    """Frequencies [Hz] and dampings of an arm with its position loop closed, linearised at rest."""
    arm = model.build(arm_file.load(name))
    n = arm.n_joints
    loop = PositionLoop(arm, 1e-3, check_all(PARAMETERS, {}, {"joints": n}))
    A, B = linear_plant(arm, np.zeros(n), coulomb=False)
    half = len(A) // 2
    A[:, half : half + n] -= B * loop.kd
    A[:, :n] -= B * loop.kp
    poles = np.linalg.eigvals(A)
    poles = sorted(poles[(poles.imag > 0.0) & (-poles.real < 0.3 * abs(poles))], key=abs)
    return [(abs(p) / (2.0 * np.pi), -p.real / abs(p)) for p in poles]


@pytest.mark.long
@pytest.mark.parametrize("kind", [STEP, SWEEP])
def test_a_simulated_arm_rings_as_its_closed_loop_does(kind, tmp_path, result):
    (first, damping), (second, _) = modes_of("one_link")[:2]
    out = tmp_path / "m.csv"
    found = result("resonance", "--simulate", "one_link", "--kind", kind, "--out", out, "--rest", 3)
    for window in found["windows"]:
        there = window["modes"]
        lowest = min(there, key=lambda m: abs(m["frequency_hz"] - first))
        assert lowest["frequency_hz"] == pytest.approx(first, rel=2e-3)
        assert lowest["damping"] == pytest.approx(damping, rel=0.02)
        assert min(abs(m["frequency_hz"] / second - 1.0) for m in there) < 2e-3
    assert bool(found["damping"]) == (kind == STEP)
    if kind == STEP:
        # By a burst of the same command: 0.1043 1/(rad s) and 80 degrees, of which 3 are half a period of the commands.
        (answer,) = found["damping"]
        assert (answer["joint"], answer["sensor"], answer["gauge"]) == ("joint1", "strain", 0)
        assert answer["sensitivity"] == pytest.approx(0.1043, rel=0.01)
        assert answer["phase"] == pytest.approx(1.389, abs=0.06)
        assert answer["scatter"] < 0.01 and not answer["refused"]
        # what was kept says the same
        again = result("resonance", out)
        assert again["windows"][0]["modes"][0]["frequency_hz"] == pytest.approx(first, rel=2e-3)


# Bounds ----------------------------------------------------------------------------------------

positive = st.floats(1e-3, 10.0)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from([STEP, SWEEP]), positive, positive, positive)
def test_whatever_the_bounds_are_the_motion_keeps_them(kind, travel, velocity, acceleration):
    bounds = Bounds(travel, velocity, acceleration, 2.0 * travel, 2.0 * velocity)
    made = design(kind, [1, 0], 2, bounds, 1.0, (1.0, 10.0), 3.0)
    time = np.linspace(0.0, made.times[-1], 4001)
    for order, limit in enumerate((travel, velocity, acceleration)):
        assert np.abs(made.derivative(order, time)).max() <= limit
    used = (
        np.abs(made.derivative(0, time)).max() / travel,
        np.abs(made.derivative(1, time)).max() / velocity,
    )
    assert max(*used, np.abs(made.derivative(2, time)).max() / acceleration) > 0.3
    np.testing.assert_allclose(made.derivative(0, np.array([-1.0, made.duration])), 0.0, atol=1e-12)


def test_a_motion_beyond_its_bounds_is_refused_before_anything_moves():
    wide, narrow = Bounds(0.1, stop_travel=0.5), Bounds(0.05)
    made = design(STEP, [0], 1, wide)
    with pytest.raises(FlexarmError, match=r"motion: travel of joint 1 at .*0\.05"):
        check(made, narrow)
    arm = Standing()
    with pytest.raises(FlexarmError, match="travel of joint 1"):
        measure(arm, made, narrow)
    assert arm.sent == 0


@pytest.mark.parametrize(
    "change, message",
    [
        ({"travel": 0.0}, "bounds: travel"),
        ({"velocity": float("nan")}, "bounds: velocity"),
        ({"stop_travel": 0.01}, "bounds: stop_travel"),
        ({"stop_velocity": float("inf")}, "bounds: stop_velocity"),
    ],
)
def test_bounds_that_bound_nothing_are_refused(change, message):
    with pytest.raises(FlexarmError, match=message):
        Bounds(**change)


@pytest.mark.parametrize(
    "words, message",
    [
        ([], "--allow-motion"),
        (["--simulate", "one_link", "--travel", "-1"], "bounds: travel"),
        (["--simulate", "one_link", "--joints", "elbow"], "--joints"),
        (["--simulate", "one_link", "--kind", "sweep", "--sweep", "9:1"], "band"),
        (["--simulate", "one_link", "--rest", "0"], "rest"),
        (["--simulate", "no_arm"], "no_arm"),
    ],
)
def test_options_of_a_measurement_are_refused_by_name(words, message, flexarm):
    code, out, err = flexarm("resonance", *words)
    assert (code, out) == (1, "") and message in err


# Arms that do what they should not ---------------------------------------------------------------


class Standing(Arm):
    """Two joints that stand, 100 joint states a second, until they are moved; then `after` the motion, see there."""

    joint_names = ("a", "b")

    def __init__(self, before=None, after=None, speeds=True):
        self.clock, self.begin, self.sent, self.stops = 0.0, None, 0, 0
        self.before, self.after, self.speeds = before, after, speeds

    def sample(self, patience):
        self.clock += 0.01
        still = np.zeros(2)
        if self.begin is None:
            return self.before(self.clock) if self.before else (self.clock, still, still)
        if self.after is None:
            return self.clock, still, still
        found = self.after(self.clock - self.begin)
        if found is None:
            self.clock += patience
            return None
        position, velocity = (np.array(part, float) for part in found)
        return self.clock, position, velocity if self.speeds else None

    def move(self, motion, start):
        self.sent, self.begin = self.sent + 1, self.clock

    def stop(self):
        self.stops += 1

    def streams(self):
        return []


BOUNDS = Bounds()
RUNAWAYS = {
    "it runs away": (lambda t: ([t, 0.0], [1.0, 0.0]), "measured travel of a"),
    "the other joint creeps": (lambda t: ([0.0, 0.02 * t], [0.0, 0.02]), "measured travel of b"),
    "it swings ever more": (
        lambda t: ([0.0, 0.01 * np.exp(t) * np.sin(20 * t)], [0.0, 0.0]),
        "of b",
    ),
    "it is fast": (lambda t: ([0.0, 0.0], [0.0, -2.0]), "measured velocity of b"),
    "it is not finite": (lambda t: ([np.nan, 0.0], [0.0, 0.0]), "measured position of a"),
    "it falls silent": (
        lambda t: None if t > 0.5 else ([0.0, 0.0], [0.0, 0.0]),
        "joint states: none came for 0.5 s",
    ),
}


@pytest.mark.parametrize("what", RUNAWAYS)
@pytest.mark.parametrize("speeds", [True, False])
def test_the_measurement_stops_at_its_bounds_whatever_the_arm_does(what, speeds):
    does, message = RUNAWAYS[what]
    if what == "it is fast" and not speeds:
        does = lambda t: ([0.0, 0.14 * np.sin(20 * t)], [0.0, 0.0])  # noqa: E731
    arm = Standing(after=does, speeds=speeds)
    motion = design(STEP, [0, 1], 2, BOUNDS)
    with pytest.raises(FlexarmError, match=message):
        measure(arm, motion, BOUNDS)
    assert (arm.sent, arm.stops) == (1, 1)
    assert arm.clock < arm.begin + motion.duration


def test_an_arm_that_moves_already_is_not_moved():
    arm = Standing(before=lambda t: (t, np.array([0.0, 0.02 * t]), None))
    with pytest.raises(FlexarmError, match=r"joint b: .*moves already"):
        measure(arm, design(STEP, [0], 2, BOUNDS), BOUNDS)
    assert arm.sent == 0


def test_an_interrupt_stops_the_arm():
    def interrupted(t):
        if t > 0.3:
            raise KeyboardInterrupt
        return [0.0, 0.0], [0.0, 0.0]

    arm = Standing(after=interrupted)
    with pytest.raises(KeyboardInterrupt):
        measure(arm, design(STEP, [0], 2, BOUNDS), BOUNDS)
    assert arm.stops == 1


def test_an_arm_that_keeps_its_bounds_is_watched_to_the_end_of_the_rest():
    arm, motion = Standing(), design(STEP, [0], 2, BOUNDS)
    measure(arm, motion, BOUNDS)
    assert arm.stops == 0 and arm.clock >= arm.begin + motion.duration
