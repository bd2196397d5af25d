# SPDX-License-Identifier: Apache-2.0
r"""Tunes baselines for an arm and its motion with the data of a design: arm file, uncertain set, rate, delay.

The uncertain set is the arm at start, middle and end of its motion, with `PAYLOADS` times its payload and one mode
more. The arm is linearised and sampled at `RATE`: once with a torque that acts at once, and once with a torque that
acts one sample late. Only the part of the state that torque reaches is used.

- Joint PID, with the weight and friction of the rigid arm along the reference, and each joint's own inertia times its
  acceleration. The integral is also used without gravity, because a PD alone sticks where friction lets it. The
  reference is shaped (ZV, ZVD or EI) for the modes that ring under the PID at the motion's end, or it is not shaped.
  Gains must be stable on the whole set. They have the shortest settling time of the linear arm on the shaped motion,
  for the worst of all payloads. If only its poles were optimised, the PID would be so soft that it does not change the
  modes' own damping.
- Joint PID with strain feedback: the same PID without a shaper. For each joint that bends a link with a gauge, it feeds
  back the moment :math:`\mu` that this link's innermost gauge shows, relative to the moment :math:`\mu_r` of the
  reference's motion, and its rate. Both gains are tuned with those of the PID, by the same measure (Luo, Direct strain
  feedback control of flexible robot arms, IEEE Trans. Automatic Control 38, 1993; there only the rate is used):

.. math:: u = u_{PID} + \kappa\,(\mu - \mu_r) + \lambda\,\dot\mu / \omega_1 .

- Full-state LQR: `comparison.baselines.FullStateLqr`, and the Kalman filter that gives it the state. Both are tuned
  together by the poles :math:`p` of all these loops at once. With the first locked frequency :math:`\omega_1` the
  tuning minimises

.. math:: \max_{cases,\,p} d(p) + c\,\overline{\max(d(p),\,-1)}, \qquad
    d(p) = \frac{\mathrm{Re}\,p}{\omega_1}\max\Bigl(1, \frac{|p|}{b\,\omega_1}\Bigr).

plus the decadic logarithm of the factor by which the sensors' noise in the torque is too large. The noise may be as
large as in a design (`NOISIEST`). Without this bound the gains are so high that an encoder's count takes a tenth of the
torque, and counts alone make the loop oscillate. Poles beyond b = `BAND` count less, because gains change the decay of
the other modes, but not that of the highest ones. The second term is a tie-break (c = `TIE`): of two gains with the
same slowest pole, it prefers the one that damps the others better.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, null_space, solve_discrete_are, solve_discrete_lyapunov
from scipy.signal import lfilter

from flexarm_control.motions import shapers
from flexarm_control.observers.kalman import measurement_covariance
from flexarm_control.robust.settings import NOISIEST
from flexarm_control.trajectory import specs
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.arm.strain_map import StrainMap, gauge_rows
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.linear import jacobian, linear_plant, sampled, sampled_noise, static_torque
from flexarm_dynamics.models import model
from flexarm_dynamics.singular_perturbation import frequencies_and_damping

from ..comparison.baselines import Baseline, FullStateLqr, JointPid
from ..comparison.controllers import DAMPED, IDLE, MAX_INTEGRAL, SHAPED, UNWATCHED, Setup
from ..comparison.tuning import Free, tune
from .trial import TOLERANCE

#: Factors of the payload in the uncertain set [-].
PAYLOADS = (0.7, 1.0, 1.3)
#: Samples per second [Hz].
RATE = 500.0
#: The baselines run without flexarm's supervision, because false alarms must not count against them. `trial.MAX_ERROR`
#: ends a run.
WATCH = UNWATCHED | {"observer.plausibility": False, "strain_limit": 1.0}
#: Evaluations per tuning: of poles, and of settling times.
BUDGET, PID_BUDGET = 150, 120
#: Slowest pole that counts as stable, in first locked frequencies [-]; largest settling time [periods].
MARGIN, NEVER = 2e-3, 8.0
#: Weight of the tie-break [-].
TIE = 0.05
#: Poles beyond this many times the first locked frequency count less [-].
BAND = 3.0
#: Torque does not reach a mode with less than this fraction of the largest mode's controllability [-].
REACHED = 1e-7


@dataclass(frozen=True)
class Linear:
    """An arm at rest, linearised; only the part that torque reaches is kept.

    Attributes
    ----------
    A : ndarray, shape (N, N)
        System matrix of this part.
    Phi, Gamma : ndarray, shape (N, N), (N, n)
        Transition over one sample, with held torque.
    X : ndarray, shape (2 (n + m), N)
        Orthonormal: the state is X times the state of this part.
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
    """An arm with everything for which its baselines are tuned.

    Attributes
    ----------
    model : ArmModel
    profile : Motion
    places, ends : tuple
        Start, middle and end of the motion, and start and end, each (n,) [rad].
    omega : float
        First frequency with joints locked [rad/s].
    reach : float
        Whole length [m].
    inertia : ndarray, shape (n,)
        Inertia of the rigid arm about each joint, the mean of both ends [kg m^2].
    """

    def __init__(self, case):
        self.case, self.model = case, model.build(case.read())
        family, settings = specs.parse(case.motion)
        still = np.zeros(self.model.n_joints)
        self.profile = specs.motion(family, settings, self.model, still)
        self.ends = self.profile.position(0.0), self.profile.position(self.profile.duration)
        self.omega = 2.0 * np.pi / case.period
        self.reach = self.model.arm.reach
        self.places = tuple(
            self.profile.position(x * self.profile.duration) for x in (0.0, 0.5, 1.0)
        )
        masses = [np.diag(self.model.terms(q, still).M)[: still.size] for q in self.ends]
        self.inertia = np.mean(masses, axis=0)

    @cached_property
    def models(self):
        """The arm with each payload and one mode more in every direction."""
        arm = self.model.arm
        more = arm.with_modes(1 + arm.most_modes)
        return [model.build(scaled(more, payload)) for payload in PAYLOADS]

    @cached_property
    def plants(self):
        """The uncertain set: a `Linear` for each model at each of the places, model by model."""
        return [linear(each, q) for each in self.models for q in self.places]

    @cached_property
    def nominal(self):
        """The `Linear` of the arm itself at each place."""
        return [linear(self.model, q) for q in self.places]

    @cached_property
    def strain_map(self):
        """The arm's map from strain to modes."""
        return StrainMap(self.model)

    @cached_property
    def seen(self):
        """What the observer sees of q and delta of a plant with one mode more: (n + m, n + modes of that plant)."""
        n, rows = self.model.n_joints, gauge_rows(self.models[1], self.model.arm.gauges)
        return block_diag(np.eye(n), self.strain_map.inverse_without(()) @ rows)

    @cached_property
    def loaded(self):
        """For each payload, at the end: the `Linear`, the tip by the state (3, ...), and the missing torque.

        The missing torque holds this payload, beyond the weight of the rigid arm that the controller knows, (n,) [N m].
        """
        found, q = [], self.ends[1]
        n = q.size
        own = self.model.terms(q, 0.0 * q).f1
        for arm_model, plant in zip(self.models, self.plants[2::3], strict=True):
            bent = arm_model.static_deflection(q)
            place = np.concatenate([q, bent])
            tip = jacobian(lambda x, m=arm_model: m.tip_position(x[:n], x[n:]), place)
            tip = np.hstack([tip, np.zeros_like(tip)])
            found.append((plant, tip, static_torque(arm_model, q) - own))
        return found

    def worst(self, found):
        """The measure to minimise, from the poles of all cases; and their largest real part; both in omega [-]."""
        poles = np.concatenate(found) / self.omega
        decay = poles.real * np.maximum(1.0, np.abs(poles) / BAND)
        return float(decay.max() + TIE * np.maximum(decay, -1.0).mean()), float(poles.real.max())


def poles(plant, K, integral):
    """Poles of a `plant`, a `Linear`, under PID, in continuous time [1/s]: with and without delay.

    `K` and `integral` are those of `pid_loop`.
    """
    return np.concatenate([_continuous(pid_loop(plant, K, integral, late)) for late in (0, 1)])


def pid_loop(plant, K, integral, late=1):
    """Sampled loop of a `plant` under PID, with the states of the part, the last torque, and the integral's torque.

    u = -`K` x - the sum of `integral` (n,) times the joint angles and the period; u acts `late` samples late, 0 or 1.
    """
    Phi, Gamma, X = plant.Phi, plant.Gamma, plant.X
    N, n = Gamma.shape
    loop = np.zeros((N + 2 * n,) * 2)
    loop[N : N + n, :N] = -K @ X
    loop[N + n :, :N] = -np.diag(integral) @ X[:n] / RATE
    loop[N + n :, N + n :] = np.eye(n)
    loop[N : N + n] += loop[N + n :]
    acting = np.eye(N + 2 * n)[N : N + n] if late else loop[N : N + n]
    loop[:N] = Gamma @ acting
    loop[:N, :N] += Phi
    return loop


def _continuous(loop):
    """Poles in continuous time of a sampled `loop` [1/s]."""
    z = np.linalg.eigvals(loop).astype(complex)
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


def pid(task, kind):
    """Tuned gains of the joints' PID for a `task`, with a shaper of a `kind` or None, and its settling time [periods].

    Refused if no gains are stable on the whole uncertain set.
    """
    return tuned_pid(task, _pid_free(task), pid_gains, kind)


def tuned_pid(task, free, gains_of, kind=None):
    """As `pid`, for the `free` numbers, from which `gains_of` makes the gains of a `task`."""

    def unstable(values):
        gains = gains_of(task, values)
        found = []
        for plant in task.plants:
            K = pid_feedback(task, gains, plant)
            found.append(poles(plant, K, gains["i"]).real.max())
        return max(max(found) / task.omega, -MARGIN)

    def cost(values):
        worst = unstable(values)
        if worst > -MARGIN:
            return NEVER * (2.0 + worst)
        gains = gains_of(task, values)
        return settling(task, gains, train_of(task, gains, kind))

    values, periods, _ = tune(cost, free, PID_BUDGET, screen=unstable)
    if periods >= 1.5 * NEVER:
        problem = "no gains of the joints' PID are stable on the whole uncertain set"
        raise DesignError(problem, field=task.case.name)
    return gains_of(task, values), periods


def pid_feedback(task, gains, plant):
    """Feedback of a PID, without the integral, of the state (q, delta, qd, delta_d) of a `plant` of the `task`.

    The moment of strain feedback is the observer's estimate from the gauges: `Task.seen`, for a plant with more modes.
    """
    size, n = len(plant.X), gains["p"].size
    K = np.zeros((n, size))
    K[:, :n], K[:, size // 2 : size // 2 + n] = np.diag(gains["p"]), np.diag(gains["d"])
    if "moment" in gains:
        rows = moment_rows(task.model)
        if size != 2 * (n + task.model.n_modes):
            rows = rows @ task.seen[n:, n:]
        K[:, n : size // 2] -= gains["moment"] * rows
        K[:, size // 2 + n :] -= gains["moment_rate"] * rows
    return K


def train_of(task, gains, kind):
    """The `Shaper` of a `kind` for modes that ring under PID `gains` at the end of a `task`; None if none rings.

    None also without a `kind`.
    """
    if kind is None:
        return None
    K = pid_feedback(task, gains, task.nominal[-1])
    omega, zeta = frequencies_and_damping(poles(task.nominal[-1], K, gains["i"]))
    rings = (zeta < DAMPED) & (omega < 0.5 * np.pi * RATE)
    if not rings.any():
        return None
    return shapers.for_modes(kind, omega[rings][:SHAPED], np.maximum(zeta[rings][:SHAPED], 0.0))


def _reference(task, train, times):
    """The quintic, shaped, at `times` (k,): position from the start, velocity, acceleration, each (k, n)."""
    profile = task.profile
    delays, amplitudes = ([0.0], [1.0]) if train is None else (train.times, train.amplitudes)
    s = np.clip((times[:, None] - delays) / profile.duration, 0.0, 1.0)
    orders = ((profile.shape[k](s) @ amplitudes) / profile.duration**k for k in range(3))
    return [np.outer(order, profile.angle) for order in orders]


def settling(task, gains, train):
    """Settling time of a PID on the motion of a `task`, shaped by a `train`, from its unshaped end on [periods].

    The arm is the linear one at the motion's end, with the worst of `PAYLOADS`; the tip is as in `trial`. If the tip is
    not settled after `NEVER` periods, the result is `NEVER` plus the decadic logarithm of the tip's largest distance in
    the last period over the tolerance, at most 0.4 `NEVER`.
    """
    times = np.arange(0.0, task.profile.duration + NEVER * task.case.period, 1.0 / RATE)
    r, rd, rdd = _reference(task, train, times)
    r = r + task.ends[0] - task.ends[1]
    push = gains["p"] * r + gains["d"] * rd + gains["acceleration"] * rdd
    worst = 0.0
    for plant, tip, load in task.loaded:
        Gamma, X = plant.Gamma, plant.X
        N, n = Gamma.shape
        loop = pid_loop(plant, pid_feedback(task, gains, plant), gains["i"])
        # Inputs: the reference, as late as the feedback; its integral; the load beyond the known weight.
        inputs = np.zeros((len(times), N + 2 * n))
        inputs[:, :N] = -Gamma @ load
        inputs[:, N : N + n] = push + gains["i"] * r / RATE
        inputs[:, N + n :] = gains["i"] * r / RATE
        start = np.zeros(N + 2 * n)
        start[:N] = X[:n].T @ r[0]
        away = _response(loop, inputs, start, np.hstack([tip @ X, np.zeros((3, 2 * n))]))
        distance = np.linalg.norm(away, axis=1) / task.reach
        after = times >= task.profile.duration
        outside = np.flatnonzero(distance[after] > TOLERANCE)
        late = 0.0 if not outside.size else (outside[-1] + 1) / RATE / task.case.period
        if outside.size and outside[-1] >= after.sum() - 2:
            rest = distance[times > times[-1] - task.case.period].max()
            late = NEVER + min(np.log10(max(rest / TOLERANCE, 1.0)), 0.4 * NEVER)
        worst = max(worst, float(late))
    return worst


def _response(loop, inputs, start, outputs):
    """Outputs (k, 3) of s' = loop s + input from a `start`, computed mode by mode."""
    values, vectors = np.linalg.eig(loop)
    drive = np.linalg.solve(vectors, inputs.T.astype(complex))
    first = np.linalg.solve(vectors, start.astype(complex))
    seen = outputs @ vectors
    out = np.zeros((outputs.shape[0], len(inputs)))
    for value, column, z, row in zip(values, drive, first, seen.T, strict=True):
        moved = np.concatenate([[z], column[:-1]])
        out += np.outer(row, lfilter([1.0], [1.0, -value], moved)).real
    return out.T


def shaped_pid(case, kind):
    """`Setup` of the joints' PID with a shaper of a `kind`, or None."""
    task = task_of(case)
    gains, _ = pid(task, kind)
    train = train_of(task, gains, kind)
    profile = task.profile if train is None else train.apply(task.profile)
    motion = specs.sampled(profile, task.model)
    return Setup(_given(), lambda arm: Pid(arm, gains), lambda arm: motion)


def _given():
    return IDLE | WATCH | {"observer.type": "filtered_derivative", "rate": RATE}


# PID with strain feedback ------------------------------------------------------------------------


#: Component of a joint's axis about which a gauge's direction bends, and sign of the moment.
ABOUT = {"y": (2, 1.0), "z": (1, -1.0), "twist": (0, 1.0)}


def moment_rows(arm_model):
    """Rows (n, m) of a model, `arm_model`: moment on each joint that its link's innermost gauge shows [N m].

    With a section's stiffness EI the moment is EI y'', a gauge's strain -c y''; twist is GJ theta'. Zeros if the
    joint's own link has no gauge that shows it. The joint turns with its link, so their axes agree.
    """
    arm, rows = arm_model.arm, np.zeros((arm_model.n_joints, arm_model.n_modes))
    for row, joint, link in zip(rows, arm.joints, arm.links, strict=True):
        seen = [g for g in arm.gauges if g.link == link.name]
        seen = [g for g in seen if abs(joint.axis[ABOUT[g.direction][0]]) > 0.5]
        if seen:
            gauge = min(seen, key=lambda g: g.position)
            part, sign = ABOUT[gauge.direction]
            sign = sign * joint.axis[part] * (1.0 if gauge.direction == "twist" else -1.0)
            strain = gauge_rows(arm_model, [gauge])[0]
            row[:] = (
                sign
                * link.rigidity(gauge.direction, gauge.position)
                / gauge.surface_distance
                * strain
            )
    return rows


class StrainPid(Pid):
    """`Pid` with feedback of the bending moment: gains ``moment`` [-] and ``moment_rate`` [s]; see the module."""

    def __init__(self, arm_model, gains):
        super().__init__(arm_model, gains)
        self._rows = moment_rows(arm_model)

    def _torque(self, s, reference, dt):
        n, m, k = self.model.n_joints, self.model.n_modes, self.gains
        u = super()._torque(s, reference, dt)
        still = reference_deflection(self.model, reference)
        u += k["moment"] * (self._rows @ (s[n : n + m] - still))
        return u + k["moment_rate"] * (self._rows @ s[2 * n + m :])


def reference_deflection(arm_model, reference):
    """Deflections (m,) under weight and inertia forces of the `reference`, without vibration: (9)."""
    terms = arm_model.terms(reference.position, reference.velocity)
    forces = terms.M[arm_model.n_joints :, : arm_model.n_joints] @ reference.acceleration
    return np.linalg.solve(terms.K2, -forces - terms.f2)


def _strain_free(task):
    return [*_pid_free(task), Free("kappa", -0.8, 4.0, 0.0), Free("lambda", -2.0, 2.0, 0.0)]


def strain_gains(task, values):
    """Gains of `StrainPid` from tuned values: those of `pid_gains`, then kappa and lambda."""
    *own, moment, rate = values
    return pid_gains(task, own) | {"moment": moment, "moment_rate": rate / task.omega}


def strain_pid(case):
    """`Setup` of the joints' PID with strain feedback."""
    task = task_of(case)
    if not moment_rows(task.model).any():
        raise DesignError("has no gauge that shows the moment on a joint", field=case.name)
    gains, _ = tuned_pid(task, _strain_free(task), strain_gains)
    return Setup(_given(), lambda arm: StrainPid(arm, gains))


# LQR with a Kalman filter ------------------------------------------------------------------------


class Lqr(FullStateLqr):
    """`FullStateLqr` with a given gain."""

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
    part = task.nominal[-1]
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


def kalman_gain(task, place, parameters):
    """Steady-state gain L (N, n + m) of the observer at one of the places, for the part that torque reaches."""
    part, m = task.nominal[place], task.model.n_modes
    n = task.model.n_joints
    # Unknown forces act through the mass matrix.
    M = task.model.terms(task.places[place], np.zeros(n)).M
    force = np.square([*parameters["torque_noise"], *[parameters["modal_force_noise"]] * m])
    density = np.zeros((2 * (n + m),) * 2)
    H = np.linalg.inv(M)
    density[n + m :, n + m :] = H @ np.diag(force) @ H.T
    Q = sampled_noise(part.A, part.X.T @ density @ part.X, 1.0 / RATE)
    C = part.X[: n + m]
    R = reading_covariance(task)
    P = _riccati(part.Phi.T, C.T, Q, R)
    return np.linalg.solve(R + C @ P @ C.T, C @ P).T


def lqg_poles(task, K, parameters):
    """Poles of the uncertain set of a `task` under LQR `K` and the Kalman filter, in continuous time [1/s]: as `poles`.

    `parameters` are those of the filter.
    """
    gains = [kalman_gain(task, place, parameters) for place in range(len(task.places))]
    found = []
    for k, plant in enumerate(task.plants):
        own, L = task.nominal[k % len(gains)], gains[k % len(gains)]
        found += [_continuous(_lqg_loop(task, plant, own, L, K, late)) for late in (0, 1)]
    return found


def _lqg_loop(task, plant, own, L, K, late):
    """Sampled loop of a plant under LQG, with the states of the part, the estimate, the last torque; as `pid_loop`."""
    N, M, n = len(plant.Phi), len(own.Phi), task.model.n_joints
    seen = L @ task.seen @ plant.X[: task.seen.shape[1]]
    loop = np.zeros((N + M + n,) * 2)
    loop[N + M :, N : N + M] = -K @ own.X
    acting = np.eye(N + M + n)[N + M :] if late else loop[N + M :]
    loop[:N] = plant.Gamma @ acting
    loop[:N, :N] += plant.Phi
    predicted = own.Gamma @ acting
    predicted[:, N : N + M] += own.Phi
    C = own.X[: n + task.model.n_modes]
    loop[N : N + M] = predicted - L @ C @ predicted + seen @ loop[:N]
    return loop


def reading_covariance(task):
    """Covariance of the readings of a `task`, (n + m, n + m), from the noise that the arm file states."""
    noise = {"position_noise": 0.0, "strain_noise": 0.0}
    return measurement_covariance(task.model, noise, task.strain_map, ())


def lqg_noise(task, K, parameters):
    """Rms torque due to the sensors' noise under LQR `K` and the filter of `parameters`, over the torque limit [-].

    It is the largest of all joints, for the loop at the end of a `task`; infinite if that loop is unstable.
    """
    place = len(task.places) - 1
    own, L = task.nominal[place], kalman_gain(task, place, parameters)
    plant = task.plants[PAYLOADS.index(1.0) * len(task.places) + place]
    loop = _lqg_loop(task, plant, own, L, K, 0)
    if np.abs(np.linalg.eigvals(loop)).max() >= 1.0:
        return np.inf
    N, M = len(plant.Phi), len(own.Phi)
    G = np.zeros((len(loop), L.shape[1]))
    G[N : N + M] = L
    P = solve_discrete_lyapunov(loop, G @ reading_covariance(task) @ G.T)
    rms = np.sqrt(np.maximum(np.diag(P)[N + M :], 0.0))
    return float((rms / task.model.arm.torque_limits).max())


def lqr(task):
    """Tuned gain of the LQR, parameters of its Kalman filter, and the slowest pole; refused as in `pid`."""

    def judged(values):
        try:
            K, filtered = lqr_gain(task, values), kalman_parameters(task, values)
            value, slowest = task.worst(lqg_poles(task, K, filtered))
            noisy = lqg_noise(task, K, filtered) if slowest < 0.0 else NOISIEST
            return K, filtered, value + max(np.log10(noisy / NOISIEST), 0.0), slowest
        except DesignError:
            return None, None, 1e3, 1e3

    values, _, _ = tune(lambda v: judged(v)[2], _lqr_free(task), BUDGET)
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
    given["publish_joint_velocity"] = False  # the tuned filter uses positions alone
    return Setup(given, lambda arm: Lqr(arm, K))


_LAST = {}


def task_of(case):
    """The `Task` of an arm; the last one is kept, with its tuned gains."""
    if case.name not in _LAST:
        _LAST.clear()
        _LAST[case.name] = Task(case)
    return _LAST[case.name]
