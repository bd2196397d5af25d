# SPDX-License-Identifier: Apache-2.0
"""Damping by strain through positions: on a plant in closed form, off-frequency, and with sensors that fail."""

import cmath
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexarm_control.shaping.strain_damping import (
    ACTIVE,
    FADING,
    OFF,
    PARAMETERS,
    StrainDamping,
    burst,
    identified,
    moved,
    pole,
)
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.parameters import check_all

T, F, RATIO, C, LATE = 0.008, 3.0, 0.01, -2e-3, 2
W = 2.0 * math.pi * F


class Link:
    """The mode of eta'' + 2 zeta w eta' + w^2 eta = -c q'', with q the command of `late` periods before."""

    def __init__(self, factor=1.0, bent=0.0, bias=0.0, late=LATE):
        self.p, self.bias, self.z = pole(F * factor, RATIO), bias, complex(bent)
        self.queue = [0.0] * late

    @property
    def strain(self):
        """The reading now."""
        return self.z.real + self.bias

    def command(self, u):
        """Take a command, and move on by a period."""
        self.queue.append(u)
        self.z = moved(self.z, self.p, answer(self.p), self.queue.pop(0), T)


def answer(p):
    """-i c w: eta'' = -c q'' at the frequency of the mode."""
    return -1j * C * abs(p)


def settings(late=LATE, **changes):
    beta = answer(pole(F, RATIO)) * cmath.exp(-1j * W * late * T)
    known = {"frequency": F, "damping": RATIO, "sensitivity": abs(beta)}
    return check_all(PARAMETERS, {**known, "phase": cmath.phase(beta), **changes})


def run(law, link, seconds, reading=lambda now, strain: (strain,), start=0.0):
    """Amplitudes of the mode and corrections, period by period."""
    amplitudes, corrections = [], []
    for k in range(int(seconds / T)):
        now = start + k * T
        corrections.append(law.update(now, *reading(now, link.strain)))
        link.command(corrections[-1])
        amplitudes.append(abs(link.z))
    return np.array(amplitudes), np.array(corrections)


def test_the_burst_finds_the_answer_of_the_closed_form():
    sent = np.append(burst(F, 0.01, T), np.zeros(300))
    link, readings = Link(bias=3e-4), []
    for u in sent:
        readings.append(link.strain)
        link.command(u)
    beta, left = identified(F, RATIO, T, sent, readings)
    wanted = answer(pole(F, RATIO)) * cmath.exp(-pole(F, RATIO) * LATE * T)
    assert beta == pytest.approx(wanted, rel=1e-9)
    assert left < 1e-9
    assert abs(beta) == pytest.approx(abs(C) * W, rel=0.02)
    lag = (math.pi / 2.0 - cmath.phase(beta)) / W
    assert lag == pytest.approx(LATE * T, rel=1e-3)


def test_strain_in_proportion_to_joint_acceleration_answers_so():
    fine, steps = 1e-4, 60000
    sent = burst(F, 0.01, fine)
    q = np.append(sent, np.zeros(steps - sent.size))
    eta, rate, readings = 0.0, 0.0, []
    acceleration = np.gradient(np.gradient(q, fine), fine)
    for a in acceleration:
        readings.append(eta)
        rate += fine * (-2.0 * RATIO * W * rate - W**2 * eta - C * a)
        eta += fine * rate
    beta, left = identified(F, RATIO, fine, q, readings)
    assert left < 0.02
    assert beta == pytest.approx(answer(pole(F, RATIO)), rel=0.03)


@pytest.mark.parametrize("factor", [0.85, 1.0, 1.15])
def test_a_push_decays_as_wanted_also_with_the_frequency_off(factor):
    law = StrainDamping(settings(observer=1.0, target=0.1), T)
    law.update(-T, 0.0)
    amplitudes, _ = run(law, Link(factor, bent=1e-4), 3.0)
    first, last = 40, 120
    decay = -math.log(amplitudes[last] / amplitudes[first]) / ((last - first) * T * W)
    assert decay == pytest.approx(0.1, rel=0.25 if factor == 1.0 else 0.4)
    assert decay > 5.0 * RATIO
    assert law.radius(factor) < 1.0


@pytest.mark.parametrize("late", [0, 8])
@pytest.mark.parametrize("factor", [0.85, 1.0, 1.15])
def test_the_eigenvalues_are_those_of_the_loop_that_runs(late, factor):
    given = settings(late, observer=0.3, target=0.05)
    law = StrainDamping(given, T)
    law.update(-T, 0.0)
    amplitudes, _ = run(law, Link(factor, bent=1e-4, late=late), 6.0)
    per_period = (amplitudes[700] / amplitudes[300]) ** (1.0 / 400.0)
    assert law.radius(factor) == pytest.approx(per_period, abs=4e-4)


def test_a_phase_that_is_wrong_with_a_frequency_off_is_refused():
    with pytest.raises(DesignError, match="frequency"):
        StrainDamping(settings(target=0.5, observer=2.0), 0.05)
    with pytest.raises(DesignError, match="no more than the mode has"):
        StrainDamping(settings(target=0.02, damping=0.02), T)


def test_the_bias_makes_no_correction():
    law = StrainDamping(settings(), T)
    _, corrections = run(law, Link(bias=5e-3), 1.0)
    assert np.abs(corrections).max() == 0.0
    # A bias that jumps later: for a moment only.
    _, corrections = run(law, Link(bias=5.2e-3), 4.0, start=1.0)
    assert 0.0 < np.abs(corrections).max() <= 0.02
    assert np.abs(corrections[-20:]).max() < 1e-5


@pytest.mark.parametrize(
    ("reading", "reason"),
    [
        (lambda now, strain: (), "silent"),
        (lambda now, strain: (math.nan,), "not finite"),
        (lambda now, strain: (math.inf,), "not finite"),
        (lambda now, strain: (0.5,), "full scale"),
        (lambda now, strain: (strain, now - 1.0), "not of now"),
        (lambda now, strain: (strain, now + 1.0), "not of now"),
        (lambda now, strain: (strain, math.nan), "not of now"),
        (lambda now, strain: (strain, 0.496), "not a new one|not of now"),
    ],
)
def test_a_sensor_in_doubt_fades_the_correction_out_and_it_comes_back(reading, reason):
    given = settings(target=0.03)
    law, link = StrainDamping(given, T), Link(bent=1e-3)
    law.update(-T, 0.0)
    run(law, link, 0.5)
    assert law.state == ACTIVE
    _, gone = run(law, link, 0.04, reading, start=0.504)
    assert law.state == ACTIVE
    _, more = run(law, link, 0.15, reading, start=0.544)
    assert law.state == FADING
    _, off = run(law, link, 0.3, reading, start=0.696)
    assert law.state == OFF
    assert law.reason
    assert re.search(reason, law.reason)
    assert off[-1] == 0.0
    steps = np.abs(np.diff(np.concatenate([gone, more, off])))
    assert steps.max() <= given["max_rate"] * T * (1.0 + 1e-9)
    before = abs(link.z)
    run(law, link, 0.9, start=1.0)
    assert law.state == OFF
    run(law, link, 1.5, start=1.904)
    assert law.state == ACTIVE
    assert law.reason == ""
    assert abs(link.z) < 0.7 * before


def test_a_sensor_at_half_the_rate_damps_and_comes_back():
    law, link = StrainDamping(settings(target=0.1), T), Link(bent=1e-3)
    law.update(-T, 0.0)

    def every_second(now, strain):
        return (strain,) if round(now / T) % 2 else ()

    run(law, link, 0.5, lambda now, strain: ())
    assert law.state == OFF
    amplitudes, _ = run(law, link, 4.0, every_second, start=0.504)
    assert law.state == ACTIVE
    assert amplitudes[-1] < 0.02 * amplitudes[0]
    # A reading counts for the time since the one before.
    half, slow = StrainDamping(settings(), T), StrainDamping(settings(), 2.0 * T)
    for law in (half, slow):
        law.update(0.0, 0.0)
    half.update(T)
    wanted = slow.update(2.0 * T, 1e-5)
    assert wanted != 0.0
    assert half.update(2.0 * T, 1e-5) == pytest.approx(wanted, rel=1e-9)


def test_a_clock_that_goes_back_is_followed():
    law, link = StrainDamping(settings(target=0.1), T), Link(bent=1e-3)
    law.update(100.0 - T, 0.0)
    run(law, link, 0.2, start=100.0)
    amplitudes, _ = run(law, link, 2.0)
    assert law.state == ACTIVE
    assert amplitudes[-1] < 0.15 * amplitudes[0]


def test_a_sensor_that_sticks_makes_no_lasting_correction():
    law, link = StrainDamping(settings(), T), Link(bent=1e-3)
    law.update(-T, 0.0)
    run(law, link, 0.1)
    stuck = link.strain
    _, corrections = run(law, link, 4.0, lambda now, strain: (stuck,), start=0.104)
    assert np.abs(corrections[-20:]).max() < 1e-2 * np.abs(corrections).max()


def test_at_its_bounds_the_correction_still_damps():
    given = settings(max_correction=4e-3, max_rate=0.05)
    law, link = StrainDamping(given, T), Link(bent=1e-3)
    law.update(-T, 0.0)
    amplitudes, corrections = run(law, link, 8.0)
    assert not law.latched
    # The rate is the tighter bound here: 0.05 / (2 pi 3) = 2.7e-3.
    assert np.abs(corrections).max() == pytest.approx(0.05 / W, rel=0.02)
    assert np.abs(np.diff(corrections)).max() <= 0.05 * T * (1.0 + 1e-9)
    free = 1e-3 * math.exp(-RATIO * W * 8.0)
    assert amplitudes[-1] < 0.5 * free


def test_with_the_sign_wrong_it_switches_off_for_good_until_the_next_start():
    law, link = StrainDamping(settings(max_correction=1e-3), T), Link(bent=1e-4)
    law.update(-T, 0.0)
    _, corrections = run(law, link, 12.0, lambda now, strain: (-strain,))
    assert law.latched
    assert law.state == OFF
    assert "sign" in law.reason
    assert corrections[-1] == 0.0
    assert np.abs(corrections).max() <= 1e-3
    law.begin()
    assert (law.state, law.reason) == (ACTIVE, "")


@given(
    st.lists(
        st.tuples(
            st.floats(0.0, 0.3),
            st.none() | st.floats(allow_nan=True, allow_infinity=True),
            st.none() | st.floats(allow_nan=True, allow_infinity=True),
        ),
        max_size=40,
    )
)
def test_whatever_comes_the_correction_is_finite_and_bounded(inputs):
    given_ = settings()
    law, now, before = StrainDamping(given_, T), 0.0, 0.0
    for step, strain, stamp in inputs:
        now += step
        out = law.update(now, strain, stamp)
        assert abs(out) <= given_["max_correction"] * (1.0 + 1e-12)
        assert abs(out - before) <= given_["max_rate"] * step + 1e-12
        before = out


@pytest.mark.parametrize(
    ("corrections", "readings", "match"),
    [
        ([0.0, 1.0, 0.0], [0.0, 0.0], "readings"),
        (np.zeros(100), np.zeros(100), "do not move"),
        (np.append([0.0, 1.0], np.zeros(10)), np.zeros(12), "too short"),
    ],
)
def test_records_that_say_nothing_are_refused(corrections, readings, match):
    with pytest.raises(DesignError, match=match):
        identified(F, RATIO, T, corrections, readings)


class Tip(Link):
    """The same mode seen by an accelerometer, which moves with the joint as well: eta'' and q'' times a reach."""

    #: Over the answer of the mode to the joint's acceleration [-]: a tip's is about 1.
    REACH = 1.0

    def __init__(self, **others):
        super().__init__(**others)
        self.sent = [0.0] * 3

    @property
    def strain(self):
        """The reading, an acceleration: that of the mode is -w^2 times what bends."""
        joint = (self.sent[-1] - 2.0 * self.sent[-2] + self.sent[-3]) / T**2
        return -(self.z * abs(self.p) ** 2).real + abs(C) * self.REACH * joint + self.bias

    def command(self, u):
        self.sent.append(u)
        super().command(u)


@pytest.mark.parametrize("factor", [0.85, 1.0, 1.15])
def test_a_push_is_damped_by_an_accelerometer_whose_answer_a_burst_finds(factor):
    sent = np.append(burst(F, 0.01, T), np.zeros(300))
    link, readings = Tip(bias=9.81), []
    for u in sent:
        readings.append(link.strain)
        link.command(u)
    beta, left = identified(F, RATIO, T, sent, readings)
    assert left < 1e-6
    assert abs(beta) == pytest.approx(abs(C) * W**3, rel=0.02)
    found = {"sensitivity": abs(beta), "phase": cmath.phase(beta), "full_scale": 40.0}
    given = check_all(PARAMETERS, {"frequency": F, "damping": RATIO, "target": 0.1, **found})
    law = StrainDamping(given, T)
    law.update(-T, 9.81)
    amplitudes, _ = run(law, Tip(factor=factor, bent=1e-4, bias=9.81), 2.0)
    decay = -math.log(amplitudes[120] / amplitudes[40]) / (80 * T * W)
    assert decay == pytest.approx(0.1, rel=0.3 if factor == 1.0 else 0.5)
