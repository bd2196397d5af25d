# SPDX-License-Identifier: Apache-2.0
"""The measured delay of the loop: a known one is found, and what shows none is left out."""

import numpy as np
import pytest

from flexarm_control.loop.torque_delay import BLOCK, LAGS, TorqueDelay

H = 1e-3


def measured(torques, delay, noise=0.0, skip=()):
    """A `TorqueDelay` after a driver whose torque, of these (samples, n) [N m], acts after so many periods.

    The samples to skip are lost: the torque before them goes on.
    """
    meter, draw = TorqueDelay(torques.shape[1]), np.random.default_rng(5)
    whole, part = divmod(delay, 1.0)
    acting, last = torques.copy(), 0
    for j, torque in enumerate(torques):
        if j in skip:
            acting[j] = acting[j - 1]
            continue
        at = [max(j - 1 - int(whole) - late, 0) for late in (0, 1)]
        mean = (1.0 - part) * acting[at[0]] + part * acting[at[1]]
        meter.add(mean + noise * draw.standard_normal(mean.shape), j - last, H)
        meter.note(torque)
        meter.judge()
        last = j
    return meter


def motion(samples, n=2):
    t = H * np.arange(samples)[:, None]
    return np.sin(2.0 * t + np.arange(n)) + 0.1 * np.sin(40.0 * t)


@pytest.mark.parametrize("delay", [0.0, 0.3, 1.0, 2.5, 7.0, LAGS - 0.5])
def test_a_known_delay_is_found_to_the_digit(delay):
    meter = measured(motion(400), delay)
    assert meter.count > 10
    assert meter.delay == pytest.approx(H * delay, abs=1e-9)


def test_a_drive_that_measures_its_torque_with_noise_shows_the_delay_all_the_same():
    draw = np.random.default_rng(1)
    torques = motion(2000) + 0.05 * draw.standard_normal((2000, 2))
    assert measured(torques, 2.5, noise=0.01).delay == pytest.approx(2.5 * H, abs=0.15 * H)


@pytest.mark.parametrize(
    ("torques", "delay"),
    [
        (np.ones((400, 1)), 2.0),  # changes by nothing
        (np.full((400, 1), np.nan), 2.0),  # unknown
        (motion(400), LAGS + 10.0),  # longer than what is looked for
        (motion(LAGS + BLOCK), 1.0),  # too short a time
    ],
)
def test_what_shows_no_delay_is_left_out(torques, delay):
    meter = measured(torques, delay)
    assert meter.count == 0 and np.isnan(meter.delay)


@pytest.mark.parametrize(("every", "off"), [(2, 0.5), (3, 1e-6), (40, 1e-6)])
def test_samples_may_be_lost(every, off):
    # Of every second one: a torque that is held for two periods does not show which of them it is in.
    meter = measured(motion(2000), 4.5, skip=range(20, 2000, every))
    assert meter.count > 5 and meter.delay == pytest.approx(4.5 * H, abs=1.001 * off * H)


def test_a_block_that_lasts_longer_than_what_is_remembered_is_left_out():
    kept = range(20, 2000, 10)
    assert measured(motion(2000), 1.0, skip=set(range(20, 2000)) - set(kept)).count == 0


def test_a_delay_that_jumps_between_two_periods_is_their_mean():
    meter, torques = TorqueDelay(2), motion(400)
    for j, torque in enumerate(torques):
        meter.add(torques[max(j - 2 - j % 2, 0)], 1, H)
        meter.note(torque)
        meter.judge()
    assert meter.delay == pytest.approx(1.5 * H, abs=0.1 * H)


@pytest.mark.parametrize(
    "interrupt", [lambda m: m.begin(), lambda m: m.add(np.ones(1), 1, 2.0 * H)]
)
def test_an_interruption_and_another_period_begin_the_measurement_anew(interrupt):
    meter, torques = TorqueDelay(1), motion(400, 1)
    for j, torque in enumerate(torques):
        if j == 200:
            found = meter.count
            interrupt(meter)
        meter.add(torques[max(j - 2, 0)], 1, H)  # a period late
        meter.note(torque)
        meter.judge()
        if 200 <= j < 200 + LAGS:
            assert meter.count == found > 5
    assert meter.count > found + 5 and meter.delay == pytest.approx(H, abs=1e-9)


# --------------------------------------------------------------------------- the delay that the control uses


def noisy(samples, size=0.05):
    return 3.0 + size * np.random.default_rng(2).standard_normal((samples, 1))


@pytest.mark.parametrize("delay", [0.0, 1.0, 1.5])
def test_a_torque_that_changes_by_noise_alone_shows_the_delay(delay):
    assert measured(noisy(200), delay).known == pytest.approx(H * delay, abs=1e-9)
    assert measured(noisy(200), delay, noise=0.005).known == pytest.approx(H * delay, abs=0.2 * H)
    assert np.isnan(measured(noisy(80), delay).known)  # of too few blocks


@pytest.mark.parametrize(
    "report",
    [
        lambda u: np.zeros_like(u),
        lambda u: np.round(u),  # coarse steps
        lambda u: 1.0 + 0.3 * np.random.default_rng(3).standard_normal(u.shape),
    ],
)
def test_reports_that_are_not_those_of_the_torque_sent_show_nothing(report):
    meter, torques = TorqueDelay(1), noisy(3000)
    reports = report(torques)
    for torque, now in zip(torques, reports, strict=True):
        meter.add(now, 1, H)
        meter.note(torque)
        meter.judge()
    assert np.isnan(meter.known)


def test_an_offset_of_the_reports_does_not_count_and_with_a_gain_only_much_change_shows_the_delay():
    smooth, rough = np.sin(2.0 * H * np.arange(2000)[:, None]), noisy(2000)
    for torques, gain, offset in ((smooth, 1.01, 0.0), (rough, 1.01, 0.0), (rough, 1.0, 0.5)):
        meter = TorqueDelay(1)
        for j, torque in enumerate(torques):
            meter.add(gain * torques[max(j - 3, 0)] + offset, 1, H)  # two periods late
            meter.note(torque)
            meter.judge()
        if torques is smooth:
            assert np.isnan(meter.known)
        else:
            assert meter.known == pytest.approx(2.0 * H, abs=0.05 * H)
