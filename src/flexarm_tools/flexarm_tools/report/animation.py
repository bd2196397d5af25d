# SPDX-License-Identifier: Apache-2.0
"""Computes the animation's numbers: straight links, their bending, and the reference.

A point of a link's axis is p_i + R_i (x, sum phi_y delta_y, sum phi_z delta_z), with the link's base frame (R_i, p_i)
of the bent arm. The page draws straight + factor (bent - straight). A factor of one shows the arm as it is; a larger
factor exaggerates the bending, to first order.
"""

import base64
from dataclasses import dataclass, replace

import numpy as np

from flexarm_dynamics.models.chain import Chain

from .analysis import motions

#: Frames per second of the run, and their largest number.
FRAMES_PER_SECOND, MAX_FRAMES = 50.0, 600
#: Time shown before and after the first motion, and at most [s].
BEFORE, AFTER, MAX_SHOWN = 0.2, 3.0, 12.0
#: Points along a link.
POINTS = 9
#: The largest deflection is drawn as this fraction of the arm's reach.
SHOWN = 0.12


class Shape:
    """The shape of an `arm`, from joint angles and modal amplitudes."""

    def __init__(self, arm):
        self.chain = chain = Chain(replace(arm.known, model="chain"))
        self.links, self._axial, self._across = arm.links, [], []
        modes, xi = chain.arm.modes, np.linspace(0.0, 1.0, POINTS)
        for link in arm.links:
            self._axial.append(xi * link.length)
            across = np.zeros((2, POINTS, chain.n_modes))
            for k, direction in enumerate("yz"):
                if direction not in link.flexible:
                    continue
                shapes = np.array([chain.mode_shapes(link.name, direction)(x) for x in xi])
                for j, mode in enumerate(modes):
                    if (mode.link, mode.direction) == (link.name, direction):
                        across[k, :, j] = shapes[:, mode.number - 1]
            self._across.append(across)

    def points(self, q, delta):
        """Points of all links' axes, shape (links, POINTS, 3) [m]."""
        R, p = self.chain.frames(q, delta)
        out = np.empty((len(self.links), POINTS, 3))
        for i, (along, across) in enumerate(zip(self._axial, self._across, strict=True)):
            local = np.column_stack([along, across[0] @ delta, across[1] @ delta])
            out[i] = p[i] + (local + self.links[i].root) @ R[i].T
        return out

    def view(self):
        """Directions on the screen: right, up and towards the eye, shape (3, 3)."""
        chain, gravity = self.chain, np.asarray(self.chain.arm.gravity, float)
        if chain.planar_axis is not None:
            out = np.asarray(chain.planar_axis, float)
            up = _across(-gravity, out, [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
            right = np.cross(up, out)
            if right[np.argmax(np.abs(right))] < 0.0:  # x goes to the right
                right, out = -right, -out
            return np.array([right, up, out])
        up = -gravity if np.linalg.norm(gravity) else np.array([0.0, 0.0, 1.0])
        up = up / np.linalg.norm(up)
        east = _across(np.array([1.0, 0.0, 0.0]), up, [[0.0, 1.0, 0.0]])
        out = 0.45 * east - 0.8 * np.cross(up, east) + 0.4 * up
        out = out / np.linalg.norm(out)
        up = _across(up, out, [])
        return np.array([np.cross(up, out), up, out])


def _across(vector, axis, others):
    """The unit vector normal to an axis that is nearest to `vector`, or to the first of `others` not along the axis."""
    for candidate in (vector, *map(np.array, others)):
        rest = candidate - (candidate @ axis) * axis
        if np.linalg.norm(rest) > 1e-6:
            return rest / np.linalg.norm(rest)
    raise AssertionError("two of three axes can't both be along one")


@dataclass(frozen=True, eq=False)
class Film:
    """One run's frames.

    Attributes
    ----------
    straight : ndarray, shape (frames, links, 2, 3)
        Base and tip of each straight link at the measured joint angles [m].
    bent : ndarray, shape (frames, links, POINTS, 3)
        Distance of the bent arm's points from those of the straight arm [m].
    reference : ndarray, shape (frames, links, 2, 3) or None
        As `straight`, at the reference angles; NaN where there is none.
    state : list of int
        The supervisor's state in each frame.
    """

    straight: np.ndarray
    bent: np.ndarray
    reference: np.ndarray
    state: list


def window(runs):
    """Time span of the animation [s]: the first motion and the rest after it, or around the fastest sample."""
    first = [(run, motions(run)) for run in runs]
    moving = [(r.time[m[0].start], r.time[m[0].end - 1]) for r, m in first if m]
    if moving:
        start = min(a for a, _ in moving) - BEFORE
        end = max(b for _, b in moving) + AFTER
    else:
        run = runs[0]
        speed = sum(np.abs(np.diff(np.nan_to_num(q))) for q in run.positions().T)
        middle = run.time[int(np.argmax(speed))] if speed.size else run.time[0]
        start, end = middle - 2.0, middle + MAX_SHOWN
    start = max(start, min(run.time[0] for run in runs))
    end = min(end, start + MAX_SHOWN, max(run.time[-1] for run in runs))
    return float(round(start, 6)) + 0.0, float(end)


def film(run, times):
    """Frames of a run at given times; before and after the run, the frame of its first or last sample."""
    rows = np.clip(np.searchsorted(run.time, times, "right") - 1, 0, run.time.size - 1)
    shape = Shape(run.arm)
    first, last = int(rows.min()), int(rows.max()) + 1
    part, rows = slice(first, last), rows - first
    q = np.nan_to_num(run.positions(part)[rows])
    delta = _held(run.deflections(part))[rows]
    wanted = run.references(part)
    links = len(shape.links)
    straight = np.empty((len(rows), links, 2, 3))
    bent = np.empty((len(rows), links, POINTS, 3))
    reference = None if wanted is None else np.full_like(straight, np.nan)
    none = np.zeros(shape.chain.n_modes)
    for k in range(len(rows)):
        line = shape.points(q[k], none)
        bent[k] = shape.points(q[k], delta[k]) - line
        straight[k] = line[:, [0, -1]]
        if wanted is not None and np.isfinite(wanted[rows[k]]).all():
            reference[k] = shape.points(wanted[rows[k]], none)[:, [0, -1]]
    return Film(straight, bent, reference, run.state[part][rows].tolist())


def _held(values):
    """A table in which each NaN is replaced by the last known value, 0 before the first one, shape (k, m)."""
    known = np.isfinite(values)
    last = np.maximum.accumulate(np.where(known, np.arange(len(values))[:, None], 0), axis=0)
    return np.nan_to_num(np.take_along_axis(values, last, axis=0))


def possible(run):
    """Whether a run can be shown: its arm is known, and it has more than one sample."""
    return run.arm is not None and run.time.size > 1


def data(runs):
    """The animation of all `runs` for the page's script, ready for JSON; None if no arm is known.

    Numbers are integer multiples of a `unit`, two bytes each, little endian, in base 64; -32768 stands for none.
    """
    runs = [run for run in runs if possible(run)]
    if not runs:
        return None
    start, end = window(runs)
    count = int(min(MAX_FRAMES, max(2, round((end - start) * FRAMES_PER_SECOND) + 1)))
    times = np.linspace(start, end, count)
    films = [film(run, times) for run in runs]
    shape = Shape(runs[0].arm)
    reach = max(float(np.abs(f.straight).max()) for f in films)
    most = max(float(np.abs(f.bent).max()) for f in films)
    factor = _round(SHOWN * reach / most) if most > 1e-9 else 1.0
    out = {"start": start, "end": end, "frames": count, "points": POINTS, "factor": factor}
    out |= {"view": shape.view().tolist(), "most": most, "runs": []}
    # Shown before the animation plays: the frame in which the arms bend most.
    bending = sum(np.abs(f.bent).max(axis=(1, 2, 3)) for f in films)
    out["still"] = float(times[int(np.argmax(bending))])
    for run, f in zip(runs, films, strict=True):
        bent = max(float(np.abs(f.bent).max()), 1e-12)
        reference = None if f.reference is None else _packed(f.reference, reach)
        out["runs"].append(
            {
                "label": run.label,
                "links": f.straight.shape[1],
                "unit": reach / 32000.0,
                "straight": _packed(f.straight, reach),
                "reference": reference,
                "bentUnit": bent / 32000.0,
                "bent": _packed(f.bent, bent),
                "state": f.state,
            }
        )
    return out


def _round(value):
    """The largest of 1, 2, 5, 10, … that is not above the value; at least 1."""
    if value <= 1.0:
        return 1.0
    steps = np.array([1.0, 2.0, 5.0]) * 10.0 ** np.floor(np.log10(value))
    return float(steps[steps <= value * (1 + 1e-9)].max())


def _packed(values, largest):
    scaled = np.clip(np.round(values / largest * 32000.0), -32000, 32000)
    whole = np.where(np.isfinite(values), scaled, -32768).astype("<i2")
    return base64.b64encode(whole.tobytes()).decode()
