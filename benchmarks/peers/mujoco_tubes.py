# SPDX-License-Identifier: Apache-2.0
"""MuJoCo model of a spatial arm of two tubes, as chains of rigid segments.

It is like `mujoco_chain` with the layout ``gauss``, but has three hinges at each node: two for bending, one for twist.
The effect of their order is of second order in a node's angles, and smaller with more nodes.
"""

import mujoco
import numpy as np

from .mujoco_chain import MujocoChain, hinges

#: Fastest settings that keep the tip within 50 um; scanned: 2 to 4 segments, steps of 10 ms divided by 2 to 50. A
#: setting counts only if half its step keeps the target too.
BEST = {"MujocoTubes": {"spatial_torque": {"segments": 3, "step": 6.25e-4}}}

_MODEL = """
<mujoco>
 <compiler angle="radian" boundmass="0" boundinertia="0"/>
 <option timestep="{step!r}" integrator="RK4" gravity="0 0 0">
  <flag constraint="disable" contact="disable" eulerdamp="disable" autoreset="disable"/>
 </option>
 <worldbody>{bodies}</worldbody>
 <actuator><motor joint="q1"/><motor joint="q2"/></actuator>
</mujoco>
"""


def _inertial(size, parameters, bodies):
    """A segment's ``inertial``: a tube from its frame on, and `bodies` (mass, inertia about all axes, position)."""
    tube = parameters["rhoA"] * size
    masses = [(tube, 0.5 * size), *((m, x) for m, _, x in bodies)]
    total = sum(m for m, _ in masses)
    centre = sum(m * x for m, x in masses) / total
    along = parameters["polar"] * size + sum(J for _, J, _ in bodies)
    across = tube * size**2 / 12.0 + sum(m * (x - centre) ** 2 for m, x in masses)
    across += sum(J for _, J, _ in bodies)
    values = f"{along!r} {across!r} {across!r}"
    return f'<inertial pos="{centre!r} 0 0" mass="{total!r}" diaginertia="{values}"/>'


def arm(parameters, segments, step):
    """Model of the case as MJCF."""
    p, (places, weights) = parameters, hinges(segments, "gauss")
    bounds = np.concatenate([[0.0], places, [1.0]]) * p["L"]
    text, offset = [], 0.0
    for number, axis in enumerate(("0 0 1", "0 1 0")):
        end = (p["Mp"], p["Jp"]) if number else (p["Mm"], p["Jm"])
        for k in range(segments + 1):
            size = float(bounds[k + 1] - bounds[k])
            bodies = [(p["Mh"], p[f"Jh{number + 1}"], 0.0)] if k == 0 else []
            bodies += [(*end, size)] if k == segments else []
            joints = f'<joint name="q{number + 1}" axis="{axis}"/>'
            if k:
                whole = float(weights[k - 1]) * p["L"]
                bend, twist = p["EI"] / whole, p["GJ"] / whole
                joints = "".join(
                    f'<joint axis="{a}" stiffness="{s!r}"/>'
                    for a, s in (("0 0 1", bend), ("0 1 0", bend), ("1 0 0", twist))
                )
            text.append(f'<body pos="{offset!r} 0 0">{joints}{_inertial(size, p, bodies)}')
            offset = size
    tip = f'<site name="tip" pos="{offset!r} 0 0"/>'
    return _MODEL.format(step=float(step), bodies="".join(text) + tip + "</body>" * len(text))


class MujocoTubes(MujocoChain):
    """Hinge chain in space under `mujoco.rollout`; settings as for `MujocoChain`."""

    name = "MuJoCo rollout in space, RK4"

    def _model(self, parameters, segments, layout, step):
        return arm(parameters, segments, step)

    def columns(self, angles):
        """Report columns from joint angles, shape (n, joints)."""
        tips = np.empty((len(angles), 3))
        for tip, row in zip(tips, angles, strict=True):
            self.data.qpos[:] = row
            mujoco.mj_kinematics(self.model, self.data)
            tip[:] = self.data.site_xpos[0]
        return {"theta1": angles[:, 0]} | dict(
            zip(("tip_x", "tip_y", "tip_z"), tips.T, strict=True)
        )
