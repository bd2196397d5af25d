# SPDX-License-Identifier: Apache-2.0
r"""Computes what a motion excites: the vibration that it leaves in a unit oscillator at each joint.

.. math:: \ddot x + 2\zeta\omega\dot x + \omega^2 x = -\ddot q_j, \qquad
    \hat x_j = \frac1\omega\Bigl|\int_0^T \ddot q_j\,e^{p(T-t)}\,dt\Bigr|

is the amplitude at the end T of the motion. How much of it appears at the tip depends on the arm; the fraction that a
shaper leaves does not.
"""

from pathlib import Path

import numpy as np
from scipy.interpolate import BPoly

from flexarm_control.shaping.modes import KINDS
from flexarm_control.trajectory import files
from flexarm_dynamics.errors import TrajectoryError

from .recommendation import BY_PROGRAMME, SMOOTH, box, impulses, train_of

#: Types of the node `shaper` that can be recommended; ``none`` if no shaper is needed.
NODE = KINDS
#: Times per period of the fastest mode, and their maximum total number.
PER_PERIOD, MOST = 40, 200_000


def read(path):
    """A trajectory from a file of any joints; its `JointTrajectoryData`.

    Parameters
    ----------
    path : str or Path
        YAML with ``joint_names``, or CSV with columns ``q1`` and so on.

    Raises
    ------
    TrajectoryError
        Naming file, place and value.
    """
    return files.read(path, _joint_names(Path(path)))


def _joint_names(path):
    """The joints that a file names or numbers, for `files.read`, which checks them; one joint if that is unknown."""
    import yaml

    try:
        text = path.read_text(encoding="utf-8-sig")
        if path.suffix.lower() == ".csv":
            header = next(line for line in text.splitlines() if line.strip()).split(",")
            count = sum(word.strip()[:1] == "q" and word.strip()[1:].isdigit() for word in header)
            return [f"joint{k + 1}" for k in range(max(count, 1))]
        found = next(yaml.safe_load_all(text))
        return [str(name) for name in found["joint_names"]] or ["joint1"]
    except (
        OSError,
        UnicodeDecodeError,
        ValueError,
        yaml.YAMLError,
        LookupError,
        TypeError,
        StopIteration,
    ):
        return ["joint1"]


def steps(trajectory, fastest):
    """The motion as small steps of the speed at equally spaced times, from its first point to its last.

    Parameters
    ----------
    trajectory : JointTrajectoryData
    fastest : float
        Frequency that must be resolved [Hz].

    Returns
    -------
    time : ndarray, shape (k,)
        [s]
    steps : ndarray, shape (k, n)
        [rad/s]

    Raises
    ------
    TrajectoryError
        For fewer than two points.
    """
    times = trajectory.times
    if times.size < 2:
        hint = "give the point at which it starts, too"
        raise TrajectoryError("point is no motion", field="trajectory", value=times.size, hint=hint)
    spline = BPoly.from_derivatives(times, np.stack(trajectory.fields, axis=1))
    length = times[-1] - times[0]
    count = int(np.clip(np.ceil(PER_PERIOD * fastest * length), 200, MOST))
    grid = np.linspace(times[0], times[-1], count + 1)
    speed = np.diff(spline(grid), axis=0) * (count / length)
    change = np.diff(speed, axis=0, prepend=0.0, append=0.0)
    return grid - times[0], change


def left(time, change, poles):
    """Amplitudes that a motion leaves at its end.

    Parameters
    ----------
    time : ndarray, shape (k,)
        [s]
    change : ndarray, shape (k, n)
        Steps of the speed [rad/s].
    poles : ndarray, shape (m,)
        [1/s]

    Returns
    -------
    ndarray, shape (m, n)
        [rad]
    """
    response = np.array([np.exp(p * (time[-1] - time)) @ change for p in np.asarray(poles)])
    return np.abs(response) / np.abs(poles)[:, None]


def of_trajectory(trajectory, spreads, candidates, retimed=None):
    """Vibration that a motion leaves in each mode, unshaped and with each candidate.

    Parameters
    ----------
    trajectory : JointTrajectoryData
    spreads : sequence of Spread
    candidates : sequence of Candidate
        Those with a kernel are used; ``least_exciting`` is left out. The first is ``none``.
    retimed : tuple of Candidate and JointTrajectoryData, optional
        From `retiming.retimed`.

    Returns
    -------
    list of dict
        For each candidate: kind, duration_s, added_s, residual (predicted; relative to the unshaped motion),
        amplitude_rad (per mode, the worst joint and pole), modes, spread and periods (as in `Candidate`).
    """
    fastest = max(s.high for s in spreads)
    time, change = steps(trajectory, fastest)
    now = [left(time, change, s.poles()) for s in spreads]
    rows = []
    for candidate in candidates:
        response = _response(candidate, spreads)
        if response is None:
            continue
        after = [
            float((a * np.abs(response(s.poles()))[:, None]).max())
            for a, s in zip(now, spreads, strict=True)
        ]
        rows.append(_row(candidate, time, after))
    part = np.array([s.part for s in spreads])
    before = np.maximum(rows[0]["amplitude_rad"], np.finfo(float).tiny)
    for row in rows:
        ratio = np.array(row["amplitude_rad"]) / before
        row["residual"] = float(np.sqrt(part @ ratio**2 / part.sum()))
    if retimed is not None:
        candidate, law = retimed
        own, change = steps(law, fastest)
        after = [float(left(own, change, s.poles()).max()) for s in spreads]
        rows.append({**_row(candidate, time, after), "residual": candidate.residual})
    return rows


def _row(candidate, time, amplitudes):
    return {
        "kind": candidate.kind,
        "duration_s": float(time[-1]) + candidate.delay,
        "added_s": candidate.delay,
        "amplitude_rad": amplitudes,
        "modes": list(candidate.modes),
        "spread": candidate.spread,
        "periods": candidate.periods,
    }


def recommended(rows, residual):
    """The row of the node's quickest shaper that leaves at most the wanted residual; if none does, the one with least.

    Parameters
    ----------
    rows : list of dict
        From `of_trajectory`.
    residual : float
        Wanted residual [-].
    """
    own = [row for row in rows if row["kind"] in NODE]
    enough = [row for row in own if row["residual"] <= residual]
    if enough:
        return min(enough, key=lambda row: (row["added_s"], row["residual"]))
    return min(own, key=lambda row: row["residual"])


def _response(candidate, spreads):
    """Response of a candidate's kernel at poles (k,); None if it has none."""
    if candidate.kind in SMOOTH:
        return box(candidate.width, SMOOTH[candidate.kind])
    if candidate.kind == BY_PROGRAMME:
        return None
    modes = [spreads[k] for k in candidate.modes]
    return impulses(train_of(candidate.kind, modes, candidate.spread, candidate.periods))
