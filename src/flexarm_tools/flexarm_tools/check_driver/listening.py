# SPDX-License-Identifier: Apache-2.0
"""Checks a driver by listening: names, numbers, time, counts, strain of an arm at rest.

Every check takes `Samples` and returns one `Finding`. No check waits, moves the arm or needs ROS. They judge medians
and minima, so a driver does not fail because this machine was too busy to read it.
"""

from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.arm.strain_map import reading_rows
from flexarm_dynamics.shown import show

from .samples import Finding, Verdict

PASS, WARN, FAIL, SKIPPED = Verdict.PASS, Verdict.WARN, Verdict.FAIL, Verdict.SKIPPED

#: Fields of names, and the arrays that they name.
FIELDS = {
    "joint_names": ("joint_position", "joint_velocity", "joint_torque"),
    "gauge_names": ("strain",),
    "mode_names": ("modal_amplitude", "modal_rate"),
}
#: Stamps further from this machine's clock than this belong to a separate clock [s].
SAME_CLOCK = 3600.0
#: An arm is at rest when its joints move less than the first, and in motion when more than the second [rad].
REST, MOTION = 2e-3, 5e-3
#: Beyond this, an angle without limits is probably in degrees or counts [rad].
FAR = 4.0 * np.pi
#: No metal gauge reads a larger strain [-].
MICROSTRAIN = 0.05


@dataclass(frozen=True)
class Tolerances:
    """Limits of what passes.

    Attributes
    ----------
    rate : float or None
        Expected samples per second [Hz]; None: any.
    rate_error : float
        Relative error of the rate [-].
    jitter : float
        Deviation of stamps from their grid, in periods [-].
    age : float
        Age of a stamp when it arrives [s].
    gain : float
        Relative error of the arm's motion against its model [-].
    torque_timeout : float
        Time within which the driver must take the safe action when torque stops [s].
    """

    rate: float | None = None
    rate_error: float = 0.05
    jitter: float = 0.5
    age: float = 0.05
    gain: float = 0.5
    torque_timeout: float = 0.05


# Names and lengths ---------------------------------------------------------------------------------


def check_layout(arm, messages):
    """Compare the messages' names with the arm file's, and lengths with the names, for each shape that occurred.

    `messages` are `flexarm_msgs/ArmState`.

    Returns
    -------
    list of Finding
        Two: ``names`` and ``lengths``.
    """
    wrong, order, lengths = [], [], []
    for names, fields in FIELDS.items():
        wanted = {
            "joint_names": arm.joint_names,
            "gauge_names": arm.gauge_names,
            "mode_names": arm.observed_modes,
        }[names]
        shapes = {
            (tuple(getattr(m, names)), tuple(len(getattr(m, f)) for f in fields)) for m in messages
        }
        for found, sizes in sorted(shapes):
            if any(sizes) and sorted(found) != sorted(wanted):
                wrong.append(f"{names} are {show(list(found))}, arm {arm.name} has {list(wanted)}")
            elif any(sizes) and found != tuple(wanted):
                order.append(names)
            lengths += [
                f"{field} has {size} values for {len(wanted)} {names}"
                for field, size in zip(fields, sizes, strict=True)
                if size not in (0, len(wanted))
            ]
    lengths += _missing(arm, messages)
    if wrong:
        first = Finding("names", FAIL, f"{wrong[0]}: send the names of the arm file")
    elif order:
        text = f"{order[0]} are not in the arm file's order: sorting them by name costs time"
        first = Finding("names", WARN, text)
    else:
        first = Finding(
            "names", PASS, "joint, gauge and mode names are the arm file's, in its order"
        )
    if lengths:
        text = f"{lengths[0]}: send one value per name, or an empty array for what is unknown"
        return [first, Finding("lengths", FAIL, text)]
    return [first, Finding("lengths", PASS, "every array has one value per name, or none")]


def _missing(arm, messages):
    """Arrays that must not be empty, but are."""
    out = []
    if any(not len(m.joint_position) for m in messages):
        out.append(f"joint_position has 0 values for {len(arm.joints)} joint_names")
    if arm.gauges and any(not len(m.strain) and not len(m.modal_amplitude) for m in messages):
        out.append(f"strain has 0 values for {len(arm.gauges)} gauge_names")
    return out


def check_finite(arm, samples):
    """All positions, velocities, strains and amplitudes are finite."""
    for what, values, names in (
        ("joint_position", samples.position, arm.joint_names),
        ("joint_velocity", samples.velocity, arm.joint_names),
        ("strain", samples.strain, arm.gauge_names),
        ("modal_amplitude", samples.amplitude, arm.observed_modes),
    ):
        if values is None or np.isfinite(values).all():
            continue
        count = (~np.isfinite(values)).sum(axis=0)
        i = int(np.argmax(count))
        text = (
            f"{what} of {names[i]} is not finite in {count[i]} of {samples.size} samples: fix the"
            " sensor or its conversion"
        )
        return Finding("finite", FAIL, text)
    return Finding("finite", PASS, "all measured values are finite")


# Counts and time -------------------------------------------------------------------------------------


def check_sequence(samples):
    """The sequence rises by one with each sample; gaps are samples lost on the way."""
    steps = np.diff(samples.sequence) % 2**32
    steps = steps[np.diff(samples.session) == 0]
    if not steps.size:
        return Finding("sequence", SKIPPED, "fewer than two samples of a session")
    middle = float(np.median(steps))
    if middle == 0:
        text = "the sequence stands still: count each sample; if the source is paused, resume it"
        return Finding("sequence", FAIL, text)
    if (steps >= 2**31).any() or middle != 1:
        text = f"the sequence goes in steps of {middle:.0f}, or backwards: add 1 with each sample"
        return Finding("sequence", FAIL, text)
    lost = int((steps - 1).sum()) / int(steps.sum())
    text = "the sequence counts the samples"
    if lost > 0.01:
        text += (
            f"; {lost:.0%} of them did not arrive: lower the rate, or give the machine more time"
        )
        return Finding("sequence", WARN, text)
    return Finding("sequence", PASS, text)


def check_session(samples):
    """There is one session while the driver runs."""
    sessions = np.unique(samples.session)
    if sessions.size > 1:
        text = f"{sessions.size} sessions in one run: draw a session at the start, and keep it until a restart"
        return Finding("session", FAIL, text)
    if sessions[0] < 2:
        text = f"the session is {sessions[0]}: draw one at each start, so that a restart is noticed"
        return Finding("session", WARN, text)
    return Finding("session", PASS, "one session")


def check_stamps(samples, tolerances):
    """Stamps rise and are recent."""
    steps = np.diff(samples.stamp)[np.diff(samples.sequence) != 0]
    if steps.size and (steps <= 0).any():
        fraction = float((steps <= 0).mean())
        text = f"{fraction:.0%} of the stamps do not rise: stamp each sample with its time of measurement"
        return Finding("stamps", FAIL, text)
    age = 1e-9 * (samples.clock - samples.stamp)
    if abs(np.median(age)) > SAME_CLOCK:
        return _check_own_clock(samples)
    least = float(age.min())
    if least < -1e-3:
        text = f"stamps are up to {-least:.3g} s in the future: use the time of measurement, on this clock"
        # A few samples come while the device's clock is still being compared with this one.
        return Finding("stamps", FAIL if np.median(age) < -1e-3 else WARN, text)
    # The minimum: a busy machine's delay must not count against the driver.
    if least > tolerances.age:
        text = (
            f"stamps are at least {least:.3g} s old when they arrive, allowed are {tolerances.age:g} s:"
            " stamp at the measurement and publish at once"
        )
        return Finding("stamps", FAIL, text)
    text = f"stamps rise and are {1e3 * float(np.median(age)):.1f} ms old when they arrive (median)"
    if np.median(age) > tolerances.age:
        return Finding("stamps", WARN, f"{text}: the transport or this machine is slow")
    return Finding("stamps", PASS, text)


def _check_own_clock(samples):
    spent = samples.arrival[-1] - samples.arrival[0]
    pace = samples.time[-1] / spent if spent > 0.0 else 0.0
    if not 0.1 < pace < 10.0:
        text = f"stamps advance {pace:.3g} s per second: stamps are nanoseconds of the time of measurement"
        return Finding("stamps", FAIL, text)
    text = f"stamps rise, {pace:.2f} s per second, on a separate clock: their age can't be judged"
    return Finding("stamps", PASS if abs(pace - 1.0) < 0.05 else WARN, text)


def check_rate(samples, tolerances):
    """Samples per second, by stamps: a slow reader does not change them."""
    period = samples.period
    if period <= 0.0:
        return Finding("rate", FAIL, "no rate: stamps or sequence stand still")
    rate, wanted = 1.0 / period, tolerances.rate
    if wanted and abs(rate / wanted - 1.0) > tolerances.rate_error:
        text = f"{rate:.1f} samples per second, expected are {wanted:g}: set the device's rate"
        return Finding("rate", FAIL, text)
    return Finding("rate", PASS, f"{rate:.1f} samples per second")


def check_jitter(samples, tolerances):
    """Stamps compared with the grid that the sequence counts."""
    period = samples.period
    steps = np.diff(samples.sequence)
    steps, taken = steps[steps > 0], 1e-9 * np.diff(samples.stamp)[steps > 0]
    if period <= 0.0 or steps.size < 10:
        return Finding("jitter", SKIPPED, "too few samples, or stamps that stand still")
    off = np.abs(taken - steps * period) / period
    often, rare = float(np.median(off)), float(np.percentile(off, 99))
    text = f"stamps deviate from their grid by {often:.1%} of a period (median), {rare:.1%} (99th percentile)"
    if often > tolerances.jitter:
        return Finding("jitter", FAIL, f"{text}: stamp with the device's clock, not at reading")
    if rare > tolerances.jitter:
        return Finding(
            "jitter", WARN, f"{text}: stamp with the device's clock, or reduce the machine's load"
        )
    return Finding("jitter", PASS, text)


# Units and strain -----------------------------------------------------------------------------------


def check_position(arm, samples):
    """Joint positions are within the joints' limits."""
    for i, joint in enumerate(arm.joints):
        low, high = joint.limits.position
        low, high = max(low, -FAR), min(high, FAR)
        q = samples.position[:, i]
        beyond = q.max() if q.max() > high else q.min() if q.min() < low else None
        if beyond is None:
            continue
        hint = "are these degrees or counts?" if abs(beyond) > 2 * np.pi else "check its zero"
        text = (
            f"joint_position of {joint.name} is {beyond:.4g}, outside {low:.4g} ... {high:.4g} rad:"
            f" {hint}"
        )
        return Finding("position", FAIL, text)
    return Finding("position", PASS, "joint positions are within the limits")


def check_velocity(arm, samples):
    """The integrated velocity agrees with the position."""
    if samples.velocity is None:
        return Finding("velocity", PASS, "joint_velocity is empty: the observer estimates it")
    time = samples.time
    judged = []
    for i, name in enumerate(arm.joint_names):
        moved = samples.position[:, i] - samples.position[0, i]
        velocity = samples.velocity[:, i]
        steps = np.diff(time) * 0.5 * (velocity[1:] + velocity[:-1])
        integral = np.concatenate([[0.0], np.cumsum(steps)])
        if max(np.ptp(moved), np.ptp(integral)) < MOTION:
            continue
        gain = slope(moved, integral)
        judged.append(name)
        if not 0.7 < gain < 1.4:
            return Finding("velocity", FAIL, _velocity_text(name, gain))
    if not judged:
        return Finding(
            "velocity", SKIPPED, "no joint moved: try --allow-motion, or move one by hand"
        )
    return Finding("velocity", PASS, "joint velocities are the derivatives of the positions")


def _velocity_text(name, gain):
    text = f"{name} moves {gain:.3g} times its integrated velocity: "
    if gain < 0.0:
        return text + "one of the two has the wrong sign"
    if 30.0 < gain < 110.0:
        return text + "position is in degrees, send rad"
    if 1 / 110.0 < gain < 1 / 30.0:
        return text + "velocity is in degrees per second, send rad/s"
    return text + "check the scales of both"


def slope(y, x):
    """Least-squares factor of y on x; 0 if x is 0."""
    square = float(x @ x)
    return float(y @ x) / square if square > 0.0 else 0.0


def check_strain_at_rest(model, samples):
    """Strains are in their range, and at rest near those of the arm under its weight."""
    gauges = model.arm.gauges
    if samples.strain is None or not np.isfinite(samples.strain).all():
        text = "no strain is published, or it is not all finite"
        return Finding("strain at rest", SKIPPED, text)
    greatest = np.abs(samples.strain).max(axis=0)
    i = int(np.argmax(greatest))
    if greatest[i] > MICROSTRAIN:
        text = (
            f"strain of {gauges[i].name} is {greatest[i]:.4g}: send m/m, not microstrain or counts"
        )
        return Finding("strain at rest", FAIL, text)
    for i, g in enumerate(gauges):
        low, high = g.range
        stuck = float(((samples.strain[:, i] <= low) | (samples.strain[:, i] >= high)).mean())
        if stuck > 0.1:
            text = f"strain of {g.name} is at the end of its range in {stuck:.0%} of the samples: fix its bridge"
            return Finding("strain at rest", FAIL, text)
    if np.ptp(samples.position, axis=0).max() > REST:
        return Finding("strain at rest", SKIPPED, "the arm is not at rest")
    rows = reading_rows(model, gauges)
    bias = np.array([g.bias for g in gauges])
    expected = rows @ model.static_deflection(samples.position.mean(axis=0)) + bias
    off = np.abs(samples.strain.mean(axis=0) - expected) / [g.full_scale for g in gauges]
    i = int(np.argmax(off))
    if off[i] > 0.1:
        text = (
            f"strain of {gauges[i].name} is off by {off[i]:.0%} of full scale at rest: balance the bridge, or call"
            " observer/calibrate_gauges"
        )
        return Finding("strain at rest", WARN, text)
    return Finding("strain at rest", PASS, "strains are those of the arm at rest")


def check_frozen_strain(arm, samples, span=None):
    """Strains change while the joints move.

    Parameters
    ----------
    arm : Arm
    samples : Samples
    span : ndarray, shape (gauges,), optional
        Peak to peak of the model's strains over these samples; default: a joint in motion bends every link.
    """
    name = "frozen strain"
    if samples.strain is None:
        return Finding(name, SKIPPED, "no strain is published")
    if span is None:
        moves = np.ptp(samples.position, axis=0).max() > MOTION
        span = np.full(len(arm.gauges), np.inf if moves else 0.0)
    # A coarse bridge may round all readings to the same count.
    tells = span > 8.0 * np.array([g.uncertainty for g in arm.gauges])
    if not tells.any():
        return Finding(name, SKIPPED, "the arm did not bend enough: try --allow-motion")
    same = tells & (samples.strain == samples.strain[0]).all(axis=0)
    frozen = [g.name for g, s in zip(arm.gauges, same, strict=True) if s]
    if frozen:
        text = (
            f"strain of {', '.join(frozen)} did not change at all while the arm moved: is the converter"
            " read for each sample?"
        )
        return Finding(name, FAIL, text)
    return Finding(name, PASS, "strains change while the arm moves")


def check_listening(model, samples, tolerances):
    """Findings of all checks of `samples` that need no motion, with the `tolerances` of the command line.

    `check_layout` must have passed.
    """
    arm = model.arm
    return [
        check_finite(arm, samples),
        check_sequence(samples),
        check_session(samples),
        check_rate(samples, tolerances),
        check_jitter(samples, tolerances),
        check_stamps(samples, tolerances),
        check_position(arm, samples),
        check_velocity(arm, samples),
        check_strain_at_rest(model, samples),
        check_frozen_strain(arm, samples),
    ]
