# SPDX-License-Identifier: Apache-2.0
r"""Plans a motion of the whole arm that follows a trajectory and leaves the arm at rest, for `preview`.

A small shift p of the reference, which is zero with its rates at both ends, is chosen so that the bending under
:math:`\ddot q = \ddot q_{ref} + \ddot p` is at rest when the trajectory ends. With :math:`p = \sum_j c_j N_j(t)`
(quintic B-splines) the modal rows of (2) along the reference,

.. math:: M_{22}\ddot\delta + C_2\dot\delta + K_2\delta = -M_{21}(\ddot q_{ref} + \ddot p) - f_2,

are linear in c to first order. The shift with the least mean square,

.. math::
    \min_c \frac{1}{T}\int |p|^2 + \epsilon\,|\ddot p|^2/\omega_1^4\,dt + \rho^2\sum_v |r_v|^2 \quad\text{s.t.}\quad
    \delta(T) = \bar\delta,\; \dot\delta(T) = 0,

solves one linear system; :math:`r_v` is explained below. (A linear programme finds the shift with the smallest maximum
within the torque limit. It takes less time, but this shift turns steeply from bound to bound and excites modes beside
the plan; one random arm was lost with it.) The full equations are then integrated along the solution, and the next
round removes the bending that remains at the end. It uses the same derivatives as long as each change is much smaller
than the one before it.

Torque beyond a fraction of the limit, `Settings.share`, is penalised. The rest is left to the feedback, for what the
model does not know. An arm with a heavier payload needs more torque. If its joints are at their limits, they fall
behind, and the feedback no longer damps the links: two random arms were lost when plans took 0.95 of the limits.

Some modes can't be brought to rest in this way, such as the vertical bending of an arm that only yaws: no torque
reaches them, and no control damps them after the motion. Yet the motion excites them. Where an arm sags, for example,
the centrifugal force lifts it, and this force goes with the squares of the joints' speeds. So the shift also determines
what the motion leaves in such a mode. Let :math:`r_v` be the amplitude of the tip, over the reach, and its rate over
the mode's frequency. The shift makes these small for arms v whose frequencies are up to `Settings.spread` higher or
lower, because the arm's payload is not known exactly. The model's own arm has the largest weight. If there is no such
shift within the torque limit, these modes are left as they are.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline, CubicHermiteSpline, make_interp_spline
from scipy.linalg import eigh
from scipy.optimize import nnls

from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import DesignError, ModelError
from flexarm_dynamics.models.fixed_step import METHODS
from flexarm_dynamics.models.model import made

from .. import kernels
from ..trajectory.values import SECOND
from .base import SHARE, torque_for_motion

#: Knots of the shift per period of the lowest bending mode.
KNOTS_PER_PERIOD = 6.0
#: Minimum and maximum number of free coefficients per joint.
MIN_COUNT, MAX_COUNT = 24, 160
#: Modes slower than this phase per knot are brought to rest; faster ones follow without being excited [rad].
FASTEST = 3.0
#: Maximum number of rounds, and change of the shift after which there is no further round [rad]. The equations are
#: linearised again if a change is more than this fraction of the one before it.
ROUNDS, CLOSE, SLOW = 8, 1e-7, 0.2
#: A plan is not found if its last change was more than this [rad]. The search for it ends early if, after this many
#: rounds, the change is also still more than `SLOW` of the first one. If the last change was smaller, the regulator
#: removes the remaining error.
FOUND, HOPELESS = 0.02, 5
#: Weight of the penalty on torque beyond the planned fraction of the limit, and maximum number of rounds in which
#: further times at which it is beyond are found.
PENALTY, PENALTIES = 1.0, 30
#: Approximate number of times at which the torque is bounded.
GRID = 100
#: Number of times at which the equations are linearised, in the first round and later, and the step of the finite
#: differences [rad], [rad/s]. With the first number throughout, the rounds hardly converge where the torque limit is
#: active: for one random arm no plan was found.
KNOTS, SMALL = (80, 400), 1e-6
#: Weight of the shift's acceleration, over the square of the lowest bending frequency, relative to the shift.
SMOOTHNESS = 0.01
#: Phase of the fastest mode per step at which the fourth-order Runge-Kutta method is stable, with a margin. The second,
#: smaller phase is for motions that make this mode so fast that the first is too large [rad].
STABLE, STABLER = 1.5, 0.75
#: Grid steps per period of the fastest mode that is brought to rest.
STEPS_PER_PERIOD = 40.0
#: A mode is not brought to rest if the force on it is less than this fraction of that on others [-]: the force of the
#: joints' acceleration at the end (the first number), or the force of the shift (the second). If the shift's force is
#: also less than the first number, the mode is not looked at.
UNDRIVEN, UNMOVED = 1e-6, 1e-2
#: Smallest force that counts as one.
TINY = 1e-300
#: What is left of modes that are not brought to rest is made small at these fractions of the spread of frequencies [-],
#: and with this weight on the amplitude of the tip over the reach, relative to the shift: rho [rad]. For the model's
#: own arm the weight is this many times as large.
SPREADS, QUIET, OWN = (-1.0, -0.5, 0.5, 1.0), 100.0, 10.0
#: The plan's step is at most this fraction of the step of `STEPS_PER_PERIOD`, or one step of the integration [-].
PLANNED = 0.25
#: A motion of more steps is not planned.
MAX_STEPS = 40_000


@dataclass(frozen=True)
class Plan:
    """A motion of the whole arm from rest to rest, as a function of the time since its start."""

    duration: float  # [s]
    motion: CubicHermiteSpline  # (q, delta, qd, delta_d)
    torque: np.ndarray  # at the grid's times, (k, n) [N m]
    step: float  # of the grid [s]
    note: str = ""  # why it does not end at rest, if it does not

    def state_at(self, elapsed):
        """State (2 (n + m),) at a time since the start [s]."""
        motion = self.motion
        out = np.empty(motion.c.shape[2])
        kernels.compiled().cubic(motion.c, motion.x, elapsed, out)
        return out

    def among(self, model, fuller):
        """The plan of a `model` as a plan of a `fuller` model, whose further modes rest."""
        n, names = model.n_joints, fuller.mode_names
        here = np.r_[np.arange(n), [n + names.index(name) for name in model.mode_names]]
        here = np.r_[here, here + n + len(names)]
        x = self.motion.x
        values, rates = np.zeros((2, x.size, 2 * (n + len(names))))
        values[:, here], rates[:, here] = self.motion(x), self.motion(x, 1)
        return replace(self, motion=CubicHermiteSpline(x, values, rates))

    def torque_at(self, elapsed):
        """Torque (n,) at a time since the start [s]."""
        out = np.empty(self.torque.shape[1])
        kernels.compiled().evenly_between(self.torque, elapsed / self.step, out)
        return out


class Unbounded(DesignError):
    """A motion whose numbers are not finite."""


def finite(*arrays):
    """The arrays, if all of their numbers are finite."""
    if not all(np.isfinite(a).all() for a in arrays):
        raise Unbounded(
            "the arm does not stand this motion", field="preview", hint="give it more time"
        )
    return arrays


def planned(model, path, start, limit, spread=0.0, share=SHARE):
    """The `Plan` of a `Planner`; it is made again in shorter steps if the motion grows without bound.

    Parameters
    ----------
    model, path, start, limit, spread, share
        As for `Planner`.

    Raises
    ------
    DesignError
        If no shift of the reference is found within the torque limit.
    """
    planner = Planner(model, path, start, limit, spread, share)
    try:
        return planner.solve()
    except Unbounded:
        finer = Planner(model, path, start, limit, spread, share, STABLER)
        if finer.steps == planner.steps:
            raise
        return finer.solve()


class Planner:
    """Plans one trajectory; see the module.

    Parameters
    ----------
    model : ArmModel
    path : Path
        Of the trajectory.
    start : ndarray, shape (3, n)
        State of rest from which it begins.
    limit : ndarray, shape (n,)
        Torque limits [N m]; infinite: none.
    spread : float
        Relative error of the frequencies of modes that the joints hardly move [-]; 0: these modes are left as they are.
    share : float
        Fraction of the torque limits beyond which torque is penalised [-].
    phase : float
        Largest phase of the fastest mode per step [rad].
    count : int, optional
        Number of intervals between the knots of the shift.
    """

    def __init__(
        self, model, path, start, limit, spread=0.0, share=SHARE, phase=STABLE, count=None
    ):
        self.model, self.start, self.limit = model, start, limit
        self.spread, self.share, self._path, self._phase = spread, share, path, phase
        self._others = None  # planners of arms with other frequencies
        self.stepper = model.driven_stepper(METHODS["rk4"])
        n, m = model.n_joints, model.n_modes
        self.duration = path.duration_ns / SECOND
        end = np.zeros((3, n))
        path.evaluate(path.duration_ns, end)
        at_end = model.terms(end[0], end[1])
        # The joints are prescribed here, so these are the modes of the arm with its joints locked.
        squares, shapes = eigh(at_end.K2, at_end.M[n:, n:]) if m else (np.array([100.0]), None)
        omega = np.sqrt(np.maximum(squares, 1e-6))
        self.omega = omega[0]
        if count is None:
            count = KNOTS_PER_PERIOD * self.duration * omega[0] / (2.0 * np.pi)
            count = int(np.clip(np.ceil(count), MIN_COUNT, MAX_COUNT))
        knots, self.count = np.linspace(0.0, self.duration, count + 1), count
        slow = max(1, int(np.sum(omega * knots[1] < FASTEST))) if m else 0
        self.rest = model.static_deflection(end[0])
        self.planned = omega[:slow]
        self.modal = shapes[:, :slow].T @ at_end.M[n:, n:] if m else np.zeros((0, 0))
        shown = [self._shown(end[0], shapes[:, i]) for i in range(slow)] if m else []
        self.shown = np.array(shown) / model.arm.reach
        coupling = np.abs(shapes.T @ at_end.M[n:, :n]).max(axis=1) if m else np.zeros(0)
        self.driven = coupling[:slow] > UNDRIVEN * coupling.max(initial=0.0)
        step = min(2.0 * np.pi / omega[max(slow, 1) - 1] / STEPS_PER_PERIOD, 0.01)
        self.steps = int(np.ceil(self.duration / min(step, phase / omega[-1])))
        # The plan has fewer steps than the integration if a faster mode that is not planned needs short ones.
        self.stride = max(1, int(PLANNED * step * self.steps / self.duration))
        self.steps = self.stride * int(np.ceil(self.steps / self.stride))
        if self.steps > MAX_STEPS:
            raise DesignError(
                f"a motion of {self.duration:g} s takes {self.steps} steps",
                field="preview",
                limit=f"at most {MAX_STEPS}",
                hint="plan it in parts, or set feedforward: model",
            )
        self.h = self.duration / self.steps
        # Whole steps and the midpoints between, as the Runge-Kutta method needs them.
        self.times = np.linspace(0.0, self.duration, 2 * self.steps + 1)
        self.reference = np.zeros((self.times.size, 3, n))
        for k, t in enumerate(self.times):
            # Just before the end, the acceleration is the last polynomial's, not that of the rest after it.
            path.evaluate(min(round(t * SECOND), path.duration_ns - 1), self.reference[k])
        knots = np.concatenate([np.zeros(5), knots, np.full(5, self.duration)])
        everything = BSpline(knots, np.eye(knots.size - 6), 5)
        # Without the first and last three, shift, velocity and acceleration are zero at either end.
        self.basis = np.array([everything(self.times, nu)[:, 3:-3] for nu in range(3)])

    def _shown(self, q, shape):
        """Displacement of the tip per unit of a mode's amplitude, of the arm at rest at q [m]."""
        there = self.model.tip_position(q, self.rest + SMALL * shape)
        return np.linalg.norm(there - self.model.tip_position(q, self.rest)) / SMALL

    def solve(self):
        """The plan, after up to `ROUNDS` rounds, each about the result of the last one.

        If there is none, more of the torque is used; if there is still none, modes that can't be brought to rest are
        left as they are.
        """
        try:
            return self._solved()
        except Unbounded:
            raise
        except DesignError:
            if self.share < SHARE:
                self.share = SHARE
            elif self._others is not None:
                self.spread, self._others = 0.0, None
            else:
                raise
        return self.solve()

    def _solved(self):
        n = self.model.n_joints
        c, knots, sizes = np.zeros((n, self.basis.shape[2])), KNOTS[0], []
        for _ in range(ROUNDS if self.model.n_modes else 0):
            self._along(c)
            change = self._change(c, knots)
            c = c + change
            sizes.append(np.abs(self.basis[0] @ change.T).max())
            if sizes[-1] < CLOSE:
                break
            knots = KNOTS[1] if len(sizes) > 1 and sizes[-1] > SLOW * sizes[-2] else 0
            hopeless = len(sizes) >= HOPELESS and sizes[-1] > SLOW * sizes[0]
            if sizes[-1] > FOUND and (hopeless or len(sizes) == ROUNDS):
                raise DesignError(
                    f"of the plan, {sizes[-1]:.2g} rad still change after {len(sizes)} rounds",
                    field="preview",
                    limit=f"{FOUND:g} rad",
                    hint="give the motion more time",
                )
        self._along(c)
        x, v = finite(*self._bend())
        at = np.arange(0, self.steps + 1, self.stride)
        a, torque = finite(*self._forces(at, x, v))
        self._refuse_beyond(torque)
        q, x, v = self.motion[2 * at], x[at], v[at]
        state = np.concatenate([q[:, 0], x, q[:, 1], v], axis=1)
        rates = np.concatenate([q[:, 1], v, q[:, 2], a], axis=1)
        motion = CubicHermiteSpline(self.times[2 * at], state, rates)
        return Plan(self.duration, motion, torque, self.stride * self.h)

    def _bend(self):
        """Bending and its rate under the motion, products of deflections included, at whole steps, (steps + 1, m)."""
        q, (n, m) = self.motion[::2], (self.model.n_joints, self.model.n_modes)
        states = np.zeros((len(q), 2 * (n + m)))
        states[:, :n], states[:, n + m : 2 * n + m] = q[:, 0], q[:, 1]
        states[0, n : n + m] = self.model.static_deflection(self.start[0])
        bent = (slice(n, n + m), slice(2 * n + m, None))
        if self.stepper is None:
            for i in range(self.steps):
                x, v = (states[i, part] for part in bent)
                for part, values in zip(bent, self._step(i, x, v), strict=True):
                    states[i + 1, part] = values
            return tuple(states[:, part] for part in bent)
        # In each step, the acceleration is a straight line with the same mean, by Simpson's rule, and first moment.
        change = np.diff(q[:, 2], axis=0)
        begin = (q[:-1, 2] + 4.0 * self.motion[1::2, 2] + q[1:, 2]) / 6.0 - 0.5 * change
        for i in range(self.steps):
            state = states[i].copy()
            self.stepper(state, begin[i], self.h, change=change[i])
            for part in bent:
                states[i + 1, part] = state[part]
        return tuple(states[:, part] for part in bent)

    def _step(self, i, x, v):
        """Bending and its rate after one more step of the Runge-Kutta method."""
        h, (begin, middle, end) = self.h, self.motion[2 * i : 2 * i + 3]
        a1 = self._bending(*begin, x, v)[0]
        v2 = v + 0.5 * h * a1
        a2 = self._bending(*middle, x + 0.5 * h * v, v2)[0]
        v3 = v + 0.5 * h * a2
        a3 = self._bending(*middle, x + 0.5 * h * v2, v3)[0]
        v4 = v + h * a3
        a4 = self._bending(*end, x + h * v3, v4)[0]
        x, a = x + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4), a1 + 2.0 * a2 + 2.0 * a3 + a4
        return x, v + h / 6.0 * a

    def _forces(self, at, x, v):
        """Acceleration of the bending (k, m) and joint torque (k, n) at some whole steps of the motion."""
        found = [self._bending(*self.motion[2 * k], x[k], v[k]) for k in at]
        return np.array([a for a, _ in found]), np.array([u for _, u in found])

    def _along(self, c):
        """Set the motion: the reference shifted by c."""
        self.motion = self.reference + np.einsum("dtj,nj->tdn", self.basis, c)

    def _linearise(self, x, v, knots):
        """Derivatives of the bending's acceleration and of the joint torque along a motion, at all times.

        The derivatives with respect to the deflection and its rate, and to the joints' position, velocity and
        acceleration, are finite differences of the full (2) at `knots` times, and linear between these.
        """
        n, m = self.model.n_joints, self.model.n_modes
        at = 2 * np.unique(np.linspace(0, self.steps, knots).astype(int))
        (found,) = finite(np.array([self._derivatives(k, x[k // 2], v[k // 2]) for k in at]))
        flat = make_interp_spline(self.times[at], found.reshape(len(at), -1), 1)(self.times)
        everywhere = flat.reshape(-1, m + n, 3 * n + 3 * m)
        # Columns: q, qd, qdd, x, v, and the bending's own acceleration, on which only the torque depends.
        columns = np.cumsum([n, n, n, m, m])
        a, u = everywhere[:, :m], everywhere[:, m:]
        self.by_joints, self.spring, self.damper, _ = np.split(a, columns[2:], axis=2)
        self.torque_by_joints, self.K1, self.C1, self.M12 = np.split(u, columns[2:], axis=2)

    def _derivatives(self, k, x, v):
        q, qd, qdd = self.motion[k]
        n, m = self.model.n_joints, self.model.n_modes
        M, (a, _) = self.model.mass_matrix(q, x), self._bending(q, qd, qdd, x, v)
        out = np.zeros((m + n, 3 * n + 3 * m))
        out[:n, 2 * n : 3 * n], out[n:, 2 * n : 3 * n] = M[:n, :n], M[n:, :n]
        out[:n, -m:] = M[:n, n:]
        here = self.model.inverse_dynamics(q, qd, qdd, x, v, a)
        for values, first in ((q, 0), (qd, n), (x, 3 * n), (v, 3 * n + m)):
            for j in range(values.size):
                kept, values[j] = values[j], values[j] + SMALL
                there = self.model.inverse_dynamics(q, qd, qdd, x, v, a)
                values[j] = kept
                out[:, first + j] = (there - here) / SMALL
        # The bending accelerates so that the modal rows of (2) stay zero; M12 adds the torque for this.
        return np.vstack([-np.linalg.solve(M[n:, n:], out[n:]), out[:n]])

    def _bending(self, q, qd, qdd, x, v):
        """Acceleration of the bending, and joint torque, by the full (2), with the joints moved as given."""
        n, model = self.model.n_joints, self.model
        M = model.mass_matrix(q, x)
        forces = model.inverse_dynamics(q, qd, qdd, x, v, np.zeros_like(x))
        a = -np.linalg.solve(M[n:, n:], forces[n:]) if x.size else x
        return a, forces[:n] + M[:n, n:] @ a

    def _respond(self, at):
        """Linear response of the bending to each coefficient of the shift, at some whole steps: (k, 3, m, n count)."""
        m, n, count = self.model.n_modes, self.model.n_joints, self.basis.shape[2]
        by = np.ascontiguousarray(self.by_joints.reshape(-1, m, 3, n))
        out = np.zeros((at.size, 3, m, n * count))
        parts = (np.ascontiguousarray(part) for part in (self.spring, self.damper))
        kernels.compiled().responses(*parts, by, self.basis, self.h, at, out)
        return out

    def _torque(self, bending, at):
        """Joint torque that belongs to `_respond`'s columns, (k, n, n count)."""
        n, count = self.model.n_joints, self.basis.shape[2]
        by = self.torque_by_joints[2 * at].reshape(-1, n, 3, n)
        u = np.einsum("tidj,dtc->tijc", by, self.basis[:, 2 * at]).reshape(-1, n, n * count)
        for matrix, part in ((self.M12, 2), (self.C1, 1), (self.K1, 0)):
            u += np.einsum("tij,tjc->tic", matrix[2 * at], bending[:, part])
        return u

    def _change(self, c, knots):
        """Change of the shift's coefficients, (n, count), by the last derivatives, or by new ones at `knots` times."""
        x, v = finite(*self._bend())
        at = np.unique(np.append(np.arange(0, self.steps, max(1, self.steps // GRID)), self.steps))
        if knots:
            self._linearise(x, v, knots)
            forced = self._respond(at)
            (self.torque_by,) = finite(self._torque(forced, at))
            self._take_end(forced[-1])
        moved = np.tile(self.moved, 2)
        A, b = self.bends[moved], -self._left(x[-1], v[-1])[moved]
        # All rows are scaled alike, since deflections are thousandths.
        scale = 1.0 / np.abs(A).max(axis=1)
        A, b = A * scale[:, None], b * scale
        _, u = finite(*self._forces(at, x, v))
        quiet, most = self._quiet(c, x, v, knots), self._for_motion(at)
        return self._within_limits(c, A, b, quiet, u, self.torque_by, most)

    def _take_end(self, forced):
        """Keep how the planned modes respond at the end, from `_respond`'s last row, and which of them are moved."""
        self.bends = np.vstack([self.modal @ forced[0], self.modal @ forced[1]])
        largest = np.abs(self.bends).max(axis=1).reshape(2, -1)
        each = largest * [self.planned**2, self.planned]  # scaled as forces
        each /= np.maximum(each.max(axis=1, initial=0.0), TINY)[:, None]
        self.moved = self.driven & (each > UNMOVED).all(axis=0)
        self.excited = ~self.moved & (each > UNDRIVEN).any(axis=0)

    def _left(self, x, v):
        """Amplitudes of the planned modes at the end, beside rest, and their rates, (2 slow,)."""
        return np.concatenate([self.modal @ (x - self.rest), self.modal @ v])

    def _quiet(self, c, x, v, knots):
        """Rows of the least squares, and their values, by which little is left of modes that are not moved.

        The bending along the motion is (x, v). The derivatives are new if `knots`.
        """
        rows, values = np.zeros((0, c.size)), np.zeros(0)
        if not self.spread or not self.excited.any():
            return rows, values
        if self._others is None:
            self._others = []
            self._others += self._alike()
        ends = [(self, x[-1], v[-1])]
        for other in self._others:
            other._along(c)
            x, v = finite(*other._bend())
            if knots:
                other._linearise(x, v, KNOTS[0])
                other._take_end(*finite(other._respond(np.array([0, other.steps]))[-1]))
            ends.append((other, x[-1], v[-1]))
        for arm, *end in ends:
            which = np.tile(arm.excited, 2)
            weight = QUIET * (OWN if arm is self else 1.0)
            factor = weight * np.concatenate([arm.shown, arm.shown / arm.planned])[which]
            rows = np.vstack([rows, factor[:, None] * arm.bends[which]])
            values = np.append(values, -factor * arm._left(*end)[which])
        return rows, values

    def _alike(self):
        """Planners for arms with other frequencies, with the same shifts.

        Softer arms that do not rest at an end are left out, and stiffer ones that need too many steps.
        """
        arm, payload = self.model.origin
        for part in SPREADS:
            stiffness = (1.0 + self.spread * part) ** 2
            try:
                model = made(scaled(arm, stiffness=stiffness), payload)
                model.static_deflection(self.start[0])
                more = 0.0, self.share, self._phase, self.count
                yield Planner(model, self._path, self.start, self.limit, *more)
            except (DesignError, ModelError):
                continue

    def _refuse_beyond(self, torque):
        """Raise a `DesignError` for a torque, (k, n), beyond the limit."""
        needed = np.abs(torque).max(axis=0)
        if (needed > self.limit).any():
            raise DesignError(
                f"no motion within the torque limits leaves the arm at rest: the best takes"
                f" {np.round(needed, 3).tolist()} N m",
                field="preview",
                limit=f"{np.round(self.limit, 3).tolist()} N m",
                hint="give it more time",
            )

    def _for_motion(self, at):
        """Torque over the limit that the motion should take at some whole steps, (k, n) [-]."""
        most = np.full((at.size, self.limit.size), self.share)
        if not any(self.model.arm.gravity):
            return most
        still = np.zeros(self.limit.size)
        for row, k in zip(most, at, strict=True):
            weight = self.model.terms(self.reference[2 * k, 0], still).f1
            row[:] = torque_for_motion(1.0, weight / self.limit, self.share)
        return most

    def _within_limits(self, c, A, b, quiet, u, du, most):
        """The change x (n, count) with A x = b after which the function of the module is smallest.

        Torque over the limit, of u + du x, beyond `most` (k, n) is penalised by the square of what is beyond.
        """
        n, count = c.shape
        N, Ndd = self.basis[0], self.basis[2] / self.omega**2
        weight = (N.T @ N + SMOOTHNESS * Ndd.T @ Ndd) / len(N)
        # The penalty weighs the same whatever the number of times and coefficients.
        unit = np.abs(weight).max()
        H = np.kron(np.eye(n), weight / unit)
        right = -H @ c.ravel()
        rows, values = (part / np.sqrt(unit) for part in quiet)
        H, right = H + rows.T @ rows, right + rows.T @ values
        limited = np.flatnonzero(np.isfinite(self.limit))
        limit = self.limit[limited]
        here = (u[:, limited] / limit).ravel()
        by = (du[:, limited] / limit[:, None]).reshape(here.size, n * count)
        change = _least(H, right, A, b)
        most = most[:, limited].ravel()
        if (np.abs(here + by @ change) <= most).all():
            return change.reshape(n, count)
        rows, values = np.vstack([by, -by]), np.append(most - here, most + here)
        return _penalised(H, right, A, b, rows, values, change).reshape(n, count)


def _least(H, right, A, b):
    """x, (k,) or (k, p), with A x = b and the least :math:`x^T H x / 2 - right^T x`."""
    held = len(b)
    kkt = np.block([[H, A.T], [A, np.zeros((held, held))]])
    return np.linalg.lstsq(kkt, np.concatenate([right, b]), rcond=1e-12)[0][: len(H)]


def _penalised(H, right, A, b, rows, values, x):
    r"""As `_least`, whose result is `x`, with a penalty where `rows` x exceeds `values`.

    The penalty is :math:`w\,|\max(0, R x - d)|^2/2` with the rows R, the values d and w = `PENALTY`. The solution is
    :math:`x = x_0 - P\lambda`. The columns of P are `_least` of those of :math:`R^T` with b = 0. The multipliers
    :math:`\lambda \ge 0` minimise :math:`\lambda^T (R P + 1/w) \lambda / 2 - \lambda^T (R x_0 - d)`, which is a problem
    of non-negative least squares. Only rows that exceeded their value in a round are included.
    """
    free, active = x, np.zeros(len(rows), bool)
    for _ in range(PENALTIES):
        beyond = rows @ x > values
        if not (beyond & ~active).any():
            break
        active |= beyond
        R = rows[active]
        P = _least(H, R.T, A, np.zeros((len(b), len(R))))
        try:
            half = np.linalg.cholesky(R @ P + np.eye(len(R)) / PENALTY)
            wanted = np.linalg.solve(half, R @ free - values[active])
            x = free - P @ nnls(half.T, wanted)[0]
        except (np.linalg.LinAlgError, RuntimeError) as error:
            raise DesignError(
                f"no plan within the torque limits is found ({error})",
                field="preview",
                hint="give the motion more time",
            ) from None
    return x
