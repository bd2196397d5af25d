# SPDX-License-Identifier: Apache-2.0
"""Motions that are made again and again: what a sensor sees after them corrects their time law."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from flexarm_control.shaping import modes as modes_module
from flexarm_control.shaping import trials as trials_module
from flexarm_control.shaping.modes import Modes
from flexarm_control.shaping.piecewise import PiecewiseMotion
from flexarm_control.shaping.trials import Ringing, Trials
from flexarm_dynamics.errors import DesignError, MessageError
from flexarm_dynamics.parameters import check_all

END = np.array([2.0, -1.0])
#: The plant: two modes, coupled by a spring that acts half-way only, which no measurement at the three places shows.
STIFFNESS, COUPLING, DAMPING = np.array([90.0, 220.0]), 60.0, 0.6
SENSOR = np.array([[1.0, 0.3], [-0.4, 0.8]])


def to_end(span, part=1.0):
    """A trapezoid of speed from rest to rest at `END`, over a part of the way."""
    way, ramp = part * END, span / 3.0
    speed = way / (span - ramp)
    done = 0.5 * ramp * speed
    start = END - way
    states = [np.stack([start, start + done, END - done, END])]
    states.append(np.stack([0 * way, speed, speed, 0 * way]))
    return PiecewiseMotion.through(np.array([0.0, ramp, span - ramp, span]), states)


def seen_after(motion):
    """Times from the end of a motion on, and what two sensors read of the plant then."""

    def rates(t, y):
        x, v = y[:2], y[2:]
        place = motion.position(np.array([t]))[0, 0] / END[0]
        k = STIFFNESS * (1.0 - 0.4 * np.sin(np.pi * place))
        c = COUPLING * np.sin(np.pi * place) ** 2
        bend = motion.acceleration(np.array([t]))[0, 0] * np.array([1.0, 0.7])
        return np.concatenate([v, -k * x - c * x[::-1] - DAMPING * v - bend])

    last = motion.knots[-1]
    times = last + np.arange(0.0, 1.6, 0.004)
    found = solve_ivp(rates, (0.0, times[-1]), np.zeros(4), t_eval=times, max_step=0.01, rtol=1e-7)
    return times - last, found.y[:2].T @ SENSOR


def known(off=1.0):
    """Modes at start, middle and end, as if there were no coupling."""
    w = np.sqrt(STIFFNESS * np.array([[1.0], [0.6], [1.0]]))
    settings = {
        "type": modes_module.RETIMED,
        "frequencies": (off * w / (2.0 * np.pi)).ravel().tolist(),
        "dampings": (0.5 * DAMPING / w).ravel().tolist(),
        "configurations": np.concatenate([0.0 * END, 0.5 * END, END]).tolist(),
    }
    return Modes(check_all(modes_module.PARAMETERS, settings), 2)


def ringing():
    w = np.sqrt(STIFFNESS)
    return Ringing(w / (2.0 * np.pi), 0.5 * DAMPING / w)


def swing(readings):
    return float(np.linalg.norm(np.ptp(readings, axis=0)))


def trials(off=1.0):
    given, small = to_end(1.4), to_end(0.4, 0.02)
    answer = ringing().answer(small, given, *seen_after(small))
    return given, Trials(given, known(off), ringing(), answer)


@pytest.mark.parametrize("off", [1.0, 0.85])
def test_what_the_measured_modes_miss_is_taken_out_in_a_few_trials_within_speed_and_acceleration(
    off,
):
    given, own = trials(off)
    unshaped, left = swing(seen_after(given)[1]), []
    for _ in range(5):
        times, readings = seen_after(own.motion)
        left.append(swing(readings) / unshaped)
        own.took(times, readings, left[-1])
    assert left[0] > 0.03
    assert own.least == min(left) < 0.2 * left[0]
    t = np.linspace(0.0, own.best.duration, 3001)
    p, v, a = own.best.states(t)
    assert np.abs(p[:, 1] + 0.5 * p[:, 0]).max() < 1e-9
    assert list(own.best.end) == list(END)
    before = given.states(np.linspace(0.0, 1.4, 3001))
    for values, limit in ((v, before[1]), (a, before[2])):
        assert np.abs(values).max() <= np.abs(limit).max() * (1.0 + 1e-4)


def test_a_trial_that_swings_more_is_not_followed_and_changes_get_smaller():
    _, own = trials()
    first = own.motion
    own.took(*seen_after(first), 1.0)
    own.took(*seen_after(own.motion), 2.0)  # as if it had been hit meanwhile
    assert own.best is first and own.least == 1.0
    t = np.linspace(0.0, first.duration, 3001)
    change = np.abs(own.motion.acceleration(t) - first.acceleration(t)).max()
    largest = np.abs(to_end(1.4).acceleration(np.linspace(0.0, 1.4, 3001))).max()
    assert 0.0 < change <= 1.05 * trials_module.LESS * trials_module.CHANGE * largest


def test_readings_that_can_not_be_used_change_nothing():
    _, own = trials()
    before = own.motion
    times, readings = seen_after(before)
    bad = readings.copy()
    bad[5, 1] = np.nan
    for given, problem in (((times, bad), "not finite"), ((times[:40], readings[:40]), "too few")):
        with pytest.raises(MessageError, match=problem):
            own.took(*given, 1.0)
    assert own.motion is before and own.least == np.inf


def test_a_motion_without_a_time_law_or_with_other_modes_is_refused():
    given, small = to_end(1.4), to_end(0.4, 0.02)
    answer = ringing().answer(small, given, *seen_after(small))
    with pytest.raises(DesignError, match="1 modes ring at the end, 2 are known"):
        Trials(given, known(), Ringing([1.5], [0.02]), answer[:1])
    unknown_speeds = PiecewiseMotion.through(given.knots, [given.position(given.knots)])
    with pytest.raises(DesignError, match="no time law"):
        Trials(unknown_speeds, known(), ringing(), answer)
