# SPDX-License-Identifier: Apache-2.0
r"""One sampled loop of an uncertain set: an arm at rest in a configuration, its sensors, filters and delay.

The arm (2), linear about rest, moves from sample to sample by Phi and Gamma (`full_order`). The control measures joint
positions and, through the strain map of the arm *file*, modal amplitudes, :math:`y = Cs`. Modes that the arm has beyond
the file's leak into these amplitudes. Rates are filtered derivatives with the corners `observer.bandwidth` and
`observer.joint_velocity_bandwidth`, as the observer computes them,

.. math::
    r_k = d_k + (r_{k-1} - d_k)\,\kappa, \qquad d_k = (y_k - y_{k-1})/h, \qquad \kappa = e^{-\omega_c h} .

Each is a first-order filter. It needs only one state f in place of the last y and r,

.. math:: r_k = f_{k-1} + \sigma y_k, \qquad f_k = \kappa r_k - \sigma y_k, \qquad \sigma = (1 - \kappa)/h .

The poles are the same except those at z = 0, and fewer states take less time. The integral is that of the slow law,
:math:`w_k = w_{k-1} - h\,q_{k-1}`. A torque acts after the delay. The feedback's torque passes two first-order filters
with the corner `slow.bandwidth` and `fast.bandwidth` (`flexarm_control.low_pass`). With the state X of all of this, and
the control :math:`u = -K\,m`,

.. math:: X_{k+1} = F X_k + G u_k, \qquad m = N X = (q, r_q, -w, \hat\delta, r_\delta) .

The torque after the filters, which is sent, is :math:`v_k = V X_k + D u_k`. If a limit changes it by :math:`\Delta v`,
this adds :math:`E\,\Delta v` to the next state (`Loop.sent`, `through`, `effect`).
"""

from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.arm.encoders import encoder_rows
from flexarm_dynamics.arm.strain_map import StrainMap, reading_rows
from flexarm_dynamics.linear import linear_plant, sampled

from ..low_pass import POLES, LowPass

#: Kind of a `Loop`: an arm within the uncertainty; a margin of gain, delay or modes; an arm whose joints stick; an arm
#: of which some joints stick while the others slide.
ARM, MARGIN, STICKS, APART = "arm", "margin", "sticks", "apart"


@dataclass(frozen=True)
class Sampling:
    """How the loop samples."""

    period: float  # h [s]
    delay: float  # from the measurement to the torque [s]
    joint_corner: float  # of the filtered derivative of joint positions [rad/s]; infinite: speeds are measured
    modal_corner: float  # of the filtered derivative of modal amplitudes [rad/s]
    torque_corner: float = np.inf  # of the feedback's low pass; infinite: none [rad/s]
    friction: tuple = (0.0,)  # fraction of each joint's Coulomb friction that is cancelled [-]
    return_rate: float = 0.0  # see `slow.joint_pid` [1/s]
    breakaway: tuple = (
        0.0,
    )  # fraction of each joint's Coulomb friction that is overcome where it sticks [-]
    breakaway_rate: float = 0.0  # see `slow.joint_pid` [1/s]


@dataclass(frozen=True)
class Loop:
    """One member of the uncertain set; see the module."""

    name: str
    F: np.ndarray  # (N, N)
    G: np.ndarray  # (N, n)
    N: np.ndarray  # (3n + 2m, N): measurements
    period: float
    fraction: float = 1.0  # fraction of the decay that is asked of it [-]
    kind: str = ARM  # ARM, MARGIN, STICKS or APART
    sent: np.ndarray | None = None  # V, (n, N): the torque that is sent is V X + D u
    through: np.ndarray | None = None  # D, (n, n)
    effect: np.ndarray | None = None  # E, (N, n): of a change of the sent torque on the next state


def measured_amplitudes(nominal, plant):
    """Amplitudes that the file's strain map gives for the plant's deflections, shape (m, m of the plant)."""
    map_ = StrainMap(nominal)
    return map_.inverse @ reading_rows(plant, nominal.arm.gauges)


def sampled_loop(
    nominal, plant, q, sampling, gain=1.0, name="", fraction=1.0, sticking=0.0, kind=ARM
):
    """The `Loop` of a `plant` at rest in q (n,) [rad] under a control that knows the `nominal` model.

    Parameters
    ----------
    nominal, plant : ArmModel
    q : ndarray, shape (n,)
        [rad]
    sampling : Sampling
    gain : float
        Factor of the torque on its way to the arm [-].
    name : str
        Of the loop.
    fraction : float
        Fraction of the decay that is asked of the loop [-].
    sticking : float or sequence of float
        Coulomb friction as a damper, over the damper that it is at rest: 1.0 at rest, less for larger movements, 0.0
        without friction; for all joints, or for each, (n,) [-].
    kind : str
        Kind of the loop: `ARM` or `MARGIN`; with `sticking` it is `STICKS`, or `APART` if each joint has its own.
    """
    n, m, mp = nominal.n_joints, nominal.n_modes, plant.n_modes
    each = np.ndim(sticking) > 0
    sticking = np.array(sticking, float) if each else sticking
    A, B = _plant(plant, np.asarray(q, float), sticking)
    B = gain * B
    h, size, p = sampling.period, A.shape[0], n + m
    C = np.zeros((p, size))
    C[:n, : n + mp] = encoder_rows(plant)
    if m:
        C[n:, n : n + mp] = measured_amplitudes(nominal, plant)
    keep = np.exp(-h * np.repeat([sampling.joint_corner, sampling.modal_corner], [n, m]))
    whole = int(sampling.delay / h + 1e-9)
    late = sampling.delay - whole * h
    split = late > 1e-12
    under_way = whole + split
    poles = 0 if np.isinf(sampling.torque_corner) else POLES
    # X = (s, f of the last sample, -w, the low pass, torques under way, newest last); no filter for measured speeds.
    measured = n if np.isinf(sampling.joint_corner) else 0
    at_w = size + p - measured
    at_v = at_w + n
    at_u = at_v + n * poles
    total = at_u + n * under_way
    rate = np.zeros((p, total))  # r_k
    slope = (1.0 - keep) / h
    rate[:, :size] = slope[:, None] * C
    rate[measured:, size:at_w] = np.eye(p - measured)
    F, G, effect = np.zeros((total, total)), np.zeros((total, n)), np.zeros((total, n))
    F[:size, :size] = sampled(A, B, h)[0]
    F[size:at_w] = (keep[:, None] * rate)[measured:]
    F[size:at_w, :size] -= (slope[:, None] * C)[measured:]
    F[at_w:at_v, at_w:at_v] = np.eye(n)
    F[at_w:at_v, :size] = h * C[:n]
    if measured:
        rate[:n] = 0.0
        rate[:n, n + mp : size] = encoder_rows(plant)
    later, end = sampled(A, B, h - late)
    # Output of the low pass in this sample, by the state and by u.
    out, through = np.zeros((n, total)), np.eye(n)
    if poles:
        passed = slice(at_v, at_u)
        low_pass = LowPass(n, sampling.torque_corner).state_space(h)
        F[passed, passed], G[passed], out[:, passed], through = low_pass

    if np.any(sticking):
        _, coulomb, smoothing = nominal.friction_table().T
        damper = sticking * coulomb / smoothing
        cancelled = np.array(sampling.friction) * damper
        overcome = np.maximum(np.array(sampling.breakaway) * damper - cancelled, 0.0)
        stiffness = sampling.return_rate * cancelled + sampling.breakaway_rate * overcome
        out += cancelled[:, None] * rate[:n]
        out[:, :size] -= stiffness[:, None] * C[:n]

    def add(matrix, age):
        if age:
            at = total - n * age
            F[:size, at : at + n] += matrix
        else:
            effect[:size] += matrix

    add(end, whole)
    if split:
        add(later @ sampled(A, B, late)[1], whole + 1)
    for age in range(under_way, 0, -1):
        at = total - n * age
        if age > 1:
            F[at : at + n, at + n : at + 2 * n] = np.eye(n)
        else:
            effect[at : at + n] = np.eye(n)
    F += effect @ out
    G += effect @ through
    N = np.zeros((3 * n + 2 * m, total))
    N[:n, :size] = C[:n]
    N[n : 2 * n] = rate[:n]
    N[2 * n : 3 * n, at_w:at_v] = np.eye(n)
    N[3 * n : 3 * n + m, :size] = C[n:]
    N[3 * n + m :] = rate[n:]
    if np.any(sticking):
        kind = APART if each else STICKS
    return Loop(name, F, G, N, h, fraction, kind, out, through, effect)


def _plant(plant, q, sticking):
    """A and B of the `plant` at rest, with the fraction `sticking` of the damper of Coulomb friction at rest."""
    A, B = linear_plant(plant, q, coulomb=False)
    if not np.any(sticking):
        return A, B
    if np.ndim(sticking):
        # Friction acts where the torques do, so each joint's part is a column of B times a row.
        rubs = linear_plant(plant, q, coulomb=True)[0] - A
        rows = np.linalg.lstsq(B, rubs, rcond=None)[0]
        return A + B @ (sticking[:, None] * rows), B
    return (1.0 - sticking) * A + sticking * linear_plant(plant, q, coulomb=True)[0], B
