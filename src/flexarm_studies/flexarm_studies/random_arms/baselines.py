# SPDX-License-Identifier: Apache-2.0
r"""Baselines for a random arm, tuned on the same information that a design has: arm file, uncertain set, rate, delay.

The uncertain set is the arm at both ends of its motion with `PAYLOADS` times its payload, linearised, sampled at
`RATE`, its torque one sample late. A gain is judged by the poles of all these loops at once, of the part of the arm
that torque reaches. With poles :math:`p` per second and the first locked frequency :math:`\omega_1` it minimises

.. math:: \max_{cases,\,p}\frac{\mathrm{Re}\,p}{\omega_1} + c\,\overline{\max(\mathrm{Re}\,p/\omega_1,\,-1)},

the second term a tie-break (c = `TIE`): of two gains with the same slowest pole, the one that damps the others better.

- Joint PID, with the weight and friction of the rigid arm along the reference, and each joint's own inertia times its
  acceleration. The integral is there without gravity, too: a PD alone sticks where friction lets it. Its reference is
  shaped (ZVD or EI) for the modes that ring under it at the motion's end.
- Full-state LQR: `comparison.baselines.FullStateLqr`, states from a Kalman filter.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import null_space, solve_discrete_are

from flexarm_control.motions import shapers
from flexarm_control.trajectory import specs
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.linear import linear_plant, sampled
from flexarm_dynamics.models import model
from flexarm_dynamics.singular_perturbation import frequencies_and_damping

from ..comparison.baselines import Baseline, FullStateLqr, JointPid
from ..comparison.controllers import DAMPED, IDLE, MAX_INTEGRAL, SHAPED, UNWATCHED
from ..comparison.tuning import Free, tune
from .trial import Setup

#: Factors of the payload in the uncertain set [-].
PAYLOADS = (0.7, 1.0, 1.3)
#: Samples per second [Hz].
RATE = 500.0
#: Evaluations of poles per tuning.
BUDGET = 400
#: Weight of the tie-break [-].
TIE = 0.05
#: A mode with less of the largest mode's controllability is out of the torques' reach [-].
REACHED = 1e-7


@dataclass(frozen=True)
class Linear:
    """An arm at rest, linearised, of which only the part is kept that torque reaches.

    Attributes
    ----------
    Phi, Gamma : ndarray, shape (N, N), (N, n)
        Of one sample, the torque held.
    X : ndarray, shape (2 (n + m), N)
        Orthonormal: the state is X times this part's.
    """

    Phi: np.ndarray
    Gamma: np.ndarray
    X: np.ndarray


def linear(arm_model, q, rate=RATE):
    """The `Linear` of a model in configuration q."""
    A, B = linear_plant(arm_model, q, coulomb=False)
    _, left = np.linalg.eig(A.T)
    reach = np.linalg.norm(left.T @ B, axis=1)
    unreached = left[:, reach < REACHED * reach.max()]
    X = np.eye(len(A))
    if unreached.size:
        X = null_space(np.vstack([unreached.real.T, unreached.imag.T]), rcond=1e-9)
    Phi, Gamma = sampled(X.T @ A @ X, X.T @ B, 1.0 / rate)
    return Linear(Phi, Gamma, X)


class Task:
    """A random arm with what its baselines are tuned for.

    Attributes
    ----------
    model : ArmModel
    profile : Motion
    ends : tuple
        Start and end of the motion, each (n,) [rad].
    omega : float
        First frequency with joints locked [rad/s].
    """

    def __init__(self, case):
        self.case, self.model = case, model.build(case.read())
        family, settings = specs.parse(case.motion)
        still = np.zeros(self.model.n_joints)
        self.profile = specs.motion(family, settings, self.model, still)
        self.ends = self.profile.position(0.0), self.profile.position(self.profile.duration)
        self.omega = 2.0 * np.pi / case.period
        masses = [np.diag(self.model.terms(q, still).M)[: still.size] for q in self.ends]
        self.inertia = np.mean(masses, axis=0)

    @cached_property
    def plants(self):
        """The uncertain set: a list of `Linear`."""
        arms = [model.build(scaled(self.model.arm, payload)) for payload in PAYLOADS]
        return [linear(arm, q) for arm in arms for q in self.ends]

    @cached_property
    def nominal(self):
        """The `Linear` of the arm at the motion's end."""
        return linear(self.model, self.ends[1])

    @cached_property
    def pid(self):
        """Tuned gains of the joints' PID, and its slowest pole."""
        return pid(self)

    def worst(self, K, integral=None):
        """What is minimised of the feedback u = -K x; and its largest pole of all, in units of omega [-]."""
        parts = [poles(plant, K, integral).real / self.omega for plant in self.plants]
        real = np.concatenate(parts)
        return float(real.max() + TIE * np.maximum(real, -1.0).mean()), float(real.max())


def poles(plant, K, integral=None, rate=RATE):
    """Poles of a `Linear` under u = -K x - the integral of `integral` (n,) times the joints' angles, one sample late.

    In continuous time [1/s].
    """
    Phi, Gamma, X = plant.Phi, plant.Gamma, plant.X
    N, n = Gamma.shape
    extra = 0 if integral is None else n
    # x, the torque on its way, and the integral's torque
    loop = np.zeros((N + n + extra,) * 2)
    loop[:N, :N], loop[:N, N : N + n], loop[N : N + n, :N] = Phi, Gamma, -K @ X
    if extra:
        loop[N + n :, :N] = -np.diag(integral) @ X[:n] / rate
        loop[N + n :, N + n :] = np.eye(n)
        loop[N : N + n] += loop[N + n :]
    z = np.linalg.eigvals(loop).astype(complex)
    return rate * np.log(np.where(np.abs(z) > 1e-12, z, 1e-12))


# PID with a shaper -----------------------------------------------------------------------------


class Pid(JointPid):
    """`JointPid` with weight, friction and centrifugal torque of the rigid arm along the reference."""

    def _along(self, reference):
        return self.model.terms(reference.position, reference.velocity).f1.copy()


def _pid_free(task):
    w = task.omega
    free = [
        Free("w [rad/s]", 0.05 * w, 5.0 * w, 0.5 * w, log=True),
        Free("zeta", 0.1, 5.0, 1.0, log=True),
        Free("kappa", 0.005, 0.3, 0.1, log=True),
    ]
    if task.model.n_joints > 1:
        free.append(Free("w_last/w_first", 0.2, 20.0, 1.0, log=True))
        free.append(Free("zeta_last/zeta_first", 1e-2, 10.0, 1.0, log=True))
    return free


def pid_gains(task, values):
    """Gains of `JointPid` from tuned values: p = m w^2, d = 2 zeta m w, i = kappa m w^3 of each joint's inertia m."""
    w, zeta, kappa, *ratio = values
    outwards = np.linspace(0.0, 1.0, task.model.n_joints)
    faster, stiffer = ratio or (1.0, 1.0)
    w, zeta = w * faster**outwards, zeta * stiffer**outwards
    m, limit = task.inertia, task.model.arm.torque_limits
    return {
        "p": m * w**2,
        "i": kappa * m * w**3,
        "d": 2.0 * zeta * m * w,
        "i_clamp": MAX_INTEGRAL * limit,
        "velocity": 0.0 * m,
        "acceleration": m,
    }


def pid(task):
    """Tuned gains of the joints' PID; refused where none are stable on the whole uncertain set."""

    def judged(values):
        law = Pid(task.model, pid_gains(task, values))
        return task.worst(law.K, law.gains["i"])

    values, _, _ = tune(
        lambda v: judged(v)[0], _pid_free(task), BUDGET, screen=lambda v: judged(v)[0]
    )
    slowest = judged(values)[1]
    if slowest >= 0.0:
        raise DesignError(
            "no gains of the joints' PID are stable on the whole uncertain set",
            field=task.case.name,
        )
    return pid_gains(task, values), slowest


def shaped(task, gains, kind):
    """The motion, shaped for the modes that ring under PID `gains` at its end; as it is where none rings."""
    law = Pid(task.model, gains)
    found = poles(task.nominal, law.K, gains["i"])
    omega, zeta = frequencies_and_damping(found)
    rings = (zeta < DAMPED) & (omega < 0.5 * np.pi * RATE)
    profile = task.profile
    if rings.any():
        train = shapers.for_modes(
            kind, omega[rings][:SHAPED], np.maximum(zeta[rings][:SHAPED], 0.0)
        )
        profile = train.apply(profile)
    return specs.sampled(profile, task.model)


def shaped_pid(case, kind):
    """`Setup` of the joints' PID with a shaper."""
    task = task_of(case)
    gains = task.pid[0]
    motion = shaped(task, gains, kind)
    given = IDLE | UNWATCHED | {"observer.type": "filtered_derivative", "rate": RATE}
    return Setup(given, lambda arm: Pid(arm, gains), lambda arm: motion)


# Full-state LQR ----------------------------------------------------------------------------------


class Lqr(FullStateLqr):
    """`FullStateLqr` with a gain that was found elsewhere."""

    def __init__(self, arm_model, K):
        Baseline.__init__(self, arm_model)
        self.K, self._feedforward = K, 1.0


def _lqr_free(task):
    w = task.omega
    reach = sum(link.length for link in task.model.arm.links)
    error = float((task.model.arm.torque_limits / task.inertia).min() / w**2)
    return (
        Free("joint error [rad]", 1e-2 * error, 1e2 * error, error, log=True),
        Free("joint rate [rad/s]", 1e-2 * error * w, 1e3 * error * w, error * w, log=True),
        Free("modal rate [m/s]", 1e-3 * reach * w, 10.0 * reach * w, 0.1 * reach * w, log=True),
        Free("alpha [1/s]", 0.0, 0.5 * w, 0.1 * w),
    )


def lqr_gain(task, values):
    """K (n, 2 (n + m)) of the nominal arm at the motion's end, designed on the part that torque reaches."""
    *sizes, decay = values
    n, m = task.model.n_joints, task.model.n_modes
    grown = np.exp(decay / RATE)
    Phi, Gamma, X = grown * task.nominal.Phi, grown * task.nominal.Gamma, task.nominal.X
    joint, speed, modal = (1.0 / size**2 for size in sizes)
    Q = X.T @ np.diag(np.repeat([joint, 0.0, speed, modal], [n, m, n, m])) @ X
    R = np.diag(1.0 / task.model.arm.torque_limits**2)
    try:
        P = solve_discrete_are(Phi, Gamma, Q, R)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return np.linalg.solve(R + Gamma.T @ P @ Gamma, Gamma.T @ P @ Phi) @ X.T


def lqr(task):
    """Tuned gain of the full-state LQR, and its slowest pole; refused as in `pid`."""

    def cost(values):
        K = lqr_gain(task, values)
        return 1e3 if K is None else task.worst(K)[0]

    values, _, _ = tune(cost, _lqr_free(task), BUDGET)
    K = lqr_gain(task, values)
    slowest = 1.0 if K is None else task.worst(K)[1]
    if slowest >= 0.0:
        raise DesignError(
            "no weights of the LQR are stable on the whole uncertain set", field=task.case.name
        )
    return K, slowest


def full_state_lqr(case):
    """`Setup` of the full-state LQR."""
    task = task_of(case)
    K = lqr(task)[0]
    observer = {
        "observer.type": "kalman",
        "observer.torque_noise": [0.01 * limit for limit in task.model.arm.torque_limits],
    }
    return Setup(IDLE | UNWATCHED | observer | {"rate": RATE}, lambda arm: Lqr(arm, K))


_LAST = {}


def task_of(case):
    """The `Task` of a random arm; the last one is kept, with its tuned gains."""
    if case.name not in _LAST:
        _LAST.clear()
        _LAST[case.name] = Task(case)
    return _LAST[case.name]
