# SPDX-License-Identifier: Apache-2.0
r"""Feed-forward from a model that runs in parallel: the nominal arm, simulated under its own regulator.

The slow manifold along the reference, :math:`s_{ref} = (q_{ref}, \bar\delta, \dot q_{ref}, \dot{\bar\delta})` with
its torque u_ref, is not exactly a motion of the arm: its expansion in mu is truncated, and the rates of the deflections
jump wherever the reference's jerk jumps. A fast control that pulls the real arm over such a jump kicks the joints, and
they return no faster than the slow poles. Therefore the nominal arm is simulated here, with the control model, under

.. math:: u_s = u_{ref} + K_s\,(s_{ref} - s),

where K_s is the optimal regulator of the *whole* arm, joints and bending, with prescribed degree of stability.
Only the reference acts on the simulated arm, so that neither noise nor delay nor an unknown payload limits the gains.
The regulator brings joints and bending to the reference in about a period of the slowest mode. (s, u_s) is a motion of
the nominal arm, sample by sample, within its torque limits. The composite control holds the real arm to it with the
gains that the real arm allows.

The regulator minimises :math:`\int e^{2\alpha t}(e^T Q e + u^T u)\,dt` of the joint errors e alone, with
:math:`Q^{1/2} = \mathrm{diag}(M_{11})\,\omega_1^2` and :math:`\alpha = 0.3\,\omega_1`. omega_1 is the lowest bending
frequency with the joints locked: the joints are held about as stiffly as the softest mode can follow. A mode that no
torque reaches, such as the vertical bending of an arm that only yaws, is left out.

If the arm's inertia changes with its joints, gains are designed along each trajectory when it is received, and
interpolated. They are designed about the moving arm (`moving_plant`), because an arm bent by its acceleration responds
differently from one at rest; for a stop on the way also about the arm at rest. A trajectory that arrives while such an
arm moves is followed on the slow manifold alone.

Coulomb friction would hold the simulated arm beside the reference, because the regulator has no integral. So the
friction on the reference, which is part of u_ref, is replaced in each sample by the friction at the simulated arm's own
speeds. The simulated friction cancels exactly this part of the torque, and the arm moves as if it had no friction.

At rest, s_ref and u_ref are those at which the control model rests under its own weight. The manifold neglects products
of deflections and weight; on it, the simulated arm would hang beside the reference.

The manifold jumps wherever the reference's jerk or snap jumps: between the polynomials of a trajectory, and at its
start and end. The regulator's torque must not jump. So the jump is added to what the regulator tracks, and fades
(module `fading`). J_i is s_ref of the polynomial before t_i, continued to t_i, minus s_ref of the polynomial after it;
likewise for u_ref.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import null_space, solve_continuous_are, solve_discrete_are

from flexarm_dynamics.errors import DesignError, ModelError
from flexarm_dynamics.linear import linear_plant, moving_plant, sampled
from flexarm_dynamics.models.fixed_step import METHODS, substeps
from flexarm_dynamics.models.model import copy

from .. import kernels
from ..arrays import some
from ..component import at_rest
from ..fading import Fading, fading_rate, lowest
from ..fast.pole_placement import PolePlacement, reaches
from ..trajectory.path import Path, around
from ..trajectory.values import SECOND
from .base import Feedforward

#: Ratio of the regulator's prescribed degree of stability to the lowest bending frequency.
DECAY = 0.3
#: Integration method of the simulation: eight stages more than RK4, and steps five times as long.
METHOD = "dop853"
#: Beyond this joint error the simulated arm starts again on the reference [rad].
LOST = 1.0
#: Largest turn of a joint [rad], and largest change of the bending load [-], between two designs along a trajectory.
APART, BENT = 0.12, 0.008
#: Number of times of a trajectory at which a design may be made.
GRID = 400
#: Relative change of the plant with the joints below which one gain serves everywhere.
NEGLIGIBLE = 1e-6
#: Number of times between two designs at which the interpolated gain is checked. If it does not hold the arm, the
#: interval is halved, as long as a joint turns by more than this in it [rad].
CHECKS, NEAREST = 3, APART / 8.0
#: Parts of a preparation, in this order; each part is useful without the later ones.
RESTING, MOVING, PLAN = "regulators of the arm at rest", "regulators of the moving arm", "plan"
PARTS = RESTING, MOVING, PLAN
#: When the reference rests, and every coordinate is this close to it, the simulated arm is set to the reference.
THERE = 1e-9
#: The reference must begin this close to the start of a plan [rad], [rad/s], [rad/s^2].
SAME_START = 1e-6


def regulator(model, q, period, velocity=None, acceleration=None):
    """Optimal gain K_s of the whole arm in a configuration, shape (n, 2 (n + m)); see the module.

    With a `velocity` and an `acceleration` (n,) of its joints the arm moves; without, it rests. The gain is optimal in
    continuous time. If this gain is unstable with a torque that is held for a `period` [s], as with modes near the
    sampling frequency, the gain is the one that is optimal in sampled time.
    """
    n, omega = model.n_joints, lowest(model, q)
    A, B = _plant(model, q, velocity, acceleration)
    Q = np.zeros(A.shape)
    inertia = np.diag(model.terms(q, np.zeros(n)).M)[:n]
    Q[:n, :n] = np.diag((inertia * omega**2) ** 2)
    V = reached(A, B)
    A, B, Q = V.T @ A @ V, V.T @ B, V.T @ Q @ V
    Phi, Gamma = sampled(A, B, period)
    try:
        P = solve_continuous_are(A + DECAY * omega * np.eye(len(A)), B, Q, np.eye(n))
        K = B.T @ P
        if np.abs(np.linalg.eigvals(Phi - Gamma @ K)).max() >= 1.0:
            faster = np.exp(DECAY * omega * period)
            Phi, Gamma = faster * Phi, faster * Gamma
            P = solve_discrete_are(Phi, Gamma, period * Q, period * np.eye(n))
            K = np.linalg.solve(period * np.eye(n) + Gamma.T @ P @ Gamma, Gamma.T @ P @ Phi)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(
            f"no regulator of {model.arm.name} at joint configuration {np.round(q, 4).tolist()} ({error})",
            field="feedforward model",
            hint="set feedforward: none",
        ) from None
    return K @ V.T


def _plant(model, q, velocity=None, acceleration=None):
    if velocity is None:
        return linear_plant(model, q, coulomb=False)
    return moving_plant(model, q, velocity, acceleration)


def reached(A, B):
    """Orthonormal directions of the state without the modes that no torque reaches, shape (N, k).

    The left eigenvectors W of those modes, :math:`W A = T W` with :math:`W B = 0`, give coordinates that move by
    themselves, whatever the torque is. V spans the remaining directions, :math:`W V = 0`. A gain K of (V'AV, V'B) gives
    A - B K V' the poles of T and of V'AV - V'B K.
    """
    poles, vectors = np.linalg.eig(A.T)
    bending = np.flatnonzero(poles.imag > 0.0)
    alone = bending[reaches(A, B, poles[bending]) < PolePlacement.UNREACHED]
    if not alone.size:
        return np.eye(len(A))
    W = np.vstack([vectors[:, alone].real.T, vectors[:, alone].imag.T])
    return null_space(W)


class Gains:
    """Regulators along a trajectory, linearly interpolated in time.

    Parameters
    ----------
    times : ndarray, shape (k,)
        Times since the trajectory's start [s].
    gains : ndarray, shape (k, n, 2 (n + m))
    """

    def __init__(self, times, gains):
        self.times, self.gains = times, gains

    def at(self, elapsed):
        """Gain at a time since the start [s]; constant beyond either end."""
        out = np.empty(self.gains.shape[1:])
        kernels.compiled().between(self.times, self.gains, elapsed, out)
        return out


@dataclass(eq=False)
class Preparation:
    """What was designed for one trajectory."""

    start: np.ndarray  # state of the reference that it begins from, (3, n)
    gains: Gains | None
    at_rest: Gains | None = None  # of the arm at rest on the path, for a stop on the way
    plan: object = None  # a `planner.Plan`
    trajectory_id: int = 0  # 0 until it is accepted
    note: str = ""  # what is missing, and why
    left: tuple = ()  # parts that are still to come

    def at(self, elapsed, path, stamp_ns):
        """Gain at a time since the start [s]; on a path that is slowed down, the bending load falls as s'^2."""
        K, moves = self.gains.at(elapsed), min(path.pace(stamp_ns) ** 2, 1.0)
        if moves < 1.0:
            K *= moves
            K += (1.0 - moves) * self.at_rest.at(elapsed)
        return K


def path_of(trajectory, start):
    """The path of a trajectory from the reference's state `start`, (3, n), which must be at rest."""
    if np.abs(start[1:]).max() > SAME_START:
        raise DesignError("the motion does not begin at rest", field="feedforward")
    path = Path.of(trajectory, 1)
    path.begin(0, start)
    return path


def gains_along(model, path, period, moving=True):
    """`Gains` along a path for samples of a `period` [s], checked on the path at `CHECKS` times of each interval.

    They are for the moving arm or, if not `moving`, for an arm that rests on the path; at both ends the arm rests. A
    motion bends the arm by its accelerations and squared speeds, divided by the square of the lowest frequency with the
    joints locked. An interval whose interpolated gain does not hold the arm is halved, as long as a joint turns by more
    than `NEAREST` in it.

    Raises
    ------
    DesignError
        If a configuration has no regulator, or the gain does not hold the arm in an interval as short as that.
    """
    grid = np.linspace(0.0, path.duration_ns / SECOND, GRID)
    states = np.empty((grid.size, 3, model.n_joints))
    for t, state in zip(grid, states, strict=True):
        path.evaluate(min(round(t * SECOND), path.duration_ns - 1), state)
    states[0, 1:] = states[-1, 1:] = 0.0
    q, velocity, acceleration = states.transpose(1, 0, 2)
    way, at = _length(q), set()
    bends = np.hstack([acceleration, velocity**2]) / lowest(model, q[0]) ** 2
    for length, step in ((way, APART), (_length(bends), BENT))[: 1 + moving]:
        count = int(np.ceil(length[-1] / step)) + 1
        at |= {*np.searchsorted(length, np.linspace(0.0, length[-1], count)).tolist()}
    if not moving:
        states = states[:, :1]
    at = sorted(at)
    gains = [_regulator_of(model, states[k], period) for k in at]
    i = 0
    while i < len(at) - 1:
        here, there = at[i], at[i + 1]
        if _hold_between(model, states[here : there + 1], gains[i : i + 2], period):
            i += 1
            continue
        if way[there] - way[here] <= NEAREST or there - here < 2:
            raise DesignError(
                f"the regulator of {model.arm.name} does not hold between joint configurations"
                f" {np.round(q[here], 3).tolist()} and {np.round(q[there], 3).tolist()} at {1.0 / period:g} Hz",
                field="feedforward",
            )
        middle = (here + there) // 2
        at.insert(i + 1, middle)
        gains.insert(i + 1, _regulator_of(model, states[middle], period))
    return Gains(grid[at], np.array(gains))


def _length(points):
    """Length of the path through points (k, n) up to each of them, by the coordinate that changes most, (k,)."""
    return np.concatenate([[0.0], np.cumsum(np.abs(np.diff(points, axis=0)).max(axis=1))])


def _regulator_of(model, state, period):
    """`regulator` for an arm in a state (position, velocity, acceleration), (3, n), or at rest in a (1, n) position."""
    return regulator(model, state[0], period, *state[1:])


def _hold_between(model, states, gains, period):
    """Whether gains interpolated between both ends hold the sampled arm in the states between, (k, 3 or 1, n)."""
    steps = len(states) - 1
    for k in np.unique(np.linspace(0, steps, CHECKS + 2).astype(int))[1:-1]:
        K = gains[0] + k / steps * (gains[1] - gains[0])
        Phi, Gamma = sampled(*_plant(model, *states[k]), period)
        if np.abs(np.linalg.eigvals(Phi - Gamma @ K)).max() >= 1.0:
            return False
    return True


class _Source(NamedTuple):
    """The source of the motion that the regulator tracks at a sample, and that motion."""

    path: object  # None: a hold
    piece: object  # of the path
    plan: object  # followed in place of the manifold; None: none
    stamp_ns: int
    state: np.ndarray  # (2 (n + m),)
    torque: np.ndarray  # (n,) [N m]

    @property
    def rests(self):
        """Whether the reference does not move."""
        return self.path is None or self.piece == Path.END

    def goes_on(self, other):
        """Whether the same formula gave this motion and the other's."""
        return self[:3] == other[:3]


class _Run:
    """The simulated arm and the regulator's memory.

    Attributes
    ----------
    state, torque : ndarray, shapes (2 (n + m),) and (n,)
    driven : ndarray, shape (n,)
        The torque minus Coulomb friction, that is, what moves the arm [N m].
    fading : Fading
        Jumps of (state, torque).
    source : _Source or None
        Source at the last sample.
    gained, placed : bool
        Whether there was a gain at the last sample, and whether the arm was set to another state then.
    """

    def __init__(self, size, n, rate):
        self.state, self.torque, self.driven = np.zeros(size), np.zeros(n), np.zeros(n)
        self.fading, self.source = Fading(size + n, rate), None
        self.gained = self.placed = False

    def take(self, other):
        """Go on from the state of the other run."""
        self.state[:], self.torque[:], self.driven[:] = other.state, other.torque, other.driven
        self.fading.take(other.fading)
        self.source, self.gained, self.placed = other.source, other.gained, other.placed


class At:
    """The reference on a path's polynomial at a stamp, at an offset from the stamp; the reference does not change."""

    def __init__(self, path, stamp_ns, offset=0.0):
        self.path, self.stamp_ns, self._offset = path, stamp_ns, offset
        state = self._state = np.empty((3, path.begin_state.shape[1]))
        path.near(stamp_ns, offset, state)
        self.position, self.velocity, self.acceleration = state

    def near(self, offset):
        """State (position, velocity, acceleration), (3, n), at an `offset` [s] from there."""
        state = np.empty_like(self._state)
        self.path.near(self.stamp_ns, self._offset + offset, state)
        return state

    def around(self, step, out):
        """Fill `out` (p, 3, n) with states as of `near`, at offsets `step` [s] apart; the middle one is 0."""
        around(self.path, self.stamp_ns, self._offset, step, out)


class _Ahead(At):
    """The reference at the next stamp, and the result for it."""

    def __init__(self, reference, dt, limit):
        super().__init__(reference.path, reference.stamp_ns + round(dt * SECOND))
        self.dt, self.limit, self.start_ns = dt, limit, self.path.start_ns
        self.run = None

    def foresaw(self, reference, dt):
        """Whether the sample that has arrived is the foreseen one."""
        path = reference.path
        now = (path, path and path.start_ns, reference.stamp_ns, dt)
        return now == (self.path, self.start_ns, self.stamp_ns, self.dt)


class ModelFeedforward(Feedforward):
    """The nominal arm, simulated beside the real one; see the module."""

    def __init__(self, model, manifold, settings):
        super().__init__(model, manifold, settings)
        n, m = model.n_joints, model.n_modes
        self._make_stepper()
        self._substeps = substeps(model, settings.period, METHOD)
        self._friction = model.friction_table()
        self._sliding = self._friction * [1.0, 0.0, 1.0]
        self._error, self._no_gain = np.zeros(2 * (n + m)), np.zeros((n, 2 * (n + m)))
        rate = fading_rate(model, settings.configuration)
        self._run, self._spare = (_Run(2 * (n + m), n, rate) for _ in range(2))
        self._name_parts()
        #: The gain, if it does not depend on the joints; else None.
        self.K = None
        if self._same_everywhere():
            self.K = regulator(model, settings.configuration, settings.period)
        self._prepared, self._first = None, True
        self._ahead = None  # the result of `look_ahead`
        self._held = None  # position, and the result of `wanted` there, while the reference rests
        # The start state of a path, and whether the preparation starts from the same.
        self._begins = None, False

    def _make_stepper(self):
        n, m = self.model.n_joints, self.model.n_modes
        self._advance = self.model.stepper(METHODS[METHOD])
        # Compiled code is loaded at its first call, which must not be on the control path.
        self._advance(np.zeros(2 * (n + m)), np.zeros(n), 0.0, 1)
        Gains(np.zeros(1), np.zeros((1, n, 2 * (n + m)))).at(0.0)

    def _name_parts(self):
        n, m = self.model.n_joints, self.model.n_modes
        self.state, self.torque = self._run.state, self._run.torque
        parts = np.split(self.state, [n, n + m, 2 * n + m])
        self.position, self.amplitude, self.velocity, self.rate = parts

    def __getstate__(self):
        """Without compiled code, and without the views of `state`: for another process."""
        left = (
            "_advance",
            "position",
            "amplitude",
            "velocity",
            "rate",
            "state",
            "torque",
            "_ahead",
        )
        return {name: value for name, value in self.__dict__.items() if name not in left}

    def __setstate__(self, state):
        self.__dict__.update(state, _ahead=None)
        self._make_stepper()
        self._name_parts()

    def _same_everywhere(self):
        """Whether the plant at rest does not change with the joints."""
        draw, n = np.random.default_rng(0), self.model.n_joints
        low, high = np.clip(self.model.arm.position_limits, -np.pi, np.pi).T
        terms = [self.model.terms(draw.uniform(low, high), np.zeros(n)) for _ in range(3)]
        for a, b in pairwise(terms):
            for x, y in ((a.M, b.M), (a.K1, b.K1), (a.K2, b.K2), (a.f1, b.f1)):
                if np.abs(x - y).max(initial=0.0) > NEGLIGIBLE * np.abs(x).max(initial=1e-9):
                    return False
        return True

    @property
    def plans(self):
        return self.K is None

    @property
    def placed(self):
        return self._run.placed

    def prepare_next(self, trajectory, start, found):
        # Works on a copy, because the loop goes on with the original model meanwhile.
        model, path = copy(self.model), path_of(trajectory, start)
        part, *left = PARTS if found is None else found.left
        found = Preparation(start, None) if found is None else found
        found = replace(found, left=tuple(left))
        try:
            if part == PLAN:
                found.plan = self._plan(model, path, start)
                found.note = "; ".join(filter(None, (found.note, found.plan and found.plan.note)))
            elif self.K is None:
                found.gains = gains_along(model, path, self.settings.period, part == MOVING)
                if found.at_rest is None:  # in a stop, gains of the moving arm are better than none
                    found.at_rest = found.gains
        except DesignError as error:  # the parts so far are better than nothing
            found.note = "; ".join(filter(None, (found.note, str(error))))
        return found

    def _plan(self, model, path, start):
        """A `Plan` that is followed in place of the slow manifold, or None; a `DesignError` if none is found."""

    def take(self, plan, trajectory_id):
        if plan is not None:
            plan.trajectory_id = trajectory_id
        self._prepared, self._ahead, self._begins = plan, None, (None, False)

    def reset(self):
        self._first, self._ahead = True, None

    def resume(self, other):
        if isinstance(other, ModelFeedforward):
            self._first, self._prepared = other._first, other._prepared
            self._ahead, self._begins = None, (None, False)
            before = other._run.source
            if self._other_payload(other) and before is not None and before.rests:
                self._first = (
                    True  # starts bent by the new weight; `law` lets the change of torque fade
                )
            else:
                self._run.take(other._run)

    def _other_payload(self, other):
        return self.model.payload_scale != other.model.payload_scale

    def _preparation(self, reference):
        """The preparation of the active trajectory and the time since its start; None, 0 if there is none."""
        prepared, path = self._prepared, reference.path
        if prepared is None or path is None:
            return None, 0.0
        followed = path.followed
        if followed.trajectory_id != prepared.trajectory_id:
            return None, 0.0
        begin = followed.begin_state  # a path that starts again has another array
        if self._begins[0] is not begin:
            self._begins = begin, np.abs(begin - prepared.start).max() <= SAME_START
        if not self._begins[1]:
            return None, 0.0
        return prepared, path.elapsed(reference.stamp_ns)

    def _planned(self, prepared, path, stamp_ns):
        """The plan that is followed at a stamp in place of the slow manifold, if any."""

    def _along(self, plan, path, stamp_ns, offset):
        """State and torque of a plan, `offset` [s] from a stamp."""

    def _source(self, reference, prepared):
        """The motion that the regulator holds the simulated arm to, with its source."""
        path, stamp = reference.path, reference.stamp_ns
        piece = Path.END if path is None else path.piece(stamp)
        plan = self._planned(prepared, path, stamp)
        held = self._held
        if plan is not None:
            piece = piece, path.followed.piece(stamp)
            state, torque = self._along(plan, path, stamp, 0.0)
        elif piece != Path.END:
            state, torque = self._on_manifold(reference)
        elif held is not None and np.array_equal(held[0], reference.position):
            state, torque = held[1:]
        else:
            state, torque = self._at_rest(reference.position)
            self._held = reference.position.copy(), state, torque
        return _Source(path, piece, plan, stamp, state, torque)

    def _on_manifold(self, reference):
        """State (2 (n + m),) and torque (n,) of the slow manifold."""
        delta, rate, torque = self.manifold.along(reference)
        return np.concatenate([reference.position, delta, reference.velocity, rate]), torque

    def _at_rest(self, position):
        """State and torque where the reference rests, exactly as the control model bends under its own weight."""
        model, none = self.model, np.zeros(self.model.n_joints)
        state, torque = self._on_manifold(at_rest(position))
        if not any(model.arm.gravity) or not model.n_modes:
            return state, torque
        try:
            delta = model.static_deflection(position)
        except ModelError:  # it folds there
            return state, torque
        terms = model.terms(position, none, delta, np.zeros_like(delta))
        state[none.size : none.size + delta.size] = delta
        return state, terms.f1 + terms.K1 @ delta

    def _continued(self, source, dt):
        """State and torque that a source would give after a time [s], (2 (n + m) + n,)."""
        if source.plan is not None:
            state, torque = self._along(source.plan, source.path, source.stamp_ns, dt)
        elif source.rests:
            state, torque = source.state, source.torque
        else:
            state, torque = self._on_manifold(At(source.path, source.stamp_ns, dt))
        return np.concatenate([state, torque])

    def update(self, reference, dt):
        ahead, self._ahead = self._ahead, None
        if ahead is not None and ahead.limit is self.limit and ahead.foresaw(reference, dt):
            self._run.take(ahead.run)
            self.acceleration[:] = ahead.acceleration
            return
        if not self._first and dt > 0.0:  # under the torque of the last sample
            self._move(self._run, dt)
        self._regulate(reference, dt, self._run)
        self.acceleration[:] = reference.acceleration

    def _regulate(self, reference, dt, run):
        """Set the torque of a run; its state, too, if the simulated arm starts again."""
        prepared, elapsed = self._preparation(reference)
        source, before = self._source(reference, prepared), run.source
        K, fading = self.K, run.fading
        if K is None and prepared is not None and prepared.gains is not None:
            K = prepared.at(elapsed, reference.path, reference.stamp_ns)
        if self._first or before is None:
            fading.clear()
            if not (source.rests or some(reference.velocity) or reference.acceleration.any()):
                # The first instant of a motion: the arm still rests, but the manifold has jumped.
                rest = np.concatenate(self._at_rest(reference.position))
                fading.jump(rest - np.concatenate([source.state, source.torque]))
        else:
            fading.advance(dt)
            if not source.goes_on(before):
                now = np.concatenate([source.state, source.torque])
                fading.jump(self._continued(before, dt) - now)
        if K is None and run.gained:  # the regulator ends: its remaining error is a jump, too
            wanted = np.concatenate([source.state, source.torque]) + fading.left
            fading.jump(np.concatenate([run.state, run.torque]) - wanted)
        run.source, run.gained = source, K is not None
        compiled, error, left = kernels.compiled(), self._error, fading.left
        # The largest error of the joints, and of all coordinates.
        joints, largest = compiled.off(source.state, left, run.state, error)
        first, self._first = self._first, False
        run.placed = first or not joints < LOST  # also true for NaN
        if run.placed or K is None or (largest < THERE and not some(reference.velocity)):
            run.state += error
            error[:] = 0.0
        gain = self._no_gain if K is None else K
        compiled.regulated(
            source.torque, left, gain, error, self.limit, self._friction, source.state, run.state, run.torque,
            run.driven,
        )  # fmt: skip

    def _move(self, run, dt):
        """Advance a run's simulated arm under its present torque."""
        count = max(1, round(dt / self.settings.period)) * self._substeps
        self._advance(run.state, run.driven, dt / count, count, self._sliding)

    def look_ahead(self, reference, dt):
        if self._first or dt <= 0.0 or reference.path is None:
            return None
        ahead = _Ahead(reference, dt, self.limit)
        run = ahead.run = self._spare
        run.take(self._run)
        self._move(run, dt)
        self._regulate(ahead, dt, run)
        self._ahead = ahead
        n, size = self.model.n_joints, run.state.size // 2
        return run.state[:n], run.state[size : size + n], ahead.acceleration
