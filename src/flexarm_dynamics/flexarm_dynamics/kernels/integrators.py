"""Fixed-step integrators of ``state' = slope(state, net torque)``; joined to a right-hand side by `kernels.load`.

The state is (q, delta, qd, delta_d). Torque goes from `torque` to `torque + change` over the whole interval;
joint friction is taken off it at each stage.
"""

import numpy as np


def take_friction(torque, friction, rates, net):
    """Net = torque less viscous and smoothed Coulomb friction; rows of `friction`: viscous, Coulomb, smoothing."""
    for i in range(net.size):
        net[i] = torque[i] - friction[i, 0] * rates[i]
        if friction[i, 1] != 0.0:
            net[i] -= friction[i, 1] * np.tanh(rates[i] / friction[i, 2])


def stage_torque(torque, change, fraction, friction, state, net, held):
    """Net torque at a stage: `fraction` of the interval has passed."""
    for i in range(net.size):
        held[i] = torque[i] + fraction * change[i]
    take_friction(held, friction, state[state.size // 2 :], net)


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
    net : ndarray, shape (2, n)
        Work space.
    friction : ndarray, shape (n, 3)
        Viscous, Coulomb, smoothing.
    data : tuple
        What the right-hand side needs.
    """
    p, size = weights.size, state.size
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
            stage_torque(torque, change, (k + nodes[i]) / substeps, friction, point, net[0], net[1])
            slope(point, net[0], data, stages[i])  # noqa: F821 - of the file that this one is joined to
        for j in range(p):
            gain = step * weights[j]
            if gain != 0.0:
                for v in range(size):
                    state[v] += gain * stages[j, v]
