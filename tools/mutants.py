# SPDX-License-Identifier: Apache-2.0
"""Puts one error at a time into a copy of the sources, and runs the tests that must fail: `make mutants`.

Each mutation is one replacement in one file. It is caught when a named test fails; a test run that cannot start, or
ends otherwise, is an error. The named tests must pass in a copy without mutations; they are run there first.
``-k TEXT`` chooses those whose name or file has the text in it.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: What a copy needs: sources and what their tests read.
COPIED = ("src", "tests", "config", "pyproject.toml", "conftest.py")
LEFT_OUT = shutil.ignore_patterns("__pycache__", "*.egg-info", ".pytest_cache", ".hypothesis")
#: Of one mutation [s].
TIMEOUT = 1800.0


@dataclass(frozen=True)
class Mutant:
    """One error.

    Attributes
    ----------
    name : str
        What is wrong then.
    file : str
        Below ``src``.
    old, new : str
        Text that occurs once in the file, and what takes its place.
    tests : str
        Arguments of pytest, relative to ``src``.
    """

    name: str
    file: str
    old: str
    new: str
    tests: str


def of(package, folder, tests, *rows):
    """Mutants of modules in one folder: rows of (module, name, old, new), or with tests of their own at the end."""
    return [
        Mutant(
            name, str(Path(package, package, folder, f"{module}.py")), old, new, *(own or [tests])
        )
        for module, name, old, new, *own in rows
    ]


CHAIN = "flexarm_dynamics/test/test_chain.py"
FORCES = f"{CHAIN}::test_forces_are_those_of_a_second_derivation"
FORWARD = f"{CHAIN}::test_forward_dynamics_solve_what_the_terms_say"
ENERGY = f"{CHAIN}::test_energies_and_momenta_are_sums_over_all_that_has_mass"
POINTS = f"{CHAIN}::test_points_turn_and_move_as_in_the_second_derivation"
IMPLICIT = "flexarm_sim/test/test_chain_simulation.py -k implicit"
ONE_LINK = "flexarm_dynamics/test/test_one_link.py -k kernel"
STEPPER = "flexarm_dynamics/test/test_one_link.py -k stepper"
ORDER = "flexarm_sim/test/test_chain_simulation.py::test_order_of_the_integrators"

ROUNDED = "flexarm_dynamics/test/test_transmission.py -k rounded"

KERNELS = of(
    "flexarm_dynamics",
    "kernels",
    FORCES,
    (
        "transmissions",
        "rounded play: only one flank is rounded",
        "    return x - 0.5 * (np.sqrt(a * a + w2) - np.sqrt(b * b + w2))",
        "    return x - 0.5 * (np.sqrt(a * a + w2) - abs(b))",
        ROUNDED,
    ),
    (
        "bodies",
        "centripetal force of a link: sign of 2 w x c'",
        "t[1, 0], t[1, 1], t[1, 2] = 0.0, 2.0 * cyd, 2.0 * czd",
        "t[1, 0], t[1, 1], t[1, 2] = 0.0, -2.0 * cyd, 2.0 * czd",
    ),
    (
        "bodies",
        "Coriolis force on a mode: factor",
        "wy * along - w2 * gy - 2.0 * wx * gzd",
        "wy * along - w2 * gy - wx * gzd",
    ),
    (
        "bodies",
        "centrifugal force on a mode: missing",
        "wz * along - w2 * gz + 2.0 * wx * gyd",
        "wz * along + 2.0 * wx * gyd",
    ),
    (
        "bodies",
        "coupling of a mode to the joint: sign",
        "w.l[i, j, 1] = -e\n",
        "w.l[i, j, 1] = e\n",
    ),
    ("bodies", "inertia of a bent link: missing", "    J[1, 1] += zz\n", ""),
    ("bodies", "inertia of a bent link: index", "    J[0, 2] -= xz\n", "    J[0, 2] -= xy\n"),
    (
        "bodies",
        "moment of r x (w x r'): sign",
        "N[1] += 2.0 * (wy * rr - (",
        "N[1] += 2.0 * (wy * rr + (",
    ),
    (
        "bodies",
        "foreshortening: factor",
        "            w.node[0, g] = 0.5 * u\n",
        "            w.node[0, g] = u\n",
    ),
    (
        "bodies",
        "foreshortening's acceleration: missing",
        "    F[0] += (wy * wy + wz * wz) * short - link[SHORT_DD]\n",
        "    F[0] += (wy * wy + wz * wz) * short\n",
    ),
    (
        "bodies",
        "foreshortening's moment r x r'': sign",
        "2.0 * (syd * wx - xsd * wy) - zsdd",
        "2.0 * (syd * wx - xsd * wy) + zsdd",
    ),
    (
        "bodies",
        "foreshortening's part of a mode's centrifugal force: missing",
        "            w.q[i, j] -= wx * wz * mode[j, SPHI] - 2.0 * wy * mode[j, SDPHI]\n",
        "            w.q[i, j] += 2.0 * wy * mode[j, SDPHI]\n",
    ),
    (
        "bodies",
        "coupling of modes by foreshortening: missing",
        "+= modes[j, k] if k <= j else modes[k, j]",
        "+= 0.0",
    ),
    (
        "sections",
        "foreshortening of the tip: sign",
        "w.partial[n, j, 0] = -draws[j]",
        "w.partial[n, j, 0] = draws[j]",
    ),
    (
        "bodies",
        "elastic force of finite slopes: missing",
        "kz2 * phi2 + kz2 * kz2 * sz * phi1",
        "kz2 * phi2",
    ),
    (
        "sections",
        "tip's Coriolis acceleration: factor",
        "        t[5, k] += 2.0 * rate[k]\n",
        "        t[5, k] += rate[k]\n",
    ),
    ("sections", "tip's angular acceleration: missing", "    bias_al[0] += ad * bd * ca\n", ""),
    (
        "sections",
        "force of a body on a link, about the joint: missing",
        "            w.N[i, k] += t[3, k] + t[9, k]\n",
        "            w.N[i, k] += t[3, k]\n",
    ),
    (
        "sections",
        "joint's offset from the tip: missing",
        "cross(carried, t[8], t[9])",
        "cross(om, t[8], t[9])",
    ),
    (
        "sections",
        "twist of a tip's frame: sign",
        "-ca * st - sa * sb * ct,",
        "ca * st - sa * sb * ct,",
    ),
    (
        "placing",
        "payload's centrifugal force: missing",
        "    cross(om, w.t[0], zf)\n",
        "    cross(om, s, zf)\n",
    ),
    (
        "recursions",
        "gravity: sign",
        "        w.a0[0, k] = -w.a0[0, k]\n",
        "        w.a0[0, k] = w.a0[0, k]\n",
    ),
    (
        "recursions",
        "rotor: its gear",
        "w.u[n] = d.rotor[n] * (dot(d.axis[n], w.al[n]) + d.gear[n] * qdd[n])",
        "w.u[n] = d.rotor[n] * (dot(d.axis[n], w.al[n]) + qdd[n])",
    ),
    (
        "recursions",
        "articulated inertia: sign of a coupling",
        "- Y[a, k] * S[k, b] - tm[5, a, k]",
        "+ Y[a, k] * S[k, b] - tm[5, a, k]",
        FORWARD,
    ),
    (
        "recursions",
        "elimination of a mode: sign",
        "            w.zn[i, a] += ga * r\n",
        "            w.zn[i, a] -= ga * r\n",
        FORWARD,
    ),
    (
        "recursions",
        "elimination of a joint: rotor missing",
        "D = dot(a, Ua) + d.gear[i] * d.gear[i] * d.rotor[i] + extra",
        "D = dot(a, Ua) + extra",
        FORWARD,
    ),
    (
        "chain",
        "momentum: coupling of a mode missing",
        "                    L[k] += w.l[i, j, k] * delta_d[d.first[i] + j]\n",
        "",
        ENERGY,
    ),
    (
        "implicit_steps",
        "implicit method: gamma",
        "gamma = 1.0 - np.sqrt(0.5)",
        "gamma = 0.5",
        IMPLICIT,
    ),
    (
        "one_link",
        "centrifugal stiffness: sign",
        "r2 = ri + qd * qd * gi",
        "r2 = ri - qd * qd * gi",
        ONE_LINK,
    ),
    ("one_link", "Coriolis torque: factor", "r1 -= 2.0 * qd * gi", "r1 -= qd * gi", ONE_LINK),
    (
        "integrators",
        "viscous friction: sign",
        "fraction * change[i] - friction[i, 0] * rate",
        "fraction * change[i] + friction[i, 0] * rate",
        STEPPER,
    ),
    (
        "integrators",
        "a stage's step",
        "point[v] = state[v] + ahead * rate[v]",
        "point[v] = state[v] + gain * rate[v]",
        ORDER,
    ),
)

MODELS = of(
    "flexarm_dynamics",
    "models",
    "flexarm_sim/test/test_integrators.py",
    (
        "fixed_step",
        "substeps of modes that are not damped: as if they were",
        "PART_OF_DAMPING * 2.0 * np.pi * damping / omega",
        "1.0 + 0.0 * omega",
    ),
    (
        "fixed_step",
        "substeps of damped modes: as if they were not",
        "return fewer",
        "return count",
    ),
    (
        "chain",
        "slow torque: play and slip are left out",
        "or self._transmissions or self._slips:\n            return None",
        "or self._slips:\n            return None",
        "flexarm_dynamics/test/test_straight_arm.py",
    ),
)

TESTS = "flexarm_control/test/"
LAWS = [
    *of(
        "flexarm_control",
        "motions",
        TESTS + "test_shapers.py",
        (
            "shapers",
            "damped period: natural",
            "return np.pi / (omega * root), ",
            "return np.pi / omega, ",
        ),
        ("shapers", "MZV: decay of half a period", "k = K**MZV_SPACING", "k = K"),
        ("shapers", "two-hump EI: its zeros", "c = 3.0 - 3.0 / x0**2", "c = 3.0 - 2.9 / x0**2"),
        ("shapers", "ZVDD: an impulse", "3.0 * K**2, K**3", "3.0 * K, K**3"),
    ),
    *of(
        "flexarm_control",
        "slow",
        TESTS + "test_slow_laws.py",
        (
            "linear_model_following",
            "the inertia: factor",
            "return self.B_inverse(terms) @ self._wanted(",
            "return 0.98 * self.B_inverse(terms) @ self._wanted(",
        ),
        (
            "model_following",
            "(13): a sign",
            "self.Lambda1 = -np.array(",
            "self.Lambda1 = np.array(",
        ),
        (
            "computed_torque",
            "gravity and velocity torque: missing",
            "u = np.linalg.solve(B, v - a)",
            "u = np.linalg.solve(B, v)",
        ),
        (
            "joint_pid",
            "the integral grows beyond the torque limit",
            "np.where(self._beyond * self._error > 0.0, 0.0, self._error)",
            "self._error",
        ),
        (
            "resolved_acceleration",
            "null space: missing",
            "return y + self.damped_inverse(J) @ (b - J @ y)",
            "return self.damped_inverse(J) @ (b - J @ y)",
        ),
        (
            "sliding_mode",
            "surface: sign",
            "s = rate + self.slope * error",
            "s = rate - self.slope * error",
        ),
        (
            "adaptive_model_following",
            "regressor: velocity torque missing",
            "Y += self._coriolis(self._difference, q, qd, speed)",
            "Y += 0.0",
        ),
    ),
    *of(
        "flexarm_control",
        "payload",
        "flexarm_control/test/test_payload_estimator.py",
        (
            "estimator",
            "strains and torques that contradict each other are used",
            "if self.low > self.high:",
            "if False:",
        ),
        (
            "estimator",
            "weight and inertia of the strains: sign",
            "strains.add(Y[n:], -need[n:], W, spring, errors, dt)",
            "strains.add(Y[n:], need[n:], W, spring, errors, dt)",
        ),
    ),
    *of(
        "flexarm_control",
        "composite",
        "flexarm_studies/test/test_payload_estimate.py -k step",
        (
            "law",
            "another payload's torque: missing in the sample in which the integral takes it",
            "                self.torque += taken\n",
            "",
        ),
    ),
    *of(
        "flexarm_control",
        "robust",
        TESTS + "test_verdict.py",
        (
            "whole",
            "verdict: the torque reported is another one",
            "y[-n:, place(whole + 1)] = (1.0 - late / T) * np.eye(n)",
            "y[-n:, place(1)] = np.eye(n)",
        ),
        (
            "whole",
            "verdict: a late torque acts at once",
            "        acts(end, whole)\n",
            "        acts(end, 0)\n",
        ),
        (
            "whole",
            "verdict: a jump counts as a slope",
            "                raise _JumpError\n",
            "                pass\n",
        ),
        (
            "verdict",
            "verdict: the phase is not tried",
            "np.exp(-1j * PHASE)",
            "1.0 + 0.0j * PHASE",
        ),
    ),
    *of(
        "flexarm_control",
        "robust",
        TESTS + "test_robust.py",
        (
            "uncertain",
            "a joint that sticks: as much decay as of one that turns",
            "STICKING = {1.0: 0.1, 0.1: 0.3}",
            "STICKING = {1.0: 0.8, 0.1: 0.9}",
        ),
        (
            "search",
            "start of a search: modes beyond the low pass as well",
            "square <= corner**2",
            "square <= np.inf",
        ),
        (
            "loop",
            "the integral",
            "F[at_w:at_v, :size] = h",
            "F[at_w:at_v, :size] = -h",
        ),
        ("loop", "a late torque acts at once", "add(end, whole)", "add(end, 0)"),
        (
            "decay",
            "every set has all of the gradient",
            "np.outer(self._weights[id(loop)], slope)",
            "np.outer(np.ones(len(self._weights[id(loop)])), slope)",
            TESTS + "test_schedule.py",
        ),
        ("search", "the worst loops are not chosen", "if value > most and", "if value < most and"),
        (
            "search",
            "searches nearby begin where the first one did",
            "search.refined(best[1] * (1.0 + away), AGAIN)",
            "search.refined(x * (1.0 + away), AGAIN)",
        ),
        (
            "search",
            "searches nearby go on when none brings anything",
            "else waited + 1",
            "else waited",
        ),
        (
            "uncertain",
            "no arm of which payload or stiffness alone differs",
            "        if uncertainty.edges\n",
            "        if False\n",
        ),
        (
            "decay",
            "the smooth maximum is none",
            "worst + w * np.log(total)",
            "worst - w * np.log(total)",
        ),
        (
            "card",
            "limits are looked for outwards only",
            "(middle, high) if stable(middle)",
            "(low, high) if stable(middle)",
        ),
        ("card", "half of the phase", "np.exp(-1j * phase)", "np.exp(-0.5j * phase)"),
        ("tip", "the gains' sign", "np.linalg.solve(A - B @ K", "np.linalg.solve(A + B @ K"),
        ("trade", "each speed starts anew", "say, gains))", "say, None))"),
        ("tip", "settling looked for to 20 %", "SETTLED = 0.02", "SETTLED = 0.2"),
    ),
    *of(
        "flexarm_control",
        "robust",
        TESTS + "test_settling.py",
        (
            "settling",
            "after a motion: forces of the file's arm are left out of the gradient",
            "+ A.T @ to_A + to_S @ S.T",
            "+ A.T @ to_A",
        ),
        (
            "settling",
            "after a motion: the other arm's bending is as stiff as the file's",
            "self._forces(self._M - M, self._K - K)",
            "self._forces(self._M - M, 0.0 * K)",
        ),
        (
            "settling",
            "after a motion: joints with friction do not stick",
            "sampling, sticking=part)",
            "sampling, sticking=0.0)",
        ),
        (
            "settling",
            "after a motion: early and late count the same",
            "step * self._time**LATE",
            "step * self._time**0",
        ),
        (
            "search",
            "after a motion: poles may be as slow as they like",
            "            if pole > low:\n",
            "            if False:\n",
        ),
        (
            "design",
            "after a motion: gains are taken however long rubbing joints let a mode ring",
            "if other is x or _rings_longer(",
            "if other is x or not (",
        ),
        (
            "settling",
            "after a motion: joints that do not rub count as what rings",
            "for k, one in self._residuals if one.rubs)",
            "for k, one in self._residuals)",
        ),
        (
            "design",
            "after a motion: every design goes on",
            "min(decays) <= 0.0 or after(x)[0] < most",
            "min(decays) <= 0.0",
        ),
        (
            "design",
            "after a motion: all loops are asked as much as before",
            "yield EASED if loop.kind == MARGIN else least",
            "yield least",
        ),
        (
            "settling",
            "after a motion: steps are as long as during it, not so their times",
            "range(self._doublings + self._longer)",
            "range(self._doublings)",
        ),
    ),
    *of(
        "flexarm_control",
        "robust",
        TESTS + "test_recovery.py",
        (
            "recovery",
            "torque limits: none are taken",
            "for most in (limit, np.inf * limit)",
            "for most in (np.inf * limit, np.inf * limit)",
        ),
        (
            "recovery",
            "torque limits: the motion is as long as it likes",
            "given = part * forces @ way, weight + part * torque, weight",
            "given = forces @ way, weight + torque, weight",
        ),
        (
            "design",
            "torque limits: no design is made slower",
            "if found.comes_back or slower.speed < SLOWEST:",
            "if True:",
        ),
        (
            "design",
            "torque limits: the slowest design is taken",
            "other.comes_back or other.recovery.limited < found.recovery.limited",
            "True",
        ),
        (
            "loop",
            "torque limits: torques under way are not changed",
            "effect[at : at + n] = np.eye(n)",
            "effect[at : at + n] = 0.0",
        ),
    ),
    *of(
        "flexarm_control",
        "kernels",
        TESTS + "test_recovery.py",
        (
            "steps",
            "torque limits: the integral goes on",
            "(X[k + 1, at] - X[k, at]) * wanted[i] < 0.0",
            "(X[k + 1, at] - X[k, at]) * wanted[i] < -np.inf",
        ),
    ),
    *of(
        "flexarm_control",
        "kernels",
        TESTS + "test_reading_checks.py",
        (
            "strains",
            "signs of gauges: no Coriolis forces on bending links",
            "moved[j] + turn[i, j] * rate",
            "moved[j] + 0.0 * rate",
        ),
    ),
    *of(
        "flexarm_control",
        "kernels",
        TESTS + "test_robust.py",
        ("eigenvectors", "the gradient's sign", "by_torque /= -period", "by_torque /= period"),
    ),
    *of(
        "flexarm_control",
        "robust",
        TESTS + "test_default.py",
        (
            "cache",
            "loops of another rate share a design",
            "[content, asdict(settings), asdict(uncertainty)",
            "[content, asdict(uncertainty)",
        ),
        ("cache", "damaged designs are used", 'found["sum"] == _hash', '"sum" in found or _hash'),
        ("default", "what is given is lost", "made.parameters | rest", "rest | made.parameters"),
    ),
    *of(
        "flexarm_control",
        "loop",
        TESTS + "test_torque_delay.py",
        ("torque_delay", "whole periods only", "float((k + f[k])", "float((k + 0.0 * f[k])"),
        (
            "torque_delay",
            "lost samples take no time",
            "range(min(count - 1, SENT))",
            "range(min(count - count, SENT))",
        ),
        (
            "torque_delay",
            "torques from before an interruption",
            "if first <= LAGS + 1 or",
            "if first <= 0 or",
        ),
        (
            "applied",
            "a first confirmation that comes late is no interruption",
            "return max(self._other_for, self._unconfirmed_for)",
            "return self._other_for",
            TESTS + "test_arm_controller.py",
        ),
    ),
    *of(
        "flexarm_control",
        "fast",
        TESTS + "test_fast_laws.py",
        (
            "lqr",
            "(20): alpha missing",
            "_solve(A2 + alpha * np.eye(A2.shape[0]), B2, q, parameters)",
            "_solve(A2, B2, q, parameters)",
        ),
        (
            "pole_placement",
            "damping's sign",
            "wanted = np.stack([-damping * omega + imaginary",
            "wanted = np.stack([damping * omega + imaginary",
        ),
        (
            "output_feedback",
            "its estimator's gain",
            "(1.0 - rho) * (Phi[m:, m:] @ inverse",
            "(1.0 + rho) * (Phi[m:, m:] @ inverse",
        ),
        (
            "fixed_gain",
            "rows and columns of the gain",
            "self._sets, self._now.reshape(-1))",
            "self._sets, self._now.T.reshape(-1))",
        ),
        ("scheduled_lqr", "interpolation", "for v in (1.0 - t, t)]", "for v in (t, 1.0 - t)]"),
    ),
    *of(
        "flexarm_control",
        "manifold",
        TESTS + "test_manifolds.py",
        (
            "expansion",
            "terms of the centre: of the first point",
            "t, centre = terms, len(terms.M) // 2",
            "t, centre = terms, 0",
            TESTS + "test_control_kernels.py",
        ),
        (
            "corrected",
            "the error's own motion: sign",
            "kp * later[:n] + kv * later[n:]",
            "kp * later[:n] - kv * later[n:]",
        ),
        (
            "corrected",
            "the error's own velocity: sign",
            "motion[1] -= later[n:]",
            "motion[1] += later[n:]",
        ),
        (
            "quasi_steady",
            "(9): gone",
            "self.amplitude[:] = quasi_steady_state(terms, slow_torque)",
            "self.amplitude[:] = 0.0",
        ),
        (
            "reference",
            "its feed-forward: gone",
            "self.feedforward[:] = found.beyond",
            "self.feedforward[:] = 0.0",
        ),
    ),
    *of(
        "flexarm_control",
        "composite",
        TESTS + "test_composite.py",
        (
            "law",
            "a law that is replaced: not faded",
            "fading.jump(old)",
            "fading.clear()",
        ),
        (
            "law",
            "the manifold without a feed-forward: not faded",
            "fading.jump(old - np.concatenate([u, amplitude, rate]))",
            "fading.clear()",
        ),
    ),
    *of(
        "flexarm_sim",
        ".",
        "flexarm_sim/test/test_damping.py",
        (
            "damping",
            "the soft start",
            "at_once + self._grown(elapsed) * (full - at_once)",
            "full",
        ),
        (
            "damping",
            "the torque of the first speed",
            "np.maximum(self.speed, np.abs(velocity), out=self.speed)",
            "self.speed[:] = np.abs(velocity)",
        ),
    ),
    *of(
        "flexarm_studies",
        "uncertain",
        "flexarm_studies/test/test_uncertain.py",
        (
            "baselines",
            "strain feedback: sign of the moment that a gauge shows",
            '(1.0 if gauge.direction == "twist" else -1.0)',
            '(-1.0 if gauge.direction == "twist" else 1.0)',
        ),
        (
            "baselines",
            "strain feedback: of the whole moment, not of what the motion leaves",
            "(s[n : n + m] - still)",
            "s[n : n + m]",
        ),
        (
            "baselines",
            "LQG: as much noise in the torque as there may be",
            "value + max(np.log10(noisy / NOISIEST), 0.0)",
            "value",
        ),
        (
            "plants",
            "friction: none is added",
            "viscous=own.viscous + fraction * limit, coulomb=own.coulomb + fraction * limit",
            "viscous=own.viscous, coulomb=own.coulomb",
        ),
        (
            "report",
            "a lost run counts as its errors until then",
            "word = next((w for w in (REFUSED, LOST) if w in row), None)",
            "word = None",
        ),
        (
            "report",
            "the worst plant is the best one",
            'found[-1] if over == "worst"',
            'found[0] if over == "worst"',
        ),
    ),
    *of(
        "flexarm_control",
        "feedforward",
        TESTS
        + "test_look_ahead.py flexarm_control/test/test_model_feedforward.py"
        + " flexarm_studies/test/test_beyond_the_paper.py",
        (
            "model",
            "the regulator's gain: sign",
            "    return K @ V.T\n",
            "    return -K @ V.T\n",
        ),
        (
            "model",
            "jumps of the manifold: not faded",
            "fading.jump(self._continued(before, dt) - now)",
            "fading.clear()",
        ),
        (
            "preview",
            "a speed that is scaled on the way: the plan is dropped",
            "or not path.kept:",
            "or path.scaled:",
        ),
        (
            "preview",
            "a speed that is scaled on the way: the plan's bending does not fade",
            "left = min(path.kept, path.pace(stamp_ns, offset))",
            "left = 3.0",
        ),
        (
            "preview",
            "torque of the coming period",
            "plan.torque_at(elapsed + 0.5 * self.settings.period)",
            "0.9 * plan.torque_at(elapsed)",
        ),
    ),
    *of(
        "flexarm_control",
        "observers",
        TESTS + "test_observers.py",
        (
            "filtered_derivative",
            "settling",
            "dt, self.bandwidth, self.amplitude",
            "dt, 2.0 * self.bandwidth, self.amplitude",
        ),
        (
            "luenberger",
            "its correction: missing",
            "predicted[m:] + L @ self.innovation",
            "predicted[m:]",
        ),
        ("true_rates", "a rate", "self.rate[:] = sample.rate", "self.rate[:] = 0.0"),
        (
            "kalman",
            "noise of the process: missing",
            "        P += step.Q\n",
            "",
            TESTS + "test_kalman.py",
        ),
        (
            "motion",
            "the rest of a step: missing",
            "        out += rest * (rate + (0.5 * rest) * (step.A @ rate))\n",
            "        pass\n",
            TESTS + "test_kalman.py",
        ),
        (
            "motion",
            "foreseen acceleration: the torque's change missing",
            "rate[self._size :] += foreseen.push @ change",
            "rate[self._size :] += 0.0",
            TESTS + "test_kalman.py",
        ),
        (
            "extended_kalman",
            "payload's scale",
            "one = (2.0 - s) * model.mass_matrix(q, delta)",
            "one = (1.0 - s) * model.mass_matrix(q, delta)",
            TESTS + "test_kalman.py",
        ),
        (
            "motion_kalman",
            "motion_kalman: the joints' acceleration does not move the links",
            "force = M[n:, :n] @ a + modal_forces(",
            "force = 0.0 * M[n:, :n] @ a + modal_forces(",
            TESTS + "test_motion_kalman.py",
        ),
        (
            "motion_kalman",
            "motion_kalman: no bias is measured",
            "self._C[n:, self._bias] = np.eye(g)",
            "self._C[n:, self._bias] = 0.0",
            TESTS + "test_motion_kalman.py",
        ),
        (
            "motion_kalman",
            "motion_kalman: the shared noise is white",
            "Phi[last, last] = self._companion",
            "Phi[last, last] = 0.0",
            TESTS + "test_motion_kalman.py",
        ),
        (
            "innovation_memory",
            "innovation_memory: one sample is remembered",
            "np.concatenate([scaled, self._past[: -scaled.size]])",
            "np.concatenate([scaled, 0.0 * self._past[: -scaled.size]])",
            TESTS + "test_innovation_memory.py",
        ),
        (
            "gauge_health",
            "a gauge that is silent",
            "self.health[~np.isfinite(strain)] = MISSING",
            "self.health[~np.isfinite(strain)] = GOOD",
            TESTS + "test_gauge_health.py",
        ),
    ),
]

TORQUE = TESTS + "test_trajectory_torque.py"

LIMITS = [
    *of(
        "flexarm_control",
        "trajectory",
        TESTS + "test_trajectory.py",
        (
            "request",
            "joints that are left out: at zero",
            "np.asarray(held, float)[~given] if name",
            "0.0 * np.asarray(held, float)[~given] if name",
        ),
        (
            "reference",
            "a motion under way that is joined: from its first point on",
            "times_ns = trajectory.times_ns - (now_ns - trajectory.stamp_ns)",
            "times_ns = trajectory.times_ns",
        ),
    ),
    *of(
        "flexarm_control",
        "trajectory",
        TESTS + "test_goal.py",
        (
            "goal",
            "a goal: the tip's swing along the axis with the least",
            "axis=0).max())",
            "axis=0).min())",
        ),
        ("goal", "a goal: before its motion's end", "if stamp_ns < self._end_ns:", "if False:"),
        (
            "goal",
            "a goal: its own tolerance of the parameter's joint",
            "limits[row, names.index(name)] = value",
            "limits[row] = value",
        ),
    ),
    *of(
        "flexarm_control",
        "trajectory",
        TORQUE,
        (
            "torque",
            "torque of a trajectory: without its velocity",
            "slow_torque(model.terms(q, qd), qdd)",
            "slow_torque(model.terms(q, 0.0 * qd), qdd)",
        ),
        (
            "torque",
            "torque of a trajectory: the start is not taken",
            "        path.begin(0, start)\n",
            "        pass\n",
        ),
        (
            "torque",
            "torque of a trajectory: the hold at its end",
            "    hold[0, 0] = path.end\n",
            "    pass\n",
        ),
    ),
    *of(
        "flexarm_dynamics",
        "",
        "flexarm_dynamics/test/test_sampling.py",
        (
            "sampling",
            "any period: both sides of the noise's series",
            "noise = noise + noise.T",
            "noise = 2.0 * noise",
        ),
        (
            "sampling",
            "any period: transitions add up",
            "Gamma = first.Gamma + first.Phi @ then.Gamma",
            "Gamma = first.Gamma + then.Gamma",
        ),
    ),
    *of(
        "flexarm_control",
        "observers/plausibility",
        TESTS + "test_reading_checks.py",
        (
            "amplitudes",
            "amplitudes beside strains: as much as they are",
            "+ SHARE * large",
            "+ 2.5 * large",
        ),
        (
            "channels",
            "light joints: in the first configuration alone",
            "self.heavy = bool(max(light) <= LIGHT)",
            "self.heavy = bool(light[0] <= LIGHT)",
        ),
        (
            "channels",
            "light joints: no mode more than the arm file has",
            "fuller = model.fuller(model.arm.most_modes + 1)",
            "fuller = model",
        ),
        (
            "channels",
            "amplitudes as gauges show them: only the modes of the file",
            "np.maximum(bends, _largest([strain_map.inverse @ e for e in felt]), out=bends)",
            "pass",
        ),
    ),
    *of(
        "flexarm_control",
        "kernels",
        TESTS + "test_manifolds.py",
        (
            "manifold",
            "inertia of the bending: sign",
            "zero[i, a] - higher[i, a]",
            "zero[i, a] + higher[i, a]",
        ),
    ),
    *of(
        "flexarm_control",
        "kernels",
        TESTS + "test_reading_checks.py",
        (
            "readings",
            "a velocity beside its position: torque steps between samples",
            "between *= 0.25 * dt * dt",
            "between *= 0.0",
        ),
        (
            "readings",
            "a joint that stands: what others' friction may hold",
            "doubt += abs(inertia[i, j]) * unsure[j]",
            "doubt += abs(inertia[i, j]) * unsure[j] * (i == j)",
        ),
        (
            "strains",
            "what the motion does not explain: the strains' own inertia",
            "inertia += load[i, j] * moved[j]",
            "inertia -= load[i, j] * moved[j]",
        ),
    ),
    *of(
        "flexarm_control",
        "kernels",
        TESTS + "test_arm_controller.py " + TESTS + "test_plausibility.py",
        (
            "limits",
            "velocity limit: never",
            "abs(error[i]), abs(qd[i])",
            "abs(error[i]), 0.0",
        ),
        (
            "limits",
            "deflection limit: only one sign",
            "value[3 * n + i] = abs(amplitude[i])",
            "value[3 * n + i] = amplitude[i]",
        ),
        (
            "limits",
            "strain limit: never",
            "value[3 * n + m + k] = abs(strain)",
            "value[3 * n + m + k] = 0.0",
        ),
        (
            "limits",
            "tracking error: only one sign",
            "abs(error[i]), abs(qd[i])",
            "error[i], abs(qd[i])",
        ),
        (
            "limits",
            "braking distance: factor",
            "abs(qd[i]) / (2.0 * able)",
            "abs(qd[i]) / (20.0 * able)",
        ),
    ),
    *of(
        "flexarm_control",
        "loop",
        TESTS + "test_arm_controller.py " + TESTS + "test_plausibility.py",
        (
            "supervisor",
            "time at the torque limit: never",
            "value[-1] = self._saturated_for",
            "value[-1] = 0.0",
        ),
        (
            "supervisor",
            "a limit that stays exceeded: never a fault",
            'if self._exceeded_for > self.settings["limit_patience"]:',
            "if False:",
        ),
        (
            "supervisor",
            "a fault is left by itself",
            "            self.state, self.reason = State.INACTIVE, reason\n",
            "            self.state, self.reason = State.READY, reason\n",
        ),
        (
            "arm_controller",
            "signs of life: a state that is repeated for ever",
            "if self._repeats > MAX_REPEATS:",
            "if False:",
        ),
        (
            "arm_controller",
            "a source that restarts elsewhere",
            "if moved.max() > SAME_PLACE:",
            "if False:",
        ),
        (
            "arm_controller",
            "a gap: the motion goes on",
            "if gap > self._resume_gap and gap > PERIODS_OF_GAP * known:",
            "if False:",
        ),
        (
            "arm_controller",
            "a driver that applied nothing for a while: torque at once",
            "elif away > self._resume_gap:",
            "elif False:",
        ),
        (
            "arm_controller",
            "a moving arm: taken over as if at rest",
            "        if _moves(sample):\n            velocity = ",
            "        if False:\n            velocity = ",
        ),
        (
            "arm_controller",
            "a swing: the reference is as fast as it",
            "np.minimum(np.abs(mean), np.abs(sample.velocity))",
            "np.abs(sample.velocity)",
        ),
        (
            "authority",
            "ramp: torque at once",
            "part = min(1.0, (self._elapsed / self._time) ** 2)",
            "part = 1.0",
        ),
        (
            "authority",
            "ramp: without the arm's weight",
            "self._weight[:] = self._holding(q)",
            "self._weight[:] = 0.0",
        ),
        (
            "authority",
            "budget of the rate: none",
            "return np.where(np.isinf(stated), BUDGET * omega * arm.torque_limits, stated)",
            "return stated",
        ),
        (
            "applied",
            "what the driver reports: only too large",
            "wrong = (reported < low) | (reported > high)",
            "wrong = reported > high",
        ),
        (
            "applied",
            "a driver that confirms no longer",
            "return not confirmed and (self._confirms or sample.controller_id != 0)",
            "return not confirmed and sample.controller_id != 0",
        ),
        (
            "arm_controller",
            "a trajectory's torque is not judged",
            "None if judged else self._judge_torque",
            "None",
            TORQUE,
        ),
        (
            "arm_controller",
            "stamps: max_gap",
            "if since_ns > self._max_gap and self.enabled:",
            "if False:",
        ),
        (
            "arm_controller",
            "stamps: max_age, of the future",
            "if abs(age) > self._max_age:",
            "if age > self._max_age:",
        ),
        (
            "samples",
            "stamps: a clock that goes back",
            "return self.NEW if sample.stamp_ns > self.stamp_ns else self.JUMP",
            "return self.NEW",
        ),
        (
            "samples",
            "sequence: an older state",
            "        if ahead >= WRAP // 2:\n",
            "        if False:\n",
        ),
    ),
    *of(
        "flexarm_dynamics",
        "models",
        "flexarm_dynamics/test/test_levels.py",
        (
            "levels",
            "level: lower than its loads need",
            "    if stiffening > negligible:\n",
            "    if stiffening < negligible:\n",
        ),
        (
            "levels",
            "level: unknown loads are none",
            "        return np.inf, np.inf\n",
            "        return 0.0, 0.0\n",
        ),
        (
            "levels",
            "level: bending that stiffness would prevent is not counted",
            "            error += self._unstiffened(q, qd, delta)\n",
            "            error += 0.0\n",
        ),
        (
            "levels",
            "level: out of range without a warning",
            "        if not beyond and np.isfinite(error):\n",
            "        if np.isfinite(error):\n",
        ),
    ),
    *[
        Mutant(
            name,
            "flexarm_ros/flexarm_ros/torque_gate.py",
            old,
            new,
            "flexarm_ros/test/test_torque_gate.py",
        )
        for name, old, new in (
            (
                "freshness: a torque that is too old",
                "        if self._until >= now:\n",
                "        if True:\n",
            ),
            (
                "freshness: a state's age, not the message's",
                "self._fresh_until = controller, sent + self.timeout",
                "self._fresh_until = controller, now + self.timeout",
            ),
            (
                "freshness: another session",
                "        if message.session != self.session:\n",
                "        if False:\n",
            ),
            (
                "freshness: out of order",
                "(sequence - self._answered) % WRAP >= WRAP // 2",
                "False",
            ),
            (
                "freshness: DISABLED",
                "            return self._close(self.DISABLED)\n",
                "            return self.DISABLED\n",
            ),
            (
                "two controllers in turn",
                "            if controller in self.ids:\n",
                "            if False:\n",
            ),
            (
                "freshness: a state that is published again",
                "self._sent[sequence] = self._sent[sequence][0], named",
                "self._sent[sequence] = now, named",
            ),
            (
                "handshake: a state that names none",
                "        if named != controller:\n",
                "        if False:\n",
            ),
            (
                "race: two torques for one state",
                "            if (torque != self._answer).any():\n",
                "            if False:\n",
            ),
            (
                "race: a torque after DISABLED",
                "            if not self._enabled:\n",
                "            if False:\n",
            ),
        )
    ],
]

RANDOM_ARMS = "flexarm_studies/test/test_random_arms.py"
STEPS = [
    *of(
        "flexarm_control",
        "feedforward",
        RANDOM_ARMS,
        (
            "preview",
            "a plan that does not converge has no more derivatives",
            "KNOTS, SMALL = (80, 400), 1e-6",
            "KNOTS, SMALL = (80, 80), 1e-6",
        ),
        (
            "preview",
            "a plan beyond all bounds is not made again",
            "if finer.steps == planner.steps:",
            "if True:",
        ),
    ),
    *of(
        "flexarm_sim",
        "",
        "flexarm_sim/test/test_plant.py",
        (
            "integrators",
            "friction asks for no shorter steps",
            "return count * min(_more(model, period, count), MOST)",
            "return count",
        ),
        (
            "integrators",
            "breakaway is no friction",
            "max(f.coulomb, f.breakaway)",
            "f.coulomb",
        ),
        (
            "integrators",
            "no friction is too much for the steps",
            "if more <= MOST:",
            "if True:",
        ),
    ),
    *of(
        "flexarm_studies",
        "uncertain",
        "flexarm_studies/test/test_uncertain.py",
        (
            "limits",
            "what friction holds is a peak",
            "(np.sqrt(2.0) * plant.arm.reach)",
            "plant.arm.reach",
        ),
    ),
    *of(
        "flexarm_studies",
        "uncertain",
        RANDOM_ARMS,
        (
            "trial",
            "an arm that its integrator loses is lost",
            "if loop.lost and loop.simulator.plant.implicit:",
            "if False:",
        ),
    ),
]

MUTANTS = KERNELS + MODELS + LAWS + LIMITS + STEPS


def places(mutant, root=ROOT):
    """How often the old text occurs."""
    return (root / "src" / mutant.file).read_text(encoding="utf-8").count(mutant.old)


def run(mutant, mutated=True):
    """Run the tests of one mutant in a copy: ``caught``, ``SURVIVED``, or what went wrong."""
    if places(mutant) != 1:
        return f"ERROR: its text occurs {places(mutant)} times"
    with tempfile.TemporaryDirectory(prefix="flexarm-mutant-") as folder:
        copy = Path(folder, "copy")
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, copy / name, ignore=LEFT_OUT)
            else:
                shutil.copy(source, copy / name)
        file = copy / "src" / mutant.file
        text = file.read_text(encoding="utf-8")
        if mutated:
            file.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
        try:
            done = run_tests(mutant, copy, Path(folder, "cache") if mutated else None)
        except subprocess.TimeoutExpired:
            return f"ERROR: no end after {TIMEOUT:g} s"
    if done.returncode in (0, 1):
        return "caught" if done.returncode else "SURVIVED"
    tail = "\n".join((done.stdout + done.stderr).splitlines()[-10:])
    return f"ERROR: pytest ended with {done.returncode}\n{tail}"


def run_tests(mutant, copy, cache):
    """Run the tests of a mutant on a copy of the sources; `cache` is for what its kernels are compiled to."""
    packages = [str(path.parent) for path in (copy / "src").glob("*/setup.py")]
    environment = dict(os.environ, OPENBLAS_NUM_THREADS="1")
    environment["PYTHONPATH"] = os.pathsep.join([*packages, os.environ["PYTHONPATH"]])
    if cache is not None and "/kernels/" in mutant.file:  # compiled anew, and never run again
        environment |= {"FLEXARM_CACHE": str(cache), "NUMBA_OPT": "1"}
    words = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    words += ["--hypothesis-profile=first_failure"]
    words += [f"src/{w}" if w.startswith("flexarm_") else w for w in mutant.tests.split()]
    return subprocess.run(
        words, cwd=copy, env=environment, capture_output=True, text=True, timeout=TIMEOUT
    )


def main():
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-k", default="", help="only mutants with this text in name or file")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    chosen = [m for m in MUTANTS if options.k in f"{m.file} {m.name}"]
    with ThreadPoolExecutor(options.processes) as executor:
        sound = {m.tests: m for m in chosen}  # one of each set of tests
        for mutant, result in zip(
            sound.values(),
            executor.map(lambda m: run(m, mutated=False), sound.values()),
            strict=True,
        ):
            if result != "SURVIVED":
                print(f"these tests fail without a mutation: {mutant.tests}\n{result}")
                return 1
        results = list(executor.map(lambda m: (m, report(m, run(m))), chosen))
    caught = sum(result == "caught" for _, result in results)
    print(f"{caught} of {len(results)} mutants are caught")
    return 0 if results and caught == len(results) else 1


def report(mutant, result):
    """Print one result as it comes."""
    print(f"{result.splitlines()[0]:8}  {mutant.file}: {mutant.name}", flush=True)
    for line in result.splitlines()[1:]:
        print(f"          {line}")
    return result


if __name__ == "__main__":
    sys.exit(main())
