# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/theory.md, evaluated: each symbol has its shape, each formula gives what the code computes."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import expm

from flexarm_control.composite.design import design
from flexarm_dynamics import linear, singular_perturbation
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models.model import build

TEXT = (Path(__file__).resolve().parents[1] / "docs" / "theory.md").read_text("utf-8")
ARMS = ("R", "P3", "two_link")


def rows(name):
    """Rows of a marked table, cells without the marks of code."""
    part = TEXT.split(f"<!-- {name}: begin -->")[1].split(f"<!-- {name}: end -->")[0]
    lines = [line for line in part.strip().splitlines() if line.startswith("|")][2:]
    return [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in lines]


def riccati(A, B, Q, R):
    """Stabilising solution of V A + A'V - V B R^-1 B'V + Q = 0, from the stable eigenvectors of the Hamiltonian."""
    size = len(A)
    values, vectors = np.linalg.eig(np.block([[A, -B @ np.linalg.inv(R) @ B.T], [-Q, -A.T]]))
    stable = vectors[:, values.real < 0]
    return np.real(stable[size:] @ np.linalg.inv(stable[:size]))


class Motion:
    """A smooth reference through the state at hand, as the manifolds ask for it."""

    def __init__(self, q, qd):
        self.q, self.qd = q, qd
        self.position, self.velocity, self.acceleration = self.near(0.0)

    def near(self, t):
        """Position, velocity and acceleration t later, (3, n)."""
        w = 2.0 + np.arange(len(self.q))
        s, c = np.sin(w * t), np.cos(w * t)
        # sin and 1 - cos are zero at t = 0, where the state is (q, qd), and the acceleration 0.3.
        position = self.q + self.qd * s / w + 0.3 * (1 - c) / w**2
        return np.array([position, self.qd * c + 0.3 * s / w, -self.qd * w * s + 0.3 * c])


def names(arm):
    """What the tables speak of, for an arm in a random state; all of it from seeds."""
    model = build(arm_file.load(arm))
    n, m = model.n_joints, model.n_modes
    random = np.random.default_rng(7)
    q, qd = random.uniform(-1, 1, n), 0.5 * random.uniform(-1, 1, n)
    terms = model.terms(q, qd)
    M = terms.M
    H11, H12, H21, H22 = terms.partition()
    kp, kv, alpha = np.full(n, 2.0), np.full(n, 3.0), 1.5
    slow = {"type": "model_following", "kp": [2.0] * n, "kv": [3.0] * n}
    fast = {"type": "lqr", "alpha": alpha, "q": [2.0] * m + [0.5] * m, "r": [0.7] * n}
    law = design(model, slow, fast, {"type": "quasi_steady"})
    exact = design(model, slow, fast, {"type": "corrected", "order": 1})
    reference = Motion(q + 0.01, qd - 0.02)
    z = 1e-3 * random.uniform(-1, 1, 2 * m)
    law.step(q, qd, z[:m], z[m:], reference, 1e-3)
    on = Motion(q, qd)
    exact.step(q, qd, z[:m], z[m:], on, 1e-3)

    def d0(t):
        position, velocity, acceleration = on.near(t)
        there = model.terms(position, velocity)
        force = there.M[n:, :n] @ acceleration + there.f2
        return -np.linalg.solve(there.K2, force)

    a, B = singular_perturbation.slow_subsystem(terms)
    A2, B2 = singular_perturbation.fast_subsystem(terms)
    A20, B20 = singular_perturbation.fast_subsystem(model.terms(np.zeros(n), np.zeros(n)))
    found = {name: getattr(np, name) for name in ("block", "zeros", "eye", "vstack", "hstack")}
    found |= {"sqrt": np.sqrt, "abs": np.abs, "inv": np.linalg.inv, "eigvals": np.linalg.eigvals}
    found |= {"max": np.max, "min": np.min, "expm": expm, "riccati": riccati}
    for name in ("slow_subsystem", "fast_subsystem", "quasi_steady_state", "slow_torque"):
        found[name] = getattr(singular_perturbation, name)
    found |= {"time_scales": singular_perturbation.time_scales, "linear": linear}
    found |= {name: getattr(terms, name) for name in ("f1", "f2", "C1", "C2", "K1", "K2")}
    M11, M12, M21, M22 = M[:n, :n], M[:n, n:], M[n:, :n], M[n:, n:]
    S = np.linalg.inv(M22 - M21 @ np.linalg.inv(M11) @ M12)
    e, ed = reference.position - q, reference.velocity - qd
    Q, R = np.diag([2.0] * m + [0.5] * m), 0.7 * np.eye(n)
    u, qdd, T = random.uniform(-1, 1, n), random.uniform(-1, 1, n), 2e-3
    link, corrected = model.arm.links[0].name, exact.manifold
    local = {k: v for k, v in locals().items() if k not in ("found", "arm", "random", "on")}
    return SimpleNamespace(**(found | local), m1=len(model.mode_shapes(link, "y")(1.0)))


@pytest.fixture(scope="module", params=ARMS)
def known(request):
    """Names of one arm."""
    return vars(names(request.param))


def evaluate(expression, known):
    """Value of a cell."""
    return np.asarray(eval(expression, {"__builtins__": {}}, known))


@pytest.mark.parametrize("row", rows("symbols"), ids=lambda row: row[0])
def test_a_symbol_is_in_the_code_and_has_its_shape(row, known):
    _, meaning, _, shape, code = row
    wanted = tuple(int(evaluate(each, known)) for each in shape.split(",") if each)
    assert meaning
    assert evaluate(code, known).shape == wanted
    assert np.isfinite(evaluate(code, known)).all()


@pytest.mark.parametrize("row", rows("formulas"), ids=lambda row: row[0])
def test_a_formula_gives_what_the_code_computes(row, known):
    _, numbers, code = row
    by_hand, computed = evaluate(numbers, known), evaluate(code, known)
    assert by_hand.shape == computed.shape
    scale = max(np.abs(computed).max(), 1e-12)
    # d0 is differenced; mu is of a double pole, to half the digits.
    off = 2e-5 if "d0(" in numbers else 1e-6
    np.testing.assert_allclose(computed, by_hand, rtol=0, atol=off * scale)


def test_the_tables_are_there():
    assert len(rows("symbols")) > 20 and len(rows("formulas")) > 12
    formulas = {row[0] for row in rows("formulas")}
    # What the text states in display, the table evaluates.
    for equation in ("(3)", "(9)", "(10)", "(11)", "(12)", "(13)", "(15)"):
        assert any(equation in formula for formula in formulas) and equation in TEXT, equation
