# SPDX-License-Identifier: Apache-2.0
"""What to measure next: what is badly determined, and what makes other intervals narrower."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_studies.identification import advice


@dataclass
class Fit:
    """As much of a fit as the advice needs."""

    covariance: np.ndarray
    values: np.ndarray
    kinds: tuple
    half_widths: np.ndarray = None
    undetermined: tuple = ()
    quantities: list = field(default_factory=list)

    def __post_init__(self):
        self.quantities = [
            SimpleNamespace(name=f"{k}{i}", kind=k) for i, k in enumerate(self.kinds)
        ]
        if self.half_widths is None:
            self.half_widths = 1.96 * np.sqrt(np.diag(self.covariance))


@pytest.fixture
def fit():
    """Gain and position act nearly alike, the mass stands alone, the hub is held."""
    P = np.array(
        [[1.0, 0.99, 0.0, 0.0], [0.99, 1.0, 0.0, 0.0], [0.0, 0.0, 1e-4, 0.0], [0.0, 0.0, 0.0, 0.0]]
    )
    widths = np.array([1.96, 1.96, 0.0196, np.nan])
    return Fit(
        P,
        np.array([10.0, 5.0, 1.0, 3.0]),
        ("gain", "position", "payload_mass", "hub_inertia"),
        widths,
    )


def test_correlations_are_of_what_is_fitted(fit):
    fitted, rho = advice.correlations(fit)
    assert_allclose(fitted, [0, 1, 2])
    assert_allclose(rho, [[1.0, 0.99, 0.0], [0.99, 1.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-12)
    assert advice.strongest(fit) == [("gain0", "position1", pytest.approx(0.99))]


def test_what_narrows_others_comes_first_and_what_is_determined_is_not_named(fit):
    made = advice.suggestions(fit)
    assert [s["name"] for s in made] == [
        "position1",
        "gain0",
    ]  # the wider one of two that act alike
    assert made[0]["how"] == "measure it with a ruler"
    assert made[0]["narrows"] == {"gain0": pytest.approx(np.sqrt(1.0 - 0.99**2))}
    assert "gain0 to 14 %" in made[0]["why"]


def test_what_is_badly_determined_is_named_with_its_interval():
    fit = Fit(np.eye(2), np.array([1.0, 100.0]), ("EI", "damping"), undetermined=("EI0",))
    (only,) = advice.suggestions(fit)
    assert only["name"] == "EI0" and only["why"] == "its interval is 196 % of its value"


def test_the_factor_is_that_of_the_conditional_distribution():
    random = np.random.default_rng(0)
    A = random.standard_normal((3, 3))
    P = A @ A.T
    fit = Fit(P, np.ones(3), ("EI", "gain", "bias"), undetermined=("EI0", "gain1", "bias2"))
    for s in advice.suggestions(fit):
        j = next(i for i, q in enumerate(fit.quantities) if q.name == s["name"])
        keep = [i for i in range(3) if i != j]
        known = P[np.ix_(keep, keep)] - np.outer(P[keep, j], P[keep, j]) / P[j, j]
        for name, factor in s["narrows"].items():
            i = next(i for i, q in enumerate(fit.quantities) if q.name == name)
            assert factor == pytest.approx(np.sqrt(known[keep.index(i), keep.index(i)] / P[i, i]))


def test_every_kind_that_is_fitted_has_a_way_to_be_measured():
    from flexarm_dynamics.arm import arm_file
    from flexarm_studies.identification import recording, strain_quantities

    arm = arm_file.load("tudor")
    still = recording.uniform(
        np.arange(30.0), {"position": np.zeros((30, 2)), "strain": np.zeros((30, 4))}
    )
    kinds = {q.kind for q in strain_quantities.strain_quantities(arm, still)}
    assert kinds <= set(advice.HOW)
