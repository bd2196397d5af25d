# SPDX-License-Identifier: Apache-2.0
r"""Checks a driver by a small push: signs, scales and order of joints, gauges and modes, against the model.

Joint j is pushed by one period of a sine,

.. math:: u(t) = \bar u + A\,e_j\,\sin(2\pi t/T), \qquad B_{jj}\,A\,T^2/(2\pi) = \Delta q

which moves the slow subsystem (10) by :math:`\Delta q` and leaves it at rest; :math:`\bar u` holds the arm's weight. T
is long compared with the longest period of the links. The model of the arm file moves under the same torque, with the
driver's stamps and the torque that it reports. Each measured signal y is compared with its prediction p: the factor
:math:`y^Tp/p^Tp` is 1 if they agree.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from flexarm_dynamics.arm.strain_map import StrainMap, reading_rows
from flexarm_dynamics.singular_perturbation import fast_subsystem, slow_subsystem
from flexarm_sim.plant import Plant

from .listening import check_finite, check_frozen_strain, check_velocity, slope
from .samples import Finding, Verdict

PASS, WARN, FAIL, SKIPPED = Verdict.PASS, Verdict.WARN, Verdict.FAIL, Verdict.SKIPPED

#: Duration of a push in periods of the slowest bending, and its limits [s].
PERIODS, MIN_DURATION, MAX_DURATION = 2.5, 0.5, 8.0
#: Maximum torque of a push, as a fraction of the joint's limit [-].
MAX_TORQUE = 0.3
#: Longest gap between samples, as a fraction of the push [-]; over a longer one the torque is unknown.
MAX_GAP = 0.05
#: A signal is judged if its prediction spans this many of its resolutions.
RESOLUTIONS = 8.0
#: A gauge or mode below this fraction of the largest of its kind is not judged; another push may move it more.
SILENT_GAUGE, SILENT_MODE = 0.1, 1e-3


@dataclass(frozen=True)
class Push:
    """One period of a sine on a joint.

    Attributes
    ----------
    joint : int
    amplitude : float
        A [N m].
    duration : float
        T [s].
    hold : ndarray, shape (n,)
        Torque that holds the arm's weight [N m].
    angle : float
        Motion of the joint, from the slow subsystem [rad].
    """

    joint: int
    amplitude: float
    duration: float
    hold: np.ndarray
    angle: float

    def torque(self, time):
        """Torque at a time since its start, shape (n,) [N m]."""
        out = self.hold.copy()
        if 0.0 <= time < self.duration:
            out[self.joint] += self.amplitude * np.sin(2.0 * np.pi * time / self.duration)
        return out

    def jolt(self, time, part):
        """Half the amplitude forward for `part` seconds, then backward; at rest after twice that time, (n,) [N m]."""
        out = self.hold.copy()
        out[self.joint] += 0.5 * self.amplitude * (1.0 if time < part else -1.0)
        return out


def plan(model, position, joint, angle=0.05):
    """A `Push` of a joint by about `angle` [rad], less if that takes too much torque.

    Parameters
    ----------
    model : ArmModel
    position : ndarray, shape (n,)
        Position of the arm [rad].
    joint : int
    angle : float
    """
    terms = model.terms(np.asarray(position, float), np.zeros(model.n_joints))
    a, B = slow_subsystem(terms)
    duration = MIN_DURATION
    if model.n_modes:
        speeds = np.abs(np.linalg.eigvals(fast_subsystem(terms)[0]))
        duration = float(np.clip(PERIODS * 2.0 * np.pi / speeds.min(), MIN_DURATION, MAX_DURATION))
    reach = B[joint, joint] * duration**2 / (2.0 * np.pi)  # [rad/(N m)]
    amplitude = min(angle / reach, MAX_TORQUE * model.arm.joints[joint].limits.torque)
    return Push(joint, amplitude, duration, -np.linalg.solve(B, a), amplitude * reach)


# What was sent and what was reported ------------------------------------------------------------------


def sent_torque(samples, sequences, torques):
    """Torque that a prompt driver applies over the interval that ends at each sample.

    Parameters
    ----------
    samples : Samples
    sequences : sequence of int
        States that were answered, ascending.
    torques : ndarray, shape (answers, n)

    Returns
    -------
    ndarray, shape (N, n)
        The last answer to an earlier state [N m]; zero before the first.
    """
    at = np.searchsorted(np.asarray(sequences, np.int64), samples.sequence, side="left") - 1
    out = np.asarray(torques, float)[np.maximum(at, 0)]
    out[at < 0] = 0.0
    return out


def check_reported(arm, push, samples, sent):
    """The reported torque agrees with the one sent."""
    name, joint = "torque reported", arm.joint_names[push.joint]
    reported = samples.torque[:, push.joint]
    known = np.isfinite(reported)
    if known.mean() < 0.5:
        text = f"the torque of {joint} is unknown (NaN): report what was applied, observers use it"
        return Finding(name, WARN, text)
    gain = slope(reported[known], sent[known, push.joint])
    if abs(gain) < 0.1:
        text = (
            f"the torque of {joint} stays {np.abs(reported[known]).max():.3g} N m while up to"
            f" {np.abs(sent).max():.3g} is sent: torque is ignored: is the drive enabled?"
        )
        return Finding(name, FAIL, text)
    if gain < 0.0:
        text = f"the torque of {joint} is reported with the wrong sign: it must have that of the torque sent"
        return Finding(name, FAIL, text)
    text = f"{joint} reports {gain:.2f} of the torque sent"
    if not 0.7 < gain < 1.4:
        return Finding(
            name, FAIL, f"{text}: check the drive's scale and limits, and for lost messages"
        )
    return Finding(name, PASS, text)


def replay(model, samples, sent, reported_holds):
    """Motion of the model under the same torque, sample by sample.

    Parameters
    ----------
    model : ArmModel
    samples : Samples
        The first one at rest or nearly so.
    sent : ndarray, shape (N, n)
        See `sent_torque`.
    reported_holds : bool
        Whether the reported torque was applied; otherwise `sent` was applied. Where the reported torque is zero
        although torque was sent, the driver took the safe action, and so does the model.

    Returns
    -------
    position : ndarray, shape (N, n)
        [rad]
    deflection : ndarray, shape (N, m)
        Modal amplitudes, all of the model's [m, rad].
    """
    period = samples.period
    plant = Plant(model, period)
    plant.reset(samples.position[0])
    if samples.velocity is not None:  # a brake may creep under the arm's weight
        plant.qd[:] = samples.velocity[0]
    applied = np.where(np.isfinite(samples.torque), samples.torque, sent)
    applied = applied if reported_holds else sent
    position, deflection = np.empty_like(samples.position), np.empty((samples.size, model.n_modes))
    position[0], deflection[0] = plant.q, plant.delta
    shares = np.diff(samples.time) / period
    for k, share in enumerate(shares, start=1):
        if reported_holds and not applied[k].any() and sent[k].any():
            plant.advance_safely(share)
        else:
            plant.advance(applied[k], share)
        position[k], deflection[k] = plant.q, plant.delta
    return position, deflection


# Responses --------------------------------------------------------------------------------------------


def match(measured, predicted):
    """Assign predictions to measured signals, up to sign, by least squares.

    `measured` and `predicted` are (N, k), a column per signal.

    Returns
    -------
    order : ndarray of int, shape (k,)
        Signal i fits prediction ``order[i]``.
    better : float
        Sum of squares with each signal's own prediction over that of the assignment; 1 where they agree.
    """
    size = measured.shape[1]
    cost = np.array(
        [
            [min(((y - p) ** 2).sum(), ((y + p) ** 2).sum()) for p in np.moveaxis(predicted, 1, 0)]
            for y in np.moveaxis(measured, 1, 0)
        ]
    )
    rows, order = linear_sum_assignment(cost)
    moved = order != np.arange(size)
    best, own = cost[rows, order][moved].sum(), np.diag(cost)[moved].sum()
    return order, 1.0 if not moved.any() else float(own / max(best, 1e-300))


#: Two signals count as exchanged if that reduces the sum of squares by this factor.
MUCH_BETTER = 4.0


def check_order(what, names, measured, predicted):
    """A finding if two signals are exchanged, otherwise None."""
    if len(names) < 2 or not np.ptp(predicted, axis=0).any():
        return None
    order, better = match(measured, predicted)
    if better < MUCH_BETTER:
        return None
    i = int(np.argmax(order != np.arange(len(names))))
    text = (
        f"{what} {names[i]} moves as {names[order[i]]} should: they are exchanged, send each under its"
        " own name"
    )
    return Finding(f"{what} order", FAIL, text)


def check_response(arm, push, samples, position, gain_error):
    """The pushed joint moves in the right direction, and about as far as the model.

    Parameters
    ----------
    arm : Arm
    push : Push
    samples : Samples
        Since the push began.
    gain_error : float
        Allowed deviation from 1 of measured over predicted motion [-].
    position : ndarray, shape (N, n)
        Of the model [rad], see `replay`.
    """
    name, joint = "response", arm.joint_names[push.joint]
    measured, expected = samples.position - samples.position[0], position - position[0]
    exchanged = check_order("joint", arm.joint_names, measured, expected)
    if exchanged is not None:
        return exchanged
    moved = expected[:, push.joint]
    if np.ptp(moved) < 1e-6:
        return Finding(name, SKIPPED, f"{joint}: the model does not move: raise --angle")
    gain = slope(measured[:, push.joint], moved)
    text = f"{joint} moves {gain:.3g} times as far as its model under {push.amplitude:.3g} N m"
    if abs(gain) < 0.05:
        why = "torque is ignored: is the drive enabled, the brake open, the encoder alive?"
        return Finding(name, FAIL, f"{text}: {why}")
    if gain < 0.0:
        why = "wrong sign: reverse the sign of the position's or of the torque's scale, not of both"
        return Finding(name, FAIL, f"{text}: {why}")
    if 25.0 < gain < 110.0:
        return Finding(name, FAIL, f"{text}: position is in degrees, send rad")
    if abs(gain - 1.0) > gain_error:
        why = "check the scales of torque and position, and inertia and friction in the arm file"
        return Finding(name, FAIL, f"{text}: {why}")
    return Finding(name, PASS, text)


def check_strain_response(model, samples, deflection, gain_error):
    """The gauges read the right sign, scale and link, each under its own name."""
    name, arm = "strain response", model.arm
    if samples.strain is None:
        return [Finding(name, SKIPPED, "no strain is published, or not all of it finite")]
    predicted = _strains(model, deflection)
    expected, measured = predicted - predicted[0], samples.strain - samples.strain[0]
    span = np.ptp(predicted, axis=0)
    findings = [check_frozen_strain(arm, samples, span)]
    if findings[0].verdict == FAIL:
        return findings
    resolution = np.array([g.uncertainty for g in arm.gauges])
    findings.append(
        _signals(
            name,
            "gauge",
            arm.gauge_names,
            measured,
            expected,
            np.maximum(RESOLUTIONS * resolution, SILENT_GAUGE * span.max()),
            gain_error,
        )
    )
    return findings


def check_modes(model, samples, deflection, gain_error):
    """Modal amplitudes, if the driver sends them, agree with the strain map and the model."""
    name, arm = "modes", model.arm
    if samples.amplitude is None:
        text = "no modal_amplitude is published: the observer maps the strain"
        return Finding(name, PASS, text)
    if arm.gauges:
        strain_map = StrainMap(model)
        expected = np.array([strain_map.amplitudes(s) for s in _strains(model, deflection)])
        if samples.strain is not None:
            # The strains, with their noise, are a better reference than the model.
            expected = np.array([strain_map.amplitudes(s) for s in samples.strain])
    else:
        expected = deflection[:, [model.mode_names.index(n) for n in arm.observed_modes]]
    names = arm.observed_modes
    measured, expected = samples.amplitude - samples.amplitude[0], expected - expected[0]
    least = SILENT_MODE * np.ptp(expected, axis=0).max(initial=0.0)
    return _signals(name, "mode", names, measured, expected, least, gain_error)


def _strains(model, deflection):
    """Strains of the model without biases, shape (N, gauges)."""
    gauges = model.arm.gauges
    return deflection @ reading_rows(model, gauges).T


def _signals(name, what, names, measured, expected, least, gain_error):
    """Order, sign and scale of several signals agree with their predictions."""
    exchanged = check_order(what, names, measured, expected)
    if exchanged is not None:
        return exchanged
    span = np.ptp(expected, axis=0)
    judged = span > least
    if not judged.any():
        text = f"the push bends the arm too little for any {what}: raise --angle"
        return Finding(name, SKIPPED, text)
    gains = {n: slope(measured[:, i], expected[:, i]) for i, n in enumerate(names) if judged[i]}
    for n, gain in gains.items():
        text = f"{what} {n} reads {gain:.3g} times what its model does"
        if gain < -0.05:
            why = (
                "wrong sign: reverse the sign of its scale, or of surface_distance in the arm file"
            )
            return Finding(name, FAIL, f"{text}: {why}")
        if abs(gain - 1.0) > gain_error:
            why = "check its scale (m/m), and gain, position and stiffness in the arm file"
            return Finding(name, FAIL, f"{text}: {why}")
    seen = ", ".join(f"{n} {g:.2f}" for n, g in gains.items())
    return Finding(name, PASS, f"{what}s bend as the model does: {seen}")


def unseen(push, samples):
    """Longest gap between samples in a push [s]; 0 if it is short enough to judge the push."""
    gap = float(np.diff(samples.time).max(initial=0.0))
    return gap if gap > max(MAX_GAP * push.duration, 1.5 * samples.period) else 0.0


def check_push(model, push, samples, sent, tolerances):
    """Findings of all checks of one push.

    Parameters
    ----------
    model : ArmModel
    push : Push
    samples : Samples
        From the last one at rest to the end of the push.
    sent : ndarray, shape (N, n)
        See `sent_torque`.
    tolerances : Tolerances
    """
    arm = model.arm
    if samples.size < 10 or samples.period <= 0.0:
        text = (
            f"{samples.size} samples came while {arm.joint_names[push.joint]} was pushed: too few"
        )
        return [Finding("response", FAIL, text)]
    if not np.isfinite(samples.position).all():
        return [check_finite(arm, samples)]
    if gap := unseen(push, samples):
        text = (
            f"no sample came for {gap:.3f} s while {arm.joint_names[push.joint]} was pushed, so that what it did"
            " can't be judged: lower the rate, or give the machine more time"
        )
        return [Finding("response", SKIPPED, text)]
    # `check_finite` has already reported the others.
    kept = {k: getattr(samples, k) for k in ("velocity", "strain", "amplitude")}
    kept = {k: v if v is None or np.isfinite(v).all() else None for k, v in kept.items()}
    samples = replace(samples, **kept)
    reported = check_reported(arm, push, samples, sent)
    velocity = check_velocity(arm, samples)
    if velocity.verdict == FAIL:
        samples = replace(samples, velocity=None)
    position, deflection = replay(model, samples, sent, reported.verdict == PASS)
    response = check_response(arm, push, samples, position, tolerances.gain)
    findings = [reported, response, velocity]
    if response.verdict == FAIL:
        # If the arm does not move like its model, its strains would seem wrong.
        return findings
    findings += check_strain_response(model, samples, deflection, tolerances.gain)
    findings.append(check_modes(model, samples, deflection, tolerances.gain))
    return findings


# When torque stops -----------------------------------------------------------------------------------


def _ratio(samples, sent, joint):
    """Reported torque of a joint over the torque sent, (N,); 0 where it is unknown."""
    return np.nan_to_num(samples.torque[:, joint] / sent[joint])


def check_stop(samples, last, sent, joint, tolerances):
    """The torque ends when no new one comes.

    Parameters
    ----------
    samples : Samples
        Across the end of the torque.
    last : int
        Sequence of the last state that was answered.
    sent : ndarray, shape (n,)
        The torque of that answer [N m].
    joint : int
    tolerances : Tolerances
    """
    name = "torque stops"
    ratio = _ratio(samples, sent, joint)
    before, after = samples.sequence <= last + 2, samples.sequence > last
    if not (ratio[before][-5:] > 0.5).any():
        text = "no torque was reported before it stopped: the watchdog can't be judged"
        return Finding(name, SKIPPED, text)
    since = 1e-9 * (samples.stamp - samples.stamp[samples.sequence <= last][-1])
    held = after & (ratio > 0.5)
    on = float(since[held].max(initial=0.0))
    limit = tolerances.torque_timeout + 2.0 * samples.period + 0.02
    text = f"the torque went on for {on:.3f} s after the last one was sent"
    if held[-1] or on > 5.0 * limit:
        why = "take the safe action when no fresh torque has come for the timeout"
        return Finding(name, FAIL, f"{text}, allowed are {tolerances.torque_timeout:g} s: {why}")
    if on > limit:
        why = "shorten the watchdog's period, or reduce the machine's load"
        return Finding(name, WARN, f"{text}, allowed are {tolerances.torque_timeout:g} s: {why}")
    return Finding(name, PASS, text)


#: Torques that must not be applied, and why.
REFUSALS = {
    "DISABLED": "mode DISABLED means the safe action, whatever torque comes with it",
    "wrong session": "a torque of another session answers a state from before the restart",
    "old sequence": "a torque that answers a state older than the timeout is too late",
}


def check_refused(kind, samples, sent, joint):
    """A torque that must not be applied is not applied.

    Parameters
    ----------
    kind : str
        Of `REFUSALS`.
    samples : Samples
        While it was sent.
    sent : ndarray, shape (n,)
        [N m]
    joint : int
    """
    if not np.isfinite(samples.torque[:, joint]).any():
        return Finding(
            kind, SKIPPED, "the torque is unknown, so it can't be judged whether it was applied"
        )
    if (_ratio(samples, sent, joint) > 0.5).any():
        return Finding(kind, FAIL, f"it was applied: {REFUSALS[kind]}")
    return Finding(kind, PASS, f"not applied: {REFUSALS[kind]}")
