# SPDX-License-Identifier: Apache-2.0
"""Modes from free ringing and from sweeps: frequencies, damping and their intervals, against signals that are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.signal import chirp, lfilter, lsim, lti

from flexarm_studies.resonance import fit as fits

#: Natural frequency [Hz] and damping of the modes, and rows per second.
MODES, RATE = ((2.1, 0.01), (5.3, 0.02), (11.7, 0.03)), 200.0


def ringing(rng, seconds=6.0, noise=0.1, memory=0.0, modes=MODES):
    """Free ringing in two channels, with an offset, a drift, and noise of so much of its rms."""
    time = np.arange(int(seconds * RATE)) / RATE
    out = np.zeros((time.size, 2))
    for hertz, damping in modes:
        omega = 2.0 * np.pi * hertz
        for channel in out.T:
            phase = omega * np.sqrt(1.0 - damping**2) * time + rng.uniform(0.0, 6.28)
            channel += rng.uniform(0.4, 1.0) * np.exp(-damping * omega * time) * np.cos(phase)
    rest = lfilter([1.0], [1.0, -memory], rng.standard_normal(out.shape), axis=0)
    return out + noise * out.std(axis=0) * rest / rest.std(axis=0) + 0.3 + 0.02 * time[:, None]


def swept(rng, seconds=15.0):
    """A base that is swept, and what two channels read of the modes and of the base itself."""
    time = np.arange(int(seconds * RATE)) / RATE
    fade = np.sqrt(np.sin(np.pi * np.clip(time / 8.0, 0.0, 1.0)))
    base = np.where(time < 8.0, fade * chirp(time, 1.0, 8.0, 16.0, "logarithmic"), 0.0)
    out = np.outer(base, [0.1, -0.1])
    for hertz, damping in MODES:
        omega = 2.0 * np.pi * hertz
        mode = lsim(lti([omega], [1.0, 2.0 * damping * omega, omega**2]), base, time)[1]
        out += np.outer(mode, rng.uniform(0.4, 1.0, 2) * rng.choice([-1.0, 1.0], 2))
    return out + 0.1 * out.std(axis=0) * rng.standard_normal(out.shape), base[:, None]


def check(made, modes=MODES):
    """Frequencies within 1 %, damping within 20 %; how far off each is, over its interval."""
    assert len(made.modes) == len(modes)
    off = []
    for mode, (hertz, damping) in zip(made.modes, modes, strict=True):
        assert mode.frequency == pytest.approx(hertz, rel=0.01)
        assert mode.damping == pytest.approx(damping, rel=0.2)
        off.append((mode.frequency - hertz) / mode.frequency_width)
        off.append((mode.damping - damping) / mode.damping_width)
    return np.abs(off)


@pytest.mark.long
def test_three_modes_under_a_tenth_of_noise_are_found_with_intervals_that_hold():
    off = [check(fits.fit(ringing(np.random.default_rng(s)), 1.0 / RATE)) for s in range(8)]
    assert np.mean(np.array(off) < 1.0) > 0.85  # of 48; 95 % are meant
    assert np.mean(np.array(off) < 0.25) < 0.5  # and they are not too wide


def test_coloured_noise_widens_the_intervals_where_it_is_loud():
    modes = MODES[:2]
    white, red = (
        fits.fit(ringing(np.random.default_rng(3), memory=m, modes=modes), 1.0 / RATE)
        for m in (0.0, 0.95)
    )
    check(red, modes)
    ratio = [
        r.frequency_width / w.frequency_width for r, w in zip(red.modes, white.modes, strict=True)
    ]
    assert ratio[0] > 1.5 and ratio[0] > 1.5 * ratio[1]


@pytest.mark.long
def test_a_sweep_gives_the_same_modes():
    for seed in range(2):
        values, base = swept(np.random.default_rng(seed))
        check(fits.fit(values, 1.0 / RATE, 0.8, 20.0, motion=base))


def test_without_noise_the_fit_is_exact():
    made = fits.fit(ringing(np.random.default_rng(0), noise=0.0), 1.0 / RATE)
    for mode, (hertz, damping) in zip(made.modes, MODES, strict=True):
        assert mode.frequency == pytest.approx(hertz, rel=1e-6)
        assert mode.damping == pytest.approx(damping, rel=1e-4)
    assert made.explained.min() > 1.0 - 1e-8


def test_amplitudes_are_those_of_the_first_sample_whatever_is_averaged():
    time = np.arange(4000) / 1000.0
    omega = 2.0 * np.pi * 25.0
    made = fits.fit(
        0.7 * np.exp(-0.01 * omega * time)[:, None] * np.cos(omega * time)[:, None], 0.001
    )
    assert made.time[1] > 0.005  # samples were averaged
    assert made.modes[0].amplitude == pytest.approx([0.7], rel=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_noise_alone_has_no_modes(seed):
    rng = np.random.default_rng(seed)
    for memory in (0.0, 0.9):
        made = fits.fit(
            lfilter([1.0], [1.0, -memory], rng.standard_normal((800, 2)), axis=0), 1.0 / RATE
        )
        assert made.explained.max(initial=0.0) < 0.5


@pytest.mark.parametrize(
    "values", [np.zeros((0, 2)), np.zeros((3, 1)), np.ones((400, 2)), np.arange(400.0)[:, None]]
)
def test_what_does_not_ring_has_no_modes(values):
    assert fits.fit(values, 0.01).modes == ()


def test_a_silent_channel_beside_one_that_rings_does_no_harm():
    values = ringing(np.random.default_rng(1))
    values[:, 1] = 4.0
    check(fits.fit(values, 1.0 / RATE))


@settings(max_examples=40, deadline=None)
@given(
    arrays(
        float, st.tuples(st.integers(0, 60), st.integers(1, 3)), elements=st.floats(-1e150, 1e150)
    ),
    st.floats(1e-4, 10.0),
)
def test_any_finite_numbers_are_fitted_or_have_no_modes(values, period):
    made = fits.fit(values, period)
    assert all(np.isfinite([m.frequency, m.damping, m.frequency_width]).all() for m in made.modes)
    assert made.fitted.shape == made.measured.shape
