# SPDX-License-Identifier: Apache-2.0
"""The printed model: every number of the case study, what the paper leaves out, and that it is a model of its own."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from flexarm_dynamics import singular_perturbation as sp
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.units import FOOT, POUND_FORCE, POUND_FORCE_FOOT
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.models.one_link import OneLink
from flexarm_dynamics.models.paper_appendix import PaperAppendix

SLUG = POUND_FORCE / FOOT  # [kg] one lbf s^2/ft
REST = np.zeros(1)


def fast_design(arm_model, errata):
    """Gains (20) in the paper's units, u_f = -k z_f, by scipy's Riccati solver; A2 - B2 k."""
    A2, B2 = sp.fast_subsystem(arm_model.terms(REST, REST))
    B2 = B2 * POUND_FORCE  # deflections in ft, torque in lbf ft
    design = errata["design"]
    Q = np.diag([float(q) for q in design["q_diagonal"]])
    shifted = A2 + float(design["alpha_1_per_s"]) * np.eye(4)
    r = float(design["r"])
    k = B2.T @ solve_continuous_are(shifted, B2, Q, np.array([[r]])) / r
    return k[0], A2 - B2 @ k


@pytest.fixture(params=["P3", "R"])
def name(request):
    return request.param


def test_mass_matrix_is_that_of_the_case_study(name, shipped, errata, agrees):
    M, expected = shipped(name).terms(REST, REST).M, errata[name]
    agrees(M[0, 0] / POUND_FORCE_FOOT, expected["m11_lbf_ft_s2"])
    agrees(M[0, 1] / POUND_FORCE, expected["m12_lbf_s2"])
    agrees(M[0, 2] / POUND_FORCE, expected["m13_lbf_s2"])
    agrees(M[1, 1] / SLUG, expected["m22_lbf_s2_per_ft"])
    agrees(M[1, 2] / SLUG, expected["m23_lbf_s2_per_ft"])
    agrees(M[2, 2] / SLUG, expected["m33_lbf_s2_per_ft"])
    np.testing.assert_array_equal(M, M.T)


def test_elastic_stiffness_is_that_of_the_case_study(name, shipped, errata, agrees):
    K2 = shipped(name).terms(REST, REST).K2
    agrees(np.diag(K2) / SLUG, errata[name]["k_e_lbf_per_ft"])
    assert K2[0, 1] == K2[1, 0] == 0.0


def test_tip_values_are_those_of_the_case_study(name, shipped, errata, agrees):
    agrees(shipped(name).phi_tip, errata[name]["phi_e"])


def test_tip_slopes_of_R_are_per_unit_length(shipped, errata, agrees):
    agrees(shipped("R").slope_tip * FOOT, errata["R"]["slope_e_per_ft"])


def test_inverse_of_the_mass_matrix_is_that_of_the_case_study(name, shipped, errata, agrees):
    H11, _, H21, _ = shipped(name).terms(REST, REST).partition()
    agrees(H21 * POUND_FORCE, errata[name]["H21_per_lbf_s2"])
    agrees(H11 * POUND_FORCE_FOOT, errata[name]["h11_per_lbf_ft_s2"])


def test_open_loop_frequencies_are_those_of_the_case_study(name, shipped, errata, agrees):
    arm_model = shipped(name)
    omega, zeta = sp.frequencies_and_damping(
        np.linalg.eigvals(sp.fast_subsystem(arm_model.terms(REST, REST))[0])
    )
    agrees(omega, errata[name]["open_omega_rad_per_s"])
    np.testing.assert_allclose(zeta, 0.0, atol=1e-12)
    np.testing.assert_allclose(arm_model.frequencies(), omega, rtol=1e-12)


def test_fast_gains_of_P3_are_those_that_reproduce_the_paper(shipped, errata, agrees):
    k, closed = fast_design(shipped("P3"), errata)
    expected = errata["P3"]
    assert np.all(k < 0.0)  # as phi_1e > 0
    agrees(np.abs(k), expected["k_magnitude_lbf_and_lbf_s"])
    omega, zeta = sp.frequencies_and_damping(np.linalg.eigvals(closed))
    agrees(omega, expected["closed_omega_rad_per_s"])
    agrees(zeta, expected["closed_zeta"])
    printed = expected["printed"]
    np.testing.assert_allclose(
        np.abs(k), np.array(printed["k_magnitude_lbf_and_lbf_s"], float), rtol=2e-4
    )
    agrees(omega, printed["closed_omega_rad_per_s"])
    agrees(zeta, printed["closed_zeta"])


def test_fast_gains_of_R_are_those_of_the_case_study(shipped, errata, agrees):
    k, closed = fast_design(shipped("R"), errata)
    agrees(k, errata["R"]["k_lbf_and_lbf_s"])
    omega, zeta = sp.frequencies_and_damping(np.linalg.eigvals(closed))
    agrees(omega, errata["R"]["closed_omega_rad_per_s"])
    agrees(zeta, errata["R"]["closed_zeta"])


def test_terms_are_those_of_the_corrected_A3_to_A6(name, shipped):
    """k11 = M qd^2 phi_1e^2 and c1 = 2 M qd [...], the misprints corrected."""
    arm_model = shipped(name)
    M, phi = arm_model.arm.payload.mass, arm_model.phi_tip
    delta, delta_d, qd = np.array([0.02, -0.01]), np.array([0.3, 0.7]), np.array([1.9])
    t, still = arm_model.terms(REST, qd, delta, delta_d), arm_model.terms(REST, REST)
    y, yd = phi @ delta, phi @ delta_d
    assert t.M[0, 0] - still.M[0, 0] == pytest.approx(M * y**2, rel=1e-12)
    assert (t.C1 @ delta_d)[0] == pytest.approx(2.0 * M * qd[0] * y * yd, rel=1e-13)
    np.testing.assert_allclose(
        still.K2 - t.K2, M * qd[0] ** 2 * np.outer(phi, phi), rtol=1e-9, atol=1e-12
    )
    for zero in (t.f1, t.f2, t.K1, t.C2):
        assert not np.any(zero)


class WithPayloadCouplings(PaperAppendix):
    """The appendix with J_p in m11 and J_p phi'_e in m12 and m13."""

    def derive(self):
        c = super().derive()
        inertia = self.arm.payload.inertia[2][2]
        return replace(c, rigid=c.rigid + inertia, h=c.h + inertia * self.slope_tip)


def test_omitted_payload_couplings_have_the_documented_effect(errata, agrees):
    arm_model = WithPayloadCouplings(arm_file.load("R"))
    expected = errata["R"]["with_J_p_couplings"]
    agrees(arm_model.terms(REST, REST).M[0, 1] / POUND_FORCE, expected["m12_lbf_s2"], units=1.0)
    k, closed = fast_design(arm_model, errata)
    agrees(k[0], expected["k_1_lbf"])
    agrees(sp.frequencies_and_damping(np.linalg.eigvals(closed))[1][1], expected["zeta_2"])


def fully_derived(name):
    return OneLink(replace(arm_file.load(name), model="one_link", model_options={}))


def test_full_derivation_differs_from_the_appendix_by_what_print_leaves_out(shipped):
    appendix, full = shipped("R"), fully_derived("R")
    a, f = appendix.coefficients, full.coefficients
    Jp, link = appendix.arm.payload.inertia[2][2], appendix.link
    options = appendix.arm.model_options
    slope = appendix.slope_tip
    assert (f.h[0] - a.h[0]) / POUND_FORCE == pytest.approx(8.52e-5 * 0.68825, rel=1e-5)
    np.testing.assert_allclose(f.h, a.h + Jp * slope, rtol=1e-12)
    missing = Jp + link.mass * link.length**2 / 3.0 - options["beam_inertia"]
    assert f.rigid - a.rigid == pytest.approx(missing, rel=1e-12)
    # The beam's own mass in m11(delta) and in the centrifugal stiffness.
    np.testing.assert_allclose(f.G - a.G, link.mass * np.eye(2), atol=1e-14)
    np.testing.assert_allclose(
        f.M22 - a.M22, (link.mass - options["beam_mass"]) * np.eye(2), atol=1e-14
    )
    # Elastic stiffness: nothing is left out, as the modes of R are orthogonal.
    np.testing.assert_allclose(f.K, a.K, atol=1e-9)


def test_modes_of_R_are_consistent_with_print_and_those_of_P3_are_not(shipped):
    np.testing.assert_allclose(shipped("R").shapes.gram(), np.eye(2), atol=1e-13)
    assert shipped("P3").shapes.gram()[0, 1] > 0.29


def test_fitted_number_raises_m23_alone():
    arm = arm_file.load("P3")
    without = replace(arm, model_options={**arm.model_options, "m23_fit": 0.0})
    fit = PaperAppendix(arm).coefficients.M22 - PaperAppendix(without).coefficients.M22
    np.testing.assert_allclose(fit / SLUG, [[0.0, 2.0631e-3], [2.0631e-3, 0.0]], rtol=1e-12)


R = arm_file.load("R")


@pytest.mark.parametrize(
    ("arm", "field"),
    [
        (arm_file.load("one_link"), "paper_appendix of one_link"),
        (replace(R, model_options={}), "paper_appendix of R"),
        (replace(R, gravity=(0.0, -9.81, 0.0)), "gravity"),  # the published model has none
        (arm_file.load("P3").with_modes(1), "paper_appendix.m23_fit"),  # it couples two modes
    ],
)
def test_an_arm_that_the_published_model_does_not_cover_is_refused(arm, field):
    with pytest.raises(ModelError) as error:
        PaperAppendix(arm)
    assert error.value.field == field


def test_R_takes_any_number_of_modes(shipped):
    np.testing.assert_allclose(
        shipped("R", 5).terms(REST, REST).M[:3, :3], shipped("R").terms(REST, REST).M, rtol=1e-12
    )
    assert shipped("R", 1).frequencies().shape == (1,)
