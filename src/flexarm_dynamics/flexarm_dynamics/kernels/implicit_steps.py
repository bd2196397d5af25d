# SPDX-License-Identifier: Apache-2.0
"""Steps of a chain whose stiff torques are taken implicitly; see `models.fixed_step`."""

import numpy as np

from .chain_data import JOINT_PARTS
from .placing import prepare
from .recursions import forward_dynamics, modal_force
from .transmissions import dead_zone, slip_level, spring_damping, take_off_slip


def spring_terms(c, state, row, step):
    """Stiffness and damping of a transmission that `implicit_step` takes implicitly: where it is or gets in contact."""
    x, rate = state[row], state[state.size // 2 + row]
    touches = c[4] > 0.0 or abs(x) >= c[2] or abs(x + step * rate) >= c[2]
    return c[0] if touches else 0.0, spring_damping(c, dead_zone(x, c[2], c[4]))


def implicit_step(state, torque, change, step, substeps, stages, net, extra, friction, data):
    r"""Advance `state` in place by a linearly implicit method that damps stiff modes: at rest stable at any step.

    A W-method of order two (Verwer et al. 1999, SIAM J. Sci. Comput. 20(4), ROS2, gamma = 1 - 1/sqrt 2,
    L-stable in the terms taken implicitly: modal stiffness, modal damping and joint friction):

    .. math::
        (I - \gamma hA)k_1 = F(y_0), \quad (I - \gamma hA)k_2 = F(y_0 + hk_1) - 2k_1, \quad
        y = y_0 + \tfrac32hk_1 + \tfrac12hk_2 .

    For the velocities, each stage is one articulated-body recursion with gamma h D + (gamma h)^2 K added to the modal
    mass. The torque is that in the middle of each step.

    Parameters
    ----------
    state, torque, change, step, substeps, friction
        As for `runge_kutta`.
    stages : ndarray, shape (4, 2 (n + m))
        Work space.
    net : ndarray, shape (n,)
        Work space.
    extra : tuple of ndarray, shapes (N, 2) and (N, K, K)
        Work space: what is added to the mass matrix.
    data : tuple
        As for `derivative`.
    """
    constants, work, _, _, driven, force = data
    d, w = constants[0], work[0]
    n, m = torque.size, force.size
    size = n + m
    gamma = 1.0 - np.sqrt(0.5)
    g = gamma * step
    joint_extra, modal_extra = extra
    for i in range(n):
        for j in range(d.count[i]):
            for k in range(d.count[i]):
                modal_extra[i, j, k] = g * d.damping[i, j, k] + g * g * d.stiffness[i, j, k]
    k1, k2, point = stages[0], stages[1], stages[2]
    for number in range(substeps):
        for v in range(2 * size):
            point[v] = state[v]
        for stage in range(2):
            out = stages[stage]
            q, delta = point[:n], point[n:size]
            qd, delta_d = point[size : size + n], point[size + n :]
            fraction = (number + 0.5) / substeps
            net_torque(torque, change, fraction, friction, point, net)  # noqa: F821 - of kernels.integrators
            prepare(d, w, q, delta, qd, delta_d)
            modal_force(d, w, delta, delta_d, force)
            if JOINT_PARTS:
                take_off_slip(d, delta, delta_d, qd, driven, net)
            for i in range(n):
                s = d.spring[i]
                if JOINT_PARTS and s >= 0:
                    stiff, damp = spring_terms(d.transmission[i], state, n + s, step)
                    if stage == 0:
                        joint_extra[i, 1] = g * damp + g * g * stiff
                        force[s] -= g * stiff * state[size + n + s]
                    else:
                        force[s] += 2.0 * joint_extra[i, 1] * k1[size + n + s]
                        force[s] -= g * stiff * (point[size + n + s] - 2.0 * k1[n + s])
                if driven[i]:  # what is called torque is then its acceleration
                    out[size + i] = net[i]
                elif stage == 0:
                    slip = friction[i, 0]
                    if friction[i, 1] != 0.0:
                        # The secant, not the tangent: a joint that slips now may stick within the step.
                        x = max(abs(qd[i]) / friction[i, 2], 1e-6)
                        slip += friction[i, 1] / friction[i, 2] * np.tanh(x) / x
                    if JOINT_PARTS and d.slip[i, 3] != 0.0:
                        x = max(abs(qd[i]) / d.slip[i, 3], 1e-6)
                        level = slip_level(d, i, delta, delta_d, qd[i])
                        slip += level / d.slip[i, 3] * np.tanh(x) / x
                    joint_extra[i, 0] = g * slip
                else:
                    net[i] += 2.0 * joint_extra[i, 0] * k1[size + i]
                first = d.first[i]
                for j in range(d.count[i]):
                    acc = 0.0
                    for k in range(d.count[i]):
                        row = n + first + k
                        if stage == 0:
                            acc -= g * d.stiffness[i, j, k] * state[size + row]
                        else:
                            acc += 2.0 * modal_extra[i, j, k] * k1[size + row]
                            acc -= g * d.stiffness[i, j, k] * (point[size + row] - 2.0 * k1[row])
                    force[first + j] += acc
            forward_dynamics(
                d, w, qd, net, force, joint_extra, modal_extra, driven,
                out[size : size + n], out[size + n :],
            )  # fmt: skip
            for v in range(size):
                if stage == 0:
                    k1[v] = state[size + v] + g * k1[size + v]
                else:
                    k2[size + v] -= 2.0 * k1[size + v]
                    k2[v] = point[size + v] - 2.0 * k1[v] + g * k2[size + v]
            if stage == 0:
                for v in range(2 * size):
                    point[v] = state[v] + step * k1[v]
        for v in range(2 * size):
            state[v] += step * (1.5 * k1[v] + 0.5 * k2[v])


def implicit_trajectory(states, starts, ends, step, substeps, stages, net, extra, friction, data):
    """As `runge_kutta_trajectory`, by `implicit_step`."""
    change = np.empty(net.size)
    for k in range(starts.shape[0]):
        begin_row(states, starts, ends, k, change)  # noqa: F821 - of kernels.integrators
        implicit_step(
            states[k + 1], starts[k], change, step, substeps, stages, net, extra, friction, data
        )
