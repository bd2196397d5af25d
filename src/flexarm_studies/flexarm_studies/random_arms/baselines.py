# SPDX-License-Identifier: Apache-2.0
r"""Baselines for a random arm, tuned on the same information that a design has: arm file, uncertain set, rate, delay.

The uncertain set is the arm at both ends of its motion with `PAYLOADS` times its payload and one mode more,
linearised, sampled at `RATE`, its torque one sample late. A gain is judged by the poles of all these loops at once, of
the part of the arm that torque reaches. With poles :math:`p` per second and the first locked frequency
:math:`\omega_1` it minimises

.. math:: \max_{cases,\,p} d(p) + c\,\overline{\max(d(p),\,-1)}, \qquad
    d(p) = \frac{\mathrm{Re}\,p}{\omega_1}\max\Bigl(1, \frac{|p|}{b\,\omega_1}\Bigr).

Poles beyond b = `BAND` count less: no gain moves the decay of the highest modes, but the others' it may. The second
term is a tie-break (c = `TIE`): of two gains with the same slowest pole, the one that damps the others better.

- Joint PID, with the weight and friction of the rigid arm along the reference, and each joint's own inertia times its
  acceleration. The integral is there without gravity, too: a PD alone sticks where friction lets it. Its reference is
  shaped (ZVD or EI) for the modes that ring under it at the motion's end.
- Full-state LQR: `comparison.baselines.FullStateLqr`, with the Kalman filter that gives it the state, tuned together.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, null_space, solve_discrete_are

from flexarm_control.motions import shapers
from flexarm_control.observers.kalman import measurement_covariance
from flexarm_control.trajectory import specs
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.arm.strain_map import StrainMap, gauge_rows
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.linear import linear_plant, sampled, sampled_noise
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
#: Of flexarm's supervision they have none: a false alarm is not theirs. `trial.MAX_ERROR` ends a run.
WATCH = UNWATCHED | {"observer.plausibility": False, "strain_limit": 1.0}
#: Evaluations of poles per tuning.
BUDGET = 400
#: Weight of the tie-break [-].
TIE = 0.05
#: Poles beyond so many times the first locked frequency count less [-].
BAND = 3.0
#: A mode with less of the largest mode's controllability is out of the torques' reach [-].
REACHED = 1e-7


@dataclass(frozen=True)
class Linear:
    """An arm at rest, linearised, of which only the part is kept that torque reaches.

    Attributes
    ----------
    A : ndarray, shape (N, N)
        Of this part.
    Phi, Gamma : ndarray, shape (N, N), (N, n)
        Of one sample, the torque held.
    X : ndarray, shape (2 (n + m), N)
        Orthonormal: the state is X times this part's.
    """

    A: np.ndarray
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
    part = X.T @ A @ X
    return Linear(part, *sampled(part, X.T @ B, 1.0 / rate), X)


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
    reach : float
        Whole length [m].
    inertia : ndarray, shape (n,)
        Of the rigid arm about each joint, the mean of both ends [kg m^2].
    """

    def __init__(self, case):
        self.case, self.model = case, model.build(case.read())
        family, settings = specs.parse(case.motion)
        still = np.zeros(self.model.n_joints)
        self.profile = specs.motion(family, settings, self.model, still)
        self.ends = self.profile.position(0.0), self.profile.position(self.profile.duration)
        self.omega = 2.0 * np.pi / case.period
        self.reach = sum(link.length for link in self.model.arm.links)
        masses = [np.diag(self.model.terms(q, still).M)[: still.size] for q in self.ends]
        self.inertia = np.mean(masses, axis=0)

    @cached_property
    def plants(self):
        """The uncertain set, with one mode more in every direction: `Linear`, of start and end in turn."""
        arm = self.model.arm
        more = arm.with_modes(
            1 + max(f.modes for link in arm.links for f in link.flexible.values())
        )
        models = [model.build(scaled(more, payload)) for payload in PAYLOADS]
        return [linear(each, q) for each in models for q in self.ends]

    @cached_property
    def nominal(self):
        """The `Linear` of the arm itself at start and end."""
        return [linear(self.model, q) for q in self.ends]

    @cached_property
    def strain_map(self):
        """The arm's map from strain to modes."""
        return StrainMap(self.model)

    @cached_property
    def seen(self):
        """What the observer sees of a plant with one mode more: (n + m, n + modes of that), of its q and delta."""
        arm, n = self.model.arm, self.model.n_joints
        more = arm.with_modes(
            1 + max(f.modes for link in arm.links for f in link.flexible.values())
        )
        rows = gauge_rows(model.build(more), arm.gauges)
        return block_diag(np.eye(n), self.strain_map.inverse_without(()) @ rows)

    @cached_property
    def pid(self):
        """Tuned gains of the joints' PID, and its slowest pole."""
        return pid(self)

    def worst(self, found):
        """What is minimised, of the poles of all cases; and their largest real part; both in omega [-]."""
        poles = np.concatenate(found) / self.omega
        decay = poles.real * np.maximum(1.0, np.abs(poles) / BAND)
        return float(decay.max() + TIE * np.maximum(decay, -1.0).mean()), float(poles.real.max())


def poles(plant, K, integral):
    """Poles of a `plant`, a `Linear`, under PID, one sample late, in continuous time [1/s].

    u = -`K` x - the sum of `integral` (n,) times the joint angles and the period.
    """
    Phi, Gamma, X = plant.Phi, plant.Gamma, plant.X
    N, n = Gamma.shape
    # The part, the torque that acts, the integral's torque.
    loop = np.zeros((N + 2 * n,) * 2)
    loop[:N, :N], loop[:N, N : N + n], loop[N : N + n, :N] = Phi, Gamma, -K @ X
    loop[N + n :, :N] = -np.diag(integral) @ X[:n] / RATE
    loop[N + n :, N + n :] = np.eye(n)
    loop[N : N + n] += loop[N + n :]
    return _continuous(np.linalg.eigvals(loop))


def _continuous(z):
    """Poles in continuous time, of sampled ones."""
    z = z.astype(complex)
    return RATE * np.log(np.where(np.abs(z) > 1e-12, z, 1e-12))


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
        law, modes = Pid(task.model, pid_gains(task, values)), task.plants[0].X.shape[0] // 2
        return task.worst(
            [poles(plant, _widened(law, modes), law.gains["i"]) for plant in task.plants]
        )

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


def _widened(law, half):
    """Feedback of a PID for a state (q, delta, qd, delta_d) of 2 `half` numbers, with more modes than the law's."""
    n = law.model.n_joints
    K = np.zeros((n, 2 * half))
    K[:, :n], K[:, half : half + n] = np.diag(law.gains["p"]), np.diag(law.gains["d"])
    return K


def shaped(task, gains, kind):
    """The motion, shaped for the modes that ring under PID `gains` at its end; as it is where none rings."""
    law = Pid(task.model, gains)
    found = poles(task.nominal[1], law.K, gains["i"])
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
    given = IDLE | WATCH | {"observer.type": "filtered_derivative", "rate": RATE}
    return Setup(given, lambda arm: Pid(arm, gains), lambda arm: motion)


# LQR with a Kalman filter ------------------------------------------------------------------------


class Lqr(FullStateLqr):
    """`FullStateLqr` with a gain that was found elsewhere."""

    def __init__(self, arm_model, K):
        Baseline.__init__(self, arm_model)
        self.K, self._feedforward = K, 1.0


def _lqr_free(task):
    w, reach = task.omega, task.reach
    error = float((task.model.arm.torque_limits / task.inertia).min() / w**2)
    return (
        Free("joint error [rad]", 1e-2 * error, 1e2 * error, error, log=True),
        Free("joint rate [rad/s]", 1e-2 * error * w, 1e3 * error * w, error * w, log=True),
        Free("modal rate [m/s]", 1e-3 * reach * w, 10.0 * reach * w, 0.1 * reach * w, log=True),
        Free("alpha [1/s]", 0.0, 0.5 * w, 0.1 * w),
        Free("torque noise, per limit [s^0.5]", 1e-4, 1e-1, 1e-2, log=True),
        Free("modal noise, per limit and reach [s^0.5]", 1e-4, 1.0, 1e-2, log=True),
    )


def lqr_gain(task, values):
    """K (n, 2 (n + m)) of the nominal arm at the motion's end, designed on the part that torque reaches."""
    *sizes, decay = values[:4]
    n, m = task.model.n_joints, task.model.n_modes
    grown = np.exp(decay / RATE)
    part = task.nominal[1]
    Phi, Gamma, X = grown * part.Phi, grown * part.Gamma, part.X
    joint, speed, modal = (1.0 / size**2 for size in sizes)
    Q = X.T @ np.diag(np.repeat([joint, 0.0, speed, modal], [n, m, n, m])) @ X
    R = np.diag(1.0 / task.model.arm.torque_limits**2)
    P = _riccati(Phi, Gamma, Q, R)
    return np.linalg.solve(R + Gamma.T @ P @ Gamma, Gamma.T @ P @ Phi) @ X.T


def _riccati(Phi, Gamma, Q, R):
    try:
        return solve_discrete_are(Phi, Gamma, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(f"the Riccati equation has no solution: {error}", field="LQR") from None


def kalman_parameters(task, values):
    """Parameters of observer ``kalman`` from tuned values."""
    limits = task.model.arm.torque_limits
    return {
        "torque_noise": [float(values[4] * limit) for limit in limits],
        "modal_force_noise": float(values[5] * limits.max() / task.reach),
    }


def kalman_gain(task, end, parameters):
    """Steady gain L (N, n + m) of the observer at one end of the motion, for the part that torque reaches."""
    part, m = task.nominal[end], task.model.n_modes
    n = task.model.n_joints
    # Unknown forces act through the mass matrix.
    M = task.model.terms(task.ends[end], np.zeros(n)).M
    force = np.square([*parameters["torque_noise"], *[parameters["modal_force_noise"]] * m])
    density = np.zeros((2 * (n + m),) * 2)
    H = np.linalg.inv(M)
    density[n + m :, n + m :] = H @ np.diag(force) @ H.T
    Q = sampled_noise(part.A, part.X.T @ density @ part.X, 1.0 / RATE)
    C = part.X[: n + m]
    noise = {"position_noise": 0.0, "strain_noise": 0.0}
    R = measurement_covariance(task.model, noise, task.strain_map, ())
    P = _riccati(part.Phi.T, C.T, Q, R)
    return np.linalg.solve(R + C @ P @ C.T, C @ P).T


def lqg_poles(task, K, parameters):
    """Poles of the uncertain set under LQR `K` and the Kalman filter, one sample late, in continuous time [1/s]."""
    n, m = task.model.n_joints, task.model.n_modes
    gains = [kalman_gain(task, end, parameters) for end in (0, 1)]
    found = []
    for k, plant in enumerate(task.plants):
        own, L = task.nominal[k % 2], gains[k % 2]
        N, M = len(plant.Phi), len(own.Phi)
        seen = task.seen @ plant.X[: task.seen.shape[1]]
        keep = np.eye(M) - L @ own.X[: n + m]
        # The plant, the estimate, the torque that acts: it was computed one sample ago.
        loop = np.zeros((N + M + n,) * 2)
        loop[:N, :N], loop[:N, N + M :] = plant.Phi, plant.Gamma
        loop[N : N + M, :N] = L @ seen @ plant.Phi
        loop[N : N + M, N : N + M] = keep @ own.Phi
        loop[N : N + M, N + M :] = keep @ own.Gamma + L @ seen @ plant.Gamma
        loop[N + M :, N : N + M] = -K @ own.X
        found.append(_continuous(np.linalg.eigvals(loop)))
    return found


def lqr(task):
    """Tuned gain of the LQR, parameters of its Kalman filter, and the slowest pole; refused as in `pid`."""

    def judged(values):
        try:
            K, filtered = lqr_gain(task, values), kalman_parameters(task, values)
            return K, filtered, *task.worst(lqg_poles(task, K, filtered))
        except DesignError:
            return None, None, 1e3, 1e3

    values, _, _ = tune(lambda v: judged(v)[2], _lqr_free(task), BUDGET // 2)
    K, filtered, _, slowest = judged(values)
    if slowest >= 0.0:
        problem = "no weights of the LQR are stable on the whole uncertain set"
        raise DesignError(problem, field=task.case.name)
    return K, filtered, slowest


def full_state_lqr(case):
    """`Setup` of the LQR with a Kalman filter."""
    K, filtered, _ = lqr(task_of(case))
    observer = {f"observer.{name}": value for name, value in filtered.items()}
    given = IDLE | WATCH | observer | {"observer.type": "kalman", "rate": RATE}
    return Setup(given, lambda arm: Lqr(arm, K))


_LAST = {}


def task_of(case):
    """The `Task` of a random arm; the last one is kept, with its tuned gains."""
    if case.name not in _LAST:
        _LAST.clear()
        _LAST[case.name] = Task(case)
    return _LAST[case.name]
