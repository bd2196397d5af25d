# SPDX-License-Identifier: Apache-2.0
"""Cost of one evaluation against links and modes; throughput of batches against cores."""

import hashlib
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from flexarm_sim import batch
from flexarm_sim.integrators import METHODS

from . import cases, own
from .peers import RATE, Torque
from .timing import least, round_robin

#: Step size at which arms of every size are stable [s].
TINY = 1e-6
STAGES = METHODS["rk4"].weights.size

#: Number of turns of one attempt, and minimum duration of a turn [s]. Both kinds of threads take turns, so that other
#: programs load both equally.
TURNS, TURN = 5, 0.25

#: Attempts to find the machine idle, and the fraction of all cores that must be free.
ATTEMPTS, ALL_THERE = 6, 0.9

#: Data for the threads that share nothing.
BLOCK = bytes(1 << 22)

#: The case whose links the arms are made of.
CASE = "two_link_torque_x0p1"


def costs(arms, effort, steps=200, foreshortening=False):
    """Time one evaluation of the accelerations, in loops and in generated code; each call makes `steps` RK4 steps.

    `arms` are pairs: number of links, modes per link. Each result has ``links``, ``modes``, the times ``loops`` and
    ``generated`` [us per evaluation] of the best turns, and ``turns`` of both. ``generated`` is None if the project
    generates no code for the arm.
    """
    chains = {arm: cases.chain(cases.parameters(CASE), *arm, foreshortening) for arm in arms}
    tasks = {}
    for arm, chain in chains.items():
        tasks["loops", arm] = _evaluations(chain, False, steps)
        if chain.straight_line is not None:
            tasks["generated", arm] = _evaluations(chain, True, steps)
    times = round_robin(tasks, effort.rounds, effort.turn)
    result = []
    for links, modes in arms:
        entry = {"links": links, "modes": modes, "turns": {}}
        for code in ("loops", "generated"):
            turns = times.get((code, (links, modes)))
            entry[code] = None
            if turns is not None:
                turns = 1e6 * turns / (STAGES * steps)
                entry[code], entry["turns"][code] = least(turns), turns.tolist()
        result.append(entry)
    return result


def _evaluations(chain, straight_line, steps):
    """A task that evaluates `STAGES` times `steps` accelerations in one compiled loop."""
    stepper = chain.stepper(METHODS["rk4"], straight_line=straight_line)
    size = 2 * (chain.n_joints + chain.n_modes)
    states = np.zeros((2, size))
    states[0] = 1e-3 * np.random.default_rng(0).standard_normal(size)
    none = np.zeros((1, chain.n_joints))

    def task():
        stepper.trajectory(states, none, none, TINY, steps)

    task()
    if not np.isfinite(states).all():
        raise RuntimeError(f"{chain.n_joints} links, {chain.n_modes} modes: not finite any more")
    return task


def core_counts(cores):
    """Numbers of cores to measure: each up to four, then doubled each time, and the number of all cores."""
    doubled = {2**k for k in range(cores.bit_length())}
    return sorted(n for n in {1, 2, 3, 4, cores} | doubled if n <= cores)


def throughput(step=1e-3, runs=240):
    """Simulated seconds per second of `batch.simulate` against cores.

    Other programs may occupy cores for whole seconds. Therefore the best turn is taken, and threads that share
    nothing, which take turns with the batches, measure how many cores were free.

    A batch consists of at least `runs` runs from random states, by RK4 with a fixed `step` [s]. Returns ``runs``, and
    ``cores``: a list with ``cores``, ``throughput`` [s/s], ``turns``, ``speedup`` over one core, and ``available``, the
    speed-up of the threads that share nothing.
    """
    parameters = cases.parameters(CASE)
    chain = cases.chain(parameters)
    counts = core_counts(os.cpu_count() or 1)
    runs = max(runs, 8 * counts[-1])
    intervals = round(cases.DURATION * RATE)
    starts, ends = own.linear_torque(Torque(CASE, parameters), intervals, 1.0 / RATE)
    size = 2 * (chain.n_joints + chain.n_modes)
    states = 1e-3 * np.random.default_rng(0).standard_normal((runs, size))
    substeps = round(1.0 / (RATE * step))

    def task(workers):
        batch.simulate(chain, states, starts, ends, step, substeps, "rk4", workers)

    def unshared(workers):
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(hashlib.sha256, [BLOCK] * (8 * counts[-1])))

    tasks = {}
    for n in counts:
        tasks["batch", n] = lambda n=n: task(n)
        tasks["unshared", n] = lambda n=n: unshared(n)
    times = {name: np.empty(0) for name in tasks}
    for _ in range(ATTEMPTS):
        more = round_robin(tasks, TURNS, TURN)
        times = {name: np.append(times[name], turns) for name, turns in more.items()}
        best = {name: least(turns) for name, turns in times.items()}
        if best["unshared", 1] / best["unshared", counts[-1]] >= ALL_THERE * counts[-1]:
            break
    return {
        "runs": runs,
        "cores": [
            {
                "cores": n,
                "throughput": runs * cases.DURATION / best["batch", n],
                "turns": (runs * cases.DURATION / times["batch", n]).tolist(),
                "speedup": best["batch", 1] / best["batch", n],
                "available": best["unshared", 1] / best["unshared", n],
            }
            for n in counts
        ],
    }
