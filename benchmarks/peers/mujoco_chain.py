# SPDX-License-Identifier: Apache-2.0
r"""MuJoCo model of planar flexible links as chains of rigid segments.

A link is a chain of rigid segments with a spring hinge between neighbours. With hinges at the nodes
:math:`x_k` of a quadrature rule on the link and stiffness :math:`EI/(w_k L)` the chain's deflection
under any static load is the quadrature of :math:`\int M(x)\dots/EI\,dx`, so

- ``uniform``, the midpoint rule: equal cells with a hinge in the middle of each. Half a segment is
  clamped in the hub, and half a segment is left at the tip. The tip deflection under a tip force
  would be too small by the fraction :math:`1/(4N^2)`; the stiffness is corrected for this.
- ``gauss``: Gauss-Legendre nodes and weights. Deflection and slope under a tip force or moment are
  exact from two hinges on. The first frequencies converge much faster than with equal segments. For
  the clamped link of one_link_pulse, the errors of the first two are 2e-4 and -6e-2 with three
  hinges, -4e-5 and 1e-3 with four; with ``uniform`` 4e-3 and 4e-2 with four, 1e-3 and 9e-3 with eight.

Each rigid segment has the mass and the rotary inertia of a rod at its place on the beam. The chain
makes true rotations, so foreshortening and large slopes are included.
"""

import mujoco
import numpy as np
from mujoco import rollout

from . import RATE, Peer, hubs, steps_per_sample

#: Version that was tested: mujoco 3.17.0 (wheels for CPython 3.10 to 3.14; 4.0.0 has none for 3.10).
PINNED = "mujoco==3.17.0"

#: Fastest settings that keep the tip within 0.5 mm (one_link_pulse), 50 um (two_link_torque_x0p1)
#: and 0.1 mm (two_link_torque). Scanned: both layouts, 2 to 6 hinges, steps of 10 ms divided by 1 to
#: 80. A setting counts only if half its step keeps the target too (not required of semi-implicit Euler
#: in two_link_torque). With the uniform layout, one_link_pulse needs 4 hinges and 5 ms (0.48 mm),
#: two_link_torque_x0p1 3 hinges and 5 ms (21 um).
BEST = {
    "MujocoChain": {
        "one_link_pulse": {"segments": 3, "step": 5e-3},
        "two_link_torque_x0p1": {"segments": 2, "step": 1e-2},
        "two_link_torque": {"segments": 4, "step": 2.5e-3},
        "three_link_torque": {"segments": 3, "step": 2.5e-3},
    },
    "MujocoChainEuler": {
        "one_link_pulse": {"segments": 3, "step": 1.0 / 600.0},
        "two_link_torque_x0p1": {"segments": 2, "step": 1.0 / 600.0},
        "two_link_torque": {"segments": 3, "step": 1.25e-4},
    },
}

_OPTION = """
 <compiler angle="radian" boundmass="0" boundinertia="0"/>
 <option timestep="{step!r}" integrator="{integrator}" gravity="0 0 0">
  <flag constraint="disable" contact="disable" eulerdamp="disable" autoreset="disable"/>
 </option>
"""


def hinges(count, layout):
    """Positions and flexibilities of `count` hinges of a link in a `layout`, ``uniform`` or ``gauss``.

    Positions along the link from 0 to 1 [-], and flexibilities relative to that of the whole link, L/EI [-], each
    (count,).
    """
    if layout == "uniform":
        places = (np.arange(count) + 0.5) / count
        return places, np.full(count, 1.0 / (count - 0.25 / count))
    if layout == "gauss":
        nodes, weights = np.polynomial.legendre.leggauss(count)
        return 0.5 * (nodes + 1.0), 0.5 * weights
    raise ValueError(f"layout {layout!r}: uniform or gauss")


def _body(rod, points, spin):
    """Mass, centre of mass and inertia about it of a segment: a `rod` (mass, length) that starts at its frame.

    `points` are masses and positions of point masses on it; `spin` is an inertia without mass.
    """
    mass, length = rod
    total = mass + sum(m for m, _ in points)
    centre = (0.5 * mass * length + sum(m * x for m, x in points)) / total
    inertia = mass * (length**2 / 12.0 + (0.5 * length - centre) ** 2)
    inertia += sum(m * (x - centre) ** 2 for m, x in points)
    return total, centre, inertia + spin


def chain(parameters, segments, layout, step, integrator):
    """Model of a case as MJCF; `segments` is the number of hinges per link, `layout` as for `hinges`.

    `integrator` is ``RK4`` or ``Euler`` (semi-implicit); `step` is in s. Order of the joints: base, link 1's hinges,
    elbow, link 2's hinges.
    """
    p = parameters
    length, rho, stiffness = p["L"], p["rhoA"], p["EI"]
    places, weights = hinges(segments, layout)
    bounds = np.concatenate([[0.0], places * length, [length]])
    text, depth, offset = [], 0, 0.0
    inertias = hubs(p)
    for number, hub in enumerate(inertias):
        last = number == len(inertias) - 1
        for k in range(segments + 1):
            size = float(bounds[k + 1] - bounds[k])
            points, spin = [], hub if k == 0 else 0.0
            if k == segments:
                points.append((p["Mp"] if last else p["Mm"], size))
                spin += p["Jp"] if last else 0.0
            mass, centre, inertia = _body((rho * size, size), points, spin)
            if k == 0:
                joint = f'<joint name="q{number + 1}" axis="0 0 1"/>'
            else:
                spring = stiffness / (float(weights[k - 1]) * length)
                joint = f'<joint axis="0 0 1" stiffness="{spring!r}"/>'
            # Only the inertia about z matters; MuJoCo always accepts three equal ones.
            text.append(
                f'<body pos="{offset!r} 0 0">{joint}<inertial pos="{centre!r} 0 0"'
                f' mass="{mass!r}" diaginertia="{inertia!r} {inertia!r} {inertia!r}"/>'
            )
            offset, depth = size, depth + 1
    motors = "".join(f'<motor joint="q{n + 1}"/>' for n in range(len(inertias)))
    return (
        "<mujoco>"
        + _OPTION.format(step=float(step), integrator=integrator)
        + f"<worldbody>{''.join(text)}{'</body>' * depth}</worldbody>"
        + f"<actuator>{motors}</actuator></mujoco>"
    )


class MujocoChain(Peer):
    """Hinge chain under `mujoco.rollout`.

    Parameters
    ----------
    step : float
        Step [s]; divides 10 ms. The torque in each step is that at its middle.
    segments : int
        Hinges per link.
    layout : str
        As for `hinges`.
    """

    integrator = "RK4"
    name = "MuJoCo rollout, RK4"

    def __init__(self, case, parameters, *, step=1e-3, segments=4, layout="gauss"):
        super().__init__(case, parameters, step=step, segments=segments, layout=layout)
        self.step, self.every, self.segments = step, steps_per_sample(step), segments
        self.model = mujoco.MjModel.from_xml_string(self._model(parameters, segments, layout, step))
        self.data = mujoco.MjData(self.model)
        places, _ = hinges(segments, layout)
        self.sizes = np.diff(np.concatenate([[0.0], places, [1.0]])) * parameters["L"]
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        self.start = np.empty(mujoco.mj_stateSize(self.model, kind))
        mujoco.mj_getState(self.model, self.data, self.start, kind)
        self.rollout = rollout.Rollout(nthread=0)

    def _model(self, parameters, segments, layout, step):
        return chain(parameters, segments, layout, step, self.integrator)

    def integrate(self, duration):
        steps = round(duration * RATE) * self.every
        torque = self.torque.sample(self.step * (np.arange(steps) + 0.5))
        states, _ = self.rollout.rollout(self.model, self.data, self.start, torque)
        return states[0, self.every - 1 :: self.every]

    def report(self, result):
        angles = np.empty((len(result) + 1, self.model.nq))
        angles[0] = self.start[1 : 1 + self.model.nq]
        angles[1:] = result[:, 1 : 1 + self.model.nq]
        return self.columns(angles)

    def columns(self, angles):
        """Report columns from joint angles, shape (n, joints)."""
        direction = np.cumsum(angles, axis=1)
        cos, sin = np.cos(direction), np.sin(direction)
        n, sizes = self.segments + 1, np.tile(self.sizes, self.links)
        columns = {"theta1": angles[:, 0], "tip_x": cos @ sizes, "tip_y": sin @ sizes}
        if self.links != 2:
            return columns
        return columns | {
            "elbow_x": cos[:, :n] @ self.sizes,
            "elbow_y": sin[:, :n] @ self.sizes,
            "alpha2": direction[:, n],
        }


class MujocoChainEuler(MujocoChain):
    """`MujocoChain` with MuJoCo's semi-implicit Euler."""

    integrator = "Euler"
    name = "MuJoCo rollout, semi-implicit Euler"
