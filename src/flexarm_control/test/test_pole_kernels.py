# SPDX-License-Identifier: Apache-2.0
"""Poles of stacks of loops and their derivatives, compiled, beside LAPACK's own through scipy."""

import os
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag, eig

from flexarm_control.kernels import compiled
from flexarm_control.kernels.poles import DEAD_BEAT, SOFT
from flexarm_control.robust import decay, threads
from flexarm_control.robust.decay import Slowest, Stack, Wanted, find_gradients, poles_of
from flexarm_control.robust.loop import Loop

WANTED = Wanted(2.0, 30.0, 0.01)
L, SIZE, TORQUES, MEASURED = 5, 11, 2, 4
SCALE = np.full((TORQUES, MEASURED), 0.1)


@pytest.fixture
def loops():
    """Loops with states in very different units, and a state that nothing but a measurement moves."""
    draw = np.random.default_rng(6)
    found = []
    for k in range(L):
        units = 10.0 ** draw.uniform(-4.0, 4.0, SIZE)
        F = 0.3 * draw.standard_normal((SIZE, SIZE))
        F[-1] = 0.0
        F, G, N = (
            F * units / units[:, None],
            draw.standard_normal((SIZE, TORQUES)) / units[:, None],
            draw.standard_normal((MEASURED, SIZE)) * units,
        )
        G[-1] = 0.0
        found.append(Loop(f"{k}", F, G, N, 0.1, 1.0 - 0.1 * k))
    return found


@pytest.fixture
def K():
    return 0.1 * np.random.default_rng(7).standard_normal((L, TORQUES, MEASURED))


def test_poles_are_lapacks_ranked_by_decay_over_what_is_asked(loops, K):
    (found,) = poles_of([Stack(loops, SCALE)], [K], WANTED)
    for k, loop in enumerate(loops):
        z = np.linalg.eigvals(loop.F - loop.G @ K[k] @ loop.N).astype(complex)
        z = z[(z.imag >= 0.0) & (np.abs(z) > DEAD_BEAT)]
        s = np.log(z) / loop.period
        v = s.real / WANTED.decay(s, loop.fraction)
        order = np.argsort(-v)
        assert_allclose(found.v[k, : s.size], v[order], rtol=1e-8)
        assert_allclose(found.s[k, : s.size], s[order], rtol=1e-8)
        assert (found.v[k, s.size :] == -np.inf).all() and s.size < SIZE


def test_gradients_are_those_of_lapacks_eigenvectors(loops, K):
    (found,) = poles_of([Stack(loops, SCALE)], [K], WANTED)
    find_gradients([found], [np.array([1, 0, 2, 0, 0])])
    few = found.slopes
    assert few.shape[1] == 2 and not few[0, 1].any() and not few[1].any() and few[2].all()
    find_gradients([found], [np.array([3, 3, 1, 3, 3])])
    slopes = found.slopes
    for k, loop in enumerate(loops):
        z, left, right = eig(loop.F - loop.G @ K[k] @ loop.N, left=True)
        for p in range(2 if k == 2 else 3):
            at = np.argmin(np.abs(z - np.exp(found.s[k, p] * loop.period)))
            x, y = right[:, at], left[:, at].conj()
            exact = -np.outer(y @ loop.G, loop.N @ x) / (loop.period * z[at] * (y @ x))
            assert_allclose(slopes[k, p], exact.real, rtol=1e-6, atol=1e-8 * np.abs(exact).max())


def test_less_is_asked_of_poles_that_torque_hardly_reaches_and_none_that_grow_are_excused():
    s = np.array([-1.0 + 1.0j, -1.0 + 20.0j, -1.0 + 100.0j, -1.0 + 900.0j, 1.0 + 900.0j, 1.0])
    soft = 2.0 * np.sqrt(SOFT * 2.0 / abs(s[1]))
    rest = [0.01 * abs(s[2]), 2.0]
    assert_allclose(WANTED.decay(s), [2.0, soft, *rest, 2.0, 2.0])
    assert_allclose(WANTED.decay(s, 0.5), [1.0, 0.5 * soft, *(0.5 * np.array(rest)), 2.0, 2.0])


def test_gains_that_are_no_numbers_are_an_error(loops, K):
    K[3, 0, 0] = np.nan
    with pytest.raises(np.linalg.LinAlgError):
        poles_of([Stack(loops, SCALE)], [K], WANTED)


def test_what_is_not_computed_moves_nothing():
    """Of loops with different numbers of poles, and of memory that held something else before."""
    turns = [np.array([[c, s], [-s, c]]) * 0.9 for c, s in ((0.8, 0.6), (0.6, 0.8), (0.96, 0.28))]
    few = Loop("", block_diag(*turns), np.ones((6, 1)), np.ones((1, 6)), 0.1)
    many = _loop([0.91, 0.9, 0.89, 0.88, 0.87, 0.86], [1] * 6)
    many = replace(many, N=np.ones((1, 6)))
    slowest = Slowest([few, many], WANTED, 0.01 * np.ones((1, 1)))
    kept, empty = [], np.empty

    def worst(shape, *args):
        found = empty(shape, *args)
        found.fill(-1 if found.dtype == int else np.nan)
        kept.append(found)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(decay.np, "empty", worst)
        value, slope = slowest.smooth(slowest.loops, 0.3)(np.zeros(1))
    assert kept and np.isfinite(value) and np.isfinite(slope).all()


def test_a_matrix_that_is_singular_to_the_last_bit_has_no_slope():
    z, one = np.zeros((1, 1), complex), np.ones(1, int)
    out = np.full((1, 1, 1, 1), np.nan)
    compiled().pole_gradients(
        np.zeros((1, 2, 2)), np.zeros((1, 2)), np.ones((1, 2, 1)), np.ones((1, 1, 2)),
        z, 0 * one, one, np.ones(1), out,
    )  # fmt: skip
    assert out == 0.0


def _loop(z, moved):
    """A loop with these poles, one state each, some of which torque moves."""
    return Loop("", np.diag(z), np.array(moved, float)[:, None], np.eye(len(z)), 0.1)


def test_poles_that_no_gain_moves_are_passed_over_unless_they_grow():
    scale = np.ones((1, 3))
    loops = [_loop([0.99, 0.98, 0.9], [0, 0, 1]), _loop([0.8, 0.7, 0.95], [1, 1, 1])]
    slowest = Slowest(loops, WANTED, scale)
    value = lambda z: np.log(z) / 0.1 / 2.0  # noqa: E731
    first, second = slowest.each(np.zeros(3))
    assert_allclose([first.v, second.v], [value(0.9), value(0.95)])
    assert_allclose(first.passed, np.log([0.99, 0.98]) / 0.1)
    assert second.passed == ()
    assert_allclose(
        [first.slope, second.slope], [1.0 / (0.1 * 0.9 * 2.0), 1.0 / (0.1 * 0.95 * 2.0)]
    )
    assert_allclose(slowest.smooth(loops, 1e-3)(np.zeros(3))[0], value(0.95))
    assert_allclose(slowest.smooth(loops[:1], 1e-3)(np.zeros(3))[0], value(0.9))
    grows = [_loop([1.02, 0.98, 0.9], [0, 0, 1])]
    assert_allclose(Slowest(grows, WANTED, scale).each(np.zeros(3))[0].v, value(1.02))
    assert_allclose(slowest.smooth(grows, 1e-3)(np.zeros(3))[0], value(1.02), rtol=1e-6)
    still = [_loop([0.99, 0.98, 0.9], [0, 0, 0])]
    (none,) = Slowest(still, WANTED, scale).each(np.zeros(3))
    assert none.v == -np.inf and len(none.passed) == 3
    assert slowest.smooth(still, 1e-3)(np.zeros(3))[0] == np.inf


@pytest.mark.parametrize("rows", [(1,), (2,), (7,), (1, 1), (3, 0, 2), (1, 9)])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_rows_are_computed_on_all_processors_as_on_one(monkeypatch, rows, count):
    monkeypatch.setattr(threads, "count", lambda: count)
    given, parts = [np.arange(1.0, n + 1.0) for n in rows], []
    out = [np.zeros(n) for n in rows]

    def double(a, b):
        parts.append((threading.get_ident(), len(a)))
        b[:] = 2.0 * a

    threads.in_parts([(double, arrays, 40) for arrays in zip(given, out, strict=True)])
    for a, b in zip(given, out, strict=True):
        assert_allclose(b, 2.0 * a)
    assert sum(n for _, n in parts) == sum(rows)
    assert max(n for _, n in parts) <= -(-sum(rows) // count) or count == 1


def test_large_rows_count_for_more_than_small_ones(monkeypatch):
    monkeypatch.setattr(threads, "count", lambda: 2)
    parts = []

    def note(a):
        parts.append((threading.get_ident() == threading.main_thread().ident, len(a)))

    threads.in_parts([(note, (np.zeros(3),), 40), (note, (np.zeros(24),), 20)])
    assert sorted(parts) == [(False, 24), (True, 3)]


def test_little_work_stays_on_one_processor(monkeypatch):
    monkeypatch.setattr(threads, "count", lambda: 2)
    parts = []
    threads.in_parts([(lambda a: parts.append(len(a)), (np.zeros(3),), 9)])
    assert parts == [3]


def test_no_more_threads_than_the_libraries_of_linear_algebra_may_have(monkeypatch):
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda process: {0, 1, 2, 3})
    for given, wanted in (("1", 1), ("3", 3), ("8", 4), ("3,1", 3), ("0", 1), ("", 4), ("many", 4)):
        monkeypatch.setenv("OMP_NUM_THREADS", given)
        assert threads.count() == wanted


def test_without_numba_s_compiler_poles_are_the_same():
    code = (
        "import numba, numpy as np; assert numba.config.DISABLE_JIT;"
        "from flexarm_control.robust.decay import Stack, Wanted, find_gradients, poles_of;"
        "from flexarm_control.robust.loop import Loop;"
        "loop = Loop('', np.diag([0.9, 0.8]), np.ones((2, 1)), np.eye(2), 0.1);"
        "(found,) = poles_of([Stack([loop], np.ones((1, 2)))], [np.zeros((1, 1, 2))], Wanted(2.0, 9.0, 0.1));"
        "find_gradients([found], [np.array([1])]);"
        "print(*np.exp(0.1 * found.s[0].real), *found.slopes[0, 0].ravel())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert_allclose(
        [float(x) for x in done.stdout.split()], [0.9, 0.8, -1.0 / 0.09, 0.0], atol=1e-9
    )


def test_an_error_on_another_processor_is_raised(monkeypatch):
    monkeypatch.setattr(threads, "count", lambda: 2)

    def refuse(a, b):
        if a[0] > 0.0:
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        threads.in_parts([(refuse, (np.arange(4.0), np.zeros(4)), 40)])
