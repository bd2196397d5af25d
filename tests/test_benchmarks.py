# SPDX-License-Identifier: Apache-2.0
"""The equations that the benchmark compares are the same ones, and its measures measure what they say."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(
    0, str(Path(__file__).resolve().parents[1])
)  # the folder is no package of the workspace

from benchmarks import cases, compare, criteria, own, scaling, tables
from benchmarks.peers import Torque, errors, hand_stiffening
from benchmarks.peers.hand_loops import HandLoops
from benchmarks.peers.numpy_equations import equations

ARMS = ["one_link_pulse", "two_link_torque_x0p1"]
STIFF = ("two links that stiffen", "three links that stiffen", "two tubes in space that stiffen")


def elbow_inertia(p):
    """Inertia on which flexarm's shapes of an inner link rest: all that hangs on it, stretched out."""
    if "Jh2" not in p:
        return None
    return p["Jh2"] + p["rhoA"] * p["L"] ** 3 / 3.0 + p["Mp"] * p["L"] ** 2 + p["Jp"]


@pytest.mark.long
@pytest.mark.parametrize("case", ARMS)
def test_three_derivations_give_the_same_accelerations(case):
    p = cases.parameters(case)
    inertia = elbow_inertia(p)
    chain = cases.chain(p)
    by_hand = HandLoops(case, p, tip_inertia=inertia)
    plain = equations(p, tip_inertia=inertia)
    size, n = plain.size, chain.n_joints
    assert (chain.n_joints + chain.n_modes, by_hand.arm.size) == (size, size)
    random = np.random.default_rng(1)
    scale = np.concatenate([np.full(n, 3.0), np.full(size - n, 0.1), np.full(size, 2.0)])
    for _ in range(50):
        state, torque = scale * random.uniform(-1.0, 1.0, 2 * size), random.uniform(-1.0, 1.0, n)
        wanted = plain.accelerations(state, torque)
        within = {"rtol": 1e-10, "atol": 1e-10 * np.abs(wanted).max()}
        np.testing.assert_allclose(chain.derivative(state, torque)[size:], wanted, **within)
        np.testing.assert_allclose(by_hand.accelerations(state, torque), wanted, **within)


def test_the_link_that_stiffens_has_the_accelerations_of_the_chain():
    p = cases.parameters("one_link_pulse")
    chain = cases.chain(p, foreshortening=True)
    constants, random = hand_stiffening.constants(chain.data, p), np.random.default_rng(2)
    for _ in range(20):
        state = np.array([3.0, 0.1, 0.1, 2.0, 2.0, 2.0]) * random.uniform(-1.0, 1.0, 6)
        torque = random.uniform(-1.0, 1.0, 1)
        found = hand_stiffening.one_stiff_link(constants, *state[1:], torque[0])
        np.testing.assert_allclose(found, chain.derivative(state, torque)[3:], rtol=1e-10)


@pytest.mark.parametrize("case", cases.MORE)
def test_the_cases_of_the_benchmark_are_simulated_within_their_targets(case):
    code = own.Flexarm(case, cases.parameters(case), **own.BEST["Flexarm"][case])
    off = errors(code.run(cases.DURATION)[1], cases.reference(case))
    assert off["tip"] <= cases.TARGETS[case]
    code = own.FlexarmLoops(case, cases.parameters(case), step=5e-3)
    off = errors(code.run(cases.DURATION)[1], cases.reference(case))
    assert off["tip"] > 2.0 * cases.TARGETS[case]  # stiffening matters


@pytest.mark.long
@pytest.mark.parametrize("case", ARMS)
def test_the_cases_are_simulated_within_their_targets(case):
    columns = {}
    for code in (own.Flexarm, HandLoops):
        t, columns[code] = code(case, cases.parameters(case), step=1e-2).run(cases.DURATION)
        assert t[-1] == cases.DURATION
        off = errors(columns[code], cases.reference(case))
        assert off["tip"] <= cases.TARGETS[case]
    # Shapes of the first of two links differ a little; the rest is the same.
    assert errors(columns[own.Flexarm], columns[HandLoops])["tip"] < 1e-5


def test_errors_are_the_largest_distance_of_the_tips_and_the_largest_angle():
    true = {"theta1": np.zeros(4), "tip_x": np.ones(4), "tip_y": np.zeros(4)}
    off = {name: column[:3].copy() for name, column in true.items()}
    off["tip_x"][1] += 3e-3
    off["tip_y"][1] -= 4e-3
    off["tip_y"][2] = 4.9e-3
    off["theta1"][2] = -0.2
    assert errors(off, true) == {"tip": pytest.approx(5e-3), "theta1": pytest.approx(0.2)}


def test_linear_torque_keeps_the_mean_and_jumps_at_a_pulses_edge():
    torque = Torque("one_link_pulse", {"Jh": 0.0, "T": 2.0})
    starts, ends = own.linear_torque(torque, 100, 1e-2)
    np.testing.assert_array_equal(starts, ends)
    np.testing.assert_array_equal(starts[[49, 50], 0], [2.0, -2.0])

    torque = Torque(
        "two_link",
        {"Jh1": 0.0, "Jh2": 0.0, "tau1": "2.0*sin(2*pi*0.5*t)", "tau2": "1.0*sin(2*pi*0.8*t)"},
    )
    starts, ends = own.linear_torque(torque, 5, 0.1)
    edges = 0.1 * np.arange(6)
    for joint, (height, omega) in enumerate(torque.sines):
        means = -np.diff(height * np.cos(omega * edges)) / (omega * 0.1)
        np.testing.assert_allclose(0.5 * (starts + ends)[:, joint], means, rtol=1e-4)


def test_counts_of_cores():
    assert scaling.core_counts(1) == [1]
    assert scaling.core_counts(2) == [1, 2]
    assert scaling.core_counts(12) == [1, 2, 3, 4, 8, 12]


def summary(own_ms, available=2.0):
    """A made-up summary: this project takes `own_ms`, a peer 1 ms, the hand-written loops 0.1 ms."""

    def code(kind, ms):
        timed = {"kind": kind, "settings": {"step": 1e-2}, "tip_error": 1e-6, "theta1_error": 0.0}
        return timed | {"ms_per_s": ms, "ratio": ms / own_ms}

    codes = {compare.OWN: code("own", own_ms), "hand": code("hand", 0.1), "peer": code("peer", 1.0)}
    slow = {"kind": "peer", "settings": {}, "tip_error": 1.0, "theta1_error": 0.0}
    same = {"step": 1e-3, "generated": own_ms, "hand": 0.1, "ratio": own_ms / 0.1}
    cost = {"modes": 2, "generated": None}
    stiff = [
        {"links": n, "modes": 2, "loops": 9.0 * n, "generated": n, "turns": {"loops": [n, n]}}
        for n in (1, 8)
    ]
    cores = [
        {"cores": n, "throughput": 9.0 * n, "speedup": n, "available": available} for n in (1, 2)
    ]
    return {
        "cases": {
            case: {"target": target, "codes": {**codes, "inexact": slow}}
            for case, target in cases.TARGETS.items()
        },
        "same_step": {name: [same] for name in compare.BY_HAND},
        "stiffening": stiff,
        "links": [{"links": 1, "loops": 1.0, **cost}, {"links": 8, "loops": 6.0, **cost}],
        "modes": [],
        "throughput": {"runs": 1, "cores": cores},
    }


def test_criteria_are_met_or_missed_by_the_figures():
    fast, slow = criteria.check(summary(0.1)), criteria.check(summary(0.5))
    assert all(c["met"] for c in fast)
    missed = [c["text"] for c in slow if not c["met"]]
    assert missed == [
        *(f"{name}: times faster than peer" for name in ("one link", "two links", *STIFF)),
        *(f"{name}: time over hand-written loops, same step" for name in compare.BY_HAND),
    ]
    busy = criteria.check(summary(0.12, available=1.1))[-1]
    assert busy["met"] is None and "1.10 cores" in busy["text"]


def test_tables_show_every_code_and_criterion():
    found = summary(0.5)
    found["criteria"] = criteria.check(found)
    text = tables.text(found)
    assert "inexact" in text and "misses" in text and "MISS one link" in text
    rows = tables.markdown(found).splitlines()
    assert "| one_link_pulse | peer | 10 ms | 1 | 500 | 1 | 2 |" in rows
    assert "| 8 | - | 6 | 8 | 72 |" in rows
