# SPDX-License-Identifier: Apache-2.0
r"""Defines what every model of an arm offers, and the terms of the equations of motion (2).

.. math::
    M(q,\delta)\begin{bmatrix}\ddot q\\ \ddot\delta\end{bmatrix}
    + \begin{bmatrix}f_1\\f_2\end{bmatrix}
    + \begin{bmatrix}C_1\dot\delta\\C_2\dot\delta\end{bmatrix}
    + \begin{bmatrix}K_1\delta\\K_2\delta\end{bmatrix}
    = \begin{bmatrix}u\\0\end{bmatrix} \qquad (2)
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from .. import registry
from ..errors import ModelError, check_shape
from ..kernels import vectors
from ..singular_perturbation import slow_torque


class Terms(NamedTuple):
    """Terms of (2) at one state, for n joints and m modal coordinates.

    Attributes
    ----------
    M : ndarray, shape (n + m, n + m)
        Mass matrix.
    f1, f2 : ndarray, shape (n,), (m,)
        Coriolis, centrifugal, gravitational and friction terms.
    C1, C2 : ndarray, shape (n, m), (m, m)
        Factors of the deflection rates; structural damping is in C2.
    K1, K2 : ndarray, shape (n, m), (m, m)
        Factors of the deflections; K2 contains the elastic and the centrifugal stiffness.
    """

    M: np.ndarray
    f1: np.ndarray
    f2: np.ndarray
    C1: np.ndarray
    C2: np.ndarray
    K1: np.ndarray
    K2: np.ndarray

    @property
    def n(self):
        """Number of joints."""
        return self.f1.size

    @property
    def H(self):
        """Inverse of the mass matrix, (3)."""
        return np.linalg.inv(self.M)

    def partition(self):
        """H11, H12, H21, H22 of (3)."""
        n, H = self.n, self.H
        return H[:n, :n], H[:n, n:], H[n:, :n], H[n:, n:]


class ArmModel(ABC):
    """A model of an arm: equations of motion, kinematics of the tip, energy.

    The vectors are q (n,) [rad] and delta (m,) [m for bending, rad for twist]; the state of the integrators
    is (q, delta, qd, delta_d).
    """

    def __init__(self, arm):
        self.arm = arm
        #: The arm whose loads the mode shapes follow from, and the factor of its payload: see `with_payload`.
        self.origin = arm, 1.0
        #: Models that `fuller` has made, with its arguments as keys.
        self._fuller = {}
        self.joint_names = arm.joint_names
        self.mode_names = arm.mode_names

    @property
    def n_joints(self):
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def n_modes(self):
        """Number of modal coordinates m."""
        return len(self.mode_names)

    #: Whether M without deflections, and K1, are the same in all states.
    same_inertia = False

    @abstractmethod
    def terms(self, q, qd, delta=None, delta_d=None):
        """Terms of (2).

        Without deflections, they are the paper's control model: a) H does not depend on the deflections, b) there are
        no products of deflections, so C1 and K1 depend only on the joints.

        Returns
        -------
        Terms
        """

    def terms_along(self, motions):
        """`Terms` at k states of the straight arm; each array has a leading axis of length k.

        Parameters
        ----------
        motions : ndarray, shape (k, 3, n)
            Positions [rad], velocities [rad/s] and accelerations of the joints; the accelerations are not used.
        """
        each = [self.terms(motion[0], motion[1]) for motion in motions]
        return Terms(*map(np.array, zip(*each, strict=True)))

    def mass_matrix(self, q, delta=None):
        """M of (2), shape (n + m, n + m); that of the straight arm if no deflections are given."""
        none = np.zeros(self.n_joints), None if delta is None else np.zeros(self.n_modes)
        return self.terms(q, none[0], delta, none[1]).M

    def inverse_dynamics(self, q, qd, qdd, delta, delta_d, delta_dd):
        """Generalised forces (joint torque, modal force) of a motion, friction included; shape (n + m,).

        For a free motion the modal part is zero.
        """
        t = self.terms(q, qd, delta, delta_d)
        out = t.M @ np.concatenate([qdd, delta_dd])
        out[: self.n_joints] += t.f1 + t.C1 @ delta_d + t.K1 @ delta
        out[self.n_joints :] += t.f2 + t.C2 @ delta_d + t.K2 @ delta
        return out

    def slow_torque(self, q, qd, acceleration):
        """Torque (n,) that gives the slow subsystem (10) an acceleration at q, qd, (n,) each [N m].

        As `singular_perturbation.slow_torque` with the `terms` at this state. Models may skip terms that are not
        needed.
        """
        return slow_torque(self.terms(q, qd), acceleration)

    @abstractmethod
    def kinetic_energy(self, q, qd, delta, delta_d):
        """Kinetic energy [J]."""

    @abstractmethod
    def potential_energy(self, q, delta):
        """Elastic and gravitational energy [J]."""

    @abstractmethod
    def tip_position(self, q, delta):
        """Position of the last link's tip in the base frame, shape (3,) [m]."""

    @abstractmethod
    def tip_velocity(self, q, qd, delta, delta_d):
        """Velocity of the last link's tip in the base frame, shape (3,) [m/s]."""

    @abstractmethod
    def tip_deflection(self, delta, link=None):
        """Deflection of a link's tip (default: the last link's) along y and z of its base frame, shape (2,) [m]."""

    @abstractmethod
    def mode_shapes(self, link, direction):
        """`beam.ModeShapes` of a link in a direction."""

    def friction_table(self):
        """Friction of the joints, as an argument of the integrators: viscous, Coulomb, smoothing speed; shape (n, 3).

        The equations of motion contain the Stribeck part, and the part that grows with the transmitted torque.
        """
        return self._friction.copy()

    @cached_property
    def _friction(self):
        frictions = [joint.friction for joint in self.arm.joints]
        return np.array([[f.viscous, f.coulomb, f.smoothing] for f in frictions])

    @abstractmethod
    def stepper(self, method):
        """Compiled fixed-step integrator.

        Parameters
        ----------
        method : Tableau or None
            An explicit Runge-Kutta method; None: the implicit one, which damps stiff modes.

        Returns
        -------
        Stepper
        """

    def driven_stepper(self, method):
        """As `stepper`, with joint accelerations in place of torque; None if the model has no such integrator."""
        return None

    def lockable_stepper(self, method):
        """As `stepper`, with `Stepper.lock`, for brakes.

        `method` is that of `stepper`.

        Raises
        ------
        ModelError
            If the model can't lock joints.
        """
        raise ModelError(
            "can't lock joints",
            field=f"model {self.arm.model}",
            hint="take safe_action damp or zero, or model chain",
        )

    @property
    def payload_scale(self):
        """Payload relative to that of the arm whose loads the mode shapes follow from [-]."""
        return self.origin[1]

    def _carrying(self, scale, model):
        """Set the origin of the `model` that `with_payload` made, and return it."""
        arm, already = self.origin
        model.origin = arm, already * scale
        return model

    def with_payload(self, scale):
        """The same arm in the same mode shapes, with its payload's mass and inertia scaled.

        Parameters
        ----------
        scale : float
            0: no payload. The payload's centre of mass stays where it is.

        Returns
        -------
        ArmModel
            Of the same class.

        Raises
        ------
        ModelError
            If the model can't take another payload.
        """
        problem = "takes no other payload than its arm file's"
        raise ModelError(problem, field=f"model {self.arm.model}")

    def fuller(self, modes, stiffens=False, finite_slope=False):
        """A more detailed model of the same arm, kept for later calls; the model itself if there is nothing to add.

        Parameters
        ----------
        modes : int
            Number in every flexible direction; as many as possible if fewer frequencies were measured.
        stiffens, finite_slope : bool
            Whether links keep their length, and whether their slopes may be large, see `levels`; for a chain only.

        Returns
        -------
        ArmModel
            With the same payload.
        """
        arm, scale = self.origin
        wanted = modes, stiffens or finite_slope, finite_slope
        if wanted not in self._fuller:
            more = arm.fuller(*wanted)
            self._fuller[wanted] = self if more == arm else made(more, scale)
        return self._fuller[wanted]

    def friction(self, qd, delta=None, delta_d=None):
        """Friction torque of the joints, shape (n,) [N m], see `Friction`.

        If the deflections `delta` and `delta_d` are not given, the part that grows with the transmitted torque is left
        out.
        """
        viscous, coulomb, smoothing = self._friction.T
        return viscous * qd + coulomb * np.tanh(qd / smoothing)

    def derivative(self, state, torque):
        """Time derivative of the state (q, delta, qd, delta_d) in the form (6), ready for scipy.

        Parameters
        ----------
        state : ndarray, shape (2 (n + m),)
        torque : ndarray, shape (n,)

        Returns
        -------
        ndarray, shape (2 (n + m),)

        Raises
        ------
        ShapeError
            For a state of another length.
        """
        n, m = self.n_joints, self.n_modes
        check_shape(state, (2 * (n + m),), "state")
        q, delta, qd, delta_d = np.split(np.asarray(state, float), [n, n + m, 2 * n + m])
        t = self.terms(q, qd, delta, delta_d)
        force = np.concatenate(
            [
                np.asarray(torque, float) - t.f1 - t.C1 @ delta_d - t.K1 @ delta,
                -t.f2 - t.C2 @ delta_d - t.K2 @ delta,
            ]
        )
        return np.concatenate([qd, delta_d, np.linalg.solve(t.M, force)])

    def energy(self, state):
        """Total energy of a state [J]."""
        n, m = self.n_joints, self.n_modes
        q, delta, qd, delta_d = np.split(np.asarray(state, float), [n, n + m, 2 * n + m])
        return self.kinetic_energy(q, qd, delta, delta_d) + self.potential_energy(q, delta)

    def stiffness_matrix(self):
        """Elastic stiffness of the modes for small deflections, shape (m, m)."""
        n = self.n_joints
        return self.terms(np.zeros(n), np.zeros(n)).K2

    def normal_modes(self, q=None, locked=False):
        """Undamped natural modes of the straight arm at rest; gravity is left out.

        Parameters
        ----------
        q : ndarray, shape (n,), optional
            Joint angles; zero if not given.
        locked : bool
            True: the joints are locked. False: they are free; rigid-body motions, of frequency zero, are left out.

        Returns
        -------
        omega : ndarray, shape (m,)
            Ascending [rad/s].
        shapes : ndarray, shape (n + m, m)
            (q, delta) of each mode, of unit modal mass.
        """
        n, m = self.n_joints, self.n_modes
        q = np.zeros(n) if q is None else np.asarray(q, float)
        M, K = self.terms(q, np.zeros(n)).M, self.stiffness_matrix()
        give = np.zeros((n, m))  # how the joints follow the modes
        if not locked:
            give = -np.linalg.solve(M[:n, :n], M[:n, n:])
        # With free joints: the modal inertia that remains when the joints follow the modes.
        mass = M[n:, n:] + M[n:, :n] @ give
        squares, vectors = eigh(K, 0.5 * (mass + mass.T)) if m else (np.zeros(0), np.zeros((0, 0)))
        return np.sqrt(np.maximum(squares, 0.0)), np.vstack([give @ vectors, vectors])

    def frequencies(self, q=None, locked=False):
        """Natural frequencies of `normal_modes` [rad/s]."""
        return self.normal_modes(q, locked)[0]

    def without_play(self):
        """The same model with all play closed; the model itself if it has no play."""
        return self

    def transmission_rates(self):
        """Rates of the fastest of all transmissions and of the fastest one with play [rad/s]; 0 if there is none."""
        return 0.0, 0.0

    def static_deflection(self, q):
        """Deflections at which the arm rests under gravity with its joints held, shape (m,).

        Raises
        ------
        ModelError
            If no such deflections are found near the straight arm: it buckles or folds under its own weight.
        """
        return self._rest(q)

    def _rest(self, q, replace_forces=None, start=None):
        """`static_deflection`; ``replace_forces(delta, force, K2)`` may change forces and their derivative in place."""
        n, m = self.n_joints, self.n_modes
        delta, rest = np.zeros(m) if start is None else start, np.zeros(n)
        if not m or not any(self.arm.gravity):
            return delta
        for _ in range(50):
            t = self.terms(q, rest, delta, np.zeros(m))
            force = t.f2 + t.K2 @ delta
            if replace_forces is not None:
                replace_forces(delta, force, t.K2)
            change = np.linalg.solve(t.K2, -force)
            delta = delta + change
            if np.abs(change).max() <= 1e-12 * max(np.abs(delta).max(), 1e-12):
                return delta
        raise ModelError(
            "is no place of rest: under gravity the arm buckles or folds there",
            field=f"joint position of {self.arm.name}",
            value=[float(angle) for angle in q],
        )


@dataclass(frozen=True)
class Tableau:
    """An explicit Runge-Kutta method: Butcher coefficients (p, p), (p,) and (p,)."""

    A: np.ndarray
    weights: np.ndarray
    nodes: np.ndarray


class Stepper:
    """A compiled fixed-step integrator of one arm; see `ArmModel.stepper`.

    It releases the interpreter's lock while it runs; each thread needs a stepper of its own.

    Parameters
    ----------
    model : ArmModel
    step, trajectory : callable
        Compiled functions of `kernels`.
    arguments : tuple
        Their arguments after the number of substeps, except friction and data.
    data : object
        Argument of the right-hand side.
    lock : callable, optional
        ``lock(mask)``: hold the joints of a boolean mask (n,) where they are, until the next call. These joints must be
        at rest, with zero torque.

    Attributes
    ----------
    friction : ndarray, shape (n, 3)
        Used if a call gives none.
    """

    def __init__(self, model, step, trajectory, arguments, data, lock=None):
        self._step, self._trajectory = step, trajectory
        self._arguments, self._data = arguments, data
        self._none = np.zeros(model.n_joints)
        self.lock = lock
        self.friction = model.friction_table()

    def __call__(self, state, torque, step, substeps=1, friction=None, change=None):
        """Advance a state in place.

        Parameters
        ----------
        state : ndarray, shape (2 (n + m),)
            (q, delta, qd, delta_d); overwritten.
        torque : ndarray, shape (n,)
            At the start [N m].
        step : float
            Length of a substep [s].
        substeps : int
            Number of substeps.
        friction : ndarray, shape (n, 3), optional
            As `ArmModel.friction_table`, which is the default.
        change : ndarray, shape (n,), optional
            Change of the torque from start to end, linear in time; zero if not given [N m].
        """
        change = self._none if change is None else change
        friction = self.friction if friction is None else friction
        self._step(state, torque, change, step, substeps, *self._arguments, friction, self._data)

    def trajectory(self, states, starts, ends, step, substeps=1, friction=None):
        """Fill ``states[1:]`` from ``states[0]`` in one compiled loop.

        Parameters
        ----------
        states : ndarray, shape (s + 1, 2 (n + m))
            Row k + 1 is `substeps` steps after row k.
        starts, ends : ndarray, shape (s, n)
            Torque at both ends of each interval, linear in between [N m].
        step, substeps, friction
            As for `__call__`.
        """
        friction = self.friction if friction is None else friction
        self._trajectory(
            states, starts, ends, step, substeps, *self._arguments, friction, self._data
        )


def explicit_stepper(module, method, data, model, lock=None):
    """`ArmModel.stepper` of a compiled module that has ``derivative`` and the integrators."""
    n, size = model.n_joints, 2 * (model.n_joints + model.n_modes)
    net, coefficients = np.zeros(n), (method.weights, method.nodes)
    if not np.tril(method.A, -2).any():
        below = np.concatenate([[0.0], np.diag(method.A, -1)])
        work = tuple(np.zeros(size) for _ in range(3))
        arguments = (below, *coefficients, work, net)
        functions = (module.low_storage, module.low_storage_trajectory)
        return Stepper(model, *functions, arguments, data, lock)
    arguments = (method.A, *coefficients, np.zeros((method.weights.size + 1, size)), net)
    functions = (module.runge_kutta, module.runge_kutta_trajectory)
    return Stepper(model, *functions, arguments, data, lock)


def build(arm):
    """The model that an arm file names, found through the entry points `flexarm.models`.

    Parameters
    ----------
    arm : Arm

    Returns
    -------
    ArmModel

    Raises
    ------
    UnknownComponentError
        If no installed package has a model of that name.
    ModelError
        If that model can't represent this arm.
    """
    return registry.find("flexarm.models", arm.model)(arm)


def copy(model):
    """Another model of the same arm in the same mode shapes: for another thread."""
    return made(*model.origin)


def made(arm, payload_scale):
    """The model of an arm with its payload scaled; `ArmModel.origin` has both arguments."""
    model = build(arm)
    return model if payload_scale == 1.0 else model.with_payload(payload_scale)


def rotation(rpy):
    """Fixed-axis roll, pitch, yaw, as in URDF; shape (3, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def about_axis(axis, angle):
    """Rotation about a unit vector, shape (3, 3)."""
    out = np.zeros((3, 3))
    vectors.about_axis(np.asarray(axis, float), angle, out)
    return out


def damping_matrix(M22, K, ratios):
    r"""Modal damping :math:`D = M_{22}\Psi\,\mathrm{diag}(2\zeta_i\omega_i)\,\Psi^T M_{22}` of the clamped modes.

    Parameters
    ----------
    M22, K : ndarray, shape (m, m)
        Modal mass and stiffness.
    ratios : sequence of float
        Damping ratios by ascending frequency; shorter than m: the last one repeats; empty: none.

    Returns
    -------
    ndarray, shape (m, m)

    Raises
    ------
    ModelError
        If the stiffness is not positive definite.
    """
    m = K.shape[0]
    if not len(ratios):
        return np.zeros((m, m))
    zeta = np.array([ratios[min(i, len(ratios) - 1)] for i in range(m)])
    squares, psi = eigh(K, M22)
    if squares.min() <= 0.0:
        problem, value = "is an eigenvalue that is not positive", float(squares.min())
        raise ModelError(problem, field="modal stiffness", value=value)
    left = M22 @ psi
    D = left @ np.diag(2.0 * zeta * np.sqrt(squares)) @ left.T
    return 0.5 * (D + D.T)  # exactly symmetric: recorded terms keep equal entries as one constant
