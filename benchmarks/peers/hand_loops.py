# SPDX-License-Identifier: Apache-2.0
r"""The equations of `numpy_equations` as closed-form loops in numba: the least time they take.

It contains everything that speeds up a loop written for only these two arms:

- Scalars throughout, classical Runge-Kutta in its form for second-order systems.
- Exact loaded modes make a last link's modal mass and stiffness diagonal, so its amplitudes are
  eliminated with constants.
- Two links are integrated in :math:`(q_1, \delta_1, \alpha_2, \delta_2)` instead of
  :math:`(q_1, q_2, \delta_1, \delta_2)`; the two differ by a constant linear map, which Runge-Kutta
  commutes with. In these coordinates, everything that depends on the bend acts on link 1 as a moment
  on its base and a force on its tip. So its amplitudes are eliminated with constants, too. Of the
  6 by 6 system, one division for the tip force and one for the two rotations remain.
"""

from math import cos, sin

import numpy as np
from numba import njit

from . import RATE, Peer, steps_per_sample
from .numpy_equations import equations, links

#: A last link whose mode shapes are not orthogonal within this tolerance, relative to the diagonal, is refused.
ORTHOGONAL = 1e-9

#: Scanned: 1 to 10 ms. 10 ms is the longest step that the report's 100 Hz allow. It is stable and keeps
#: the tip within 0.13 mm (one_link_pulse) and 23 um (two_link_torque_x0p1), the model's own error.
BEST = {
    "HandLoops": {
        "one_link_pulse": {"step": 1e-2},
        "two_link_torque_x0p1": {"step": 1e-2},
        "two_link_torque": {"step": 1e-2},
    }
}


def _check_diagonal(matrix, what):
    """Raise ValueError unless a 2 by 2 matrix is diagonal."""
    if abs(matrix[0, 1]) > ORTHOGONAL * np.sqrt(matrix[0, 0] * matrix[1, 1]):
        raise ValueError(f"{what} is not diagonal: the shapes are not the link's loaded modes")


def one_link_constants(link):
    """Constants of `one_link`, a tuple of floats, from a `numpy_equations.Link`."""
    _check_diagonal(link.mass, "modal mass")
    _check_diagonal(link.stiffness, "modal stiffness")
    mass, gram = np.diag(link.mass), link.gram
    lever = link.coupling / mass
    values = [
        link.inertia - link.coupling @ lever, *gram[0], gram[1, 1],
        *(1.0 / mass), *(np.diag(link.stiffness) / mass), *link.coupling, *lever,
    ]  # fmt: skip
    return tuple(float(v) for v in values)


def two_links_constants(inner, outer):
    """Constants of `two_links`, a tuple of floats, from two `numpy_equations.Link`, `inner` and `outer`."""
    _check_diagonal(outer.mass, "modal mass")
    _check_diagonal(outer.stiffness, "modal stiffness")
    gram1, gram2, mass2 = inner.gram, outer.gram, np.diag(outer.mass)
    by_stiffness = np.linalg.solve(inner.mass, inner.stiffness)
    by_slope = np.linalg.solve(inner.mass, inner.slope)
    by_coupling = np.linalg.solve(inner.mass, inner.coupling)
    by_tip = np.linalg.solve(inner.mass, inner.tip)
    values = [
        inner.length, *inner.tip, *inner.coupling, *gram1[0], gram1[1, 1],
        *by_stiffness.ravel(), *by_slope, *by_coupling, *by_tip,
        inner.inertia - inner.coupling @ by_coupling, inner.tip @ by_coupling, inner.tip @ by_tip,
        outer.first_x, *outer.first_y, *gram2[0], gram2[1, 1],
        *(1.0 / mass2), *(np.diag(outer.stiffness) / mass2), *outer.coupling,
        outer.inertia - outer.coupling @ (outer.coupling / mass2),
        outer.first_y @ (outer.first_y / mass2), outer.first_y @ (outer.coupling / mass2),
    ]  # fmt: skip
    return tuple(float(v) for v in values)


@njit(inline="always", cache=True)
def one_link(k, x1, x2, r, v1, v2, torque):
    """Accelerations of (q, delta1, delta2) at amplitudes x, hub rate r and amplitude rates v."""
    inertia, g11, g12, g22, b1, b2, w1, w2, m1, m2, a1, a2 = k
    bent1, bent2 = g11 * x1 + g12 * x2, g12 * x1 + g22 * x2
    rr = r * r
    f1, f2 = rr * bent1 * b1 - w1 * x1, rr * bent2 * b2 - w2 * x2
    acc = (torque - 2.0 * r * (v1 * bent1 + v2 * bent2) - m1 * f1 - m2 * f2) / (
        inertia + x1 * bent1 + x2 * bent2
    )
    return acc, f1 - a1 * acc, f2 - a2 * acc


@njit(inline="always", cache=True)
def two_links(k, q, x1, x2, al, y1, y2, r, v1, v2, s, u1, u2, torque1, torque2):
    """Accelerations of (q1, delta1, alpha2, delta2) at (q, x, al, y) and rates (r, v, s, u)."""
    (
        length, e1, e2, m1, m2, g11, g12, g22, w11, w12, w21, w22, sl1, sl2, c1, c2, t1, t2, j1, em, ee,
        fx, h1, h2, p11, p12, p22, b1, b2, o1, o2, n1, n2, j2, hh, hm,
    ) = k  # fmt: skip
    bend = al - q
    c, z = cos(bend), sin(bend)
    tip = e1 * x1 + e2 * x2
    fy = h1 * y1 + h2 * y2
    along, across = fx * c - fy * z, fx * z + fy * c
    rr, ss = r * r, s * s

    # Velocity-dependent parts of link 2's inertial force, rotated into frame 1, and of the elbow's
    # acceleration.
    own_x, own_y = -2.0 * s * (h1 * u1 + h2 * u2) - ss * fx, -ss * fy
    force_x, force_y = c * own_x - z * own_y, z * own_x + c * own_y
    elbow_x, elbow_y = -2.0 * r * (e1 * v1 + e2 * v2) - rr * length, -rr * tip
    turned_x, turned_y = c * elbow_x + z * elbow_y, c * elbow_y - z * elbow_x

    # Amplitudes of link 2 without the rotations, and the forces that they exert.
    bent1, bent2 = p11 * y1 + p12 * y2, p12 * y1 + p22 * y2
    f1 = ss * bent1 * b1 - o1 * y1 - h1 * b1 * turned_y
    f2 = ss * bent2 * b2 - o2 * y2 - h2 * b2 * turned_y
    push, twist = h1 * f1 + h2 * f2, n1 * f1 + n2 * f2
    moment2 = torque2 - 2.0 * s * (u1 * bent1 + u2 * bent2) - fx * turned_y + fy * turned_x - twist
    inertia2 = j2 + y1 * bent1 + y2 * bent2

    # The same for link 1.
    bent1, bent2 = g11 * x1 + g12 * x2, g12 * x1 + g22 * x2
    d1 = rr * x1 - w11 * x1 - w12 * x2 - sl1 * torque2
    d2 = rr * x2 - w21 * x1 - w22 * x2 - sl2 * torque2
    free = e1 * d1 + e2 * d2
    lever = tip * z + length * c
    rest = push - hh * c * free
    moment1 = (
        torque1
        - torque2
        - 2.0 * r * (v1 * bent1 + v2 * bent2)
        + tip * force_x
        - length * force_y
        - m1 * d1
        - m2 * d2
        - lever * rest
    )
    moment2 -= (along - hm * c) * free

    # Force on the tip of link 1 = f0 + fa acc2 - fq acc1.
    reach = lever - c * em
    scale = 1.0 / (1.0 - c * c * hh * ee)
    f0 = (force_y + c * rest) * scale
    fa = (along - hm * c) * scale
    fq = c * hh * reach * scale
    cross = tip * across + length * along
    by1 = em - lever * hh * c * ee
    by2 = ee * (along - hm * c)
    a11 = j1 + x1 * bent1 + x2 * bent2 - hh * lever * reach + by1 * fq
    a12 = cross - lever * hm - by1 * fa
    a22 = inertia2 - by2 * fa
    moment1 += by1 * f0
    moment2 += by2 * f0
    over = 1.0 / (a11 * a22 - a12 * a12)
    acc1 = (a22 * moment1 - a12 * moment2) * over
    acc2 = (a11 * moment2 - a12 * moment1) * over
    force = f0 + fa * acc2 - fq * acc1
    d1 -= c1 * acc1 + t1 * force
    d2 -= c2 * acc1 + t2 * force
    across_acc = lever * acc1 + c * (e1 * d1 + e2 * d2)
    return (
        acc1,
        d1,
        d2,
        acc2,
        f1 - b1 * (h1 * across_acc + n1 * acc2),
        f2 - b2 * (h2 * across_acc + n2 * acc2),
    )


def one_link_runner(accelerations):
    """Runge-Kutta 4 of one link whose `accelerations` are compiled: ``run(constants, step, every, torques, rows)``."""

    @njit
    def run(k, h, every, torque, out):
        """Runge-Kutta 4 from ``out[0]``: writes (q, delta, rates) into the rows, `every` steps apart."""
        q, x, y, r, v, w = out[0]
        half, sixth = 0.5 * h, h / 6.0
        quarter, half2, sixth2 = half * half, half * h, h * h / 6.0
        i = 0
        for row in range(1, out.shape[0]):
            for _ in range(every):
                start, middle, end = torque[i, 0, 0], torque[i, 1, 0], torque[i, 2, 0]
                i += 1
                a1, b1, c1 = accelerations(k, x, y, r, v, w, start)
                xm, ym = x + half * v, y + half * w
                a2, b2, c2 = accelerations(
                    k, xm, ym, r + half * a1, v + half * b1, w + half * c1, middle
                )
                a3, b3, c3 = accelerations(
                    k, xm + quarter * b1, ym + quarter * c1,
                    r + half * a2, v + half * b2, w + half * c2, middle,
                )  # fmt: skip
                a4, b4, c4 = accelerations(
                    k, x + h * v + half2 * b2, y + h * w + half2 * c2,
                    r + h * a3, v + h * b3, w + h * c3, end,
                )  # fmt: skip
                q += h * r + sixth2 * (a1 + a2 + a3)
                x += h * v + sixth2 * (b1 + b2 + b3)
                y += h * w + sixth2 * (c1 + c2 + c3)
                r += sixth * (a1 + 2.0 * (a2 + a3) + a4)
                v += sixth * (b1 + 2.0 * (b2 + b3) + b4)
                w += sixth * (c1 + 2.0 * (c2 + c3) + c4)
            out[row, 0], out[row, 1], out[row, 2] = q, x, y
            out[row, 3], out[row, 4], out[row, 5] = r, v, w

    return run


#: Runge-Kutta 4 of one link from ``out[0]``: writes (q, delta, rates) into the rows, `every` steps apart.
run_one = one_link_runner(one_link)


@njit(cache=True)
def run_two(k, h, every, torque, out):
    """The same for two links: (q1, delta1, alpha2, delta2, rates)."""
    xa, xb, xc, xd, xe, xf, va, vb, vc, vd, ve, vf = out[0]
    half, sixth = 0.5 * h, h / 6.0
    quarter, half2, sixth2 = half * half, half * h, h * h / 6.0
    i = 0
    for row in range(1, out.shape[0]):
        for _ in range(every):
            step = torque[i]
            i += 1
            a1, b1, c1, d1, e1, f1 = two_links(
                k, xa, xb, xc, xd, xe, xf, va, vb, vc, vd, ve, vf, step[0, 0], step[0, 1]
            )
            ya, yb, yc = xa + half * va, xb + half * vb, xc + half * vc
            yd, ye, yf = xd + half * vd, xe + half * ve, xf + half * vf
            a2, b2, c2, d2, e2, f2 = two_links(
                k, ya, yb, yc, yd, ye, yf,
                va + half * a1, vb + half * b1, vc + half * c1, vd + half * d1, ve + half * e1, vf + half * f1,
                step[1, 0], step[1, 1],
            )  # fmt: skip
            a3, b3, c3, d3, e3, f3 = two_links(
                k, ya + quarter * a1, yb + quarter * b1, yc + quarter * c1,
                yd + quarter * d1, ye + quarter * e1, yf + quarter * f1,
                va + half * a2, vb + half * b2, vc + half * c2, vd + half * d2, ve + half * e2, vf + half * f2,
                step[1, 0], step[1, 1],
            )  # fmt: skip
            a4, b4, c4, d4, e4, f4 = two_links(
                k, xa + h * va + half2 * a2, xb + h * vb + half2 * b2, xc + h * vc + half2 * c2,
                xd + h * vd + half2 * d2, xe + h * ve + half2 * e2, xf + h * vf + half2 * f2,
                va + h * a3, vb + h * b3, vc + h * c3, vd + h * d3, ve + h * e3, vf + h * f3,
                step[2, 0], step[2, 1],
            )  # fmt: skip
            xa += h * va + sixth2 * (a1 + a2 + a3)
            xb += h * vb + sixth2 * (b1 + b2 + b3)
            xc += h * vc + sixth2 * (c1 + c2 + c3)
            xd += h * vd + sixth2 * (d1 + d2 + d3)
            xe += h * ve + sixth2 * (e1 + e2 + e3)
            xf += h * vf + sixth2 * (f1 + f2 + f3)
            va += sixth * (a1 + 2.0 * (a2 + a3) + a4)
            vb += sixth * (b1 + 2.0 * (b2 + b3) + b4)
            vc += sixth * (c1 + 2.0 * (c2 + c3) + c4)
            vd += sixth * (d1 + 2.0 * (d2 + d3) + d4)
            ve += sixth * (e1 + 2.0 * (e2 + e3) + e4)
            vf += sixth * (f1 + 2.0 * (f2 + f3) + f4)
        out[row, 0], out[row, 1], out[row, 2] = xa, xb, xc
        out[row, 3], out[row, 4], out[row, 5] = xd, xe, xf
        out[row, 6], out[row, 7], out[row, 8] = va, vb, vc
        out[row, 9], out[row, 10], out[row, 11] = vd, ve, vf


class HandLoops(Peer):
    """Closed-form loops, Runge-Kutta 4 with a fixed step.

    Parameters
    ----------
    step : float
        Step [s]; divides 10 ms.
    tip_mass, tip_inertia : float, optional
        As for `numpy_equations.links`.
    """

    name = "hand-written loops, numba RK4"

    def __init__(self, case, parameters, *, step=1e-3, tip_mass=None, tip_inertia=None):
        super().__init__(case, parameters, step=step)
        self.arm = equations(parameters, tip_mass, tip_inertia)
        arm = links(parameters, tip_mass, tip_inertia)
        self.constants = (two_links_constants if self.links == 2 else one_link_constants)(*arm)
        self.step, self.every = step, steps_per_sample(step)
        self.integrate(1.0 / RATE)  # compiles

    def simulate(self, start, torque):
        """Simulate from a given state under given torques.

        Parameters
        ----------
        start : ndarray, shape (2n,)
            (q, delta, rates); for two links (q1, q2, delta1, delta2, rates).
        torque : ndarray, shape (steps, 3, joints)
            Torques at the start, middle and end of each step [N m].

        Returns
        -------
        ndarray, shape (1 + steps // every, 2n)
            States in the same coordinates.
        """
        out = np.empty((1 + len(torque) // self.every, len(start)))
        if self.links == 1:
            out[0] = start
            run_one(self.constants, self.step, self.every, torque, out)
            return out
        slope = self.arm.inner.slope
        for base in (0, 6):
            q1, q2 = start[base], start[base + 1]
            delta1 = start[base + 2 : base + 4]
            out[0, base], out[0, base + 1 : base + 3] = q1, delta1
            out[0, base + 3] = q1 + q2 + slope @ delta1
            out[0, base + 4 : base + 6] = start[base + 4 : base + 6]
        run_two(self.constants, self.step, self.every, torque, out)
        for base in (0, 6):
            delta1 = out[:, base + 1 : base + 3].copy()
            out[:, base + 1] = out[:, base + 3] - out[:, base] - delta1 @ slope
            out[:, base + 2 : base + 4] = delta1
        return out

    def accelerations(self, state, torque):
        """Second derivatives of (q, delta) or (q1, q2, delta1, delta2)."""
        if self.links == 1:
            return np.array(one_link(self.constants, *state[1:], torque[0]))
        slope = self.arm.inner.slope
        x, v = state[:6], state[6:]
        own = [(p[0], p[2], p[3], p[0] + p[1] + slope @ p[2:4], p[4], p[5]) for p in (x, v)]
        acc = two_links(self.constants, *own[0], *own[1], *torque)
        second = acc[3] - acc[0] - slope @ np.array(acc[1:3])
        return np.array([acc[0], second, acc[1], acc[2], acc[4], acc[5]])

    def integrate(self, duration):
        torque = self.torque.stages(round(duration * RATE) * self.every, self.step)
        return self.simulate(np.zeros(2 * self.arm.size), torque)

    def report(self, result):
        return self.arm.columns(result)
