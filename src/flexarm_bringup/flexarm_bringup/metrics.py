"""What is reported of a run: tracking, vibration, torque; from recorded samples, without ROS."""

from dataclasses import dataclass, fields

import numpy as np

from flexarm_dynamics.units import FOOT, POUND_FORCE_FOOT


@dataclass(frozen=True)
class Record:
    """Samples of a run, one row each; time zero is where the trajectory starts.

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
        """The same with one row in `every`."""
        return Record(*(getattr(self, f.name)[::every] for f in fields(self)))

    def tip_deflection(self, model):
        """Deflection of the tip, y = phi_e delta, of an arm of one link, shape (k,) [m]."""
        return self.amplitude @ _phi_tip(model)

    def tip_x(self, model):
        """End point along X0, (A9), actual and of the rigid arm on the reference, each (k,) [m]."""
        length, y = model.arm.links[0].length, self.tip_deflection(model)
        q = self.position[:, 0]
        return length * np.cos(q) - y * np.sin(q), length * np.cos(self.reference[:, 0])

    def tip_x_rate(self, model):
        """Its rate, (A10), actual and of the rigid arm on the reference, each (k,) [m/s]."""
        length, y = model.arm.links[0].length, self.tip_deflection(model)
        q, qd = self.position[:, 0], self.velocity[:, 0]
        actual = (-length * np.sin(q) - y * np.cos(q)) * qd
        actual -= (self.rate @ _phi_tip(model)) * np.sin(q)
        wanted = -length * np.sin(self.reference[:, 0]) * self.reference_velocity[:, 0]
        return actual, wanted


def _phi_tip(model):
    """Shapes along y of the one link at its tip, shape (m,)."""
    return model.mode_shapes(model.arm.links[0].name, "y")(1.0)


def case_study_metrics(record, model, settle=3.0, until=8.0):
    """The figures that the reference table of the case study has, in its units.

    Parameters
    ----------
    record : Record
    model : ArmModel
        Of one link.
    settle, until : float
        Window of the residual: from the trajectory's start [s].

    Returns
    -------
    dict
        Keys as in ``summary.json``.
    """
    inside = (record.time >= 0.0) & (record.time <= until + 1e-9)
    late = inside & (record.time >= settle - 1e-9)
    error = np.degrees(np.abs(record.reference - record.position)[:, 0])
    tip = record.tip_deflection(model) / FOOT
    return {
        "peak_joint_error_deg": float(error[inside].max()),
        "max_joint_error_after_3s_deg": float(error[late].max()),
        "residual_tip_rms_ft": float(np.sqrt(np.mean(tip[late] ** 2))),
        "peak_tip_deflection_ft": float(np.abs(tip[inside]).max()),
        "peak_torque_lbf_ft": {
            "slow": float(np.abs(record.slow_torque[inside]).max() / POUND_FORCE_FOOT),
            "fast": float(np.abs(record.fast_torque[inside]).max() / POUND_FORCE_FOOT),
            "total": float(np.abs(record.torque[inside]).max() / POUND_FORCE_FOOT),
        },
    }


def linear_metrics(model, law, q):
    """Frequencies, gains and poles of a composite design, at rest in configuration q.

    Parameters
    ----------
    model : ArmModel
        Of one link.
    law : CompositeControl
    q : ndarray, shape (n,)

    Returns
    -------
    dict
        Keys as in ``summary.json``; k_f in the paper's units, u_f = -k z_f.
    """
    from flexarm_dynamics import singular_perturbation as sp
    from flexarm_dynamics.units import POUND_FORCE

    terms = model.terms(q, np.zeros(model.n_joints))
    A2, B2 = sp.fast_subsystem(terms)
    open_loop, _ = sp.frequencies_and_damping(np.linalg.eigvals(A2))
    K = -law.fast.K_f
    closed, damping = sp.frequencies_and_damping(np.linalg.eigvals(A2 - B2 @ K))
    poles = np.linalg.eigvals(
        sp.full_order_matrix(terms, law.slow.kp, law.slow.kv, law.slow.B_inverse(terms), K)
    )
    poles = sorted(poles, key=lambda p: (abs(p), p.imag))
    return {
        "open_loop_frequencies_rad_s": open_loop.tolist(),
        "k_f": (K[0] / POUND_FORCE).tolist(),
        "closed_loop_frequencies_rad_s": closed.tolist(),
        "closed_loop_damping": damping.tolist(),
        "full_order_poles": [[float(p.real), float(p.imag)] for p in poles],
    }
