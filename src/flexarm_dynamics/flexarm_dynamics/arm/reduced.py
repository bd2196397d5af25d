# SPDX-License-Identifier: Apache-2.0
r"""Reads links given by reduced matrices, which finite-element programs export, from a NumPy archive of named arrays.

A point that is at x in the undeformed link is at :math:`x + \Phi_j(x)\delta_j + \tfrac12\Psi_{jk}(x)\delta_j\delta_k`.
The shapes :math:`\Phi_j` and their slopes are zero at the root. :math:`\Psi_{jk}` may be left out; it describes the
foreshortening of the bent link, and gives the geometric stiffness: an acceleration a adds :math:`a\cdot\int\Psi_{jk}dm`
to the stiffness, a force f at the tip adds :math:`-f\cdot\Psi_{jk}`. All arrays are in SI and in the link's frame,
whose origin is the root. The K modes may be of any kind (Craig-Bampton, normal, static) and need not be orthogonal.

Shabana (2020), Dynamics of Multibody Systems, 5th ed., ch. 5 (the shape integrals); Craig & Bampton (1968), AIAA
Journal 6(7).
"""

import hashlib
import zipfile
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import eigh

from ..errors import ArmFileError

#: Direction of the modes of such a link, as in ``boom_reduced_mode1``.
DIRECTION = "reduced"
#: Max. number of modes of an archive, and its largest size [bytes].
MAX_MODES, MAX_BYTES = 60, 64 * 2**20
#: Arrays by name: shape, and what it is. K modes, P stations, S strains.
ARRAYS = {
    "mass": ((), "mass [kg]"),
    "first_moment": ((3,), "int x dm [kg m]"),
    "inertia": ((3, 3), "inertia about the root [kg m^2]"),
    "modal_mass": (("K", "K"), "int Phi_j . Phi_k dm, rotary inertia included"),
    "modal_stiffness": (("K", "K"), ""),
    "translation": (("K", 3), "int Phi_j dm"),
    "rotation": (("K", 3), "int x cross Phi_j dm, rotary inertia included"),
    "first": (("K", 3, 3), "int x Phi_j' dm"),
    "second": (("K", "K", 3, 3), "int Phi_j Phi_k' dm"),
    "tip": ((3,), "where the next joint is [m]"),
    "tip_translation": (("K", 3), "Phi_j there"),
    "tip_rotation": (("K", 3), "rotation vector of the tip"),
}
#: Arrays that may be left out; they are then zero or not used.
OPTIONAL = {
    "modal_damping": (("K", "K"), "instead of the arm file's damping ratios"),
    "second_translation": (("K", "K", 3), "int Psi_jk dm"),
    "second_first": (("K", "K", 3, 3), "int x Psi_jk' dm"),
    "second_tip": (("K", "K", 3), "Psi_jk at the tip"),
    "second_twist": (("K", "K"), "second order of the tip's rotation about x"),
    "stations": (("P",), "places along x [m], for pictures"),
    "station_translation": (("P", "K", 3), "Phi_j there"),
    "station_rotation": (("P", "K", 3), "rotation vector there"),
    "strain_names": (("S",), "names of points with gauges"),
    "strain": (("S", "K"), "strain there per amplitude"),
}
#: Largest asymmetry of the modal matrices, relative to their largest entry [-].
ASYMMETRY = 1e-6
#: Displacement of a mode with amplitude one where it is largest, over tip and stations [m]: about that of beam modes.
SCALE = 2.0


@dataclass(frozen=True, eq=False)
class Reduced:
    """Reduced matrices of a link in its normal modes with the root held, by ascending frequency.

    Attributes
    ----------
    digest : str
        Hash of all arrays: two links with the same digest are equal.
    arrays : dict of ndarray
        By the names of `ARRAYS` and `OPTIONAL`; those of `OPTIONAL` may be missing.
    """

    digest: str
    arrays: dict = field(repr=False)

    def __eq__(self, other):
        return isinstance(other, Reduced) and self.digest == other.digest

    def __hash__(self):
        return hash(self.digest)

    def __getitem__(self, name):
        return self.arrays[name]

    @property
    def modes(self):
        """Number of modes."""
        return len(self.arrays["translation"])

    @property
    def stiffens(self):
        """Whether its arrays include the foreshortening of the bent link."""
        return "second_translation" in self.arrays

    def get(self, name):
        """An array by its name; zeros if it is optional and missing."""
        if name in self.arrays:
            return self.arrays[name]
        return np.zeros([self.modes if size == "K" else size for size in OPTIONAL[name][0]])

    def loaded(self, mass, moment, inertia, count):
        """The same link in its lowest modes with a rigid body at its tip.

        Parameters
        ----------
        mass : float
            Mass of the body [kg].
        moment : ndarray, shape (3,)
            Its first moment from the tip [kg m].
        inertia : ndarray, shape (3, 3)
            Its inertia about the tip [kg m^2].
        count : int
            Number of modes.
        """
        return _in_modes(self.arrays, self.carrying(mass, moment, inertia), count)

    def carrying(self, mass, moment, inertia):
        """Modal mass with a rigid body at the tip, (K, K); arguments as for `loaded`."""
        T, R = self["tip_translation"], self["tip_rotation"]
        cross = T @ np.cross(R, moment).T
        return self["modal_mass"] + mass * T @ T.T + R @ inertia @ R.T + cross + cross.T

    def scaled(self, stiffness, damping):
        """The same link with its stiffness, and its damping if stated, multiplied by factors."""
        factors = {"modal_stiffness": stiffness, "modal_damping": damping}
        return _made({name: factors.get(name, 1.0) * value if name in factors else value
                      for name, value in self.arrays.items()})  # fmt: skip


def _made(arrays):
    """`Reduced` of arrays, which become read-only."""
    digest = hashlib.sha256()
    for name, value in sorted(arrays.items()):
        digest.update(f"{name}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
        value.setflags(write=False)
    return Reduced(digest.hexdigest()[:16], arrays)


class Shapes:
    """Motion of the sections at a link's stations in each mode, and strain of gauges at named points.

    Parameters
    ----------
    reduced : Reduced
    """

    def __init__(self, reduced):
        self.reduced, self.count = reduced, reduced.modes
        r, zero = reduced, np.zeros((1, reduced.modes, 3))
        tip = float(r["tip"][0])
        places = r.get("stations") if "stations" in r.arrays else np.zeros(0)
        inner = (places > 0.0) & (places < tip)
        self._x = np.concatenate([[0.0], places[inner], [tip]])
        self._values = [
            np.concatenate(
                [zero, r[f"station_{name}"][inner] if inner.any() else zero[:0], [r[f"tip_{name}"]]]
            )
            for name in ("translation", "rotation")
        ]

    def at(self, x):
        """Translation and rotation vector of each mode at x, (K, 3) each; linear between stations."""
        k = int(np.clip(np.searchsorted(self._x, x) - 1, 0, self._x.size - 2))
        t = (x - self._x[k]) / (self._x[k + 1] - self._x[k])
        return tuple((1.0 - t) * v[k] + t * v[k + 1] for v in self._values)

    def strain(self, point):
        """Strain at a named point per amplitude, (K,)."""
        return self.reduced["strain"][list(self.reduced["strain_names"]).index(point)]


def read(path, where):
    """Read an archive.

    Parameters
    ----------
    path : Path
    where : str
        Field of the arm file that names the archive.

    Returns
    -------
    Reduced

    Raises
    ------
    ArmFileError
        Naming the array, its shape and what is wanted.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ArmFileError(where, "is too large", value=str(path), limit=f"{MAX_BYTES} bytes")
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (
        OSError,
        ValueError,
        EOFError,
        zipfile.BadZipFile,
        NotImplementedError,
        KeyError,
        MemoryError,
    ) as error:
        hint = "written with numpy.savez"
        raise ArmFileError(where, f"can't be read: {error}", value=str(path), hint=hint) from None
    return of_arrays(arrays, where)


def of_arrays(arrays, where="reduced"):
    """`Reduced` of named arrays, checked.

    Parameters
    ----------
    arrays : mapping of array_like
        As `ARRAYS` and `OPTIONAL` name them.
    where : str
        What errors call the archive.

    Returns
    -------
    Reduced

    Raises
    ------
    ArmFileError
        Naming the array, its shape or value and what is wanted.
    """
    given = _checked(arrays, where)
    for name in ("modal_mass", "modal_stiffness", "modal_damping", "inertia"):
        if name in given:
            given[name] = _symmetric(given[name], f"{where}: {name}")
    _check_mass(given, where)
    squares = eigh(given["modal_stiffness"], given["modal_mass"], eigvals_only=True)
    if squares[0] <= 1e-12 * squares[-1]:
        hint, value = "hold the root: free shapes move it", float(squares[0])
        name, limit = f"{where}: modal_stiffness", "positive definite"
        raise ArmFileError(name, "is singular", value=value, limit=limit, hint=hint)
    return _in_modes(given, given["modal_mass"], squares.size)


def _in_modes(given, mass, count):
    """`Reduced` of arrays in the lowest `count` normal modes for a modal mass (K, K)."""
    _, P = eigh(given["modal_stiffness"], mass)
    P = P[:, :count]
    places = [given["tip_translation"], *given.get("station_translation", ())]
    size = np.max([np.linalg.norm(P.T @ place, axis=1) for place in places], axis=0)
    P = P * np.where(size > 0.0, SCALE / np.where(size > 0.0, size, 1.0), 1.0)
    P = P * np.where(P.sum(axis=0) < 0.0, -1.0, 1.0)
    return _made({name: _transformed(name, value, P) for name, value in given.items()})


def _checked(arrays, where):
    """The arrays as finite floats of the right shapes."""
    wanted = {**ARRAYS, **OPTIONAL}
    for name in arrays:
        if name not in wanted:
            raise ArmFileError(f"{where}: {name}", "no such array", limit=", ".join(wanted))
    for name in ARRAYS:
        if name not in arrays:
            raise ArmFileError(f"{where}: {name}", "missing", hint=ARRAYS[name][1])
    together = (("stations", "station_translation", "station_rotation"), ("strain_names", "strain"))
    for group in (*together, ("second_translation", "second_first", "second_tip")):
        for name in group:
            if name not in arrays and any(other in arrays for other in group):
                raise ArmFileError(f"{where}: {name}", "missing", limit=f"with {', '.join(group)}")
    sizes, out = {}, {}
    for name, value in arrays.items():
        value = np.asarray(value)
        names = name == "strain_names"
        if value.dtype.kind not in ("U" if names else "fiu"):
            problem = f"is of type {value.dtype}"
            raise ArmFileError(
                f"{where}: {name}", problem, limit="text" if names else "real numbers"
            )
        shape = wanted[name][0]
        expected = [
            sizes.setdefault(s, n) if isinstance(s, str) else s
            for s, n in zip(shape, value.shape, strict=False)
        ]
        if len(shape) != value.ndim or tuple(expected) != value.shape:
            limit = f"({', '.join(map(str, shape))})" + "".join(
                f", {k} = {n}" for k, n in sizes.items()
            )
            raise ArmFileError(f"{where}: {name}", f"has the shape {value.shape}", limit=limit)
        if names:
            out[name] = value
            continue
        value = value.astype(float)
        if not np.isfinite(value).all():
            raise ArmFileError(f"{where}: {name}", "is not finite")
        out[name] = value
    if not 1 <= sizes["K"] <= MAX_MODES:
        raise ArmFileError(
            f"{where}: modal_mass", "modes", value=sizes["K"], limit=f"1 to {MAX_MODES}"
        )
    if not out["tip"][0] > 0.0:
        hint = "the link extends along x from its root"
        raise ArmFileError(
            f"{where}: tip",
            "is not before the root",
            value=out["tip"].tolist(),
            limit="x > 0",
            hint=hint,
        )
    return out


def _symmetric(value, where):
    off = np.abs(value - value.T).max()
    if off > ASYMMETRY * np.abs(value).max():
        raise ArmFileError(
            where, "is not symmetric", value=float(off), limit=f"{ASYMMETRY:g} of its largest entry"
        )
    return 0.5 * (value + value.T)


def _check_mass(a, where):
    """Refuse masses that no body can have: the kinetic energy of any motion must be positive."""
    c, K = a["first_moment"], len(a["translation"])
    cross = np.array([[0.0, -c[2], c[1]], [c[2], 0.0, -c[0]], [-c[1], c[0], 0.0]])
    M = np.zeros((6 + K, 6 + K))
    M[:3, :3], M[3:6, 3:6], M[6:, 6:] = a["mass"] * np.eye(3), a["inertia"], a["modal_mass"]
    M[3:6, :3], M[:3, 3:6] = cross, cross.T
    M[6:, :3], M[6:, 3:6] = a["translation"], a["rotation"]
    M[:3, 6:], M[3:6, 6:] = a["translation"].T, a["rotation"].T
    size = np.sqrt(np.maximum(np.diag(M), 1e-300))
    lowest = np.linalg.eigvalsh(M / np.outer(size, size))[0]
    modal = np.linalg.eigvalsh(a["modal_mass"])[0]
    if not (a["mass"] > 0.0 and modal > 0.0 and lowest > -1e-6):
        problem = "mass, first_moment, inertia, translation, rotation and modal_mass are of no body"
        hint = "they are in SI about the root, of the same shapes?"
        raise ArmFileError(
            f"{where}: modal_mass",
            problem,
            value=float(min(lowest, modal)),
            limit="positive",
            hint=hint,
        )


def _transformed(name, value, P):
    """An array in other modes, the columns of P."""
    for axis, size in enumerate((ARRAYS | OPTIONAL)[name][0]):
        if size == "K":
            value = np.moveaxis(np.tensordot(value, P, (axis, 0)), -1, axis)
    return value
