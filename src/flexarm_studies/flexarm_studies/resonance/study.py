# SPDX-License-Identifier: Apache-2.0
"""Goes from a recording to a shaper: windows, modes, their spread, the recommendation; as plain data and as text."""

from dataclasses import dataclass, replace

import numpy as np

from flexarm_dynamics.errors import FlexarmError

from . import effect, retiming, windows
from .families import dependence, families
from .fit import HIGHEST
from .recommendation import BY_PROGRAMME, LONGEST, WIDEST, Spread, recommend, widened
from .time_law import Move

#: The shaper ignores a mode with less than this fraction of the vibration's energy [-].
MIN_PART = 1e-3
#: Configurations closer than this count as one [rad].
SAME_PLACE = 0.05
#: Default motion for the least exciting time law.
MOVE = Move(0.5, 1.0, 4.0)


@dataclass(frozen=True)
class Wishes:
    """What the user wants.

    Attributes
    ----------
    residual : float
        Fraction of the vibration that may be left [-].
    margin : float
        Fraction by which frequencies may be off in addition to the measured spread [-].
    low, high : float
        Range of frequencies that is searched [Hz].
    windows : tuple of (float, float)
        Begin and end of each window [s]; if empty, the windows are found automatically.
    quantities : tuple of str
        Quantities that are used; if empty, as in `windows.channels`.
    move : Move
        Motion for the least exciting time law.
    """

    residual: float = 0.05
    margin: float = 0.05
    low: float = 0.0
    high: float = HIGHEST
    windows: tuple = ()
    quantities: tuple = ()
    move: Move = MOVE


@dataclass(frozen=True, eq=False)
class Study:
    """What a recording shows about the modes, and what follows from it.

    Attributes
    ----------
    channels : Channels
    windows : list of Window
    families : list of Family
    spreads : list of Spread
        Of each family, widened by the margin.
    recommendation : Recommendation
    answers : tuple of Answer
        Responses of sensors to steps of the joints, if the arm was moved by steps.
    """

    channels: windows.Channels
    windows: list
    families: list
    spreads: list
    recommendation: object
    answers: tuple = ()


def study(recordings, wishes=None) -> Study:
    """Find the modes of recordings that ring freely, and recommend a shaper.

    Parameters
    ----------
    recordings : sequence of Recording
        With the same channels, for example of one arm in several configurations.
    wishes : Wishes, optional

    Raises
    ------
    FlexarmError
        If nothing rings, a window has no samples, or a recording has channels that differ from those of the first.
    """
    wishes = wishes or Wishes()
    first, rings = None, []
    for recording in recordings:
        found = windows.channels(recording, wishes.quantities or None)
        first = first or found
        _same_channels(first, found)
        if wishes.windows:
            parts = [found.rows(*window) for window in wishes.windows]
        else:
            parts = windows.free(found, recording)
        rings += windows.modes_of(found, parts, wishes.low, wishes.high)
    return of_windows(first, rings, wishes)


def _same_channels(first, other):
    for name in ("names", "joint_names"):
        wanted, there = getattr(first, name), getattr(other, name)
        if wanted != there:
            field = "channels" if name == "names" else "joints"
            hint = "choose the same with --channels"
            raise FlexarmError(
                "differ from those of the first recording", field=field, value=", ".join(there),
                limit=", ".join(wanted), hint=hint,
            )  # fmt: skip


def of_windows(found, rings, wishes) -> Study:
    """The study of windows that ring.

    Parameters
    ----------
    found : Channels
    rings : list of Window
    wishes : Wishes

    Raises
    ------
    FlexarmError
        If no window rings.
    """
    if not rings:
        hint = "record what follows a quick motion or a blow, or name a stretch with --window"
        raise FlexarmError("nothing rings freely", field="recording", hint=hint)
    modes = families(rings, found.quantities)
    spreads = [Spread(*f.frequencies, f.dampings, f.part) for f in modes]
    spreads = widened(spreads, wishes.margin)
    shaped = [s for s in spreads if s.part > MIN_PART]
    return Study(found, rings, modes, shaped, recommend(shaped, wishes.residual, wishes.move))


def by_configuration(made, modes=None):
    """The shaped modes of each configuration, for a shaper that depends on the joints.

    Parameters
    ----------
    made : Study
    modes : sequence of int, optional
        Indices of the modes; not given: those of the recommended shaper.

    Returns
    -------
    list of (ndarray, list of Spread)
        Configuration [rad] and its modes; empty if no mode depends on the joints.
    """
    modes = made.recommendation.chosen.modes if modes is None else modes
    shaped = [f for f in made.families if f.part > MIN_PART]
    laws = [dependence(shaped[k], made.windows) for k in modes]
    if not any(law is not None and law.counts for law in laws):
        return []
    out = []
    for place in _places(made.windows):
        here = []
        for k, law in zip(modes, laws, strict=True):
            middle = law.at(place) if law is not None and law.counts else shaped[k].frequency
            here.append(replace(made.spreads[k], low=middle, high=middle))
        out.append((place, here))
    return out


def _places(rings):
    places = []
    for window in rings:
        near = [np.abs(window.configuration - p).max() < SAME_PLACE for p in places]
        if not any(near):
            places.append(window.configuration)
    return places


# As plain data -------------------------------------------------------------------------------


def plain(made, motion=None):
    """All that was found, ready for JSON, with numbers in SI; `motion` as in `yaml_lines`."""
    names = made.channels.joint_names
    return {
        "channels": list(made.channels.names),
        "joints": list(names),
        "windows": [_window(w) for w in made.windows],
        "modes": [_family(f, made.windows) for f in made.families],
        "recommendation": _recommendation(made),
        "damping": [_answer(found) for found in made.answers],
        "yaml": yaml_lines(made, motion),
    }


def _window(window):
    fitted = window.fit
    return {
        "from_s": window.begin,
        "to_s": window.end,
        "configuration": [float(q) for q in window.configuration],
        "explained": [float(e) for e in fitted.explained],
        "modes": [
            {
                "frequency_hz": mode.frequency,
                "frequency_half_width_hz": mode.frequency_width,
                "damping": mode.damping,
                "damping_half_width": mode.damping_width,
                "amplitude": [float(a) for a in mode.amplitude],
            }
            for mode in fitted.modes
        ],
    }


def _family(family, rings):
    law = dependence(family, rings)
    return {
        "frequency_hz": family.frequency,
        "frequencies_hz": list(family.frequencies),
        "dampings": list(family.dampings),
        "windows": list(family.windows),
        "part": family.part,
        "dependence": law
        and {
            "at": [float(q) for q in law.mean],
            "frequency_hz": law.frequency,
            "slope_hz_per_rad": [float(g) for g in law.slope],
            "error_hz": law.error,
            "constant_error_hz": law.constant_error,
            "counts": law.counts,
        },
    }


def _answer(found):
    refused = found.refusal()
    return {**found.settings(), "scatter": found.scatter, "refused": refused}


def _recommendation(made):
    found = made.recommendation
    return {
        "residual_wanted": found.wanted,
        "met": found.met,
        "shaper": found.chosen.kind,
        "delay_s": found.chosen.delay,
        "residual": found.chosen.residual,
        "spreads": [
            {"low_hz": s.low, "high_hz": s.high, "dampings": list(s.dampings), "part": s.part}
            for s in made.spreads
        ],
        "candidates": [
            {
                "kind": c.kind,
                "modes": list(c.modes),
                "delay_s": c.delay,
                "residual": c.residual,
                "nominal_residual": c.nominal,
                "width_s": c.width,
                "spread": c.spread,
                "periods": c.periods,
            }
            for c in found.candidates
        ],
    }


def yaml_lines(made, motion=None):
    """Parameters of the node `shaper`, a list of lines to paste.

    Parameters
    ----------
    made : Study
    motion : list of dict, optional
        From `of_trajectory`; the lines are then for the shaper recommended for this motion.
    """
    kind, modes, spread, periods = _recommended(made, motion)
    shaped = [made.spreads[k] for k in modes]
    places = by_configuration(made, modes)
    rows = [here for _, here in places] or [shaped]
    lines = [
        "shaper:",
        "  ros__parameters:",
        f"    shaper.type: {kind}",
    ]
    if modes:
        lines += [
            f"    shaper.frequencies: {_floats([s.frequency for row in rows for s in row])}",
            f"    shaper.dampings: {_floats([s.damping for row in rows for s in row])}",
        ]
    if made.channels.joint_names:
        lines.insert(2, f"    joint_names: [{', '.join(made.channels.joint_names)}]")
    if periods:
        # Rounded up, so that the printed number covers the value found.
        up = lambda value, most: min(float(np.ceil(1e3 * value)) / 1e3, most)  # noqa: E731
        spread, periods = up(spread, WIDEST), up(periods, LONGEST)
        lines += [f"    shaper.spread: {spread}", f"    shaper.periods: {periods}"]
    if places:
        flat = [float(q) for place, _ in places for q in place]
        lines.append(f"    shaper.configurations: {_floats(flat)}")
    return lines


def _recommended(made, motion):
    """Kind, modes, spread and periods of the recommended shaper, for a motion if one is given."""
    if not motion:
        chosen = made.recommendation.chosen
        return chosen.kind, chosen.modes, chosen.spread, chosen.periods
    row = effect.recommended(motion, made.recommendation.wanted)
    return row["kind"], row["modes"], row["spread"], row["periods"]


def _floats(values):
    """A YAML list, every number with a decimal point: ROS does not accept integers as floats."""
    return "[" + ", ".join(repr(float(f"{v:.4g}")) for v in values) + "]"


# As text ---------------------------------------------------------------------------------------


def text(made, motion=None):
    """Lines for people; `motion` is what `effect.of_trajectory` found of a trajectory, if there is one."""
    yield from _windows_text(made)
    yield from _modes_text(made)
    yield from _table(made.recommendation)
    if motion:
        yield from _motion_text(motion, made.recommendation.wanted)
    lines = yaml_lines(made, motion)
    yield from ("", "to paste into the parameters of the node shaper:", *lines)
    yield from _answers_text(made.answers)


def _answers_text(answers):
    if not answers:
        return
    first = answers[0]
    yield f"\nanswer of {first.channel} to steps at {first.frequency:.3f} Hz: what damping by it needs"
    for found in answers:
        phase = np.degrees(np.angle(found.beta))
        yield (
            f"  {found.joint:16} {abs(found.beta):.4g} 1/(rad s), phase {phase:.0f} degrees, "
            f"{100.0 * found.scatter:.2g} % scatter between steps"
        )
    if refused := first.refusal():
        yield f"no damping by it: {refused}"
        return
    yield "for damping by a sensor, to the same parameters (the sensor's own numbers: see docs/vibration.md):"
    for name, value in first.settings().items():
        yield f"    damping.{name}: {float(f'{value:.4g}') if isinstance(value, float) else value}"


def _windows_text(made):
    yield f"channels: {', '.join(made.channels.names)}"
    yield "free ringing"
    for window in made.windows:
        at = ", ".join(f"{q:.2f}" for q in window.configuration)
        yield f"  {window.begin:.2f} to {window.end:.2f} s" + (f" at ({at})" if at else "")
        for mode in window.fit.modes:
            yield (
                f"    {mode.frequency:8.3f} +- {mode.frequency_width:.3f} Hz, damping "
                f"{mode.damping:.4f} +- {mode.damping_width:.4f}"
            )


def _modes_text(made):
    yield "\nmodes"
    for family in made.families:
        (low, high), (least, _, most) = family.frequencies, family.dampings
        yield (
            f"  {low:.3f} to {high:.3f} Hz, damping {least:.4f} to {most:.4f}, in {len(family.modes)} of "
            f"{len(made.windows)} windows, {100.0 * family.part:.3g} % of the vibration"
        )
        law = dependence(family, made.windows)
        if law is not None:
            slopes = ", ".join(
                f"{g:+.3f} of {name}"
                for name, g in zip(made.channels.joint_names, law.slope, strict=True)
                if g
            )
            which = "goes with the joints" if law.counts else "does not go with the joints"
            yield (
                f"    {which}: {slopes} [Hz/rad]; a window that was left out is predicted within "
                f"{law.error:.3f} Hz, by the mean within {law.constant_error:.3f} Hz"
            )


def _table(found):
    yield f"\nresidual over the spread, and the time that a motion gets longer; wanted {100.0 * found.wanted:g} %"
    yield "  shaper           modes  residual   in the middle   delay [s]"
    for c in sorted(found.candidates, key=lambda c: c.delay):
        mark = "*" if c is found.chosen else " "
        modes = str(len(c.modes)) if c.modes else "-"
        middle = f"{100.0 * c.nominal:7.2f} %"
        yield f"{mark} {c.kind:16} {modes:5} {100.0 * c.residual:8.2f} % {middle:>13} {c.delay:13.3f}"
    if not found.met:
        yield "none meets it: the modes spread too far; measure where the arm works, or shape by configuration"
    law = [c for c in found.candidates if c.kind == BY_PROGRAMME]
    if law:
        yield f"{BY_PROGRAMME}: for one motion, against the trapezoidal one within the same limits"


def _motion_text(rows, wanted):
    yield "\nthe trajectory: its duration, the residual, and what it leaves of each mode, per unit at the joint [mrad]"
    for row in rows:
        amplitudes = "  ".join(f"{1e3 * a:9.4f}" for a in row["amplitude_rad"])
        residual = 100.0 * row["residual"]
        yield f"  {row['kind']:16} {row['duration_s']:8.3f} s {residual:8.2f} % {amplitudes}"
    best = effect.recommended(rows, wanted)
    what = f"longer by {best['added_s']:.3f} s, leaves {100.0 * best['residual']:.2f} %"
    yield f"best for this trajectory: {best['kind']}, {what}"


def of_trajectory(made, trajectory):
    """What a trajectory excites: unshaped, with each candidate, and with a new time law; see `effect.of_trajectory`.

    Parameters
    ----------
    made : Study
    trajectory : JointTrajectoryData

    Raises
    ------
    FlexarmError
        For a trajectory that is not a motion.
    """
    wanted, joints = made.recommendation.wanted, trajectory.positions.shape[1]
    places = by_configuration(made, range(len(made.spreads)))
    if len(made.channels.joint_names) != joints:
        places = []  # they are for other joints
    law = retiming.retimed(trajectory, made.spreads, places, wanted)
    return effect.of_trajectory(trajectory, made.spreads, made.recommendation.candidates, law)
