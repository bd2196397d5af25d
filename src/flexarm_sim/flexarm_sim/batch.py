# SPDX-License-Identifier: Apache-2.0
"""Many simulations in parallel: different initial states, torques or arms."""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from flexarm_dynamics.arm.description import Arm
from flexarm_dynamics.errors import ShapeError
from flexarm_dynamics.models import levels, model

from . import integrators


def simulate(models, states, starts, ends, step, substeps=1, method="rk4", workers=None):
    """Simulate many arms, or one arm from many states.

    Parameters
    ----------
    models : ArmModel or Arm, or sequence of them
        One for all, or one each with the same numbers of joints and modes. An `Arm` is simulated at the level that
        its loads need, see `levels.simulated`.
    states : ndarray, shape (b, 2 (n + m))
        Initial (q, delta, qd, delta_d).
    starts, ends : ndarray, shape (s, n) or (b, s, n)
        Torque at both ends of each interval of ``substeps * step`` seconds, linear between them [N m].
    step : float
        [s]
    substeps : int
        Steps per interval.
    method : str
        One of `integrators.METHODS`.
    workers : int, optional
        Number of threads; default: that of the cores. The compiled loops release the interpreter's lock.

    Returns
    -------
    ndarray, shape (b, s + 1, 2 (n + m))
        Values that are not finite are beyond the range of the model or the step.

    Raises
    ------
    ShapeError
        For arrays that do not fit the models.
    """
    states = np.atleast_2d(np.asarray(states, float))
    count, size = states.shape
    if isinstance(models, (list, tuple)):
        models = [_built(each) for each in models]
    else:
        models = _built(models)
    each = list(models) if isinstance(models, (list, tuple)) else [models] * count
    if len(each) != count:
        raise ShapeError("must be one per state", field="models", value=len(each), limit=count)
    for arm_model in each:
        if 2 * (arm_model.n_joints + arm_model.n_modes) != size:
            entries = 2 * (arm_model.n_joints + arm_model.n_modes)
            raise ShapeError(
                f"entries do not fit {arm_model.arm.name}",
                field="states",
                value=size,
                limit=entries,
            )
    first = models[0] if isinstance(models, (list, tuple)) and models else models
    n = getattr(first, "n_joints", 0)
    starts, ends = (np.asarray(torque, float) for torque in (starts, ends))
    if starts.shape != ends.shape or starts.ndim not in (2, 3) or starts.shape[-1] != n:
        shapes = (starts.shape, ends.shape)
        raise ShapeError("are wrong shapes", field="torque", value=shapes, limit=f"(..., {n})")
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
        # Interleaved chunks cost the same whatever the order of the runs.
        list(pool.map(run, [range(k, count, workers) for k in range(workers)]))
    return out


def _built(given):
    """A model as it is, and that of an `Arm` at the level that its loads need."""
    return model.build(levels.simulated(given)) if isinstance(given, Arm) else given
