# SPDX-License-Identifier: Apache-2.0
r"""Feed-forward with preview: a motion that bends the arm and leaves it straight at its end.

A trajectory is known as a whole when it is received, and the joints need not follow it exactly. A small shift p of the
reference, zero with its rates at both ends, is chosen so that the bending under
:math:`\ddot q = \ddot q_{ref} + \ddot p` is at rest when the trajectory ends. With :math:`p = \sum_j c_j N_j(t)`
(quintic B-splines) the modal rows of (2) along the reference,

.. math:: M_{22}\ddot\delta + C_2\dot\delta + K_2\delta = -M_{21}(\ddot q_{ref} + \ddot p) - f_2,

are linear in c to first order. The shift of least mean square,

.. math::
    \min_c \int |p|^2 + \epsilon\,|\ddot p|^2/\omega_1^4\,dt \quad\text{s.t.}\quad
    \delta(T) = \bar\delta,\; \dot\delta(T) = 0,

solves one linear system. If its torque exceeds the limit, what is beyond 0.95 of it is penalised where it is, round by
round; if that does not end within the limit, a linear programme (HiGHS through scipy) finds the shift with the smallest
maximum, which is rougher: its steep turns excite the modes that are not in the plan. The full equations are then
integrated along the solution, linearised there, and solved again. A mode that the shift does not move is left out. All
of this happens when the trajectory is received, off the control path. `model` follows the motion in place of the slow
manifold: the regulator of its simulated arm removes the remaining error. Where no shift is found the manifold remains,
and the reason is in `Preparation.note`.

In a stop, the plan can't be followed. Its bending beside the slow manifold is a vibration, which goes on in its own
time and ends with the plan; the regulator damps it as the joints slow down. So with the manifold's motion s_ref along
the stop, and s_path along the trajectory, the simulated arm is held to

.. math:: s_{ref}(t) + \dot s(t)\,\bigl(s_{plan}(t) - s_{path}(t)\bigr),

where :math:`\dot s`, from 1 to 0, is the stop's time law (module `trajectory.path`); likewise the torque.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, CubicHermiteSpline, make_interp_spline
from scipy.linalg import eigh
from scipy.optimize import linprog

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models.fixed_step import METHODS

from .. import kernels
from ..trajectory.values import SECOND
from .model import At, ModelFeedforward

#: Knots of the shift per period of the lowest bending mode.
KNOTS_PER_PERIOD = 6.0
#: Least and largest number of free coefficients per joint.
MIN_COUNT, MAX_COUNT = 24, 160
#: Modes slower than this phase per knot are brought to rest; faster ones follow without being excited [rad].
FASTEST = 3.0
#: Rounds of linearisation at most, and change of the shift after which there is no other one [rad].
ROUNDS, CLOSE = 6, 1e-7
#: Of the torque limit, the part that a plan takes where it would take more; what is beyond is penalised by a weight, in
#: so many rounds at most.
RESERVED, PENALTY, PENALTIES = 0.95, 1.0, 30
#: Number of times at which shift and torque are bounded.
GRID = 100
#: Number of times at which the equations are linearised, and the step of the differences [rad], [rad/s].
KNOTS, SMALL = 80, 1e-6
#: Weight of the shift's acceleration, over the square of the lowest bending frequency, beside the shift.
SMOOTHNESS = 0.01
#: Phase of the fastest mode per step at which Runge-Kutta's fourth order is still stable, with a margin [rad].
STABLE = 1.5
#: Grid steps per period of the fastest mode that is brought to rest.
STEPS_PER_PERIOD = 40.0
#: A mode that the shift moves by less than this of what it moves the others by is left as it is [-].
UNMOVED = 1e-6
#: Length of the plan's steps over that of those grid steps, at most [-].
PLANNED = 0.25
#: A longer motion is not planned [samples].
MAX_STEPS = 20_000


@dataclass(frozen=True)
class Plan:
    """A motion of the whole arm from rest to rest, by the time since its start."""

    duration: float  # [s]
    motion: CubicHermiteSpline  # (q, delta, qd, delta_d)
    torque: np.ndarray  # at the grid's times, (k, n) [N m]
    step: float  # of the grid [s]

    def state_at(self, elapsed):
        """State (2 (n + m),) at a time since the start [s]."""
        motion = self.motion
        out = np.empty(motion.c.shape[2])
        kernels.compiled().cubic(motion.c, motion.x, elapsed, out)
        return out

    def torque_at(self, elapsed):
        """Torque (n,) at a time since the start [s]."""
        out = np.empty(self.torque.shape[1])
        kernels.compiled().evenly_between(self.torque, elapsed / self.step, out)
        return out


class Preview(ModelFeedforward):
    """The planned motion, while there is one; `model` otherwise. See the module."""

    plans = True

    def _make_stepper(self):
        super()._make_stepper()
        n, size = self.model.n_joints, 2 * (self.model.n_joints + self.model.n_modes)
        none = Plan(
            1.0, CubicHermiteSpline([0.0, 1.0], *np.zeros((2, 2, size))), np.zeros((2, n)), 1.0
        )
        none.state_at(0.0), none.torque_at(0.0)

    def _plan(self, model, path, start):
        with np.errstate(over="ignore", invalid="ignore"):  # `_finite` checks the results
            return _Planner(model, path, start, self.limit).solve()

    def _planned(self, prepared, path, stamp_ns):
        if prepared is None or prepared.plan is None or path.scaled:
            return None  # a plan at another speed is no motion of the arm
        elapsed_ns = stamp_ns - path.followed.start_ns
        return prepared.plan if 0 <= elapsed_ns < prepared.plan.duration * SECOND else None

    def _along(self, plan, path, stamp_ns, offset):
        way = path.followed
        elapsed = (stamp_ns - way.start_ns) / SECOND + offset
        # The torque is held over the coming period: that of its middle.
        state, torque = plan.state_at(elapsed), plan.torque_at(elapsed + 0.5 * self.settings.period)
        if path is way:
            return state, torque
        stop, motion = (self._on_manifold(At(p, stamp_ns, offset)) for p in (path, way))
        left = path.speed(stamp_ns, offset)
        return stop[0] + left * (state - motion[0]), stop[1] + left * (torque - motion[1])


def _finite(*arrays):
    """The arrays, if all of their numbers are finite."""
    if not all(np.isfinite(a).all() for a in arrays):
        raise DesignError(
            "the arm does not stand this motion", field="preview", hint="give it more time"
        )
    return arrays


class _Planner:
    """One trajectory's linear programme."""

    def __init__(self, model, path, start, limit):
        self.model, self.start, self.limit = model, start, limit
        self.stepper = model.driven_stepper(METHODS["rk4"])
        n, m = model.n_joints, model.n_modes
        self.duration = path.duration_ns / SECOND
        end = np.zeros((3, n))
        path.evaluate(path.duration_ns, end)
        at_end = model.terms(end[0], end[1])
        # The joints are prescribed here: the modes of the arm with its joints locked.
        squares, shapes = eigh(at_end.K2, at_end.M[n:, n:]) if m else (np.array([100.0]), None)
        omega = np.sqrt(np.maximum(squares, 1e-6))
        self.omega = omega[0]
        count = KNOTS_PER_PERIOD * self.duration * omega[0] / (2.0 * np.pi)
        count = int(np.clip(np.ceil(count), MIN_COUNT, MAX_COUNT))
        knots = np.linspace(0.0, self.duration, count + 1)
        slow = max(1, int(np.sum(omega * knots[1] < FASTEST))) if m else 0
        self.rest = model.static_deflection(end[0])
        self.modal = shapes[:, :slow].T @ at_end.M[n:, n:] if m else np.zeros((0, 0))
        step = min(2.0 * np.pi / omega[max(slow, 1) - 1] / STEPS_PER_PERIOD, 0.01)
        self.steps = int(np.ceil(self.duration / min(step, STABLE / omega[-1])))
        # The plan has fewer, where the fastest mode, which is not planned, needs short steps.
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
        # Whole steps and the midpoints between, as Runge-Kutta wants them.
        self.times = np.linspace(0.0, self.duration, 2 * self.steps + 1)
        self.reference = np.zeros((self.times.size, 3, n))
        for k, t in enumerate(self.times):
            # Up to the end, not at it: there the last polynomial's acceleration counts, not the rest after it.
            path.evaluate(min(round(t * SECOND), path.duration_ns - 1), self.reference[k])
        knots = np.concatenate([np.zeros(5), knots, np.full(5, self.duration)])
        everything = BSpline(knots, np.eye(knots.size - 6), 5)
        # Without the first and last three: zero at either end, with velocity and acceleration.
        self.basis = np.array([everything(self.times, nu)[:, 3:-3] for nu in range(3)])

    def solve(self):
        """The plan, after up to `ROUNDS` of linearisation about the last one."""
        n = self.model.n_joints
        c = np.zeros((n, self.basis.shape[2]))
        for _ in range(ROUNDS if self.model.n_modes else 0):
            self._along(c)
            change = self._programme(c)
            c = c + change
            if np.abs(self.basis[0] @ change.T).max() < CLOSE:
                break
        self._along(c)
        x, v = _finite(*self._bend())
        at = np.arange(0, self.steps + 1, self.stride)
        a, torque = _finite(*self._forces(at, x, v))
        q, x, v = self.motion[2 * at], x[at], v[at]
        state = np.concatenate([q[:, 0], x, q[:, 1], v], axis=1)
        rates = np.concatenate([q[:, 1], v, q[:, 2], a], axis=1)
        motion = CubicHermiteSpline(self.times[2 * at], state, rates)
        return Plan(self.duration, motion, torque, self.stride * self.h)

    def _bend(self):
        """Bending and its rate under the motion, products of deflections included, at whole steps, (steps + 1, m)."""
        start = self.model.static_deflection(self.start[0])
        if self.stepper is None:
            found = self._integrated(lambda k, x, v: self._bending(*self.motion[k], x, v)[0], start)
            return found[:, 0], found[:, 1]
        q, (n, m) = self.motion[::2], (self.model.n_joints, self.model.n_modes)
        states, change = np.zeros((len(q), 2 * (n + m))), np.diff(q[:, 2], axis=0)
        # The line in each step that has the acceleration's mean, by Simpson's rule, and its first moment.
        begin = (q[:-1, 2] + 4.0 * self.motion[1::2, 2] + q[1:, 2]) / 6.0 - 0.5 * change
        states[0, n : n + m] = start
        states[:, :n], states[:, n + m : 2 * n + m] = q[:, 0], q[:, 1]
        for i in range(self.steps):
            state, after = states[i].copy(), states[i + 1]
            self.stepper(state, begin[i], self.h, change=change[i])
            after[n : n + m], after[2 * n + m :] = state[n : n + m], state[2 * n + m :]
        return states[:, n : n + m], states[:, 2 * n + m :]

    def _forces(self, at, x, v):
        """Acceleration of the bending (k, m) and joint torque (k, n) at some whole steps of the motion."""
        found = [self._bending(*self.motion[2 * k], x[k], v[k]) for k in at]
        return np.array([a for a, _ in found]), np.array([u for _, u in found])

    def _integrated(self, acceleration, start):
        """Deflection and its derivatives at whole steps, (steps + 1, 3, ...), by Runge-Kutta's method from rest.

        `acceleration` takes the place in `times`, a deflection and its rate.
        """
        h, out = self.h, np.zeros((self.steps + 1, 3, *start.shape))
        out[0, 0] = start
        for i in range(self.steps):
            x, v, k = out[i, 0], out[i, 1], 2 * i
            a1 = out[i, 2] = acceleration(k, x, v)
            v2 = v + 0.5 * h * a1
            a2 = acceleration(k + 1, x + 0.5 * h * v, v2)
            v3 = v + 0.5 * h * a2
            a3 = acceleration(k + 1, x + 0.5 * h * v2, v3)
            v4 = v + h * a3
            a4 = acceleration(k + 2, x + h * v3, v4)
            out[i + 1, 0] = x + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
            out[i + 1, 1] = v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        out[-1, 2] = acceleration(2 * self.steps, out[-1, 0], out[-1, 1])
        return out

    def _along(self, c):
        """Set the motion: the reference shifted by c."""
        self.motion = self.reference + np.einsum("dtj,nj->tdn", self.basis, c)

    def _linearise(self, x, v):
        """Derivatives of the bending's acceleration and of the joint torque along a motion, at all times.

        By deflection and its rate, and by the joints' position, velocity and acceleration: differences of (2) in
        full, at `KNOTS` times and linear between.
        """
        n, m = self.model.n_joints, self.model.n_modes
        at = 2 * np.unique(np.linspace(0, self.steps, KNOTS).astype(int))
        (found,) = _finite(np.array([self._derivatives(k, x[k // 2], v[k // 2]) for k in at]))
        flat = make_interp_spline(self.times[at], found.reshape(len(at), -1), 1)(self.times)
        everywhere = flat.reshape(-1, m + n, 3 * n + 3 * m)
        # Columns: q, qd, qdd, x, v, and the bending's own acceleration, in the torque alone.
        columns = np.cumsum([n, n, n, m, m])
        a, u = everywhere[:, :m], everywhere[:, m:]
        self.by_joints, self.spring, self.damper, _ = np.split(a, columns[2:], axis=2)
        self.torque_by_joints, self.K1, self.C1, self.M12 = np.split(u, columns[2:], axis=2)

    def _derivatives(self, k, x, v):
        q, qd, qdd = self.motion[k]
        n, m = self.model.n_joints, self.model.n_modes
        t = self.model.terms(q, qd, x, v)
        M12 = t.M[:n, n:]
        out = np.zeros((m + n, 3 * n + 3 * m))
        out[m:, -m:] = M12
        out[:m, 2 * n : 3 * n] = -np.linalg.solve(t.M[n:, n:], t.M[n:, :n])
        out[m:, 2 * n : 3 * n] = t.M[:n, :n]
        here, u = self._bending(q, qd, qdd, x, v)
        for part, values in enumerate((q, qd, None, x, v)):
            if values is None:
                continue
            first = (0, n, 0, 3 * n, 3 * n + m)[part]
            for j in range(values.size):
                kept, values[j] = values[j], values[j] + SMALL
                there, u2 = self._bending(q, qd, qdd, x, v)
                values[j] = kept
                out[:m, first + j] = (there - here) / SMALL
                # At fixed acceleration of the bending: that part comes through M12.
                out[m:, first + j] = (u2 - u - M12 @ (there - here)) / SMALL
        return out

    def _bending(self, q, qd, qdd, x, v):
        """Acceleration of the bending, and joint torque, with the joints moved as given: (2), in full."""
        n = self.model.n_joints
        if self.stepper is None:
            t = self.model.terms(q, qd, x, v)
            M, f1, f2 = t.M, t.f1 + t.C1 @ v + t.K1 @ x, t.f2 + t.C2 @ v + t.K2 @ x
        else:  # the same, without the arm's derivatives
            M, f = self.model.mass_matrix(q, x), self.model.forces(q, qd, x, v)
            f1, f2 = f[:n] + self.model.friction(qd, x, v), f[n:]
        force = -f2 - M[n:, :n] @ qdd
        a = np.linalg.solve(M[n:, n:], force) if force.size else force
        return a, M[:n, :n] @ qdd + M[:n, n:] @ a + f1

    def _respond(self):
        """Linear response of the bending to each coefficient of the shift: (steps + 1, 3, m, n count)."""
        m, n, count = self.model.n_modes, self.model.n_joints, self.basis.shape[2]
        by = self.by_joints.reshape(-1, m, 3, n)
        force = np.einsum("tmdn,dtj->tmnj", by, self.basis).reshape(-1, m, n * count)

        def acceleration(k, x, v):
            return self.spring[k] @ x + self.damper[k] @ v + force[k]

        return self._integrated(acceleration, np.zeros((m, n * count)))

    def _torque(self, bending, at):
        """Joint torque that goes with `_respond`'s columns, at some whole steps, (k, n, n count)."""
        n, count = self.model.n_joints, self.basis.shape[2]
        by = self.torque_by_joints[2 * at].reshape(-1, n, 3, n)
        u = np.einsum("tidj,dtc->tijc", by, self.basis[:, 2 * at]).reshape(-1, n, n * count)
        for matrix, part in ((self.M12, 2), (self.C1, 1), (self.K1, 0)):
            u += np.einsum("tij,tjc->tic", matrix[2 * at], bending[at, part])
        return u

    def _programme(self, c):
        """Change of the shift's coefficients, (n, count)."""
        x, v = _finite(*self._bend())
        self._linearise(x, v)
        forced = self._respond()
        A = np.vstack([self.modal @ forced[-1, 0], self.modal @ forced[-1, 1]])
        b = -np.concatenate([self.modal @ (x[-1] - self.rest), self.modal @ v[-1]])
        # On one scale: deflections are thousandths. A mode that no joint moves is left as it is.
        largest = np.abs(A).max(axis=1)
        each = largest.reshape(2, -1)
        moved = np.tile((each > UNMOVED * each.max(axis=1)[:, None]).all(axis=0), 2)
        scale = 1.0 / largest[moved]
        A, b = A[moved] * scale[:, None], b[moved] * scale
        at = np.arange(0, self.steps + 1, max(1, self.steps // GRID))
        (_, u), du = _finite(*self._forces(at, x, v)), self._torque(forced, at)
        change = self._within_limits(c, A, b, u, du)
        return self._linear_programme(c, A, b, u, du) if change is None else change

    def _within_limits(self, c, A, b, u, du):
        """As `_least_squares`, within the torque limit; None where that is not found.

        What is beyond `RESERVED` of the limit is penalised, at the times and joints where it is, until these no longer
        change.
        """
        bounded = np.flatnonzero(np.isfinite(self.limit))
        limit = self.limit[bounded]
        here, by = u[:, bounded] / limit, du[:, bounded] / limit[:, None]
        over, change = np.zeros(here.shape), self._least_squares(c, A, b)
        for _ in range(PENALTIES):
            share = here + by @ change.ravel()
            if np.abs(share).max(initial=0.0) <= 1.0 and not over.any():
                return change
            now = np.where(np.abs(share) > RESERVED, np.sign(share), 0.0)
            if (now == over).all():
                return change if np.abs(share).max() <= 1.0 else None
            over = now
            at = over != 0.0
            change = self._least_squares(c, A, b, by[at], RESERVED * over[at] - here[at])
        return None

    def _least_squares(self, c, A, b, rows=None, values=None):
        """The change x after which the mean square of the shift, and of its acceleration, is least, with A x = b.

        `rows` x should be near `values`, by a penalty of weight `PENALTY`.
        """
        n, count = c.shape
        N, Ndd = self.basis[0], self.basis[2] / self.omega**2
        weight = N.T @ N + SMOOTHNESS * Ndd.T @ Ndd
        H = np.kron(np.eye(n), weight / np.abs(weight).max())
        size, held, right = n * count, len(b), -H @ c.ravel()
        if rows is not None:
            H = H + PENALTY * rows.T @ rows
            right = right + PENALTY * rows.T @ values
        kkt = np.block([[H, A.T], [A, np.zeros((held, held))]])
        right = np.concatenate([right, b])
        return np.linalg.lstsq(kkt, right, rcond=1e-12)[0][:size].reshape(n, count)

    def _linear_programme(self, c, A, b, u, du):
        """The change after which the largest shift is least, within the torque limit."""
        n, count = c.shape
        each = slice(None, None, max(1, self.steps // GRID))
        rows, bounds = [], []
        for sign in (1.0, -1.0):
            for part, column in ((0, 0), (2, 1)):
                N = self.basis[part][::2][each]
                for j in range(n):
                    row = np.zeros((N.shape[0], n * count + 2))
                    row[:, j * count : (j + 1) * count] = sign * N
                    row[:, n * count + column] = -1.0
                    rows.append(row)
                    bounds.append(-sign * N @ c[j])
            for j in np.flatnonzero(np.isfinite(self.limit)):
                rows.append(np.hstack([sign * du[:, j], np.zeros((len(du), 2))]))
                bounds.append(self.limit[j] - sign * u[:, j])
        result = linprog(
            np.concatenate([np.zeros(n * count), [1.0, 0.1 * np.sqrt(SMOOTHNESS) / self.omega**2]]),
            np.vstack(rows),
            np.concatenate(bounds),
            np.hstack([A, np.zeros((len(b), 2))]),
            b,
            bounds=[(None, None)] * (n * count) + [(0.0, None)] * 2,
            method="highs",
        )
        if not result.success:
            needed = np.abs(u).max(axis=0)
            raise DesignError(
                f"no motion within the torque limits leaves the arm at rest: the reference alone takes"
                f" {np.round(needed, 3).tolist()} N m",
                field="preview",
                limit=f"{np.round(self.limit, 3).tolist()} N m",
                hint="give it more time",
            )
        return result.x[: n * count].reshape(n, count)
