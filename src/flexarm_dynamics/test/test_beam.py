# SPDX-License-Identifier: Apache-2.0
"""Mode shapes: roots, boundary conditions, orthogonality, integrals, limiting cases."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from flexarm_dynamics.arm.units import FOOT, POUND_FORCE
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.models import beam

# Roots of cos(b) cosh(b) = -1 to 15 digits (Young & Felgar's table, extended).
CLAMPED_FREE_ROOTS = (
    1.875104068711961,
    4.694091132974175,
    7.854757438237613,
    10.995540734875467,
    14.137168391046471,
    17.278759532088236,
    20.420352251041251,
    23.561944901806444,
    26.703537555518299,
    29.845130209102816,
)
XI = np.linspace(0.0, 1.0, 41)


#: Length, mass per length and EI of the paper's beam.
PAPER = 4.0 * FOOT, 0.005124 * POUND_FORCE / FOOT**2, 28.6 * POUND_FORCE * FOOT**2


def paper_beam(frequencies_hz):
    """Shapes of the paper's beam from frequencies."""
    return beam.from_frequencies(frequencies_hz, *PAPER)


def frequencies_of(shapes, length, mass_per_length, stiffness):
    """Natural frequencies (beta/L)^2 sqrt(EI/(rho A)) of a uniform beam [rad/s]."""
    return (shapes.beta / length) ** 2 * np.sqrt(stiffness / mass_per_length)


@pytest.fixture(params=["clamped_free", "loaded", "offset", "from_frequencies"])
def shapes(request):
    """Shapes of every kind, as many as make sense."""
    return {
        "clamped_free": lambda: beam.clamped_free(10),
        "loaded": lambda: beam.loaded(10, 1.2, 0.25, 0.05, 1.2e-4),
        "offset": lambda: beam.loaded(10, 1.2, 0.25, 0.05, 1.2e-4, 0.07),
        "from_frequencies": lambda: paper_beam([2.12, 14.3]),
    }[request.param]()


def test_ten_clamped_free_modes_are_those_of_the_literature():
    shapes = beam.clamped_free(10)
    beta = shapes.beta
    np.testing.assert_allclose(beta, CLAMPED_FREE_ROOTS, rtol=1e-14)
    # Divided by the derivative: the distance to the exact root.
    residual = np.cos(beta) * np.cosh(beta) + 1.0
    slope = np.cos(beta) * np.sinh(beta) - np.sin(beta) * np.cosh(beta)
    np.testing.assert_allclose(residual / slope, 0.0, atol=1e-14)
    np.testing.assert_allclose(shapes.gram(), np.eye(10), atol=1e-12)
    scaled = shapes.gram(2) / np.outer(beta**2, beta**2)
    np.testing.assert_allclose(scaled, np.eye(10), atol=1e-12)
    np.testing.assert_allclose(shapes(1.0), 2.0 * (-1.0) ** np.arange(10), rtol=1e-13)
    # The free end carries no moment and no shear.
    np.testing.assert_allclose(shapes(1.0, 2) / beta**2, 0.0, atol=1e-13)
    np.testing.assert_allclose(shapes(1.0, 3) / beta**3, 0.0, atol=1e-13)


def test_every_shape_is_clamped_of_unit_norm_and_bends_to_the_positive_side(shapes):
    np.testing.assert_allclose(np.diag(shapes.gram()), 1.0, rtol=1e-13)
    np.testing.assert_allclose(shapes(0.0), 0.0, atol=1e-14)
    np.testing.assert_allclose(shapes(0.0, 1) / shapes.beta, 0.0, atol=1e-14)
    assert np.all(shapes(0.0, 2) > 0.0)
    assert shapes(1.0)[0] > 0.0


def test_shapes_from_frequencies_carry_no_moment_at_the_tip():
    shapes = paper_beam([2.12, 14.3])
    np.testing.assert_allclose(shapes(1.0, 2) / shapes.beta**2, 0.0, atol=1e-14)
    assert np.all(np.abs(shapes(1.0, 3) / shapes.beta**3) > 0.05)


@pytest.mark.parametrize("derivative", [1, 2, 3])
def test_derivatives_match_central_differences(shapes, derivative):
    step = 2e-4 / np.sqrt(shapes.beta.max())
    xi = XI[1:-1]

    def below(offset):
        return shapes(xi + offset * step, derivative - 1)

    # Sixth order.
    difference = (
        45.0 * (below(1) - below(-1)) - 9.0 * (below(2) - below(-2)) + below(3) - below(-3)
    ) / (60.0 * step)
    scale = shapes.beta**derivative
    np.testing.assert_allclose(difference / scale, shapes(xi, derivative) / scale, atol=3e-11)


def test_shapes_solve_the_beam_equation(shapes):
    np.testing.assert_allclose(
        shapes(XI, 4) / shapes.beta**4, shapes(XI), atol=1e-14 * np.abs(shapes(XI)).max()
    )


def test_shapes_equal_the_textbook_form_where_it_has_digits():
    shapes = beam.clamped_free(3)
    for i, b in enumerate(shapes.beta):
        nu = -(np.sin(b) + np.sinh(b)) / (np.cos(b) + np.cosh(b))
        assert nu < 0.0  # published with a positive sign
        x = b * XI
        textbook = np.sin(x) - np.sinh(x) + nu * (np.cos(x) - np.cosh(x))  # (A1)
        np.testing.assert_allclose(shapes(XI)[:, i], textbook / -nu, atol=1e-11)


def test_values_have_one_column_per_mode():
    shapes = beam.clamped_free(3)
    assert shapes.count == 3
    assert shapes(0.5).shape == (3,)
    assert shapes(XI).shape == (XI.size, 3)
    np.testing.assert_array_equal(shapes(XI)[7], shapes(XI[7]))


def test_shapes_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        beam.clamped_free(2).beta[0] = 1.0


@pytest.mark.parametrize("inertia", ["8.52e-5 (corrected)", "8.52e-3 (printed)"])
def test_loaded_modes_have_the_exact_clamped_frequencies(frequencies, parameters, inertia):
    p = parameters["one_link_pulse"]
    load = float(inertia.split()[0]) * POUND_FORCE * FOOT
    shapes = beam.loaded(4, p["L"], p["rhoA"], p["Mp"], load)
    omega = frequencies_of(shapes, p["L"], p["rhoA"], p["EI"])
    exact = frequencies["one_link"][f"clamped Jp={inertia}"]["rad_s"]
    np.testing.assert_allclose(omega, exact, rtol=1e-8)


@pytest.mark.parametrize("offset", [0.0, 0.2])
@pytest.mark.parametrize("inertia", [0.0, 0.02])
def test_ten_loaded_modes_are_orthogonal_in_loaded_mass_and_in_stiffness(inertia, offset):
    length, rho, mass = 1.2, 0.25, 0.3
    shapes = beam.loaded(10, length, rho, mass, inertia, offset)
    slope = shapes(1.0, 1) / length
    centre = shapes(1.0) + offset * slope
    M = rho * length * shapes.gram() + mass * np.outer(centre, centre)
    M += inertia * np.outer(slope, slope)
    K = shapes.gram(2)
    for matrix in (M, K):
        scale = np.sqrt(np.diag(matrix))
        np.testing.assert_allclose(matrix / np.outer(scale, scale), np.eye(10), atol=1e-12)
    # Rayleigh's quotient is the frequency.
    np.testing.assert_allclose(np.diag(K) / np.diag(M), shapes.beta**4 / (rho * length), rtol=1e-12)


def test_loaded_tip_balances_the_payload():
    length, rho, mass, inertia, offset = 1.2, 0.25, 0.3, 0.02, 0.1
    shapes = beam.loaded(10, length, rho, mass, inertia, offset)
    tip, slope = shapes(1.0), shapes(1.0, 1) / length
    bending, shear = shapes(1.0, 2) / length**2, shapes(1.0, 3) / length**3
    # EI = 1: omega^2 = beta^4 / (rho L^4); d'Alembert on the payload.
    square = shapes.beta**4 / (rho * length**4)
    force = mass * square * (tip + offset * slope)
    moment = inertia * square * slope + offset * force
    np.testing.assert_allclose(shear / shapes.beta**3, -force / shapes.beta**3, atol=1e-11)
    np.testing.assert_allclose(bending / shapes.beta**2, moment / shapes.beta**2, atol=1e-11)


def test_without_load_the_loaded_modes_are_the_clamped_free_ones():
    loaded, free = beam.loaded(10, 1.3, 0.7), beam.clamped_free(10)
    np.testing.assert_allclose(loaded.beta, free.beta, rtol=1e-14)
    np.testing.assert_allclose(loaded(XI), free(XI), atol=1e-12)


def test_a_small_load_changes_the_modes_little():
    loaded, free = beam.loaded(10, 1.0, 1.0, 1e-9, 1e-12), beam.clamped_free(10)
    np.testing.assert_allclose(loaded(XI), free(XI), atol=1e-6)
    assert np.all(loaded.beta < free.beta)


def test_under_a_huge_mass_the_tip_is_pinned_and_the_first_mode_is_a_spring():
    ratio = 1e7
    shapes = beam.loaded(4, 1.0, 1.0, ratio)
    # A massless beam has 3 EI/L^3; a third of a quarter of the beam's mass comes on top.
    first = (3.0 / (ratio + 33.0 / 140.0)) ** 0.25
    np.testing.assert_allclose(shapes.beta[0], first, rtol=1e-8)
    pinned = [
        brentq(lambda b: np.sin(b) - np.cos(b) * np.tanh(b), lo, hi, xtol=1e-14)
        for lo, hi in ((3.0, 4.5), (6.0, 7.5), (9.5, 10.5))
    ]
    np.testing.assert_allclose(shapes.beta[1:], pinned, rtol=1e-6)


@pytest.mark.parametrize("mass, inertia", [(1e3, 1e3), (1e8, 1e7), (1e7, 1e8), (1e9, 1e9)])
def test_no_mode_is_lost_under_a_heavy_body(mass, inertia):
    """Mass and inertia both heavy: two roots lie close together near zero."""
    shapes = beam.loaded(3, 1.0, 1.0, mass, inertia)
    # Massless beam: stiffness of the tip in deflection and slope.
    K, M = np.array([[12.0, -6.0], [-6.0, 4.0]]), np.diag([mass, inertia])
    expected = np.sort(np.linalg.eigvals(np.linalg.solve(M, K)).real) ** 0.25
    np.testing.assert_allclose(shapes.beta[:2], expected, rtol=2e-3)
    assert shapes.beta[2] == pytest.approx(4.730, abs=2e-3)  # clamped at both ends


def test_offset_payload_is_a_load_on_a_rigid_extension():
    """Against Hermite finite elements whose last element is a rigid lever of length d."""
    length, rho, mass, inertia, offset = 1.2, 0.25, 0.3, 0.004, 0.15
    count = 60
    h = length / count
    unit = np.array([1.0, h, 1.0, h])  # a slope's row and column
    k = [[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]]
    k = np.outer(unit, unit) * k / h**3
    m = [[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]
    m = np.outer(unit, unit) * m * rho * h / 420.0
    size = 2 * (count + 1)
    K, M = np.zeros((size, size)), np.zeros((size, size))
    for e in range(count):
        here = slice(2 * e, 2 * e + 4)
        K[here, here] += k
        M[here, here] += m
    lever = np.array([[1.0, offset], [0.0, 1.0]])  # motion of the centre of mass
    M[-2:, -2:] += lever.T @ np.diag([mass, inertia]) @ lever
    omega = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(M[2:, 2:], K[2:, 2:])).real)[:4])
    shapes = beam.loaded(4, length, rho, mass, inertia, offset)
    np.testing.assert_allclose(frequencies_of(shapes, length, rho, 1.0), omega, rtol=1e-6)


def test_none_of_the_ten_modes_under_a_load_is_skipped():
    """Mode i has i - 1 nodes between clamp and tip."""
    xi = np.linspace(0.02, 1.0, 2001)
    light = beam.loaded(10, 1.0, 1.0, 0.2)
    changes = np.sum(np.diff(np.sign(light(xi)), axis=0) != 0, axis=0)
    np.testing.assert_array_equal(changes, np.arange(10))
    # Inertia adds one degree of freedom: the roots interlace.
    for inertia in (1e-3, 0.1, 10.0):
        beta = beam.loaded(10, 1.0, 1.0, 0.2, inertia).beta
        assert np.all(beta < light.beta)
        assert np.all(beta[1:] > light.beta[:-1])


def test_more_modes_leave_the_first_ones_as_they_are():
    few, many = (beam.loaded(n, 1.2, 0.25, 0.05, 1e-4) for n in (2, 20))
    np.testing.assert_array_equal(few.beta, many.beta[:2])
    np.testing.assert_allclose(few(XI), many(XI)[:, :2], atol=1e-13)


@pytest.mark.parametrize(
    ("load", "limit"),
    [
        ((1e11, 0.0, 0.0), "at most 1e+10"),
        ((0.0, 1e11, 0.0), "at most 1e+10"),
        ((1e4, 0.0, 1e4), "at most 1e+10"),
        ((np.nan,), "2 are needed"),  # no roots
    ],
)
def test_a_load_without_modes_in_the_range_searched_is_refused(load, limit):
    with pytest.raises(ModelError) as error:
        beam.loaded(2, 1.0, 1.0, *load)
    assert (error.value.field, error.value.limit) == ("tip load", limit)


def test_shapes_from_measured_frequencies_are_those_of_the_case_study(errata, agrees):
    shapes = paper_beam([2.12, 14.2626])
    found = frequencies_of(shapes, *PAPER)
    np.testing.assert_allclose(found, 2.0 * np.pi * np.array([2.12, 14.2626]), rtol=1e-13)
    agrees(shapes(1.0), errata["P3"]["phi_e"])
    gram = paper_beam([2.12, 14.3]).gram()  # not orthogonal
    agrees(gram[0, 1], errata["measured_frequencies"]["gram_12_unit_norm_shapes"])


def test_integrals_reach_their_stated_tolerance(shapes):
    def exact(function):
        points = np.linspace(0.0, 1.0, 9)
        parts = pairwise(points)
        # With full_output quad keeps quiet when rounding stops it short of 1e-15.
        return sum(
            quad(function, a, b, epsabs=1e-15, epsrel=1e-13, full_output=1)[0] for a, b in parts
        )

    m = shapes.count
    moment = shapes.integral(lambda xi: xi)
    area = shapes.integral()
    tolerance = beam.INTEGRAL_TOLERANCE
    for i in {0, 1, m - 1}:
        assert area[i] == pytest.approx(exact(lambda x, i=i: shapes(x)[i]), abs=tolerance)
        assert moment[i] == pytest.approx(exact(lambda x, i=i: x * shapes(x)[i]), abs=tolerance)
        for derivative in (0, 1, 2):
            gram = shapes.gram(derivative, lambda xi: 1.0 - xi**2)
            expected = exact(
                lambda x, i=i, k=derivative: (1.0 - x**2) * shapes(x, k)[i] * shapes(x, k)[m - 1]
            )
            assert gram[i, m - 1] == pytest.approx(expected, abs=tolerance * np.abs(gram).max())
            np.testing.assert_array_equal(gram, gram.T)


def test_first_moment_of_clamped_free_modes_is_known_in_closed_form():
    # int xi phi'''' = [xi phi''' - phi''] = phi''(0) at a free end.
    shapes = beam.clamped_free(10)
    np.testing.assert_allclose(
        shapes.integral(lambda xi: xi), shapes(0.0, 2) / shapes.beta**4, atol=1e-14
    )
    np.testing.assert_allclose(shapes.integral(), -shapes(0.0, 3) / shapes.beta**4, atol=1e-14)
