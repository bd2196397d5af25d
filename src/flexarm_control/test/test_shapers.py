# SPDX-License-Identifier: Apache-2.0
"""Shapers: closed forms, the vibration that is left at and off the design frequency, and on the arms."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from flexarm_control.motions import excitation, shapers
from flexarm_control.motions.profiles import quintic, smooth
from flexarm_dynamics.errors import NOT_GIVEN, DesignError
from flexarm_dynamics.singular_perturbation import fast_subsystem

OMEGA, ZETA = 7.3, 0.06


def vibration_left(motion, omega, zeta, extra=0.0):
    """Amplitude of an oscillator on the moving base, at the motion's end; by integration, not by theory.

    x'' + 2 zeta omega x' + omega^2 x = -q'', and the amplitude is that of the free vibration after.
    """

    def derivative(t, x):
        return [x[1], -2 * zeta * omega * x[1] - omega**2 * x[0] - motion.acceleration(t)[0]]

    end = motion.duration + extra
    x, v = solve_ivp(derivative, (0.0, end), [0.0, 0.0], rtol=1e-10, atol=1e-13, max_step=0.02).y[
        :, -1
    ]
    damped = omega * np.sqrt(1.0 - zeta**2)
    return np.hypot(x, (v + zeta * omega * x) / damped)


def test_zv_and_zvd_are_those_of_the_literature():
    """Undamped: halves half a period apart; quarter, half, quarter. Damped: by hand with K."""
    train = shapers.zv(2.0 * np.pi, 0.0)
    np.testing.assert_allclose(train.times, [0.0, 0.5], rtol=1e-15)
    np.testing.assert_allclose(train.amplitudes, [0.5, 0.5], rtol=1e-15)
    train = shapers.zvd(2.0 * np.pi, 0.0)
    np.testing.assert_allclose(train.times, [0.0, 0.5, 1.0], rtol=1e-15)
    np.testing.assert_allclose(train.amplitudes, [0.25, 0.5, 0.25], rtol=1e-15)
    K = np.exp(-0.1 * np.pi / np.sqrt(0.99))
    train = shapers.zvd(3.0, 0.1)
    np.testing.assert_allclose(train.amplitudes * (1 + K) ** 2, [1.0, 2 * K, K * K], rtol=1e-14)
    np.testing.assert_allclose(train.times[1], np.pi / (3.0 * np.sqrt(0.99)), rtol=1e-15)


def test_nothing_is_left_at_the_design_frequency_and_for_zvd_no_slope_either():
    step = 1e-4 * OMEGA
    for make in (shapers.zv, shapers.zvd):
        assert make(OMEGA, ZETA).residual(OMEGA, ZETA) < 1e-15
    slopes = [
        make(OMEGA, ZETA).residual(OMEGA + step, ZETA) / step for make in (shapers.zv, shapers.zvd)
    ]
    # Undamped ZV: V = |cos(pi omega / (2 omega_0))|, of slope pi / (2 omega_0); ZVD is its square.
    assert slopes[0] == pytest.approx(np.pi / (2.0 * OMEGA), rel=0.2)
    assert slopes[1] < 1e-3 * slopes[0]


def test_undamped_residuals_are_the_cosines():
    ratio = np.linspace(0.3, 2.5, 40)
    expected = np.abs(np.cos(0.5 * np.pi * ratio))
    np.testing.assert_allclose(
        shapers.zv(OMEGA, 0).residual(ratio * OMEGA, 0.0), expected, atol=1e-14
    )
    np.testing.assert_allclose(
        shapers.zvd(OMEGA, 0).residual(ratio * OMEGA, 0.0), expected**2, atol=1e-14
    )


def test_ei_leaves_five_percent_at_the_design_frequency_and_nothing_beside_it():
    v = shapers.EI_RESIDUAL
    train = shapers.ei(2.0 * np.pi, 0.0)
    np.testing.assert_allclose(train.times, [0.0, 0.5, 1.0], atol=1e-15)
    np.testing.assert_allclose(
        train.amplitudes, [(1 + v) / 4, (1 - v) / 2, (1 + v) / 4], rtol=1e-12
    )
    damped, wd = shapers.ei(OMEGA, ZETA), OMEGA * np.sqrt(1.0 - ZETA**2)
    np.testing.assert_allclose(damped.residual(OMEGA, ZETA), v, rtol=1e-9)
    # The zeros of the train's polynomial, as poles with the same decay and another frequency.
    first, _, last = damped.amplitudes
    K, cosine = np.sqrt(last / first), damped.amplitudes[1] / (2.0 * np.sqrt(first * last))
    beside = wd * (1.0 + np.arccos(cosine) / np.pi)
    np.testing.assert_allclose(K, np.exp(-ZETA * OMEGA * np.pi / wd), rtol=1e-12)
    omega = np.hypot(beside, ZETA * OMEGA)
    assert damped.residual(omega, ZETA * OMEGA / omega) < 1e-12
    # Robust where ZVD is not: 20 % off.
    assert (
        train.residual(1.2 * 2.0 * np.pi, 0.0)
        < 0.06
        < shapers.zvd(2.0 * np.pi, 0.0).residual(1.2 * 2.0 * np.pi, 0.0)
    )


@pytest.mark.parametrize("kind", shapers.SHAPERS)
@pytest.mark.parametrize("damping", [0.0, 0.01, 0.08, 0.2])
def test_every_shaper_keeps_the_end_of_a_motion_and_is_as_good_as_its_name(kind, damping):
    times, amplitudes = train = shapers.impulses(kind, 3.1, damping)
    assert amplitudes.sum() == pytest.approx(1.0, abs=1e-14) and (amplitudes > 0.0).all()
    assert times[0] == 0.0 and (np.diff(times) > 0.0).all()
    period = 1.0 / (3.1 * np.sqrt(1.0 - damping**2))
    periods = {"zv": 0.5, "mzv": 0.75, "zvd": 1.0, "ei": 1.0, "2hump_ei": 1.5, "zvdd": 1.5}
    assert train.duration == pytest.approx(periods[kind] * period, rel=1e-14)
    left = train.residual(2.0 * np.pi * 3.1, damping)
    assert left == pytest.approx(shapers.EI_RESIDUAL if kind == "ei" else 0.0, abs=1e-12)


@pytest.mark.parametrize(("kind", "order"), [("zv", 1), ("mzv", 1), ("zvd", 2), ("zvdd", 3)])
@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_the_residual_of_a_zero_of_higher_order_is_that_flat(kind, order, damping):
    """V goes as the distance from the design pole to the power of 1, 2, 3: half the distance, so much less."""
    train, omega = shapers.impulses(kind, 1.0, damping), 2.0 * np.pi
    near, nearer = (train.residual(omega * (1.0 + off), damping) for off in (2e-3, 1e-3))
    assert np.log2(near / nearer) == pytest.approx(order, abs=0.01)


def test_two_hump_ei_has_humps_of_its_tolerance_and_the_published_amplitudes():
    """Singhose et al. (1997): A1 = (3X^2 + 2X + 3V^2) / (16X), X = (V^2 (sqrt(1 - V^2) + 1))^(1/3), A2 = 1/2 - A1."""
    V = shapers.EI_RESIDUAL
    train = shapers.impulses("2hump_ei", 1.0, 0.0)
    X = np.cbrt(V**2 * (np.sqrt(1.0 - V**2) + 1.0))
    first = (3.0 * X**2 + 2.0 * X + 3.0 * V**2) / (16.0 * X)
    np.testing.assert_allclose(
        train.amplitudes, [first, 0.5 - first, 0.5 - first, first], rtol=1e-12
    )
    ratio = np.linspace(0.72, 1.28, 20001)
    inside = train.residual(2.0 * np.pi * ratio, 0.0)
    assert inside.max() == pytest.approx(V, rel=1e-6)
    assert ((inside[1:-1] > inside[:-2]) & (inside[1:-1] > inside[2:])).sum() == 2
    # With damping the humps are nearly as high.
    damped = shapers.impulses("2hump_ei", 1.0, 0.05).residual(2.0 * np.pi * ratio, 0.05)
    assert damped.max() == pytest.approx(V, rel=0.35)


def test_mzv_is_that_of_klipper():
    """At 0, 3/8 and 3/4 of a period: 1 - 1/sqrt 2, sqrt 2 - 1 and 1 - 1/sqrt 2 without damping."""
    times, amplitudes = shapers.impulses("mzv", 2.0, 0.0)
    np.testing.assert_allclose(times, [0.0, 0.1875, 0.375], rtol=1e-14)
    side = 1.0 - np.sqrt(0.5)
    np.testing.assert_allclose(amplitudes, [side, np.sqrt(2.0) - 1.0, side], rtol=1e-14)
    k = np.exp(-0.75 * 0.1 * np.pi / np.sqrt(0.99))
    raw = np.array([side, (np.sqrt(2.0) - 1.0) * k, side * k**2])
    damped = shapers.impulses("mzv", 2.0, 0.1).amplitudes
    np.testing.assert_allclose(damped, raw / raw.sum(), rtol=1e-14)


def test_convolved_trains_unpack_and_none_changes_nothing():
    pairs = [tuple(shapers.impulses("zv", f, 0.02)) for f in (3.0, 9.0)]
    both = shapers.convolve(pairs)
    expected = shapers.for_modes("zv", 2.0 * np.pi * np.array([3.0, 9.0]), [0.02, 0.02])
    np.testing.assert_array_equal(both.times, expected.times)
    np.testing.assert_array_equal(both.amplitudes, expected.amplitudes)
    alone = shapers.convolve([shapers.impulses("none", 3.0, 0.0), both])
    np.testing.assert_array_equal(alone.times, both.times)
    assert shapers.impulses("none", 3.0, 0.0).duration == 0.0


@pytest.mark.parametrize("kind", ["zv", "zvd"])
@pytest.mark.parametrize("off", [0.8, 1.0, 1.15])
def test_an_integrated_oscillator_keeps_what_the_formula_says(kind, off):
    """Off the design frequency the shaped motion leaves V times what the motion itself leaves."""
    shaper = shapers.for_modes(kind, [OMEGA], [ZETA])
    motion = quintic(0.0, 1.0, 0.9)
    bare = vibration_left(motion, off * OMEGA, ZETA)
    left = vibration_left(shaper.apply(motion), off * OMEGA, ZETA)
    assert bare > 0.01
    assert left == pytest.approx(shaper.residual(off * OMEGA, ZETA) * bare, rel=1e-5, abs=1e-8)


def test_shapers_of_two_modes_cancel_both_and_their_residuals_multiply():
    omega, zeta = np.array([OMEGA, 31.0]), np.array([ZETA, 0.01])
    both = shapers.for_modes("zv", omega, zeta)
    single = [shapers.zv(w, z) for w, z in zip(omega, zeta, strict=True)]
    assert both.times.size == 4 and both.amplitudes.sum() == pytest.approx(1.0, abs=1e-15)
    assert np.all(np.diff(both.times) > 0.0)
    assert both.duration == pytest.approx(single[0].duration + single[1].duration)
    np.testing.assert_allclose(both.residual(omega, zeta), 0.0, atol=1e-14)
    anywhere = np.linspace(5.0, 40.0, 9)
    product = single[0].residual(anywhere, 0.02) * single[1].residual(anywhere, 0.02)
    np.testing.assert_allclose(both.residual(anywhere, 0.02), product, rtol=1e-10, atol=1e-15)


def test_a_shaped_motion_is_the_sum_of_delayed_copies_with_exact_derivatives():
    motion = smooth([0.2, -1.0], [1.0, 3.0], 1.1, 4)
    shaper = shapers.zvd(OMEGA, ZETA)
    shaped = shaper.apply(motion)
    assert shaped.duration == pytest.approx(1.1 + shaper.times[2])
    t, small = np.linspace(0.01, shaped.duration, 50), 1e-5
    by_hand = sum(
        a * motion.position(t - d) for a, d in zip(shaper.amplitudes, shaper.times, strict=True)
    )
    np.testing.assert_allclose(shaped.position(t), by_hand, rtol=1e-14)
    for f, df in ((shaped.position, shaped.velocity), (shaped.velocity, shaped.acceleration)):
        np.testing.assert_allclose((f(t + small) - f(t - small)) / (2 * small), df(t), atol=2e-7)
    for at, where in ((-1.0, motion.start), (0.0, motion.start), (9.0, [1.0, 3.0])):
        np.testing.assert_allclose(shaped.position(at), where, rtol=1e-14)
        np.testing.assert_allclose(shaped.velocity(at), 0.0, atol=1e-14)
    assert shaped.position(0.3).shape == (2,)


def test_on_the_papers_arm_the_fast_subsystem_is_left_at_rest(arm_r):
    """A slow, small motion: (11) does not change along it, so that the theory is exact."""
    q = np.array([1.0])
    A2, _ = fast_subsystem(arm_r.terms(q, np.zeros(1)))
    omega, _ = shapers.modes_at(arm_r, q)
    np.testing.assert_allclose(omega, np.sort(np.abs(np.linalg.eigvals(A2)))[::2], rtol=1e-12)
    motion = quintic(1.0, 1.001, 0.5)
    bare = excitation.along(arm_r, motion, q).residual
    for kind, modes in (("zv", 2), ("zvd", 2)):
        shaped = shapers.for_arm(arm_r, q, kind, modes).apply(motion)
        assert excitation.along(arm_r, shaped, q).residual < 1e-7 * bare
    one = shapers.for_arm(arm_r, q, "zv", 1)
    assert one.times.size == 2 and one.residual(omega[0], 0.0) < 1e-12


@pytest.mark.parametrize(
    ("make", "field", "value"),
    [
        (lambda arm: shapers.zv(0.0, 0.1), "shaper frequency", 0.0),
        (lambda arm: shapers.zvd(3.0, 1.0), "shaper damping ratio", 1.0),
        (lambda arm: shapers.zv(3.0, -0.1), "shaper damping ratio", -0.1),
        (lambda arm: shapers.for_modes("si", [1.0], [0.0]), "shaper", "si"),
        (lambda arm: shapers.impulses("zvddd", 1.0, 0.0), "shaper", "zvddd"),
        (lambda arm: shapers.impulses("mzv", np.inf, 0.0), "shaper frequency", np.inf),
        (lambda arm: shapers.for_modes("zv", [], []), "shaper modes", NOT_GIVEN),
        (lambda arm: shapers.for_modes("zvd", [1.0] * 7, [0.0] * 7), "shaper impulses", 2187),
        (lambda arm: shapers.for_arm(arm, [0.0], "zv", 3), "shaper modes", 3),
    ],
)
def test_what_makes_no_shaper_is_refused(arm_r, make, field, value):
    with pytest.raises(DesignError) as error:
        make(arm_r)
    assert (error.value.field, error.value.value) == (field, value)
