# SPDX-License-Identifier: Apache-2.0
"""Many simulations at once on all cores: other initial states, other torques, other arms."""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from flexarm_dynamics.errors import ShapeError

from . import integrators


def simulate(models, states, starts, ends, step, substeps=1, method="rk4", workers=None):
    """Trajectories of many arms or of one arm from many states.

    Parameters
    ----------
    models : ArmModel or sequence of ArmModel
        One for all, or one each, all with as many joints and modes.
    states : ndarray, shape (b, 2 (n + m))
        Initial (q, delta, qd, delta_d).
    starts, ends : ndarray, shape (s, n) or (b, s, n)
        Torque at both ends of each interval of ``substeps * step`` seconds, linear between [N m].
    step : float
        [s]
    substeps : int
        Steps per interval.
    method : str
        One of `integrators.METHODS`.
    workers : int, optional
        Threads; as many as there are cores if not given. The compiled loops run without the interpreter's
        lock.

    Returns
    -------
    ndarray, shape (b, s + 1, 2 (n + m))
        What is no longer finite went beyond what the model or the step holds for.

    Raises
    ------
    ShapeError
        For arrays that don't fit the models.
    """
    states = np.atleast_2d(np.asarray(states, float))
    count, size = states.shape
    each = list(models) if isinstance(models, (list, tuple)) else [models] * count
    if len(each) != count:
        raise ShapeError(f"{len(each)} models for {count} initial states")
    for model in each:
        if 2 * (model.n_joints + model.n_modes) != size:
            raise ShapeError(
                f"{model.arm.name}: states have {size} entries, wanted"
                f" {2 * (model.n_joints + model.n_modes)}"
            )
    first = models[0] if isinstance(models, (list, tuple)) and models else models
    n = getattr(first, "n_joints", 0)
    starts, ends = (np.asarray(torque, float) for torque in (starts, ends))
    if starts.shape != ends.shape or starts.ndim not in (2, 3) or starts.shape[-1] != n:
        raise ShapeError(f"torque has shapes {starts.shape} and {ends.shape}, wanted (..., {n})")
    starts = np.ascontiguousarray(np.broadcast_to(starts, (count, *starts.shape[-2:])))
    ends = np.ascontiguousarray(np.broadcast_to(ends, starts.shape))
    out = np.empty((count, starts.shape[1] + 1, size))
    out[:, 0] = states
    tableau = integrators.METHODS[method]

    def run(chunk):
        steppers = {}
        for i in chunk:
            if id(each[i]) not in steppers:
                steppers[id(each[i])] = each[i].stepper(tableau)
            steppers[id(each[i])].trajectory(out[i], starts[i], ends[i], step, substeps)

    workers = min(workers or os.cpu_count() or 1, count) or 1
    with ThreadPoolExecutor(workers) as pool:
        # Each thread takes every so manieth run: chunks of equal cost whatever the order.
        list(pool.map(run, [range(k, count, workers) for k in range(workers)]))
    return out
