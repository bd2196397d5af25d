r"""Feed-forward with preview: a motion that bends the arm and leaves it straight at its end.

When a whole trajectory is known at its receipt, the joints need not follow it to the last millidegree: a small
shift p of the reference, zero with its rates at either end, can be chosen such that the bending which
:math:`\ddot q = \ddot q_{ref} + \ddot p` makes ends at rest with the trajectory. With :math:`p = \sum_j c_j N_j(t)`
(quintic B-splines) the modal rows of (2) along the reference,

.. math:: M_{22}\ddot\delta + C_2\dot\delta + K_2\delta = -M_{21}(\ddot q_{ref} + \ddot p) - f_2,

are linear in c, so that the smallest largest shift is a linear programme:

.. math::
    \min_c \max_t |p(t)| \quad\text{s.t.}\quad \delta(T) = \bar\delta,\; \dot\delta(T) = 0,\;
    |u(t)| \le u_{max},

solved once at receipt, off the control path (HiGHS through scipy). What M_21 and f_2 change with p is taken in by
doing so twice. The motion then serves `model` in the place of the slow manifold: the nominal arm that runs along
takes up what is left, sampling and products of deflections.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline, CubicHermiteSpline
from scipy.linalg import eigh
from scipy.optimize import linprog

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.model import build

from ..trajectory.path import Path
from ..trajectory.values import SECOND
from .model import ModelFeedforward

#: Longest time between two knots of the shift, over the period of the lowest bending mode.
KNOTS_PER_PERIOD = 6.0
#: At least and at most so many free coefficients per joint.
FEWEST, MOST = 24, 160
#: Modes slower than this phase per knot are brought to rest; faster ones follow without being excited [rad].
FASTEST = 3.0
#: Rounds of linearisation.
ROUNDS = 2
#: Shift and torque are bounded at so many times.
GRID = 250
#: Weight of the shift's largest acceleration, times the duration squared, beside the largest shift.
SMOOTHNESS = 1e-6
#: Phase of the fastest mode per step at which Runge-Kutta's fourth order is still stable, with a margin [rad].
STABLE = 1.5
#: Longest grid step over the period of the fastest mode that is brought to rest.
STEPS_PER_PERIOD = 40.0
#: A longer motion is not planned [samples].
LONGEST = 20_000
#: The reference must begin within this of where the plan did [rad], [rad/s], [rad/s^2].
SAME_START = 1e-6


@dataclass(frozen=True)
class Plan:
    """A motion of the whole arm from rest to rest, by the time since its start.

    Attributes
    ----------
    trajectory_id : int
        Of the trajectory it is for; 0 until it is accepted.
    start : ndarray, shape (3, n)
        State of the reference that it begins from.
    duration_ns : int
    motion : CubicHermiteSpline
        (q, delta, qd, delta_d) over the elapsed time [s].
    torque : ndarray, shape (k, n)
        At the grid's times [N m].
    step : float
        Of the grid [s].
    shift : float
        Largest shift of a joint from the reference [rad].
    """

    start: np.ndarray
    duration_ns: int
    motion: CubicHermiteSpline
    torque: np.ndarray
    step: float
    shift: float
    trajectory_id: int = 0

    def at(self, elapsed):
        """State (2 (n + m),) and torque (n,) at a time since the start [s]."""
        x = elapsed / self.step
        i = min(int(x), len(self.torque) - 2)
        f = x - i
        return self.motion(elapsed), (1.0 - f) * self.torque[i] + f * self.torque[i + 1]


class Preview(ModelFeedforward):
    """The planned motion, while there is one; `model` otherwise. See the module."""

    plans = True

    def __init__(self, model, manifold, settings):
        super().__init__(model, manifold, settings)
        self._plan = None

    def take(self, plan, trajectory_id):
        self._plan = None if plan is None else replace(plan, trajectory_id=trajectory_id)

    def resume(self, other):
        super().resume(other)
        self._plan = getattr(other, "_plan", None)

    def wanted(self, reference):
        plan, path = self._plan, getattr(reference, "path", None)
        if plan is None or path is None or path.trajectory_id != plan.trajectory_id:
            return super().wanted(reference)
        elapsed = reference.stamp_ns - path.start_ns
        same = np.abs(path.begin_state - plan.start).max() < SAME_START
        if not same or not 0 <= elapsed < plan.duration_ns:
            return super().wanted(reference)
        state, _ = plan.at(elapsed / SECOND)
        # The torque is held over the coming period: that of its middle.
        return state, plan.at(elapsed / SECOND + 0.5 * self.settings.period)[1]

    def prepare(self, trajectory, start):
        """Plan the motion of a trajectory; off the control path.

        Parameters
        ----------
        trajectory : JointTrajectoryData
        start : ndarray, shape (3, n)
            State of the reference where it will begin: at rest.

        Returns
        -------
        Plan

        Raises
        ------
        DesignError
            When the trajectory does not go from rest to rest, is too long, or can't be done within the torque limit.
        """
        # A model of its own: the loop goes on with this one meanwhile.
        return plan(build(self.model.arm), trajectory, start, self.limit)


def plan(model, trajectory, start, limit):
    """See `Preview.prepare`."""
    fields = (trajectory.positions, trajectory.velocities, trajectory.accelerations)
    path = Path(trajectory.times_ns, [values for values in fields if values is not None], 1)
    path.begin(0, start)
    moving = max(np.abs(start[1:]).max(), 0.0)
    if moving > SAME_START:
        raise DesignError("preview: the motion does not begin at rest")
    return _Planner(model, path, start, limit).solve()


class _Planner:
    """One trajectory's linear programme."""

    def __init__(self, model, path, start, limit):
        self.model, self.path, self.start, self.limit = model, path, start, limit
        n, m = model.n_joints, model.n_modes
        self.duration = path.duration_ns / SECOND
        end = np.zeros((3, n))
        path.evaluate(path.duration_ns, end)
        at_end = model.terms(end[0], end[1])
        # The joints are prescribed here: the modes of the arm with its joints locked.
        squares, shapes = eigh(at_end.K2, at_end.M[n:, n:]) if m else (np.array([100.0]), None)
        omega = np.sqrt(np.maximum(squares, 1e-6))
        count = KNOTS_PER_PERIOD * self.duration * omega[0] / (2.0 * np.pi)
        count = int(np.clip(np.ceil(count), FEWEST, MOST))
        knots = np.linspace(0.0, self.duration, count + 1)
        slow = max(1, int(np.sum(omega * knots[1] < FASTEST))) if m else 0
        self.rest = model.static_deflection(end[0])
        self.modal = shapes[:, :slow].T @ at_end.M[n:, n:] if m else np.zeros((0, 0))
        step = min(2.0 * np.pi / omega[max(slow, 1) - 1] / STEPS_PER_PERIOD, 0.01)
        self.steps = int(np.ceil(self.duration / min(step, STABLE / omega[-1])))
        if self.steps > LONGEST:
            raise DesignError(
                f"preview: a motion of {self.duration:g} s takes {self.steps} steps, at most {LONGEST}: plan it in"
                " parts, or set feedforward: model"
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
        """The plan, after `ROUNDS` of linearisation about the last one."""
        n = self.model.n_joints
        c = np.zeros((n, self.basis.shape[2]))
        for _ in range(ROUNDS if self.model.n_modes else 0):
            self._along(c)
            c = c + self._programme(c)
        self._along(c)
        q, free = self.motion, self._integrate(self.motion[:, 2, :, None])[..., 0]
        state = np.concatenate([q[::2, 0], free[:, 0], q[::2, 1], free[:, 1]], axis=1)
        rates = np.concatenate([q[::2, 1], free[:, 1], q[::2, 2], free[:, 2]], axis=1)
        return Plan(
            start=self.start.copy(),
            duration_ns=self.path.duration_ns,
            motion=CubicHermiteSpline(self.times[::2], state, rates),
            torque=self._torque(q[::2, 2, :, None], free[..., None])[..., 0] + self.f1[::2],
            step=self.h,
            shift=float(np.abs(q[:, 0] - self.reference[:, 0]).max()),
        )

    def _along(self, c):
        """Terms of (2) along the reference shifted by c."""
        n = self.model.n_joints
        self.motion = self.reference + np.einsum("dtj,nj->tdn", self.basis, c)
        terms = [self.model.terms(q[0], q[1]) for q in self.motion]
        M = np.array([t.M for t in terms])
        self.M11, self.M12 = M[:, :n, :n], M[:, :n, n:]
        inverse = np.linalg.inv(M[:, n:, n:])
        self.drive = -inverse @ M[:, n:, :n]
        self.spring = -inverse @ np.array([t.K2 for t in terms])
        self.damper = -inverse @ np.array([t.C2 for t in terms])
        self.load = -np.einsum("tij,tj->ti", inverse, np.array([t.f2 for t in terms]))
        self.f1 = np.array([t.f1 for t in terms])
        self.C1, self.K1 = np.array([t.C1 for t in terms]), np.array([t.K1 for t in terms])

    def _integrate(self, acceleration, loaded=True):
        """Deflection, rate and their second derivative at whole steps, under joint accelerations.

        Parameters
        ----------
        acceleration : ndarray, shape (2 steps + 1, n, columns)
            [rad/s^2]
        loaded : bool
            With f_2 and from the deflection at the start; False: the response from zero alone.

        Returns
        -------
        ndarray, shape (steps + 1, 3, m, columns)
        """
        m, columns = self.model.n_modes, acceleration.shape[2]
        force = np.einsum("tmn,tnc->tmc", self.drive, acceleration)
        out = np.zeros((self.steps + 1, 3, m, columns))
        if loaded:
            force += self.load[..., None]
            out[0, 0] = self.model.static_deflection(self.start[0])[:, None]
        K, D, h = self.spring, self.damper, self.h

        def slope(k, x, v):
            return K[k] @ x + D[k] @ v + force[k]

        for i in range(self.steps):
            x, v, k = out[i, 0], out[i, 1], 2 * i
            a1 = out[i, 2] = slope(k, x, v)
            v2 = v + 0.5 * h * a1
            a2 = slope(k + 1, x + 0.5 * h * v, v2)
            v3 = v + 0.5 * h * a2
            a3 = slope(k + 1, x + 0.5 * h * v2, v3)
            v4 = v + h * a3
            a4 = slope(k + 2, x + h * v3, v4)
            out[i + 1, 0] = x + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
            out[i + 1, 1] = v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        out[-1, 2] = slope(-1, out[-1, 0], out[-1, 1])
        return out

    def _torque(self, acceleration, bending):
        """Joint torque of a motion at whole steps, f_1 aside, (steps + 1, n, columns)."""
        each = slice(None, None, 2)
        u = np.einsum("tij,tjc->tic", self.M11[each], acceleration)
        for matrix, part in ((self.M12, 2), (self.C1, 1), (self.K1, 0)):
            u += np.einsum("tij,tjc->tic", matrix[each], bending[:, part])
        return u

    def _programme(self, c):
        """Change of the shift's coefficients, (n, count)."""
        n, count = c.shape
        free = self._integrate(self.motion[:, 2, :, None])
        columns = np.zeros((self.times.size, n, n * count))
        for j in range(n):
            columns[:, j, j * count : (j + 1) * count] = self.basis[2]
        forced = self._integrate(columns, loaded=False)
        end, each = free[-1, :2, :, 0], slice(None, None, max(1, self.steps // GRID))
        A_eq = np.vstack([self.modal @ forced[-1, 0], self.modal @ forced[-1, 1]])
        b_eq = -np.concatenate([self.modal @ (end[0] - self.rest), self.modal @ end[1]])
        u = (self._torque(self.motion[::2, 2, :, None], free)[..., 0] + self.f1[::2])[each]
        du = self._torque(columns[::2], forced)[each]
        rows, bounds = [], []
        limited = np.isfinite(self.limit)
        for sign in (1.0, -1.0):
            for part, weight in ((0, [1.0, 0.0]), (2, [0.0, 1.0])):
                N = self.basis[part][::2][each]
                for j in range(n):
                    row = np.zeros((N.shape[0], n * count + 2))
                    row[:, j * count : (j + 1) * count] = sign * N
                    row[:, -2:] = -np.array(weight)
                    rows.append(row)
                    bounds.append(-sign * N @ c[j])
            for j in np.flatnonzero(limited):
                rows.append(np.hstack([sign * du[:, j], np.zeros((len(du), 2))]))
                bounds.append(self.limit[j] - sign * u[:, j])
        # Among equal shifts the smoother one.
        cost = np.concatenate([np.zeros(n * count), [1.0, SMOOTHNESS * self.duration**2]])
        # On one scale: deflections are thousandths.
        scale = 1.0 / np.maximum(np.abs(A_eq).max(axis=1), 1e-30)
        result = linprog(
            cost,
            np.vstack(rows),
            np.concatenate(bounds),
            np.hstack([A_eq * scale[:, None], np.zeros((A_eq.shape[0], 2))]),
            b_eq * scale,
            bounds=[(None, None)] * (n * count) + [(0.0, None)] * 2,
            method="highs",
        )
        if not result.success:
            needed = np.abs(u).max(axis=0)
            raise DesignError(
                f"preview: no motion within the torque limits {np.round(self.limit, 3).tolist()} N m leaves the arm"
                f" at rest (the reference alone takes {np.round(needed, 3).tolist()} N m): give it more time"
            )
        return result.x[: n * count].reshape(n, count)
