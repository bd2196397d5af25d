# SPDX-License-Identifier: Apache-2.0
"""Fixed-step integrators of ``state' = derivative(state, net torque)``; joined to a right-hand side by `kernels.load`.

The state is (q, delta, qd, delta_d). Torque goes from `torque` to `torque + change` over the whole interval;
joint friction is taken off it at each stage.
"""

import numpy as np


def net_torque(torque, change, fraction, friction, point, net):
    """Net torque at a stage with the state `point`, when `fraction` of the interval has passed."""
    half = point.size // 2
    for i in range(net.size):
        rate = point[half + i]
        value = torque[i] + fraction * change[i] - friction[i, 0] * rate
        if friction[i, 1] != 0.0:
            value -= friction[i, 1] * np.tanh(rate / friction[i, 2])
        net[i] = value


def runge_kutta(
    state, torque, change, step, substeps, tableau, weights, nodes, stages, net, friction, data
):
    """Advance `state` in place by `substeps` explicit Runge-Kutta steps.

    Parameters
    ----------
    state : ndarray, shape (2 (n + m),)
        Overwritten.
    torque, change : ndarray, shape (n,)
        At the start, and what is added until the end [N m].
    step : float
        Length of one substep [s].
    substeps : int
        How many.
    tableau, weights, nodes : ndarray, shape (p, p), (p,), (p,)
        Butcher coefficients.
    stages : ndarray, shape (p + 1, 2 (n + m))
        Work space; the last row holds the state of a stage.
    net : ndarray, shape (n,)
        Work space.
    friction : ndarray, shape (n, 3)
        Viscous, Coulomb, smoothing.
    data : tuple
        What the right-hand side needs.
    """
    p, size, share = weights.size, state.size, 1.0 / substeps
    point = stages[p]
    for k in range(substeps):
        for i in range(p):
            for v in range(size):
                point[v] = state[v]
            for j in range(i):
                gain = step * tableau[i, j]
                if gain != 0.0:
                    for v in range(size):
                        point[v] += gain * stages[j, v]
            net_torque(torque, change, (k + nodes[i]) * share, friction, point, net)
            derivative(point, net, data, stages[i])  # noqa: F821 - of the file that this one is joined to
        for j in range(p):
            gain = step * weights[j]
            if gain != 0.0:
                for v in range(size):
                    state[v] += gain * stages[j, v]


def begin_row(states, starts, ends, k, change):
    """Copy row k of a trajectory to row k + 1, and set the change of torque in between."""
    for v in range(states.shape[1]):
        states[k + 1, v] = states[k, v]
    for i in range(change.size):
        change[i] = ends[k, i] - starts[k, i]


def runge_kutta_trajectory(
    states, starts, ends, step, substeps, tableau, weights, nodes, stages, net, friction, data
):
    """Fill ``states[1:]`` from ``states[0]``: row k + 1 is `substeps` steps after row k.

    Parameters
    ----------
    states : ndarray, shape (s + 1, 2 (n + m))
        Row 0 is given.
    starts, ends : ndarray, shape (s, n)
        Torque at the start and at the end of each interval; linear between [N m].
    step, substeps, tableau, weights, nodes, stages, net, friction, data
        As for `runge_kutta`.
    """
    change = np.empty(net.size)
    for k in range(starts.shape[0]):
        begin_row(states, starts, ends, k, change)
        runge_kutta(
            states[k + 1], starts[k], change, step, substeps, tableau, weights, nodes, stages, net,
            friction, data,
        )  # fmt: skip


def low_storage(
    state, torque, change, step, substeps, below, weights, nodes, work, net, friction, data
):
    """As `runge_kutta` for methods whose stages need the previous one alone, as the classical one of order four.

    Parameters
    ----------
    state, torque, change, step, substeps, weights, nodes, net, friction, data
        As there.
    below : ndarray, shape (p,)
        Butcher coefficient of stage i - 1 in stage i; the first is not used.
    work : tuple of three ndarray, shape (2 (n + m),)
        Work space.
    """
    point, total, rate = work
    size, p, share = state.size, weights.size, 1.0 / substeps
    for k in range(substeps):
        for v in range(size):
            point[v] = state[v]
            total[v] = state[v]
        for i in range(p):
            net_torque(torque, change, (k + nodes[i]) * share, friction, point, net)
            derivative(point, net, data, rate)  # noqa: F821
            gain = step * weights[i]
            if i + 1 < p:
                ahead = step * below[i + 1]
                for v in range(size):
                    total[v] += gain * rate[v]
                    point[v] = state[v] + ahead * rate[v]
            else:
                for v in range(size):
                    state[v] = total[v] + gain * rate[v]


def low_storage_trajectory(
    states, starts, ends, step, substeps, below, weights, nodes, work, net, friction, data
):
    """As `runge_kutta_trajectory`, by `low_storage`."""
    change = np.empty(net.size)
    for k in range(starts.shape[0]):
        begin_row(states, starts, ends, k, change)
        low_storage(
            states[k + 1], starts[k], change, step, substeps, below, weights, nodes, work, net,
            friction, data,
        )  # fmt: skip
