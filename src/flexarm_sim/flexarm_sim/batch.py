# SPDX-License-Identifier: Apache-2.0
"""Simulates many arms side by side on all cores, with different initial states, torques or arms; arrays in and out."""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from flexarm_dynamics.arm.description import Arm
from flexarm_dynamics.errors import ShapeError
from flexarm_dynamics.models import levels, model

from . import integrators


class Arms:
    """Arms that are advanced together, interval by interval.

    Parameters
    ----------
    models : ArmModel or Arm, or sequence of them
        One for all, or one each with the same numbers of joints and modes. An `Arm` is simulated at the level that
        its loads need, see `levels.simulated`.
    states : ndarray, shape (b, 2 (n + m))
        Initial (q, delta, qd, delta_d).
    step : float
        [s]
    substeps : int
        Steps per interval.
    method : str
        One of `integrators.METHODS`.
    workers : int, optional
        Number of threads; default: the number of cores. The compiled loops release the interpreter's lock.

    Attributes
    ----------
    models : list of ArmModel
        One each.
    states : ndarray, shape (b, 2 (n + m))
        The present ones; may be written to between two calls. A state that is not finite has left the range of the
        model, or the step is too long.

    Raises
    ------
    ShapeError
        For arrays that do not fit the models.
    """

    def __init__(self, models, states, step, substeps=1, method="rk4", workers=None):
        self.states = np.array(np.atleast_2d(states), float)
        self.models = models_of(models, len(self.states))
        _check(self.models, self.states.shape[1])
        self.step, self.substeps = step, substeps
        tableau, count = integrators.METHODS[method], len(self.models)
        workers = min(workers or os.cpu_count() or 1, count) or 1
        # Interleaved parts cost the same whatever the order of the arms. Each thread has steppers of its own.
        self._parts = []
        for k in range(workers):
            steppers = {id(m): m.stepper(tableau) for m in self.models[k::workers]}
            part = range(k, count, workers)
            self._parts.append([(i, steppers[id(self.models[i])]) for i in part])
        self._pool = ThreadPoolExecutor(workers)
        first = self.models[0] if self.models else models
        self.n_joints = getattr(first, "n_joints", 0)

    def advance(self, torque):
        """Advance all arms by one interval.

        Parameters
        ----------
        torque : ndarray, shape (n,) or (b, n)
            Constant during the interval [N m].

        Returns
        -------
        ndarray, shape (b, 2 (n + m))
            `states`.

        Raises
        ------
        ShapeError
            For a torque of another shape.
        """
        torque = np.asarray(torque, float)
        wanted = (len(self.models), self.n_joints)
        if torque.shape not in (wanted, wanted[1:]):
            raise ShapeError("is a wrong shape", field="torque", value=torque.shape, limit=wanted)
        torque = np.ascontiguousarray(np.broadcast_to(torque, wanted))

        def run(part):
            for i, advance in part:
                advance(self.states[i], torque[i], self.step, self.substeps)

        self._run(run)
        return self.states

    def follow(self, starts, ends):
        """Advance all arms over many intervals.

        Parameters
        ----------
        starts, ends : ndarray, shape (s, n) or (b, s, n)
            Torque at both ends of each interval, linear between them [N m].

        Returns
        -------
        ndarray, shape (b, s + 1, 2 (n + m))
            States from the present ones on; the last ones become the present ones.

        Raises
        ------
        ShapeError
            For torques of other shapes.
        """
        n, count = self.n_joints, len(self.models)
        starts, ends = (np.asarray(torque, float) for torque in (starts, ends))
        if starts.shape != ends.shape or starts.ndim not in (2, 3) or starts.shape[-1] != n:
            shapes = (starts.shape, ends.shape)
            raise ShapeError("are wrong shapes", field="torque", value=shapes, limit=f"(..., {n})")
        starts = np.ascontiguousarray(np.broadcast_to(starts, (count, *starts.shape[-2:])))
        ends = np.ascontiguousarray(np.broadcast_to(ends, starts.shape))
        out = np.empty((count, starts.shape[1] + 1, self.states.shape[1]))
        out[:, 0] = self.states

        def run(part):
            for i, stepper in part:
                stepper.trajectory(out[i], starts[i], ends[i], self.step, self.substeps)

        self._run(run)
        self.states[:] = out[:, -1]
        return out

    def _run(self, work):
        """Call `work` with the arms of each thread."""
        if len(self._parts) == 1:
            work(self._parts[0])
        else:
            list(self._pool.map(work, self._parts))

    def close(self):
        """End the threads."""
        self._pool.shutdown()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def simulate(models, states, starts, ends, step, substeps=1, method="rk4", workers=None):
    """Simulate many arms, or one arm from many states: `Arms.follow` in one call.

    Parameters
    ----------
    models, states, step, substeps, method, workers
        As of `Arms`.
    starts, ends : ndarray, shape (s, n) or (b, s, n)
        Torque at both ends of each interval of ``substeps * step`` seconds, linear between them [N m].

    Returns
    -------
    ndarray, shape (b, s + 1, 2 (n + m))
        A state that is not finite has left the range of the model, or the step is too long.

    Raises
    ------
    ShapeError
        For arrays that do not fit the models.
    """
    with Arms(models, states, step, substeps, method, workers) as arms:
        return arms.follow(starts, ends)


def models_of(given, count):
    """A list of `count` models, from what `Arms` takes; a `ShapeError` for another number of them."""
    many = list(given) if isinstance(given, (list, tuple)) else [given] * count
    if len(many) != count:
        raise ShapeError("must be one per state", field="models", value=len(many), limit=count)
    built = {id(one): _built(one) for one in many}  # one for all that are the same
    return [built[id(one)] for one in many]


def _check(models, size):
    """Raise a `ShapeError` if the states of a model do not have `size` entries."""
    for arm_model in models:
        entries = 2 * (arm_model.n_joints + arm_model.n_modes)
        if entries != size:
            raise ShapeError(
                f"entries do not fit {arm_model.arm.name}",
                field="states",
                value=size,
                limit=entries,
            )


def _built(given):
    """A given model as it is, or the model of an `Arm` at the level that its loads need."""
    return model.build(levels.simulated(given)) if isinstance(given, Arm) else given
