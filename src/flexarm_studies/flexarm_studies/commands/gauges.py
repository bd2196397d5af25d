# SPDX-License-Identifier: Apache-2.0
r"""``flexarm gauges``: computes how well an arm's strain gauges resolve its modes, and their best positions.

With rows R and the rms error sigma of a reading, the amplitudes of the observed modes have the covariance

.. math:: C = (R^T W R)^{-1}, \qquad W = \sigma^{-2} ,

separately for each link and direction, because a gauge measures only its own link's bending in its own direction. Sets
of positions on a grid, at every twentieth of the link, are ranked by the criterion

- A: trace C, the sum of the variances (the default),
- D: det C, the volume of the ellipsoid of errors,
- condition: condition number of R with its columns scaled to one,

Up to `MAX_SETS` sets, all are compared. If there are more, the search starts from the best set with one gauge per mode,
or from an even spread, and adds the best gauge one at a time. Then it exchanges single gauges until no exchange helps.
"""

from itertools import combinations
from math import comb

import numpy as np

from flexarm_control.observers.gauge_health import resolution
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import REDUCED, Gauge
from flexarm_dynamics.arm.strain_map import (
    StrainMap,
    confused,
    gauge_rows,
    reading_noise,
    reading_rows,
)
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model

from .options import add_arm_arguments, check_file, show

CRITERIA = ("A", "D", "condition")
#: Candidate positions per link: every twentieth of its length, ends included.
GRID = 21
#: Up to this number all sets of positions are compared, in about a second.
MAX_SETS = 250_000
#: Assumed rms error and distance from the neutral axis if no gauge of the link states them [strain], [m].
ASSUMED_NOISE, ASSUMED_DISTANCE = 1e-6, 1e-3
#: Two modes are hard to distinguish if the cosine between their patterns of strain is larger.
ALIKE = 0.98
#: Number of the best sets that are listed.
LISTED = 3


def add_arguments(parser):
    """Arguments of ``gauges``."""
    parser.description = (
        "Noise and condition number of the present gauges, and the best positions on each link."
    )
    parser.epilog = "example: flexarm gauges R --count 3 --plot results/gauges.png"
    add_arm_arguments(parser)
    parser.add_argument(
        "--modes",
        type=int,
        metavar="N",
        help="resolve N modes per flexible direction (the arm file's observed_modes if not given)",
    )
    parser.add_argument(
        "--count",
        type=int,
        metavar="K",
        help="gauges per link and direction (as many as the arm has)",
    )
    parser.add_argument(
        "--criterion",
        choices=CRITERIA,
        default="A",
        help="A: sum of the variances; D: their ellipsoid's volume; condition: condition number",
    )
    parser.add_argument("--plot", metavar="FILE", help="draw curvatures and positions")


def gauges(options):
    """Run ``gauges``."""
    arm = arm_file.load(options.arm)
    observed = arm.observed_modes
    if options.modes is not None:
        arm = arm.with_modes(options.modes)
        observed = arm.mode_names
    result = study(model.build(arm), observed, options.count, options.criterion)
    if options.plot:
        result["plot"] = draw(result, options.plot)
    for place in result["places"]:
        del place["curvature"]
    show(options, result, text(result))
    return result


def study(arm_model, observed, count=None, criterion="A"):
    """The present and the best gauges of every link and direction with observed modes, as plain data in SI.

    The gauges of `arm_model` are to resolve the `observed` modes, with `count` gauges per link and direction; if not
    given, as many as the arm has, at least one per mode. `criterion` is one of `CRITERIA`.
    """
    arm = arm_model.arm
    if not observed:
        raise FlexarmError(f"of {arm.name} are none: it is rigid", field="modes to observe")
    places = []
    for key in dict.fromkeys((m.link, m.direction) for m in arm.modes if m.name in observed):
        if key[1] == REDUCED:  # the points are those of its archive: there is no choice
            continue
        names = [m.name for m in arm.modes if (m.link, m.direction) == key and m.name in observed]
        present = [g for g in arm.gauges if (g.link, g.direction) == key]
        wanted = max(len(present), len(names)) if count is None else count
        if wanted < len(names):
            problem = f"gauges can't observe the {len(names)} modes of {key[0]} in {key[1]}"
            limit = f"at least {len(names)}"
            raise FlexarmError(problem, field="--count", value=wanted, limit=limit)
        if wanted > GRID:
            problem = "gauges are more than there are positions"
            raise FlexarmError(problem, field="--count", value=wanted, limit=GRID)
        places.append(_place(arm_model, key, names, present, wanted, criterion))
    if not places:
        problem, hint = "are at the points that archives name", "flexarm show has their condition"
        raise FlexarmError(problem, field=f"gauges of {arm.name}", hint=hint)
    return {"arm": arm.name, "criterion": criterion, "places": places}


def _place(arm_model, key, names, present, count, criterion):
    """One link and direction."""
    link, (distance, noise, assumed) = arm_model.arm.link(key[0]), _typical(present)
    grid = np.linspace(0.0, link.length, GRID)
    candidates = [Gauge("", key[0], x, key[1], distance) for x in grid.tolist()]
    unit = gauge_rows(arm_model, candidates, names)
    order, values = best_sets(unit / noise, count, criterion)
    place = {
        "link": key[0],
        "direction": key[1],
        "modes": names,
        "noise": noise,
        "surface_distance": distance,
        "assumed": assumed,
        "present": _present(arm_model, names, present),
        "best": [
            {"positions": grid[list(s)].tolist(), **_quality(unit[list(s)] / noise)}
            for s, v in zip(order, values, strict=True)
            if np.isfinite(v)
        ],
        "next": _next(arm_model, names, present, unit / noise, grid, criterion),
        "curvature": {"position": grid, "rows": unit},
    }
    if not place["best"]:
        unseen, alike = confused(unit, names)
        place["impossible"] = [*unseen, *alike]
    return place


def _typical(present):
    """Surface distance, rms error of a reading, and which of them had to be assumed."""
    assumed = []
    distance = abs(present[0].surface_distance) if present else ASSUMED_DISTANCE
    if not present:
        assumed.append(f"gauges {1e3 * distance:g} mm from the neutral axis")
    stated = [g for g in present if g.uncertainty > 0.0]
    noise = float(np.median(resolution(stated))) if stated else ASSUMED_NOISE
    if not stated:
        assumed.append(f"{1e6 * noise:g} microstrain rms of noise")
    return distance, noise, assumed


def _weighted(arm_model, names, present):
    noise, stated = reading_noise(present)
    noise = noise if stated else ASSUMED_NOISE * noise
    return reading_rows(arm_model, present, names) / noise[:, None]


def _present(arm_model, names, present):
    """Quality of the arm file's gauges."""
    found = {"names": [g.name for g in present], "positions": [g.position for g in present]}
    if not present:
        return {**found, "condition": None, "amplitude_noise": None, "unseen": names, "alike": []}
    rows = _weighted(arm_model, names, present)
    unseen, alike = confused(rows, names)
    found |= {"unseen": list(unseen), "alike": list(alike), "hardly": _hardly(rows, names)}
    if unseen or alike:
        return {**found, "condition": None, "amplitude_noise": None}
    return {**found, **_quality(rows)}


def _hardly(rows, names):
    """Pairs of modes whose patterns of strain are nearly the same, with the cosine between them."""
    size = np.linalg.norm(rows, axis=0)
    unit = rows / np.where(size > 0.0, size, 1.0)
    cosine = np.abs(unit.T @ unit)
    return [
        [names[i], names[j], float(cosine[i, j])]
        for i, j in combinations(range(len(names)), 2)
        if cosine[i, j] > ALIKE
    ]


def _quality(rows):
    """Condition number of weighted rows, and the rms noise of each amplitude [m, rad]."""
    covariance = np.linalg.inv(rows.T @ rows)
    return {
        "condition": float(np.linalg.cond(rows)),
        "amplitude_noise": np.sqrt(np.diag(covariance)).tolist(),
    }


def criterion_of(rows, criterion):
    """One of `CRITERIA` of many sets of gauges, shape (sets,); infinite for a set that can't resolve the modes.

    `rows` are weighted, shape (sets, gauges, modes). A smaller criterion is better.
    """
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    scaled = rows / np.where(size > 0.0, size, 1.0)
    values = np.linalg.svd(scaled, compute_uv=False)
    modes = rows.shape[2]
    if rows.shape[1] < modes:
        return np.full(rows.shape[0], np.inf)
    good = values[:, -1] * StrainMap.WORST_CONDITION > values[:, 0]
    out = np.full(rows.shape[0], np.inf)
    if criterion == "condition":
        out[good] = values[good, 0] / values[good, -1]
        return out
    information = np.swapaxes(rows[good], 1, 2) @ rows[good]
    if criterion == "D":
        out[good] = 1.0 / np.linalg.det(information)
    else:
        out[good] = np.trace(np.linalg.inv(information), axis1=1, axis2=2)
    return out


def best_sets(rows, count, criterion):
    """The best sets of `count` candidates, best first: tuples of indices, and their criterion, one of `CRITERIA`.

    `rows` are weighted, shape (candidates, modes).
    """
    candidates = rows.shape[0]
    if comb(candidates, count) > MAX_SETS:
        chosen = _exchange(rows, count, criterion)
        return [chosen], criterion_of(rows[list(chosen)][None], criterion)
    sets = np.array(list(combinations(range(candidates), count)))
    values = np.concatenate(
        [criterion_of(rows[s], criterion) for s in np.array_split(sets, len(sets) // 5000 + 1)]
    )
    order = np.argsort(values, kind="stable")[:LISTED]
    return [tuple(s) for s in sets[order].tolist()], values[order]


def _exchange(rows, count, criterion):
    """A set that no exchange of a single candidate improves."""
    modes = rows.shape[1]
    # The start is the best of all sets with one gauge per mode, if these are few enough, else an even spread.
    start = modes if comb(rows.shape[0], modes) <= MAX_SETS else count
    if start == count:
        chosen = list(np.unique(np.linspace(0, rows.shape[0] - 1, count).astype(int)))
    else:
        chosen = list(best_sets(rows, start, criterion)[0][0])
    while len(chosen) < count:
        chosen.append(_best_one(rows, chosen, criterion))
    while True:
        before = criterion_of(rows[chosen][None], criterion)[0]
        for i in range(count):
            rest = chosen[:i] + chosen[i + 1 :]
            chosen = [*rest[:i], _best_one(rows, rest, criterion), *rest[i:]]
        if not criterion_of(rows[chosen][None], criterion)[0] < before * (1.0 - 1e-12):
            return tuple(sorted(int(c) for c in chosen))


def _best_one(rows, chosen, criterion):
    """The candidate that is best in addition to the chosen ones."""
    left = [i for i in range(rows.shape[0]) if i not in chosen]
    values = criterion_of(rows[[[*chosen, i] for i in left]], criterion)
    return left[int(np.argmin(values))]


def _next(arm_model, names, present, rows, grid, criterion):
    """Best positions of one gauge more, in addition to the present ones."""
    if len(present) + 1 < len(names) or not present:
        return []
    have = _weighted(arm_model, names, present)
    sets = np.array([np.vstack([have, row]) for row in rows])
    values = criterion_of(sets, criterion)
    order = [i for i in np.argsort(values, kind="stable") if np.isfinite(values[i])][:LISTED]
    return [{"position": float(grid[i]), **_quality(sets[i])} for i in order]


def text(d):
    """Lines of the result for people."""
    yield f"{d['arm']}: gauges for each link and direction; criterion {d['criterion']}"
    for p in d["places"]:
        unit = ("rad", 1.0) if p["direction"] == "twist" else ("mm", 1e3)
        yield ""
        yield f"{p['link']}, {p['direction']}: {', '.join(p['modes'])}"
        if p["assumed"]:
            yield f"  assumed: {'; '.join(p['assumed'])}"
        yield f"  {'positions [m]':40}{'condition':>10}  rms noise of each amplitude [{unit[0]}]"
        yield from _present_lines(p, unit)
        for k, s in enumerate(p["best"]):
            yield _line("best" if not k else f"{k + 1}.", s["positions"], s, unit)
        for s in p["next"][:1]:
            yield _line("one more", [s["position"]], s, unit)
        if "impossible" in p:
            yield f"  no gauges on this link can distinguish {', '.join(p['impossible'])}"
    if "plot" in d:
        yield f"plot: {d['plot']}"


def _present_lines(p, unit):
    now = p["present"]
    if not now["names"]:
        yield "  now: none"
        return
    if now["condition"] is not None:
        yield _line("now", now["positions"], now, unit)
    else:
        yield f"  now {', '.join(f'{x:.4g}' for x in now['positions'])}: not enough"
    if now["unseen"]:
        yield f"  warning: {', '.join(now['unseen'])} causes no strain at {', '.join(now['names'])}"
    if now["alike"]:
        yield (
            f"  warning: {', '.join(now['names'])} can't distinguish {' and '.join(now['alike'])}, which cause the"
            " same strains; move a gauge or add one"
        )
    elif now["condition"] is not None:
        for a, b, cosine in now["hardly"]:
            yield f"  warning: {a} and {b} are hard to distinguish: the cosine between their strains is {cosine:.3f}"


def _line(label, positions, quality, unit):
    where = ", ".join(f"{x:.4g}" for x in positions)
    noise = ", ".join(f"{unit[1] * v:.3g}" for v in quality["amplitude_noise"])
    return f"  {label:10}{where:30}{quality['condition']:10.3g}  {noise}"


def draw(d, path):
    """Draw each observed mode's strain along the links, present and best positions; return the path."""
    from ..plotting import plt, save

    path = check_file(path)
    places = d["places"]
    figure, axes = plt.subplots(
        len(places), 1, figsize=(7.0, 2.6 * len(places) + 0.6), squeeze=False, layout="constrained"
    )
    for ax, p in zip(axes[:, 0], places, strict=True):
        x, rows = p["curvature"]["position"], p["curvature"]["rows"]
        for name, row in zip(p["modes"], rows.T, strict=True):
            ax.plot(x, row / np.abs(row).max(), lw=1.5, label=name)
        now = p["present"]["positions"]
        ax.plot(now, [0.0] * len(now), "s", ms=7, color="black", label="now")
        if p["best"]:
            best = p["best"][0]["positions"]
            ax.plot(best, [0.0] * len(best), "D", ms=7, mfc="none", color="tab:red", label="best")
        ax.axhline(0.0, color="0.7", lw=0.8, zorder=0)
        ax.set_ylabel(f"{p['link']}, {p['direction']}\nstrain, scaled [-]")
        ax.set_xlabel("position [m]")
        ax.legend(fontsize=8, ncols=2)
    figure.suptitle(f"{d['arm']}: strain of each mode along the links")
    return str(save(figure, path, dpi=120))
