# SPDX-License-Identifier: Apache-2.0
"""Computes the metrics of a run from recorded samples: tracking, vibration, torque; without ROS.

The whole project has one definition of each of these two numbers:

peak error
    The largest value of `joint_error` over a window: how far the joint is from its reference.
residual vibration
    `residual_vibration` over `residual_window`: how much the tip still moves about its place of rest, by bending alone,
    beginning one second after a motion. The window is reported beside the number.
"""

from dataclasses import dataclass, fields

import numpy as np

from flexarm_dynamics import singular_perturbation as sp
from flexarm_dynamics.arm.encoders import encoder_rows, motors_at_rest
from flexarm_dynamics.arm.units import FOOT, POUND_FORCE, POUND_FORCE_FOOT


@dataclass(frozen=True)
class Record:
    """Samples of a run, one per row; time zero is the start of the trajectory.

    Attributes
    ----------
    time : ndarray, shape (k,)
        [s]
    reference, reference_velocity, position, velocity : ndarray, shape (k, n)
        [rad], [rad/s]
    amplitude, rate, quasi_steady : ndarray, shape (k, m)
        [m], [m/s]
    slow_torque, fast_torque, torque : ndarray, shape (k, n)
        [N m]
    """

    time: np.ndarray
    reference: np.ndarray
    reference_velocity: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    amplitude: np.ndarray
    rate: np.ndarray
    quasi_steady: np.ndarray
    slow_torque: np.ndarray
    fast_torque: np.ndarray
    torque: np.ndarray

    def thinned(self, every):
        """The same record with one row of `every`."""
        return type(self)(*(getattr(self, f.name)[::every] for f in fields(self)))

    def tip_deflection(self, model):
        """Deflection of the tip, y = phi_e delta, of an arm of one link, shape (k,) [m]."""
        return self.amplitude @ _phi_tip(model)

    def tip_x(self, model):
        """End point along X0, (A9), actual and of the rigid arm on the reference, each (k,) [m]."""
        length, y = model.arm.links[0].length, self.tip_deflection(model)
        q = self.position[:, 0]
        return length * np.cos(q) - y * np.sin(q), length * np.cos(self.reference[:, 0])

    def tip_x_rate(self, model):
        """Rate of `tip_x`, (A10), actual and of the rigid arm on the reference, each (k,) [m/s]."""
        length, y = model.arm.links[0].length, self.tip_deflection(model)
        q, qd = self.position[:, 0], self.velocity[:, 0]
        actual = (-length * np.sin(q) - y * np.cos(q)) * qd
        actual -= (self.rate @ _phi_tip(model)) * np.sin(q)
        wanted = -length * np.sin(self.reference[:, 0]) * self.reference_velocity[:, 0]
        return actual, wanted


@dataclass(frozen=True)
class SimulatedRecord(Record):
    """A record with values that only the simulation knows.

    Attributes
    ----------
    plant_position : ndarray, shape (k, n)
        The simulated arm's joint angles [rad].
    plant_amplitude : ndarray, shape (k, modes of the plant)
        Its true modal amplitudes [m, rad].
    saturated : ndarray of bool, shape (k,)
        Whether the torque was at a limit.
    state : ndarray of int, shape (k,)
        The controller's state, as numbered by `Supervisor`.
    """

    plant_position: np.ndarray
    plant_amplitude: np.ndarray
    saturated: np.ndarray
    state: np.ndarray


def _phi_tip(model):
    """Shapes along y of the one link at its tip, shape (m,)."""
    return model.mode_shapes(model.arm.links[0].name, "y")(1.0)


#: Time after the motion's end from which residual vibration is judged [s]: see `residual_window`.
SETTLE = 1.0
#: Time after the motion's end until which it is judged at most [s].
MAX_REST = 6.0
#: A window that waits for `SETTLE` is at least this long [s].
MIN_WINDOW = 0.5


def joint_error(reference, position):
    """Distance of the joints from their references, of the same shape [rad]."""
    return np.abs(reference - position)


def residual_window(rest, settle=SETTLE):
    """Window in which residual vibration is judged, for a rest of `rest` seconds after a motion.

    Right after a motion the slow control is still removing its tracking error, and the torque for this bends the arm.
    That bending is not vibration, but an rms over the whole rest includes it. On the paper's arm it hides that the
    composite control leaves twenty times less vibration than the slow control alone. The window therefore starts one
    second after the motion: 2.5 time constants of the case study's slow poles. It ends six seconds after the motion, so
    runs of different length can be compared. For the case study's motion of 2 s this is the window 3 to 8 s after the
    start.

    A rest too short for that is judged from the motion's end: the number then contains the slow settling, as its window
    shows.

    Returns start and end, counted from the motion's end [s]; `settle` is the start if the rest is long enough [s].
    """
    end = min(rest, MAX_REST)
    return (settle if end >= settle + MIN_WINDOW - 1e-9 else 0.0), end


def residual_vibration(bending, at_rest=None):
    """Rms distance of the tip from its place of rest, as far as bending moves it [m].

    Parameters
    ----------
    bending : ndarray, shape (k, ...)
        Displacement of the tip by the deflections, over a window of k samples [m].
    at_rest : array_like, optional
        Its value at rest [m]. A simulation knows it: the static deflection of the plant. If not given, it is the mean
        over the window: otherwise static errors of gauges and model would count as vibration on a real arm.
    """
    away = bending - (bending.mean(axis=0) if at_rest is None else at_rest)
    return float(np.sqrt(np.sum(away**2) / len(away)))


def case_study_metrics(record, model, settle=3.0, until=8.0):
    """The metrics of a `record` in the case study's reference table, in its units; keys as in ``summary.json``.

    `settle` and `until` are the `residual_window` of the motion of 2 s, counted from the trajectory's start [s]. Peaks
    are over 0 to `until`.
    """
    inside = (record.time >= 0.0) & (record.time <= until + 1e-9)
    late = inside & (record.time >= settle - 1e-9)
    error = np.degrees(joint_error(record.reference, record.position)[:, 0])
    tip = record.tip_deflection(model) / FOOT
    return {
        "peak_joint_error_deg": float(error[inside].max()),
        "max_joint_error_after_3s_deg": float(error[late].max()),
        "residual_tip_rms_ft": residual_vibration(tip[late], 0.0),
        "peak_tip_deflection_ft": float(np.abs(tip[inside]).max()),
        "peak_torque_lbf_ft": {
            "slow": float(np.abs(record.slow_torque[inside]).max() / POUND_FORCE_FOOT),
            "fast": float(np.abs(record.fast_torque[inside]).max() / POUND_FORCE_FOOT),
            "total": float(np.abs(record.torque[inside]).max() / POUND_FORCE_FOOT),
        },
    }


#: Settling times below this are reported as this [s].
MIN_SETTLING = 0.05
#: Static deflections are computed at this interval along the motion, and interpolated linearly between [s].
SAG_INTERVAL = 0.01
#: Length of the record's end over which the final tip error is judged [s].
FINAL = 0.5


def tracking_metrics(record, model, plant_model, end, window=3.0, tolerance=1e-3, settle=SETTLE):
    """How well an arm followed a motion, and how it came to rest; for any number of joints and links.

    The tip's error is its distance from the tip of the equivalent rigid arm at the reference. Under gravity the arm
    sags even at rest: the errors `about_sag` are therefore distances from the tip of the statically bent arm at the
    reference, and settling is judged by them.

    Parameters
    ----------
    record : SimulatedRecord
    model, plant_model : ArmModel
        The arm as the controller knows it, and as it is simulated.
    end : float
        Time at which the motion ends [s].
    window : float
        Time for which the arm rests after the motion [s].
    tolerance : float
        Tolerance of the tip, for the settling time [m].
    settle : float
        Start of the residual vibration's window: see `residual_window` [s].

    Returns
    -------
    dict
        Numbers, lists with one number per joint, and None for what the record does not reach; ready for JSON.

        ``peak_joint_error_rad``, ``rms_joint_error_rad``
            `joint_error` to the true joint angle, of motor or link as its encoder measures it, per joint, from the
            motion's start to the record's end.
        ``peak_tip_error_mm``, ``rms_tip_error_mm``
            Error of the tip, as above; under gravity also ``…_about_sag_mm``, and ``static_sag_mm`` of the arm at rest
            at the motion's end.
        ``residual_tip_rms_mm``, ``residual_window_s``
            `residual_vibration` about the static deflection, and its window's start and end after the motion.
        ``final_tip_error_mm``
            The tip's largest error over the record's last `FINAL`: it is large also if the loop oscillates.
        ``settling_time_s``
            From the motion's end until the tip's error stays below the tolerance, at least `MIN_SETTLING`.
        ``peak_torque_Nm``, ``rms_torque_Nm``
            As sent, per joint.
        ``saturation_share``
            Fraction of the samples with a torque at its limit.
        ``peak_deflection_mm``, ``case_study``
            For arms of one link in a plane: the tip's own deflection y, and `case_study_metrics` if the record reaches
            its window.
    """
    if record.time[-1] >= 0.0:  # otherwise the arm was lost before the motion began
        record = _from(record, 0.0)
    slack = encoder_rows(plant_model)[:, plant_model.n_joints :]
    error = joint_error(record.reference, record.plant_position + record.plant_amplitude @ slack.T)
    tip = tip_path(plant_model, record.plant_position, record.plant_amplitude)
    wanted = tip_path(model, record.reference, np.zeros((record.time.size, model.n_modes)))
    found = {
        "peak_joint_error_rad": error.max(0).tolist(),
        "rms_joint_error_rad": _rms(error, 0).tolist(),
        **_tip_errors("mm", distance := np.linalg.norm(tip - wanted, axis=1)),
    }
    if any(plant_model.arm.gravity):
        at_rest = _sagging_path(plant_model, record)
        distance = np.linalg.norm(tip - at_rest, axis=1)
        found["static_sag_mm"] = 1e3 * float(np.linalg.norm(at_rest[-1] - wanted[-1]))
        found |= _tip_errors("about_sag_mm", distance)
    span = residual_window(window, settle)
    residual = _residual(record, plant_model, tip, end, span)
    found["residual_tip_rms_mm"] = residual
    found["residual_window_s"] = None if residual is None else list(span)
    last = record.time >= record.time[-1] - FINAL - 1e-9
    found["final_tip_error_mm"] = 1e3 * float(distance[last].max())
    found["settling_time_s"] = _settling_time(record.time, distance, end, tolerance)
    found["peak_torque_Nm"] = np.abs(record.torque).max(0).tolist()
    found["rms_torque_Nm"] = _rms(record.torque, 0).tolist()
    found["saturation_share"] = float(np.mean(record.saturated))
    if len(model.arm.links) == 1 and set(model.arm.links[0].flexible) == {"y"}:
        phi = _phi_tip(plant_model)  # deflections of transmissions come later; they bend no link
        deflection = record.plant_amplitude[:, : phi.size] @ phi
        found["peak_deflection_mm"] = 1e3 * float(np.abs(deflection).max())
        long_enough = record.time[-1] >= 8.0 - 1e-9
        found["case_study"] = case_study_metrics(record, model) if long_enough else None
    return found


def _from(record, start):
    """The part of a record from a time on [s]."""
    kept = record.time >= start - 1e-9
    return type(record)(*(getattr(record, f.name)[kept] for f in fields(record)))


def _rms(values, axis=None):
    return np.sqrt(np.mean(np.square(values), axis))


def _tip_errors(unit, distance):
    return {
        f"peak_tip_error_{unit}": 1e3 * float(distance.max()),
        f"rms_tip_error_{unit}": 1e3 * float(_rms(distance)),
    }


def tip_path(model, position, amplitude):
    """Path of the tip for joint `position` (k, n) and modal `amplitude` (k, m), shape (k, 3) [m].

    Rows that repeat the one before are not computed again.
    """
    rows, out = np.hstack([position, amplitude]), np.empty((len(position), 3))
    new = np.append(True, (rows[1:] != rows[:-1]).any(1))
    for k in np.flatnonzero(new):
        out[k] = model.tip_position(position[k], amplitude[k])
    return out[np.maximum.accumulate(np.where(new, np.arange(len(out)), 0))]


def _sagging_path(model, record):
    """The tip of the statically bent arm along the reference, shape (k, 3) [m]."""
    time, reference = record.time, record.reference
    knots = np.searchsorted(time, np.arange(time[0], time[-1], SAG_INTERVAL) - 1e-9)
    knots = np.unique(np.append(knots, len(time) - 1))
    amplitude, before = [], None
    for k in knots:
        if before is None or (reference[k] != before).any():
            before, bent = reference[k], motors_at_rest(model, reference[k])[1]
        amplitude.append(bent)
    amplitude = np.array(amplitude).reshape(len(knots), model.n_modes)
    columns = [np.interp(time, time[knots], column) for column in amplitude.T]
    amplitude = np.array(columns).reshape(model.n_modes, len(time)).T
    slack = encoder_rows(model)[:, model.n_joints :]
    return tip_path(model, reference - amplitude @ slack.T, amplitude)


def _residual(record, model, tip, end, span):
    """Residual vibration about the plant's static deflection [mm]; None for a record that does not reach the window."""
    start, stop = (end + s for s in span)
    late = (record.time >= start - 1e-9) & (record.time <= stop + 1e-9)
    if record.time[-1] < stop - 1e-6 or not late.any():
        return None
    position = record.plant_position[late]
    straight = np.zeros((len(position), model.n_modes))
    middle = position.mean(0)
    bent = model.tip_position(middle, model.static_deflection(middle))
    static = bent - model.tip_position(middle, straight[0])
    return 1e3 * residual_vibration(tip[late] - tip_path(model, position, straight), static)


def _settling_time(time, distance, end, tolerance):
    """Time from the end until the tip stays within the tolerance [s]; None if it does not."""
    outside = np.flatnonzero((time >= end - 1e-9) & (distance > tolerance))
    if time[-1] < end - 1e-9 or (outside.size and outside[-1] == len(time) - 1):
        return None
    settled = float(time[outside[-1] + 1] - end) if outside.size else 0.0
    return max(settled, MIN_SETTLING)


def linear_metrics(model, law, q):
    """Frequencies, gains and poles of a composite `law` for an arm of one link at rest in configuration q.

    Keys as in ``summary.json``; k_f in the paper's units and with its sign, u_f = -k_f z_f.
    """
    terms = model.terms(q, np.zeros(model.n_joints))
    A2, B2 = sp.fast_subsystem(terms)
    open_loop, _ = sp.frequencies_and_damping(np.linalg.eigvals(A2))
    K_f = law.fast.K_f
    closed, damping = sp.frequencies_and_damping(np.linalg.eigvals(A2 + B2 @ K_f))
    poles = np.linalg.eigvals(
        sp.full_order_matrix(terms, law.slow.kp, law.slow.kv, law.slow.B_inverse(terms), K_f)
    )
    poles = sorted(poles, key=lambda p: (abs(p), p.imag))
    return {
        "open_loop_frequencies_rad_s": open_loop.tolist(),
        "k_f": (-K_f[0] / POUND_FORCE).tolist(),
        "closed_loop_frequencies_rad_s": closed.tolist(),
        "closed_loop_damping": damping.tolist(),
        "full_order_poles": [[float(p.real), float(p.imag)] for p in poles],
    }
