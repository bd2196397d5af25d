# SPDX-License-Identifier: Apache-2.0
r"""Computes the time law that excites the links least, for a given duration and torque limit.

The joints go in a straight line of joint space, :math:`q = q_0 + \Delta\,\sigma(t)`, and :math:`\sigma` is a spline of
degree five with rest and no jerk at both ends, whose coefficients x are found by a convex programme

.. math:: \min_x\; \frac{w\,E(T) + \frac1T\int_0^T E\,dt}{E_5} + \epsilon\,\frac{\int\dddot\sigma^2dt}{J_5}
    \quad\text{with}\quad |\bar u_i(t)| \le u_{i,max},\; 0 \le |\Delta_i|\,\dot\sigma(t) \le v_{i,max} .

E is the energy of the deviation from the quasi-steady state that the fast subsystem (11) has along the motion. The
deviation is linear in x (`excitation`). :math:`E_5, J_5` are those of a quintic of the same duration. The torque
:math:`\bar u` of (10) and the quasi-steady state (9) are linearised along the last solution, and the programme is
solved again until it no longer changes (sequential convex programming). For one joint without gravity and friction
a single solution is exact, except for the effect of the joint's rate on the stiffness.

An interior-point method solves the quadratic programme (`least_squares`). A linear programme decides whether there
is a solution at all, and finds the least torque or duration if there is none.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import linprog

from flexarm_dynamics.errors import DesignError, ShapeError, TrajectoryError

from . import excitation
from .profiles import Profile, quintic

#: Pieces of the spline. Trajectory points at all multiples of T / INTERVALS make the sampled motion exact.
INTERVALS = 25
#: Number of times per piece at which limits are enforced and the response is computed.
PER_INTERVAL = 6
_DEGREE = 5
_REST = 4  # coefficients at either end, fixed by rest without jerk
#: Weight w of the energy left at the end, relative to the mean along the way.
RESIDUAL_WEIGHT = 100.0
#: Weight epsilon of the jerk: among motions that excite equally, it selects the smoothest.
JERK_WEIGHT = 1e-4
_ROUNDS = 40
#: The fast subsystem is updated in this many rounds only, the first ones: with updates in all, fast motions would not
#: settle.
_REFRESHED = 10
_ITERATIONS = 100
_SETTLED = 1e-5  # of sigma, between two rounds
_STEP = 1e-5  # of the differences that linearise the torque
#: How far the torque may exceed its limit between the times at which it is enforced [-].
_SLACK = 1e-6


@dataclass(frozen=True, eq=False)
class LeastExciting:
    """A least-exciting motion."""

    profile: Profile
    excitation: excitation.Excitation  # and torque, by the full reduced model
    quintic: excitation.Excitation  # of the quintic in that time, which may exceed the limits
    rounds: int  # convex programmes solved


def least_exciting(
    model, start, end, duration, torque_limit=None, velocity_limit=None
) -> LeastExciting:
    """Return the motion that excites the modes least.

    Parameters
    ----------
    model : ArmModel
    start, end : (n,) array_like
        Joint angles, at rest [rad].
    duration : float
        T [s].
    torque_limit, velocity_limit : (n,) array_like, optional
        Limits of the slow torque [N m] and of the speeds [rad/s]; the arm file's if not given. Leave some
        torque for the fast control.

    Raises
    ------
    TrajectoryError
        If no time law stays within the limits; it names the least torque and the least duration that would do.
    DesignError
        If the programme does not settle.
    ShapeError
        If the limits have another length.
    """
    base = quintic(start, end, duration)
    if base.start.shape != (model.n_joints,):
        raise ShapeError(f"has shape {base.start.shape}", field="start", limit=(model.n_joints,))
    torque = _limit("torque_limit", torque_limit, model.arm.torque_limits)
    speed = _limit("velocity_limit", velocity_limit, model.arm.velocity_limits)
    if not np.any(base.angle):
        raise TrajectoryError("is the start: there is nothing to move", field="end")
    problem = _Problem(model, base, torque, speed)
    problem.check_feasible()
    x, rounds = problem.solve()
    profile = problem.profile(x)
    points = 2 * PER_INTERVAL * INTERVALS + 1
    excited, of_quintic = (excitation.along(model, p, points=points) for p in (profile, base))
    return LeastExciting(profile, excited, of_quintic, rounds)


def _limit(name, given, default):
    values = np.array(default if given is None else given, float)
    if values.shape != (len(default),):
        raise ShapeError(f"has shape {values.shape}", field=name, limit=(len(default),))
    if not (values > 0.0).all():
        i = int(np.argmin(values > 0.0))
        raise TrajectoryError(
            "is out of range", field=f"{name}[{i}]", value=float(values[i]), limit="above 0"
        )
    return values


class _Basis:
    """sigma and its derivatives by s = t / T at the grid's times, as functions r + A x of the free coefficients."""

    def __init__(self):
        inner = np.linspace(0.0, 1.0, INTERVALS + 1)[1:-1]
        self.knots = np.concatenate([np.zeros(_DEGREE + 1), inner, np.ones(_DEGREE + 1)])
        self.count = INTERVALS + _DEGREE
        self.free = slice(_REST, self.count - _REST)
        self.s = np.linspace(0.0, 1.0, PER_INTERVAL * INTERVALS + 1)
        fixed = np.zeros(self.count)
        fixed[-_REST:] = 1.0
        splines = [BSpline(self.knots, np.eye(self.count), _DEGREE)]
        splines += [splines[0].derivative(i) for i in (1, 2, 3)]
        full = [spline(self.s) for spline in splines]
        self.matrices = [A[:, self.free] for A in full]
        self.constants = [A @ fixed for A in full]

    def spline(self, x):
        """sigma by s."""
        coefficients = np.zeros(self.count)
        coefficients[self.free], coefficients[-_REST:] = x, 1.0
        return BSpline(self.knots, coefficients, _DEGREE)

    def fit(self, sigma):
        """Coefficients of the spline nearest to a time law given at the grid's times."""
        return np.linalg.lstsq(self.matrices[0], sigma - self.constants[0], rcond=None)[0]


class _Problem:
    """The programme of one motion; `x` are the free coefficients of sigma."""

    def __init__(self, model, base, torque_limit, speed_limit):
        self.model, self.base = model, base
        self.torque_limit, self.speed_limit = torque_limit, speed_limit
        self.basis = _Basis()
        self.first = self.basis.fit(base.shape[0](self.basis.s))

    def profile(self, x):
        """The motion of the coefficients."""
        spline = self.basis.spline(x)
        shape = (spline, spline.derivative(), spline.derivative(2))
        return replace(self.base, shape=shape)

    # Limits ------------------------------------------------------------------------------------

    def linearised(self, x, duration):
        """Torque and quasi-steady amplitudes at the grid's times: r + A x, exact at x in value and gradient.

        r is (k, n + m), A (k, n + m, c).
        """
        matrices = self.basis.matrices[:3]
        states = [r + A @ x for r, A in zip(self.basis.constants[:3], matrices, strict=True)]
        value = self._reduced(*states, duration)
        A = np.zeros((*value.shape, x.size))
        for i, matrix in enumerate(matrices):
            # Forward differences: exact for the acceleration, which is linear, and accurate enough for the
            # others, whose change between two rounds goes to zero.
            step = 1.0 if i == 2 else _STEP
            ahead = list(states)
            ahead[i] = states[i] + step
            gradient = (self._reduced(*ahead, duration) - value) / step
            A += gradient[:, :, None] * matrix[:, None, :]
        return value - A @ x, A

    def _reduced(self, sigma, rate, acceleration, duration):
        """Torque and quasi-steady amplitudes (k, n + m) of states of sigma, derivatives by s."""
        angle = self.base.angle
        q, qd = self.base.start + np.outer(sigma, angle), np.outer(rate, angle) / duration
        states = zip(q, qd, np.outer(acceleration, angle) / duration**2, strict=True)
        try:
            return np.array([np.concatenate(excitation.reduced(self.model, *s)) for s in states])
        except np.linalg.LinAlgError:
            raise DesignError(
                f"s makes the joints of {self.model.arm.name} so fast that the links lose their stiffness in this"
                " model, and the quasi-steady state does not exist",
                field="duration",
                value=duration,
                hint="take a longer one",
            ) from None

    def torque_rows(self, r, A):
        """Torque divided by its limit, at all times, for all joints that have one: r (k,), A (k, c)."""
        n = self.model.n_joints
        bounded = np.flatnonzero(np.isfinite(self.torque_limit))
        scale = self.torque_limit[bounded]
        r, A = r[:, :n][:, bounded] / scale, A[:, :n][:, bounded] / scale[:, None]
        return r.ravel(), A.reshape(r.size, A.shape[2])

    def speed_bound(self, duration):
        """Largest sigma' by s that the speed limits of all joints allow."""
        moving = self.base.angle != 0.0
        return float(np.min(self.speed_limit[moving] / np.abs(self.base.angle[moving])) * duration)

    def check_feasible(self):
        """Refuse limits that no time law keeps, with limits that would do."""
        T = self.base.duration
        shortest = T / self.speed_bound(T) if np.isfinite(self.speed_bound(T)) else 0.0
        # The quintic's peak speed is 15/8 of the mean.
        if 2.0 * shortest < T and self._excess(self.first) < 0.95:
            return
        need = np.inf if shortest >= T else self._least_factor(T)
        if need <= 1.0:
            return
        why, hint = self._why_not(T, shortest, need)
        raise TrajectoryError(
            f"s is too short for the limits: {why}", field="duration", value=T, hint=hint
        )

    def _why_not(self, T, shortest, need):
        """Why no motion keeps the limits, and what would do."""
        limits = self.torque_limit
        if np.isfinite(need):
            enough = ", ".join(
                f"{name} {need * limit:.4g}"
                for name, limit in zip(self.model.joint_names, limits, strict=True)
                if np.isfinite(limit)
            )
            why = f"it needs {need:.4g} times the torque limits ({enough} N m)"
        elif shortest >= T:
            why = f"the speed limits alone need {shortest:.4g} s"
        else:
            why = "the speed limits leave no time law"
        hold = max(
            np.max(np.abs(excitation.reduced(self.model, q, 0 * q, 0 * q)[0]) / limits)
            for q in self.base.position(np.linspace(0.0, T, 33))
        )
        if hold >= 1.0:
            return f"holding the arm on the way takes {hold:.4g} times the torque limits", ""
        duration = self._least_duration(max(T, shortest), need)
        return why, f"take {duration:.4g} s" if duration else ""

    def _least_duration(self, below, need):
        """A duration that is long enough, within 1 % of the least; None if none is found."""
        # Torques of inertia fall as 1 / T^2.
        above = below * (1.005 * np.sqrt(need) if np.isfinite(need) else 1.005)
        for _ in range(12):
            if self._least_factor(above) <= 1.0:
                break
            below, above = above, 1.5 * above
        else:
            return None
        middle = 0.991 * above  # the first guess is often right
        while above > 1.01 * below:
            if self._least_factor(middle) <= 1.0:
                above = middle
            else:
                below = middle
            middle = np.sqrt(above * below)
        return above

    def _least_factor(self, duration):
        """The least multiple of the torque limits with which a motion of this duration is possible.

        min alpha with |r + A x| <= alpha, 0 <= sigma' <= its bound; linearised anew until it settles.
        """
        b, x, before = self.basis, self.first, np.inf
        bound = self.speed_bound(duration)
        for _ in range(_ROUNDS):
            r, A = self.torque_rows(*self.linearised(x, duration))
            one = np.ones((r.size, 1))
            rows, sides = [np.hstack([A, -one]), np.hstack([-A, -one])], [-r, r]
            rate, zero = b.matrices[1], np.zeros((b.s.size, 1))
            rows.append(np.hstack([-rate, zero]))
            sides.append(b.constants[1])
            if np.isfinite(bound):
                rows.append(np.hstack([rate, zero]))
                sides.append(bound - b.constants[1])
            cost = np.zeros(x.size + 1)
            cost[-1] = 1.0
            bounds = [(None, None)] * x.size + [(0.0, None)]
            found = linprog(cost, np.vstack(rows), np.concatenate(sides), bounds=bounds)
            if found.status != 0:
                return np.inf
            x, alpha = found.x[:-1], found.x[-1]
            if abs(alpha - before) <= 1e-4 * alpha:
                break
            before = alpha
        return alpha

    # Programme ---------------------------------------------------------------------------------

    def solve(self):
        """Sequential convex programming; returns the coefficients and how many programmes it took."""
        x, tighter, part, before = self.first, 1.0, 1.0, np.inf
        for count in range(1, _ROUNDS + 1):
            if count <= _REFRESHED:
                self.response = self._response(x)
            try:
                new = self._programme(x, tighter)
            except TrajectoryError as error:
                raise self._unsettled(f"round {count}: {error}") from None
            change = np.abs(self.basis.matrices[0] @ (new - x)).max()
            # A full step while the rounds converge, a fraction of it if they oscillate.
            part = max(0.5 * part, 0.1) if change > 0.7 * before else min(1.5 * part, 1.0)
            x, before = x + (part if change > _SETTLED else 1.0) * (new - x), change
            if change > _SETTLED:
                continue
            excess = self._excess(x)
            if excess <= 1.0 + _SLACK:
                return x, count
            # Between the times at which it is enforced, the torque exceeds its limit by a little.
            tighter *= (1.0 - 0.1 * _SLACK) / excess
        raise self._unsettled(f"it still changes after {_ROUNDS} rounds")

    @staticmethod
    def _unsettled(why):
        return DesignError(
            f"does not settle ({why}): the torque changes too much along it",
            field="least-exciting motion",
            hint="give a longer duration or a higher torque limit",
        )

    def _response(self, x):
        """The fast subsystem along the motion of x."""
        profile, times = self.profile(x), self.base.duration * self.basis.s
        q, qd, _ = profile.states(times)
        return excitation.FastResponse(self.model, times[1], q, qd)

    def _excess(self, x):
        """Peak torque divided by its limit, by the full reduced model, also between the grid's times."""
        profile = self.profile(x)
        times = np.linspace(0.0, profile.duration, 2 * (self.basis.s.size - 1) + 1)
        states = zip(*profile.states(times), strict=True)
        torque = [excitation.reduced(self.model, *state)[0] for state in states]
        return float(np.max(np.abs(torque) / self.torque_limit))

    def _programme(self, x, tighter):
        """The convex programme linearised at x."""
        T, b, n = self.base.duration, self.basis, self.model.n_joints
        r, A = self.linearised(x, T)
        rows, sides = self._objective(r[:, n:], A[:, n:])
        torque, gradients = self.torque_rows(r, A)
        G = [-gradients, gradients, b.matrices[1]]
        h = [torque - tighter, -torque - tighter, -b.constants[1]]
        bound = self.speed_bound(T)
        if np.isfinite(bound):
            G.append(-b.matrices[1])
            h.append(b.constants[1] - bound)
        return least_squares(rows, sides, np.vstack(G), np.concatenate(h))

    def _objective(self, r, A):
        """Rows and right-hand sides whose squared difference the programme minimises."""
        b, k, quintics = self.basis, self.basis.s.size, self.first
        jerk, jerk_constant = b.matrices[3] / np.sqrt(k), b.constants[3] / np.sqrt(k)
        scale = np.sqrt(JERK_WEIGHT) / np.linalg.norm(jerk @ quintics + jerk_constant)
        rows, sides = [scale * jerk], [-scale * jerk_constant]
        if self.model.n_modes:
            both = np.concatenate([A, r[:, :, None]], axis=2)
            z = self.response.weighed(self.response.deviation(both))
            weights = np.full(k, 1.0 / k)
            weights[-1] += RESIDUAL_WEIGHT
            z *= np.sqrt(weights)[:, None, None]
            z = z.reshape(-1, z.shape[2])
            unit = np.linalg.norm(z[:, :-1] @ quintics + z[:, -1])
            if unit > 0.0:
                rows.append(z[:, :-1] / unit)
                sides.append(-z[:, -1] / unit)
        return np.vstack(rows), np.concatenate(sides)


def least_squares(E, f, G, h):
    r"""Minimise :math:`\|Ex - f\|` with :math:`Gx \ge h`, by a primal-dual interior-point method.

    Mehrotra's predictor and corrector, Nocedal & Wright (2006), algorithm 16.4, on the rows of G scaled to length 1.

    Parameters
    ----------
    E, f : (k, c), (k,) arrays
        E of full column rank.
    G, h : (l, c), (l,) arrays

    Raises
    ------
    TrajectoryError
        If it does not converge: the inequalities contradict each other.
    """
    # With the columns of Q instead of those of E the Hessian is the identity.
    Q, R = np.linalg.qr(E)
    C = np.linalg.solve(R.T, G.T).T
    scale = np.linalg.norm(C, axis=1)
    empty = scale <= 1e-12 * scale.max()  # at the ends x has no effect
    if (h[empty] > 1e-9).any():
        raise TrajectoryError("the limits leave no room at the ends", hint="raise one of them")
    C, d = C[~empty] / scale[~empty, None], h[~empty] / scale[~empty]
    y = target = Q.T @ f
    if (C @ y >= d).all():
        return np.linalg.solve(R, y)
    size = max(1.0, np.abs(d).max())
    slack = np.maximum(np.abs(C @ y - d), 1e-2 * size)
    force = np.full(d.size, size)
    for _ in range(_ITERATIONS):
        dual, primal = y - target - C.T @ force, C @ y - slack - d
        gap = slack @ force / d.size
        if max(np.abs(dual).max(), np.abs(primal).max(), gap) < 1e-10 * size:
            return np.linalg.solve(R, y)
        if not force.max() < 1e20 * size or slack.min() < 1e-30 * size:
            break  # forces grow without bound: no x satisfies all inequalities
        weight = force / slack
        matrix = np.linalg.cholesky(np.eye(y.size) + (C.T * weight) @ C)

        def step(complement):
            side = -dual - C.T @ ((complement + force * primal) / slack)  # noqa: B023
            dy = np.linalg.solve(matrix.T, np.linalg.solve(matrix, side))  # noqa: B023
            ds = C @ dy + primal  # noqa: B023
            return dy, ds, -(complement + force * ds) / slack  # noqa: B023

        _, ds, df = step(slack * force)
        reach = min(_reach(slack, ds), _reach(force, df))
        after = (slack + reach * ds) @ (force + reach * df) / d.size
        centre = (after / gap) ** 3 * gap
        dy, ds, df = step(slack * force + ds * df - centre)
        reach = min(1.0, 0.995 * min(_reach(slack, ds), _reach(force, df)))
        y, slack, force = y + reach * dy, slack + reach * ds, force + reach * df
    raise TrajectoryError("the limits contradict each other", hint="raise one of them")


def _reach(values, change):
    """How far positive values can go along a change before one is zero."""
    down = change < 0.0
    return float(np.min(-values[down] / change[down], initial=1e3))
