# SPDX-License-Identifier: Apache-2.0
"""What the checks of the readings find in strains and positions that are computed, not simulated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.plausibility.agreement import Agreement
from flexarm_control.observers.plausibility.amplitudes import SourceAmplitudes
from flexarm_control.observers.plausibility.channels import Channels, mean_accelerations
from flexarm_control.observers.plausibility.jumps import Jumps
from flexarm_control.observers.plausibility.low_pass import LowPass
from flexarm_control.observers.plausibility.monitor import Monitor
from flexarm_control.observers.plausibility.standstill import Standstill
from flexarm_control.observers.plausibility.strain_law import StrainLaw
from flexarm_control.observers.plausibility.zero_drift import CORRECTED, SLOW
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Friction, scaled
from flexarm_dynamics.arm.strain_map import StrainMap, gauge_rows
from flexarm_dynamics.linear import linear_plant, sampled
from flexarm_dynamics.models import model as models

PERIOD = 1e-3  # [s]
NOISE = 5e-7  # [-] of a gauge
COUNTS = 65536  # of the encoder, per turn


def known_arm():
    """Arm R with a stated noise of its sensors."""
    arm = arm_file.load("R")
    return replace(
        arm,
        gauges=tuple(replace(g, noise=NOISE) for g in arm.gauges),
        joints=tuple(replace(j, encoder_counts=COUNTS) for j in arm.joints),
    )


def readings(arm, seconds, speed=3.0, amplitude=0.15, swing=0.0, seed=0):
    """Position (k, 1) and strains (k, 2) of an arm whose joint swings: the exact answer of its links.

    Parameters
    ----------
    arm : Arm
    seconds, speed, amplitude : float
        Duration [s], angular frequency [rad/s] and amplitude of the joint [rad].
    swing : float
        Of the first mode, free at its own frequency with the joint held [m].
    """
    m = models.build(arm)
    terms, t = m.terms(np.zeros(1), np.zeros(1)), PERIOD * np.arange(round(seconds / PERIOD))
    q = amplitude * np.sin(speed * t)
    M, K = terms.M[1:, 1:], terms.K2
    delta = np.outer(np.sin(speed * t), np.linalg.solve(K - speed**2 * M, terms.M[1:, 0]))
    delta *= speed**2 * amplitude
    squares, shapes = np.linalg.eig(np.linalg.solve(M, K))
    first = int(np.argmin(squares))
    delta += swing * np.outer(np.cos(np.sqrt(squares[first]) * t), shapes[:, first])
    random, count = np.random.default_rng(seed), 2.0 * np.pi / COUNTS
    strain = delta @ StrainMap(m).rows.T + NOISE * random.standard_normal((t.size, 2))
    return count * np.round(q / count)[:, None], strain


class Judged:
    """The law of R's strains, fed with readings whose `noise` was seen; what it found first."""

    def __init__(self, change, plant=None, begin=1.0, seconds=3.0, noise=0.0, **motion):
        m = models.build(known_arm())
        self.map = StrainMap(m)
        self.law = StrainLaw(Channels(m, self.map), self.map, 0.3)
        self.drifting = self.wiring = None
        position, strain = readings(plant or known_arm(), seconds, **motion)
        for k, (q, e) in enumerate(zip(position, strain, strict=True)):
            since = PERIOD * k - begin
            if since >= 0.0:
                q, e = change(q.copy(), e.copy(), since)
            _, wiring = self.law.update(q, e, np.zeros(1), PERIOD, np.full(2, noise))
            drift = self.law.drift
            if drift.found.size and self.drifting is None:
                self.drifting = since, drift.found.tolist(), drift.joint(self.law.drive)
                drift.doubted[drift.found] = True
            if wiring is not None and self.wiring is None:
                self.wiring = since, self.law.hypotheses[wiring][0]


def honest(q, e, t):
    return q, e


def drifts(rate):
    def change(q, e, t):
        return q, e + np.array([rate * t, 0.0])

    return change


# --------------------------------------------------------------------------- low pass


def test_the_second_derivative_of_the_low_pass_is_exact_for_uneven_steps():
    """A parabola: its second derivative is 2 a, and the signal is late by three time constants."""
    low, random, t = LowPass(2, 40.0), np.random.default_rng(0), 0.0
    low.start(np.zeros(2))
    for _ in range(3000):
        dt = random.uniform(1e-4, 1e-3)
        t += dt
        low.update(np.array([3.0 * t, 5.0]), dt)
    np.testing.assert_allclose(low.signal, [3.0 * (t - 3.0 / 40.0), 5.0], rtol=1e-8)
    np.testing.assert_allclose(low.second, 0.0, atol=1e-5)
    low.start(np.zeros(2))
    for k in range(2000):
        low.update(np.array([2.0 * (k * PERIOD) ** 2, 0.0]), PERIOD)
    assert low.second[0] == pytest.approx(4.0, rel=1e-6)


def test_signals_that_are_cleared_begin_at_zero():
    low = LowPass(2, 40.0)
    low.start(np.ones(2))
    low.clear(slice(1, 2))
    np.testing.assert_array_equal(low.signal, [1.0, 0.0])
    low.update(np.zeros(2), PERIOD)
    assert low.signal[0] > 0.9
    assert low.signal[1] == 0.0


def test_coriolis_forces_on_bending_links_are_part_of_the_law():
    """A second link, on a first one that bends while both turn fast; its own equation, integrated exactly."""
    text = arm_file.find("two_link").read_text().replace("inertia: 0.1", "inertia: 0.5")
    m = models.build(arm_file.parse(text.replace("EI_y: 1.0", "EI_y: 30.0")))
    n, map_, turn = m.n_joints, StrainMap(m), 4.0

    def motion(t):
        sine, cosine = np.sin(turn * t), np.cos(turn * t)
        return np.outer([sine, turn * cosine, -(turn**2) * sine], [1.0, 1.0])

    def derivative(t, state):
        q, qd, qdd = motion(t)
        now, (delta, rate) = m.terms(q, qd), state.reshape(2, -1)
        forces = now.M[n:, :n] @ qdd + now.f2 + now.C2 @ rate + now.K2 @ delta
        return np.concatenate([rate, -np.linalg.solve(now.M[n:, n:], forces)])

    t, start = PERIOD * np.arange(2500), np.zeros(2 * m.n_modes)
    first = m.terms(*motion(0.0)[:2])
    start[: m.n_modes] = -np.linalg.solve(first.K2, first.f2)
    found = solve_ivp(derivative, t[[0, -1]], start, "LSODA", t, rtol=1e-8, atol=1e-10)
    law = StrainLaw(Channels(m, map_), map_, 0.3)
    left, coriolis = np.zeros((2, len(m.arm.gauges)))
    for k, state in enumerate(found.y.T):
        q, qd, _ = motion(t[k])
        delta, rate = state.reshape(2, -1)
        law.update(q, map_.rows @ delta, qd, PERIOD, np.zeros(left.size))
        now = m.terms(q, qd)
        np.maximum(left, np.abs(law.drift.residual), out=left)
        forced = map_.rows @ np.linalg.solve(now.K2, now.C2 @ rate)
        np.maximum(coriolis, np.abs(forced), out=coriolis)
    assert coriolis[2] > 5e-6
    # The law's matrices are up to 40 ms old. Without these forces it would be 0.6.
    assert (left[2:] < 0.35 * coriolis[2:]).all()


# --------------------------------------------------------------------------- zero drift


@pytest.mark.parametrize("payload", [0.7, 1.0, 1.3])
def test_an_honest_arm_does_not_drift_with_another_payload(payload):
    judged = Judged(honest, scaled(known_arm(), payload), swing=2e-3)
    assert judged.drifting is None
    assert judged.wiring is None


def test_strains_fit_the_motion_to_less_than_half_of_their_noise():
    judged = Judged(honest, swing=2e-3)
    np.testing.assert_allclose(judged.law.drift.residual, 0.0, atol=0.4 * NOISE)


@pytest.mark.parametrize("rate", [1e-4, 2e-5])
@pytest.mark.parametrize("speed", [0.0, 3.0])
def test_a_gauge_that_drifts_is_found_in_the_time_that_is_stated(rate, speed):
    judged = Judged(drifts(rate), speed=speed)
    since, gauges, joint = judged.drifting
    drift = judged.law.drift
    assert gauges == [0]
    assert joint is None
    assert since <= (drift.bound[0] + NOISE) / rate + SLOW + 3.0 / judged.law.corner + 0.01


def test_what_a_drift_leaves_after_the_correction_is_its_rate_times_the_delay():
    rate = 1e-4
    judged = Judged(drifts(rate))
    left = rate * 2.0 - judged.law.drift.correction[0]
    assert left == pytest.approx(rate * (CORRECTED + 3.0 / judged.law.corner), abs=2.0 * NOISE)
    assert judged.law.drift.correction[1] == 0.0


def test_an_encoder_that_begins_to_drift_is_named_with_the_strains():
    def change(q, e, t):
        return q + 0.2 * t, e

    since, _, joint = Judged(change).drifting
    assert joint == 0
    assert since < 0.1


def test_a_gap_keeps_the_zero_and_forgets_the_motion():
    m = models.build(known_arm())
    map_ = StrainMap(m)
    law = StrainLaw(Channels(m, map_), map_, 0.3)
    zero = np.array([3e-5, 0.0])
    for _ in range(1000):
        law.update(np.zeros(1), zero, np.zeros(1), PERIOD, np.zeros(2))
    law.update(np.array([0.3]), zero, np.zeros(1), 0.05, np.zeros(2))
    for _ in range(1000):
        law.update(np.array([0.3]), zero, np.zeros(1), PERIOD, np.zeros(2))
    np.testing.assert_allclose(law.drift.residual, 0.0, atol=1e-12)
    assert not law.drift.found.size


# --------------------------------------------------------------------------- wiring


@pytest.mark.parametrize("begin", [0.75, 0.8, 1.5, 1.57, 1.65])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda q, e, t: (q, -e), "strain of root and middle has the wrong sign"),
        (lambda q, e, t: (q, e[::-1]), "strain of root and middle: the gauges are exchanged"),
    ],
)
def test_wrong_wiring_that_begins_where_strains_do_not_jump_is_named(change, words, begin):
    """The strains are small when it begins, so that no reading jumps."""
    since, found = Judged(change, begin=begin, speed=4.0).wiring
    assert found == words
    assert since < 0.3


def test_exchanged_gauges_are_named_although_what_they_read_fits_no_motion():
    """A free oscillation, read wrongly, moves more than the strains that are read."""
    motion = {"speed": 2.0, "amplitude": 0.2, "swing": 1e-3}
    since, found = Judged(lambda q, e, t: (q, e[::-1]), **motion).wiring
    assert "the gauges are exchanged" in found
    assert since < 0.3


def test_strains_that_are_small_beside_the_noise_that_was_seen_raise_no_question():
    """A recording of a real arm, whose file states no noise: gauges that read 5 microstrain and 3 of noise."""
    exchanged = {"change": lambda q, e, t: (q, e[::-1]), "speed": 4.0}
    assert "exchanged" in Judged(**exchanged, noise=1e-6).wiring[1]
    assert Judged(**exchanged, noise=1e-4).wiring is None


def test_an_arm_with_one_gauge_can_have_the_wrong_sign():
    """The only hypothesis has no other to be compared with."""
    text = arm_file.find("R").read_text().replace("modes: 2", "modes: 1")
    arm = arm_file.parse(text[: text.rindex("  - {name: middle")])
    assert wirings_of_a_swing(arm, lambda rows: -rows) == {None, 0}


def test_strains_that_are_too_large_are_no_exchanged_gauges():
    """Of a link with one mode, whose exchanged gauges make its amplitude smaller and do nothing else."""
    text = arm_file.find("R").read_text().replace("modes: 2", "modes: 1")
    arm = arm_file.parse(text.replace("position: 2.0", "position: 2.2"))

    def larger(rows):
        return rows * (rows @ rows) / (rows @ rows[::-1])

    assert wirings_of_a_swing(arm, larger) == {None}


def test_gauges_that_agree_with_each_other_would_not_if_they_were_exchanged():
    """Of a link with one mode, however well the exchanged readings' amplitude fits the motion."""
    text = arm_file.find("R").read_text().replace("modes: 2", "modes: 1")
    m = models.build(arm_file.parse(text))
    map_ = StrainMap(m)
    law, rows = StrainLaw(Channels(m, map_), map_, 0.3), map_.rows[:, 0]
    law.update(np.zeros(1), np.zeros(2), np.zeros(1), PERIOD, np.zeros(2))
    exchanged = next(h[2] for h in law.hypotheses if "exchanged" in h[0])
    still = np.zeros((3, len(law.hypotheses), 4, 2))

    def misfit(read):
        """Misfit of all hypotheses, whose readings at rest are `read`, to a motion that asks just their amplitude."""
        still[0] = read
        return law._fit(still, -np.tile(law._project @ read, (4, 1)))

    assert misfit(rows) == pytest.approx(0.0, abs=1e-20)
    swapped = exchanged @ rows
    alone = swapped - law._project @ swapped
    wanted = alone @ alone / (2.0 * ((law._project @ swapped) ** 2).sum())
    assert misfit(swapped) == pytest.approx(wanted)
    assert wanted > 0.1


def wirings_of_a_swing(arm, read):
    """What is found while an arm with one mode swings; `read` makes the readings of an amplitude from its strains."""
    m = models.build(arm)
    map_ = StrainMap(m)
    law, rows = StrainLaw(Channels(m, map_), map_, 0.3), map_.rows[:, 0]
    terms, found = m.terms(np.zeros(1), np.zeros(1)), set()
    gain = 9.0 / (terms.K2 - 9.0 * terms.M[1:, 1:])[0, 0] * terms.M[1, 0]
    for k in range(2000):
        swing = 0.2 * np.sin(3.0 * PERIOD * k)
        strain = read(rows) * gain * swing
        _, wiring = law.update(np.array([swing]), strain, np.zeros(1), PERIOD, np.zeros(rows.size))
        found.add(wiring)
    return found


# --------------------------------------------------------------------------- rates


def channels():
    m = models.build(known_arm())
    return Channels(m, StrainMap(m))


@pytest.mark.parametrize(("drift", "found"), [(0.1, True), (0.0, False)])
def test_a_position_that_drifts_beside_its_velocity_is_found_without_modal_rates(drift, found):
    """The modes' rates are unknown; the joint's windows go on."""
    c = channels()
    agreement, value = Agreement(c), np.zeros(c.size)
    value[c.rate] = np.nan
    evidence = []
    for k in range(400):
        t = PERIOD * k
        value[c.position], value[c.velocity] = 0.3 * t + drift * t, 0.3
        pairs = agreement.update(value.copy(), PERIOD, 0.0, np.zeros(1))
        evidence.extend([] if pairs is None else pairs.tolist())
    assert set(evidence) == ({0} if found else set())


def test_a_velocity_that_its_source_has_filtered_is_not_wrong():
    c = channels()
    agreement, value, late = Agreement(c), np.zeros(c.size), 0.0
    value[c.rate] = np.nan
    for k in range(2000):
        t = PERIOD * k
        true = 0.5 * np.sin(3.0 * t)
        late += (1.0 - np.exp(-PERIOD / 0.004)) * (true - late)
        value[c.position], value[c.velocity] = (1.0 - np.cos(3.0 * t)) / 6.0, late
        assert agreement.update(value.copy(), PERIOD, 0.0, np.zeros(1)) is None


@pytest.mark.parametrize("held", [True, False])
def test_a_joint_that_bent_links_hold_need_not_answer_the_torque(held):
    # Friction, and the links' bending, hold it against a tenth of the torque limit.
    arm = known_arm()
    model = models.build(arm)
    channels = Channels(model, StrainMap(model))
    checks, terms = Standstill(channels), model.terms(np.zeros(1), np.zeros(1))
    across = np.linalg.solve(terms.M[1:, 1:], terms.M[1:, :1])[:, 0] @ terms.K2
    torque = np.array([0.2 * arm.torque_limits[0]])
    delta = -torque[0] * across / (across @ across)
    found = []
    for k in range(60):
        reading = np.concatenate([[0.1], 1e-6 * np.sin([k, 2 * k]), [np.nan]])
        joints = checks.update(reading, torque, np.zeros(2), 1e-3, delta if held else 0.0 * delta)[
            0
        ]
        found += joints.tolist()
    assert bool(found) != held


@pytest.mark.parametrize(("torque", "found"), [((0.0, 0.13), False), ((0.2, 0.0), True)])
def test_a_joint_that_stands_is_not_asked_to_answer_what_another_joints_friction_may_hold(
    torque, found
):
    # Fractions of the limits; 5 % of each may be friction, and 1.3 times the torque of the second acts on the first.
    arm = arm_file.load("two_link")
    model = models.build(arm)
    checks, answers = Standstill(Channels(model, StrainMap(model))), []
    size = len(arm.gauges)
    for k in range(60):
        reading = np.concatenate(
            [[0.1, 0.1 + 1e-4 * k], 1e-6 * np.sin(k + np.arange(size)), [np.nan, np.nan]]
        )
        answers += checks.update(
            reading,
            np.array(torque) * arm.torque_limits,
            np.zeros(size),
            PERIOD,
            np.zeros(model.n_modes),
        )[0].tolist()
    assert set(answers) == ({0} if found else set())


@pytest.mark.parametrize(
    ("changes", "still", "found"),
    [
        ((-24, -20, -17, -7, -6, -3, -3), 7, False),  # of a simulated gauge that turned
        ((-24, -20, -17, -7, -6, -3, -3), 13, True),  # no vibration turns so slowly
        ((-24, -20, -17, -17, -16, -17, -16), 7, True),
    ],
)
def test_a_gauge_that_turns_at_once_does_not_stand_still(changes, still, found):
    c = channels()
    checks, gauges, count = Standstill(c), [], 0.0
    for change in (1, 2, 1, *changes, *(0,) * still):
        count += change
        reading = np.full(2 * c.n + c.g, np.nan)
        reading[c.n : c.n + c.g] = 1e-6 * count
        gauges += checks.update(reading, np.full(c.n, np.nan), np.zeros(c.g), PERIOD)[1].tolist()
    assert bool(gauges) == found


def test_joint_is_light_if_it_is_so_in_one_configuration():
    """A joint of small inertia elsewhere does not hide it."""

    class Changing:
        """R: a hundredth of itself when straight, and with a light joint otherwise."""

        def __init__(self):
            self.whole = models.build(known_arm())

        def __getattr__(self, name):
            return getattr(self.whole, name)

        def terms(self, q, qd):
            terms = self.whole.terms(q, qd)
            M = terms.M.copy()
            if q[0] == 0.0:
                M *= 0.01
            else:
                M[0, 0] = M[0, 1:] @ np.linalg.solve(M[1:, 1:], M[1:, 0]) / 0.9
            return terms._replace(M=M)

    model = Changing()
    assert Channels(model.whole, None).heavy
    assert not Channels(model, None).heavy


@pytest.mark.parametrize(("name", "least"), [("R", 0.95), ("tapered", 0.5)])
def test_a_step_of_the_torque_accelerates_no_strain_beyond_its_bound_while_the_modes_turn(
    name, least
):
    arm = scaled(arm_file.load(name), damping=0.0)
    model = models.build(arm)
    map_, n, m = StrainMap(model), model.n_joints, model.n_modes
    c, q = Channels(model, map_), np.zeros(n)
    M = model.terms(q, q).M
    force = np.eye(n + m)[:, 0]
    K = np.zeros_like(M)
    K[n:, n:] = model.stiffness_matrix()
    # M x'' + K x = e_1 from rest: x'' = cos(Omega t) M^-1 e_1, with Omega^2 = M^-1 K.
    at_first = np.linalg.solve(M, force)
    squares, shapes = np.linalg.eig(np.linalg.solve(M, K))
    parts = shapes * np.linalg.solve(shapes, at_first)
    omega = np.sqrt(np.abs(squares))
    times = np.linspace(0.0, 20.0 * np.pi / omega[omega > 1.0].min(), 20000)
    bent = (parts @ np.cos(np.outer(omega, times)))[n:]
    for readings_, rows in ((bent, c.amplitude), (map_.rows @ bent, c.strain)):
        largest = np.abs(readings_).max(axis=1)
        bound = 0.5 * c.gain[rows, 0]
        assert np.all(largest < bound * 1.001)
        assert np.all(largest > least * bound)  # it is not much looser than that
    # The gauge in the middle hardly feels the step itself.
    assert abs(map_.rows @ at_first[n:])[-1] < 0.5 * np.abs(map_.rows @ bent)[-1].max()


@pytest.mark.parametrize(("step", "found"), [(0.0, True), (0.1, False)])
def test_steps_of_the_torque_swing_a_light_joint_between_samples_that_see_it_at_rest(step, found):
    model = models.build(arm_file.load("two_link"))
    c = Channels(model, StrainMap(model))
    agreement, value, named = Agreement(c), np.full(c.size, np.nan), False
    for k in range(400):
        value[c.position], value[c.velocity] = [0.0, 0.02 * PERIOD * k], 0.0
        named |= agreement.update(value.copy(), PERIOD, 0.0, step * c.strength) is not None
    assert named == found


@pytest.mark.parametrize(("period", "soon"), [(20e-3, True), (24e-3, False)])
def test_a_velocity_that_swings_near_the_sampling_frequency_is_judged_over_long_windows(
    period, soon
):
    """In 60 samples in a row a swing of the next mode is in the same phase, and takes half of the velocity away."""
    model = models.build(known_arm())
    channels = Channels(model, StrainMap(model))
    assert (channels.fastest * period > 2.0) != soon
    agreement, named = Agreement(channels), False
    for k in range(1000):
        value = np.full(channels.size, np.nan)
        value[channels.position] = k * period
        value[channels.velocity] = 0.5 if 400 <= k < 460 else 1.0
        named |= agreement.update(value, period, 0.0, np.zeros(1)) is not None
    assert named == soon


@pytest.mark.parametrize("period", [12e-3, 24e-3])
def test_a_velocity_of_the_wrong_sign_is_found_at_once_however_fast_the_modes_are(period):
    model = models.build(known_arm())
    channels = Channels(model, StrainMap(model))
    agreement, found = Agreement(channels), []
    for k in range(60):
        value = np.full(channels.size, np.nan)
        value[channels.position], value[channels.velocity] = -k * period, 1.0
        if agreement.update(value, period, 0.0, np.zeros(1)) is not None:
            found.append(k)
    assert found and found[0] < 24


@pytest.mark.parametrize(
    ("period", "factor", "found"),
    [
        (1e-3, 1.3, True),
        (12e-3, 1.3, False),
        (12e-3, 2.0, True),
        (24e-3, 2.0, True),
        (24e-3, 0.5, True),
    ],
)
def test_a_velocity_may_be_off_by_more_where_modes_are_fast_for_the_sampling(period, factor, found):
    model = models.build(known_arm())
    channels = Channels(model, StrainMap(model))
    fastest = channels.model.frequencies(np.zeros(1))[-1]
    assert (fastest * period > 1.0) == (period > 2e-3)
    agreement, named = Agreement(channels), False
    for k in range(300):
        value = np.full(channels.size, np.nan)
        value[channels.position], value[channels.velocity] = factor * k * period, 1.0
        named |= agreement.update(value, period, 0.0, np.zeros(1)) is not None
    assert named == found


def test_lost_samples_in_which_a_mode_turns_far_are_no_jump_of_the_strains():
    # A swing of the second mode, 14 Hz, at 200 Hz; every seventh sample is lost.
    model = models.build(known_arm())
    channels = Channels(model, StrainMap(model))
    jumps, period, last = Jumps(channels), 5e-3, 0
    omega = channels.fastest
    for k in range(1, 400):
        if k % 7 == 0 and k > 60:
            continue
        value = np.full(channels.size, np.nan)
        value[channels.position] = 0.3
        value[channels.strain] = 2e-4 * np.cos(omega * k * period) * (k > 100)
        found = jumps.judge(value, np.array([0.5]), (k - last) * period, k - last)
        if k > 130:
            assert found == (None, None)
        jumps.take(value, k * period)
        last = k


def undamped(name, modes):
    """Model of a shipped arm without damping and friction, with so many modes, and its A and B at rest."""
    arm = arm_file.load(name).with_modes(modes)
    links = tuple(
        replace(link, flexible={d: replace(f, damping=(0.0,)) for d, f in link.flexible.items()})
        for link in arm.links
    )
    free = Friction()
    arm = replace(arm, links=links, joints=tuple(replace(j, friction=free) for j in arm.joints))
    model = models.build(arm)
    return model, *linear_plant(model, np.zeros(model.n_joints))


@pytest.mark.parametrize("modes", [1, 3])
def test_a_step_of_the_torque_moves_the_arm_by_half_of_the_mean_acceleration_times_the_square(
    modes,
):
    model, A, B = undamped("two_link", modes)
    n, m = model.n_joints, model.n_modes
    for time in (1e-4, 2e-3, 0.1):
        moved, begun = sampled(A, B, time)[1], sampled(A, B, 0.5 * time)[1]
        for part, found, of_velocity in (
            (0.5 * time**2, moved[: n + m], False),
            (0.5 * time, begun[n + m :], True),
        ):
            means = np.vstack(mean_accelerations(model, np.zeros(n), time, of_velocity))
            small = 1e-9 * np.abs(found).max()
            assert part * means == pytest.approx(found, rel=1e-6, abs=small)


@pytest.mark.parametrize("period", [1e-3, 2e-3])
def test_modes_that_the_file_lacks_turn_a_light_joint_fast_without_a_jump(period):
    """The torque rises and falls by steps; the arm has two modes more than the file says."""
    arm = arm_file.load("two_link").with_modes(1)
    gains = np.resize([-5.0, 5.0], len(arm.gauges))
    gauges = tuple(replace(g, gain=f) for g, f in zip(arm.gauges, gains, strict=True))
    file = models.build(replace(arm, gauges=gauges))
    plant, A, B = undamped("two_link", 3)
    channels, map_ = Channels(file, StrainMap(file)), StrainMap(file)
    plain = models.build(arm)
    strains = Channels(plain, StrainMap(plain)).gain[channels.strain]
    assert channels.gain[channels.strain] == pytest.approx(np.abs(gains)[:, None] * strains)
    # Soon after a step a velocity may be farther off than the mean until later.
    assert (channels.gain[channels.velocity] > channels.gain[channels.position])[1, 1]
    jumps, n, m = Jumps(channels), plant.n_joints, plant.n_modes
    rows = gains[:, None] * gauge_rows(plant, arm.gauges)
    Phi, Gamma = sampled(A, B, period)
    x, torque, limit = np.zeros(2 * (n + m)), np.zeros(n), 0.05 * channels.strength
    for k in range(400):
        if k >= 60:
            torque = limit * np.clip([k % 40 - 18, 22 - k % 40], -1, 1).min()
        x = Phi @ x + Gamma @ torque
        value = np.full(channels.size, np.nan)
        q, delta, qd, delta_d = np.split(x, [n, n + m, 2 * n + m])
        value[channels.position], value[channels.velocity] = q, qd
        value[channels.strain] = rows @ delta
        value[channels.amplitude] = map_.inverse @ rows @ delta
        value[channels.rate] = map_.inverse @ rows @ delta_d
        outliers, _ = jumps.judge(value, torque, period, 1)
        assert outliers is None, (k, [channels.names[i] for i in outliers])
        jumps.take(value, (k + 1) * period)


# --------------------------------------------------------------------------- modal amplitudes


def contradictions(change, seconds=3.0, begin=1.0, bias=0.0, **motion):
    """When amplitudes that are changed from `begin` on are found to contradict the strains; None: never [s]."""
    c = channels()
    map_ = StrainMap(c.model)
    check, value = SourceAmplitudes(c, map_), np.zeros(c.size)
    _, strain = readings(known_arm(), seconds, **motion)
    for k, e in enumerate(strain):
        amplitude = map_.inverse @ e
        value[c.strain] = e + bias
        value[c.amplitude] = amplitude if PERIOD * k < begin else change(amplitude)
        if check.update(value, PERIOD):
            return PERIOD * k - begin
    return None


@pytest.mark.parametrize("factor", [-1.0, 0.0, 2.0])
@pytest.mark.parametrize("bias", [0.0, 3e-5])
def test_amplitudes_that_the_sources_own_strains_contradict_are_found(factor, bias):
    """Whatever constant bias the raw strains have: amplitudes come from calibrated ones."""
    found = contradictions(lambda a: factor * a, amplitude=1.0, bias=bias)
    assert found is not None and 0.0 < found < 0.6


@pytest.mark.parametrize(
    ("begin", "trust", "text"),
    [
        (1.5, ArmSample.STOP, "modal_amplitude of link1_y_mode1 jumped"),
        (np.pi / 3.0, ArmSample.DISTRUSTED, "contradict each other"),
    ],
)
def test_amplitudes_that_jump_away_from_the_strains_are_done_without(begin, trust, text):
    """The strains went on without a jump, so they are right; where nothing jumped, either may be wrong."""
    m = models.build(known_arm())
    map_ = StrainMap(m)
    monitor, sample = Monitor(m, map_, None), ArmSample(1, m.n_modes, 2)
    position, strains = readings(known_arm(), 4.0, amplitude=1.0)
    for k, (q, e) in enumerate(zip(position, strains, strict=True)):
        wrong = PERIOD * k >= begin
        sample.position[:], sample.strain, sample.velocity_known = q, e, False
        sample.amplitude = (-1.0 if wrong else 1.0) * (map_.inverse @ e)
        sample.stamp_ns = 1_000_000_000 + round(1e9 * PERIOD * k)
        sample.trust, sample.doubt = ArmSample.TRUSTED, ""
        monitor.judge(sample, PERIOD if k else 0.0, 1)
        monitor.take(sample)
        monitor.mark(sample)
        assert wrong or sample.trust == ArmSample.TRUSTED
    assert sample.trust == trust and text in sample.doubt
    assert (sample.amplitude is None) == (trust == ArmSample.STOP)


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.4])
def test_amplitudes_of_another_model_of_the_links_do_not_contradict_the_strains(factor):
    assert contradictions(lambda a: factor * a, amplitude=1.0, begin=0.0) is None


@pytest.mark.parametrize("swing", [0.0, 2e-3])
def test_amplitudes_that_their_source_has_filtered_are_not_wrong(swing):
    late = np.zeros(2)

    def filtered(a):
        late[:] += (1.0 - np.exp(-PERIOD / 0.004)) * (a - late)
        return late.copy()

    assert contradictions(filtered, begin=0.0, amplitude=1.0, swing=swing) is None


def test_a_check_without_amplitudes_begins_anew_when_they_come():
    """What came before says nothing of the zeros."""
    c = channels()
    check, value = SourceAmplitudes(c, StrainMap(c.model)), np.zeros(c.size)
    value[c.strain] = 1e-4
    assert not any(check.update(value, PERIOD) for _ in range(500))
    value[c.amplitude] = np.nan
    assert not check.update(value, PERIOD)
    value[c.amplitude] = 5.0 * StrainMap(c.model).inverse @ value[c.strain]
    assert not any(check.update(value, PERIOD) for _ in range(500))
    value[c.amplitude] = np.zeros(c.m)
    assert any(check.update(value, PERIOD) for _ in range(500))
