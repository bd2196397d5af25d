# SPDX-License-Identifier: Apache-2.0
"""Makes the arrays of links given by reduced matrices (`arm.reduced`) from shapes at a mesh's nodes or from a beam."""

import numpy as np

from ..kernels import chain_data as kernel
from .assembly import modes_of


def from_nodes(nodes, mass, shapes, stiffness, tip, tip_translation, tip_rotation):
    """Arrays of `arm.reduced.ARRAYS` from shapes at the nodes of a finite-element mesh.

    Parameters
    ----------
    nodes : array_like, shape (P, 3)
        Undeformed positions in the link's frame, the root at the origin [m].
    mass : array_like or sparse matrix, shape (P,) or (P, P)
        Lumped masses of the nodes, or the consistent mass matrix of one direction [kg].
    shapes : array_like, shape (P, 3, K)
        Displacements of the nodes per unit of each mode; zero where the root is held.
    stiffness : array_like, shape (K, K)
        Modal stiffness.
    tip : array_like, shape (3,)
        Position of the next joint [m].
    tip_translation, tip_rotation : array_like, shape (K, 3)
        Displacement and rotation vector of the tip per unit of each mode.

    Returns
    -------
    dict of ndarray
        For ``numpy.savez(file, **arrays)``.
    """
    X, Phi = np.asarray(nodes, float), np.moveaxis(np.asarray(shapes, float), 2, 0)
    count = len(X)
    lumped = np.ndim(mass) == 1

    def weighed(values):
        """Masses times values at the nodes, (P, ...)."""
        flat = values.reshape(count, -1)
        out = np.asarray(mass)[:, None] * flat if lumped else mass @ flat
        return np.asarray(out).reshape(values.shape)

    ones, own = weighed(np.ones((count, 1)))[:, 0], weighed(X)
    moments = X.T @ own  # int x x' dm
    mPhi = np.stack([weighed(p) for p in Phi])
    first = np.einsum("pa,jpb->jab", X, mPhi)
    second = np.einsum("jpa,kpb->jkab", Phi, mPhi)
    return {
        "mass": np.array(ones.sum()),
        "first_moment": ones @ X,
        "inertia": np.trace(moments) * np.eye(3) - moments,
        "modal_mass": np.einsum("jkaa->jk", second),
        "modal_stiffness": np.asarray(stiffness, float),
        "translation": mPhi.sum(axis=1),
        "rotation": np.stack(
            [first[:, e, f] - first[:, f, e] for e, f in ((1, 2), (2, 0), (0, 1))], 1
        ),
        "first": first,
        "second": second,
        "tip": np.asarray(tip, float),
        "tip_translation": np.asarray(tip_translation, float),
        "tip_rotation": np.asarray(tip_rotation, float),
    }


def of_link(chain, name, stations=17):
    """The arrays of an arm's beam link, its second order included, in the modes that it has.

    Parameters
    ----------
    chain : Chain
        To include the second order, its level must be above the first. The link must have no bodies, and its root must
        be at its joint.
    name : str
        Of the link.
    stations : int
        Number of places along the link, for pictures.

    Returns
    -------
    dict of ndarray
    """
    i = [link.name for link in chain.arm.links].index(name)
    link, d = chain.arm.links[i], chain.data
    modes, L, K = modes_of(link, chain._shapes), link.length, int(d.count[i])
    mass, first_moment, second_moment, polar = link.moments()
    a = {
        "mass": np.array(mass), "first_moment": np.array([first_moment, 0.0, 0.0]),
        "inertia": np.diag([polar, second_moment, second_moment]),
        "modal_mass": np.where(d.direction[i, :K, None] == d.direction[i, None, :K], d.gram[i, :K, :K], 0.0),
        "modal_stiffness": d.stiffness[i, :K, :K], "modal_damping": d.damping[i, :K, :K],
        "translation": np.zeros((K, 3)), "rotation": np.zeros((K, 3)), "first": np.zeros((K, 3, 3)),
        "second": np.zeros((K, K, 3, 3)), "tip": np.array([L, 0.0, 0.0]),
        "stations": np.linspace(0.0, L, stations),
    }  # fmt: skip
    for j in range(K):
        kind, s, e = d.direction[i, j], d.s[i, j], d.e[i, j]
        if kind == kernel.TWIST:
            a["rotation"][j, 0] = s
            continue
        a["translation"][j, kind] = s
        a["first"][j, 0, kind] = e
        a["rotation"][j, 3 - kind] = e if kind == kernel.Y else -e
        for k in range(K):
            if d.direction[i, k] != kernel.TWIST:
                a["second"][j, k, kind, d.direction[i, k]] = d.gram[i, j, k]
    a["station_translation"], a["station_rotation"] = _places(
        d.direction[i], modes, a["stations"], L
    )
    ends = _places(d.direction[i], modes, np.array([L]), L)
    a["tip_translation"], a["tip_rotation"] = ends[0][0], ends[1][0]
    return a if d.level == kernel.FIRST_ORDER else a | _second_order(d, i, K)


def _places(directions, modes, x, length):
    """Translation and rotation of the modes at places, (P, K, 3) each."""
    translation, rotation = np.zeros((2, x.size, len(modes), 3))
    for j, (shape, number, _) in enumerate(modes):
        kind, value = directions[j], shape(x / length)[:, number]
        if kind == kernel.TWIST:
            rotation[:, j, 0] = value
            continue
        slope = shape(x / length, 1)[:, number] / length
        translation[:, j, kind] = value
        rotation[:, j, 3 - kind] = slope if kind == kernel.Y else -slope
    return translation, rotation


def _second_order(d, i, K):
    """Foreshortening of a beam, Psi_jk = -e_x int phi_j' phi_k' dx, and its second-order rotation about its axis."""
    bends = d.direction[i, :K] != kernel.TWIST
    same = (d.direction[i, :K, None] == d.direction[i, None, :K]) & bends[:, None]
    slopes = d.node_slope[i, :, :K]
    products = np.einsum("gj,gk->gjk", slopes, slopes) * same
    drawn = -np.einsum("gh,gjk->hjk", d.cumulate[i], products)  # at each node and, last, at the tip
    out = {
        "second_translation": np.zeros((K, K, 3)), "second_first": np.zeros((K, K, 3, 3)),
        "second_tip": np.zeros((K, K, 3)),
    }  # fmt: skip
    out["second_translation"][..., 0] = np.einsum("g,gjk->jk", d.node_mass[i], drawn[:-1])
    weights = d.node_mass[i] * d.node_x[i]
    out["second_first"][..., 0, 0] = np.einsum("g,gjk->jk", weights, drawn[:-1])
    out["second_tip"][..., 0] = drawn[-1]
    bishop = d.bishop[i, :K, :K]
    return out | {"second_twist": -(bishop + bishop.T)}
