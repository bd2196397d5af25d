# SPDX-License-Identifier: Apache-2.0
r"""Writes an arm as a URDF: each flexible link is a chain of short rigid pieces that small joints bend and twist.

A link of length L becomes N pieces of length h = L/N. Piece k has the direction of the link's tangent at the middle of
the piece, :math:`x = (k + 1/2)h`. The frame after the last piece has the direction of the tip. So the chain's tip
differs by

.. math:: \sum_k h\,t(x_k) - \int_0^L t\,dx = O(h^2)

from that of a beam of constant length with the tangent t. At the level `first_order`, links get longer as they bend, by
:math:`\tfrac12\int y'^2 dx`. Rigid pieces do not, so this difference remains.

Where two pieces meet there is one revolute joint for each way in which the link is flexible: about z for bending along
y, about y for bending along z, about x for twist, in this order. The angles are found from the rotation between the end
of the chain so far and the wanted section, so errors do not add up along the link.

The URDF is for display (RViz, robot_state_publisher, Foxglove). The small joints have no springs, so a simulation of
this URDF does not behave like the arm. Rotors behind gears and the first motor, which does not move, are left out.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np

from ..errors import ModelError
from ..models.model import about_axis, rotation
from .sections import Sections

#: Axis of the small joint for each direction, in the order of the rotations Rz Ry Rx.
AXES = {"y": (0.0, 0.0, 1.0), "z": (0.0, 1.0, 0.0), "twist": (1.0, 0.0, 0.0)}
#: Radius of a link as it is drawn, relative to the length of all links [-].
THICKNESS = 0.01
#: Limit of a small joint's angle [rad]; URDF requires a number.
BEND = 1.5


@dataclass(frozen=True)
class Junction:
    """The small joints where a piece begins: their names by direction."""

    link: str
    joints: dict


class PieceChain:
    """The URDF of an arm, and the joint values that give it the arm's shape.

    Parameters
    ----------
    model : ArmModel
    pieces : int
        Number of pieces of each flexible link.

    Attributes
    ----------
    joint_names : tuple of str
        The arm's joints, then the small ones, link by link, from base to tip.

    Raises
    ------
    ModelError
        If `pieces` is below 1, or if two parts have the same name.
    """

    def __init__(self, model, pieces=8):
        if pieces < 1:
            field = f"pieces of a link of {model.arm.name}"
            raise ModelError("is too few", field=field, value=pieces, limit="at least 1")
        self.arm, self.pieces = model.arm, int(pieces)
        self._sections = Sections(model, 2 * self.pieces)
        self._junctions = [self._of(link) for link in self.arm.links]
        small = [n for link in self._junctions for j in link for n in j.joints.values()]
        self.joint_names = (*self.arm.joint_names, *small)
        self._values = np.zeros(len(self.joint_names))
        _check_unique(self.arm.name, self.joint_names)

    def _of(self, link):
        """Junctions of a flexible link; none of a rigid one."""
        directions = [d for d in AXES if d in link.flexible or link.reduced is not None]
        count = self.pieces + 1 if directions else 0
        return [
            Junction(link.name, {d: f"{link.name}_{d}_joint{k + 1}" for d in directions})
            for k in range(count)
        ]

    def joint_values(self, q, delta=None):
        """Angles of all joints.

        Parameters
        ----------
        q : (n,) array_like
            [rad]
        delta : (m,) array_like, optional
            Modal amplitudes [m, rad]; not given: the straight arm.

        Returns
        -------
        ndarray, shape (len(joint_names),)
            [rad], in the order of `joint_names`; each call overwrites and returns the same array.

        Raises
        ------
        ShapeError
        """
        n = len(self.arm.joints)
        self._values[:n] = q
        at = n
        for junctions, (R, _) in zip(self._junctions, self._sections.frames(q, delta), strict=True):
            now = R[0]
            for junction, wanted in zip(junctions, (*R[1::2], R[-1]), strict=False):
                for direction, angle in angles(now.T @ wanted, junction.joints):
                    self._values[at] = angle
                    now = now @ about_axis(AXES[direction], angle)
                    at += 1
        return self._values

    def urdf(self):
        """The URDF, a string of XML."""
        return _Writer(self).text()


def angles(turn, directions):
    """Angles about z, y and x that together give a rotation, for those axes that have a joint.

    Parameters
    ----------
    turn : ndarray, shape (3, 3)
    directions : container of str
        Of "y" (about z), "z" (about y) and "twist" (about x).

    Yields
    ------
    direction : str
    angle : float
        [rad]
    """
    if "y" in directions:
        yield "y", float(np.arctan2(turn[1, 0], turn[0, 0]))
        forward = np.hypot(turn[0, 0], turn[1, 0])
    else:
        forward = turn[0, 0]
    if "z" in directions:
        yield "z", float(np.arctan2(-turn[2, 0], forward))
    if "twist" in directions:
        yield "twist", float(np.arctan2(turn[2, 1], turn[2, 2]))


def _check_unique(arm, names):
    seen = set()
    for name in names:
        if name in seen:
            problem, hint = "is the name of two parts", "give that joint or link another name"
            raise ModelError(problem, field=f"URDF of {arm}", value=name, hint=hint)
        seen.add(name)


class _Writer:
    """Writes the URDF of a `PieceChain`, from base to tip."""

    def __init__(self, chain):
        self.chain, self.arm = chain, chain.arm
        self.radius = THICKNESS * self.arm.reach
        self.root = ET.Element("robot", name=self.arm.name)
        for name, colour in (("beam", "0.16 0.44 0.70 1"), ("hub", "0.25 0.25 0.28 1")):
            ET.SubElement(ET.SubElement(self.root, "material", name=name), "color", rgba=colour)

    def text(self):
        self._link("base_link")
        parent = "base_link"
        for i, link in enumerate(self.arm.links):
            parent = self._arm_link(i, link, parent)
        self._payload(parent)
        for kind in ("link", "joint"):
            _check_unique(self.arm.name, [e.get("name") for e in self.root.iter(kind)])
        ET.indent(self.root)
        return '<?xml version="1.0"?>\n' + ET.tostring(self.root, encoding="unicode") + "\n"

    def _arm_link(self, i, link, parent):
        """Write a joint of the arm and the link behind it; returns the name of its tip's frame."""
        joint = self.arm.joints[i]
        self._joint(joint.name, parent, link.name, joint.axis, joint.origin_xyz, joint.origin_rpy)
        self._limits(joint)
        body = self._link(link.name)
        self._visual(body, 3.0 * self.radius, 2.0 * self.radius, joint.axis, (0.0,) * 3, "hub")
        junctions = self.chain._junctions[i]
        tip, base = f"{link.name}_tip", link.name
        if any(link.root):
            base = f"{link.name}_root"
            self._fixed(f"{base}_joint", link.name, base, link.root)
            self._link(base)
        if junctions:
            if joint.hub_inertia:
                self._inertial(body, 0.0, _about(joint))
            self._pieces(link, base, junctions, tip)
        else:
            if base != link.name and joint.hub_inertia:
                self._inertial(body, 0.0, _about(joint))
            more = _about(joint) if base == link.name else 0.0
            self._beam(self._named(base), link, 0.0, link.length, more)
            self._fixed(f"{tip}_joint", base, tip, (link.length, 0.0, 0.0))
            self._bodies(link, base, 0.0, link.length)
        after = self.arm.joints[i + 1 : i + 2]
        end = self._link(tip)
        if after and (after[0].motor_mass or after[0].housed):
            at, turn = after[0].origin_xyz, rotation(after[0].origin_rpy)
            inertia = turn @ np.asarray(after[0].housing_inertia) @ turn.T
            self._inertial(end, after[0].motor_mass, inertia, at)
        return tip

    def _named(self, name):
        return next(e for e in self.root.iter("link") if e.get("name") == name)

    def _bodies(self, link, parent, start, end):
        """Write the bodies on the part of a link whose frame is `parent`; bodies at the tip belong to the last part."""
        for k, body in enumerate(link.bodies):
            last = end >= link.length * (1.0 - 1e-12)
            if start <= body.position < end or (last and body.position >= end):
                name = f"{link.name}_body{k + 1}"
                self._fixed(f"{name}_joint", parent, name, (body.position - start, 0.0, 0.0))
                own = self._link(name)
                self._inertial(own, body.mass, np.asarray(body.inertia), body.offset)

    def _pieces(self, link, parent, junctions, tip):
        length, step = link.length / self.chain.pieces, 0.0
        for k, junction in enumerate(junctions):
            last = len(junction.joints) - 1
            for j, (direction, name) in enumerate(junction.joints.items()):
                whole = tip if k == self.chain.pieces else f"{link.name}_piece{k + 1}"
                child = whole if j == last else f"{link.name}_{direction}_{k + 1}"
                joint = self._joint(name, parent, child, AXES[direction], (step, 0.0, 0.0))
                ET.SubElement(
                    joint, "limit", lower=_text(-BEND), upper=_text(BEND), effort="0", velocity="0"
                )
                if j != last:
                    self._link(child)
                parent, step = child, 0.0
            if k < self.chain.pieces:
                self._beam(self._link(parent), link, k * length, length)
                self._bodies(link, parent, k * length, (k + 1) * length)
            step = length

    def _beam(self, body, link, start, length, more=0.0):
        """Write a rigid piece of a link from `start` on, along x [m]; `more` is added inertia (3, 3) [kg m^2]."""
        mass, first, second, polar = link.moments(start, start + length)
        centre = first / mass
        across = second - mass * centre**2
        # In the model, sections have a polar inertia only for twist; without it, use that of the rod that is drawn.
        along = polar or 0.5 * mass * self.radius**2
        inertia = np.diag([along, across, across]) + more
        self._inertial(body, mass, inertia, (centre - start, 0.0, 0.0))
        self._visual(body, length, self.radius, (1.0, 0.0, 0.0), (0.5 * length, 0.0, 0.0), "beam")

    def _payload(self, parent):
        payload = self.arm.payload
        if not payload.mass:
            return
        self._fixed("payload_joint", parent, "payload", (0.0, 0.0, 0.0))
        body = self._link("payload")
        self._inertial(body, payload.mass, np.asarray(payload.inertia), payload.offset)
        visual = ET.SubElement(body, "visual")
        ET.SubElement(visual, "origin", xyz=_text(*payload.offset))
        ball = ET.SubElement(visual, "geometry")
        ET.SubElement(ball, "sphere", radius=_text(2.0 * self.radius))
        ET.SubElement(visual, "material", name="hub")

    # Elements ----------------------------------------------------------------------------------

    def _link(self, name):
        return ET.SubElement(self.root, "link", name=name)

    def _joint(self, name, parent, child, axis, xyz, rpy=(0.0, 0.0, 0.0)):
        self.last = joint = ET.SubElement(self.root, "joint", name=name, type="revolute")
        ET.SubElement(joint, "parent", link=parent)
        ET.SubElement(joint, "child", link=child)
        ET.SubElement(joint, "origin", xyz=_text(*xyz), rpy=_text(*rpy))
        ET.SubElement(joint, "axis", xyz=_text(*axis))
        return joint

    def _fixed(self, name, parent, child, xyz):
        joint = ET.SubElement(self.root, "joint", name=name, type="fixed")
        ET.SubElement(joint, "parent", link=parent)
        ET.SubElement(joint, "child", link=child)
        ET.SubElement(joint, "origin", xyz=_text(*xyz))

    def _limits(self, joint):
        """Write the limits; without both position limits a joint is continuous, and missing other limits are large."""
        limits, element = joint.limits, self.last
        low, high = limits.position
        given = {
            "effort": _text(min(limits.torque, 1e6)),
            "velocity": _text(min(limits.velocity, 1e3)),
        }
        if np.isfinite(low) and np.isfinite(high):
            given |= {"lower": _text(low), "upper": _text(high)}
        else:
            element.set("type", "continuous")
        ET.SubElement(element, "limit", given)
        ET.SubElement(
            element,
            "dynamics",
            damping=_text(joint.friction.viscous),
            friction=_text(joint.friction.coulomb),
        )

    @staticmethod
    def _inertial(body, mass, inertia, xyz=(0.0, 0.0, 0.0)):
        inertial = ET.SubElement(body, "inertial")
        ET.SubElement(inertial, "origin", xyz=_text(*xyz))
        ET.SubElement(inertial, "mass", value=_text(mass))
        names = {f"i{'xyz'[a]}{'xyz'[b]}": inertia[a, b] for a in range(3) for b in range(a, 3)}
        ET.SubElement(inertial, "inertia", {name: _text(value) for name, value in names.items()})

    @staticmethod
    def _visual(body, length, radius, axis, middle, material):
        """Write a cylinder about an axis; in URDF cylinders are about z."""
        x, y, z = axis
        rpy = (0.0, np.arccos(np.clip(z, -1.0, 1.0)), np.arctan2(y, x))
        visual = ET.SubElement(body, "visual")
        ET.SubElement(visual, "origin", xyz=_text(*middle), rpy=_text(*rpy))
        geometry = ET.SubElement(visual, "geometry")
        ET.SubElement(geometry, "cylinder", length=_text(length), radius=_text(radius))
        ET.SubElement(visual, "material", name=material)


def _about(joint):
    """Inertia of a hub, known only about its joint's axis, shape (3, 3) [kg m^2]."""
    return joint.hub_inertia * np.outer(joint.axis, joint.axis)


def _text(*values):
    return " ".join(f"{float(v) + 0.0:.12g}" for v in values)
