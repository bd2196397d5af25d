# SPDX-License-Identifier: Apache-2.0
"""Removes fixed joints: the two links that a fixed joint holds together become one, before anything is computed.

A rigid link before a fixed joint becomes a body at the root of the link after it; the axis of that link then
begins away from its joint. A rigid link after a fixed joint, behind a link that bends, becomes a body at the tip of
that link. The next joint moves with it.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import ArmFileError
from .description import Body


def merged(joints, links, fixed):
    """Joints and links without the fixed joints.

    Parameters
    ----------
    joints, links : sequence of Joint, Link
        As the file has them, one joint for each link.
    fixed : set of int
        The joints that do not turn.

    Returns
    -------
    joints, links : tuple of Joint, Link

    Raises
    ------
    ArmFileError
        If the links on both sides of a fixed joint bend, or if a rigid link behind a bending one ends the arm.
    """
    if 0 in fixed:
        hint = "turn and move the next joint's origin instead"
        raise ArmFileError("joints[0].type", "the first joint is fixed", value="fixed", hint=hint)
    joints, links, names = list(joints), list(links), list(range(len(joints)))
    for number in sorted(fixed):
        i = names.index(number)
        place = f"joints[{number}].type"
        if not links[i - 1].flexible:
            joints[i], links[i] = _before(joints[i - 1], links[i - 1], joints[i], links[i])
            del joints[i - 1], links[i - 1], names[i - 1]
            continue
        if links[i].flexible or links[i - 1].reduced is not None:
            problem = f"both {links[i - 1].name} and {links[i].name} bend, one on either side"
            hint = "make them one link with sections, or a link given by reduced matrices"
            raise ArmFileError(place, problem, value="fixed", hint=hint)
        if i + 1 == len(links):
            hint = "give its mass and inertia to the payload, with an offset"
            problem = f"{links[i].name} is rigid and ends the arm behind a link that bends"
            raise ArmFileError(place, problem, value="fixed", hint=hint)
        links[i - 1], joints[i + 1] = _after(links[i - 1], joints[i], links[i], joints[i + 1])
        del joints[i], links[i], names[i]
    return tuple(joints), tuple(links)


def _turn(joint):
    return Rotation.from_euler("xyz", joint.origin_rpy)


def _three(rows):
    return tuple(map(tuple, np.asarray(rows).tolist()))


def _tip(link):
    """A rigid link's tip in its joint's frame."""
    return np.add(link.root, (link.length, 0.0, 0.0))


def _pieces(link):
    """Masses of a rigid link in its joint's frame: (mass, inertia about its centre, centre)."""
    mass, first, second, polar = link.moments()
    centre = first / mass
    across = second - mass * centre**2
    root = np.array(link.root)
    yield mass, np.diag([polar, across, across]), root + np.array([centre, 0.0, 0.0])
    for body in link.bodies:
        place = root + np.add(body.offset, (body.position, 0.0, 0.0))
        yield body.mass, np.array(body.inertia), place


def _before(joint, rigid, fixed, link):
    """Joint and link that replace a rigid link and the link fixed to its tip, in the frame of the latter."""
    B = _turn(fixed).as_matrix()
    tip = _tip(rigid) + fixed.origin_xyz
    root = B.T @ tip + np.array(link.root)
    bodies = tuple(
        Body(0.0, mass, _three(B.T @ inertia @ B), tuple((B.T @ centre - root).tolist()))
        for mass, inertia, centre in _pieces(rigid)
    )
    turned = replace(
        joint,
        axis=tuple((B.T @ joint.axis).tolist()),
        origin_rpy=tuple((_turn(joint) * _turn(fixed)).as_euler("xyz").tolist()),
        housing_inertia=_three(B.T @ np.array(joint.housing_inertia) @ B),
    )
    return turned, replace(link, root=tuple(root.tolist()), bodies=(*bodies, *link.bodies))


def _after(link, fixed, rigid, joint):
    """The link with a rigid one as bodies at its tip, and the joint moved to the tip of the rigid one."""
    B = _turn(fixed).as_matrix()
    xyz = np.array(fixed.origin_xyz)
    bodies = tuple(
        Body(link.length, mass, _three(B @ inertia @ B.T), tuple((xyz + B @ centre).tolist()))
        for mass, inertia, centre in _pieces(rigid)
    )
    tip = _tip(rigid) + joint.origin_xyz
    moved = replace(
        joint,
        origin_xyz=tuple((xyz + B @ tip).tolist()),
        origin_rpy=tuple((_turn(fixed) * _turn(joint)).as_euler("xyz").tolist()),
    )
    return replace(link, bodies=(*link.bodies, *bodies)), moved
