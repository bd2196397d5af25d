# SPDX-License-Identifier: Apache-2.0
r"""The time law that excites the links least, for a given duration and torque limit.

The joints go in a straight line of joint space, :math:`q = q_0 + \Delta\,\sigma(t)`, and :math:`\sigma` is a spline of
degree five with rest and no jerk at both ends, whose coefficients x are found by a convex programme

.. math:: \min_x\; \frac{w\,E(T) + \frac1T\int_0^T E\,dt}{E_5} + \epsilon\,\frac{\int\dddot\sigma^2dt}{J_5}
    \quad\text{with}\quad |\bar u_i(t)| \le u_{i,max},\; 0 \le |\Delta_i|\,\dot\sigma(t) \le v_{i,max},

E the energy of the deviation from the quasi-steady state that the fast subsystem (11) has along the motion,
linear in x before it is squared (`excitation`); :math:`E_5, J_5` those of a quintic of the same duration. The torque
:math:`\bar u` of (10) and the quasi-steady state (9) are linearised along the last solution and the programme is
solved anew until it changes no more: sequential convex programming. For one joint without gravity and
friction a single solution is exact but for what the rate of the joint does to the stiffness.

The quadratic programme is solved by an interior-point method (`least_squares`). Whether there is a solution at all,
and the least torque or duration if not, a linear programme says.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import linprog

from flexarm_dynamics.errors import DesignError, ShapeError, TrajectoryError

from . import excitation
from .profiles import Profile, quintic

#: Pieces of the spline. Points at multiples of T / INTERVALS make the sampled motion exact.
INTERVALS = 25
#: Times at which limits hold and the response is taken, per piece.
PER_INTERVAL = 6
_DEGREE = 5
_REST = 4  # coefficients at either end that rest without jerk fixes
#: Weight w of what is left at the end, beside the mean along the way.
RESIDUAL_WEIGHT = 100.0
#: Weight epsilon of the jerk: of what excites alike the smoother is taken.
JERK_WEIGHT = 1e-4
_ROUNDS = 40
#: Rounds after which the fast subsystem stays that of the motion found so far: fast motions swing with it.
_REFRESHED = 10
_ITERATIONS = 100
_SETTLED = 1e-5  # of sigma, between two rounds
_STEP = 1e-5  # of the differences that linearise the torque
#: How far the torque may be above its limit between the times at which it is held [-].
_SLACK = 1e-6


@dataclass(frozen=True, eq=False)
class LeastExciting:
    """A least-exciting motion.

    Attributes
    ----------
    profile : Profile
        The motion.
    excitation : Excitation
        What it excites, and its torque, by the full reduced model.
    quintic : Excitation
        The same of the quintic of the same duration, which may go beyond the limits.
    rounds : int
        Convex programmes solved.
    """

    profile: Profile
    excitation: excitation.Excitation
    quintic: excitation.Excitation
    rounds: int


def least_exciting(
    model, start, end, duration, torque_limit=None, velocity_limit=None, configuration=None
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
        Of the slow torque [N m] and of the speeds [rad/s]; the arm file's limits if not given. The fast
        control wants torque beside it: leave it some.
    configuration : (n,) array_like, optional
        Where (11) is taken [rad]; along the motion if not given.

    Returns
    -------
    LeastExciting

    Raises
    ------
    TrajectoryError
        If no time law keeps within the limits; names the least torque and the least duration that would do.
    DesignError
        If the programme does not settle.
    ShapeError
        For limits or a configuration of another length.
    """
    base = quintic(start, end, duration)
    if base.start.shape != (model.n_joints,):
        raise ShapeError(f"start has shape {base.start.shape}, wanted {(model.n_joints,)}")
    joints = [joint.limits for joint in model.arm.joints]
    torque = _limit("torque_limit", torque_limit, [j.torque for j in joints])
    speed = _limit("velocity_limit", velocity_limit, [j.velocity for j in joints])
    if not np.any(base.angle):
        raise TrajectoryError("start and end are the same: there is nothing to move")
    problem = _Problem(model, base, torque, speed, configuration)
    problem.check_feasible()
    x, rounds = problem.solve()
    profile = problem.profile(x)
    points = 2 * PER_INTERVAL * INTERVALS + 1
    return LeastExciting(
        profile,
        excitation.along(model, profile, configuration, points),
        excitation.along(model, base, configuration, points),
        rounds,
    )


def _limit(name, given, default):
    values = np.array(default if given is None else given, float)
    if values.shape != (len(default),):
        raise ShapeError(f"{name} has shape {values.shape}, wanted {(len(default),)}")
    if not (values > 0.0).all():
        i = int(np.argmin(values > 0.0))
        raise TrajectoryError(f"{name}[{i}] is {values[i]}: it must be above 0")
    return values


class _Basis:
    """sigma and its derivatives at the grid's times as functions of the free coefficients: r + A x, by s = t / T."""

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

    def coefficients(self, x):
        out = np.zeros(self.count)
        out[self.free], out[-_REST:] = x, 1.0
        return out

    def fit(self, sigma):
        """Coefficients of the spline nearest to a time law given at the grid's times."""
        return np.linalg.lstsq(self.matrices[0], sigma - self.constants[0], rcond=None)[0]


class _Problem:
    """The programme of one motion; `x` are the free coefficients of sigma."""

    def __init__(self, model, base, torque_limit, speed_limit, configuration):
        self.model, self.base = model, base
        self.torque_limit, self.speed_limit = torque_limit, speed_limit
        self.configuration = configuration
        self.basis = _Basis()
        self.first = self.basis.fit(base.shape[0](self.basis.s))

    def profile(self, x, duration=None):
        """The motion of the coefficients."""
        b = self.basis
        spline = BSpline(b.knots, b.coefficients(x), _DEGREE)
        shape = (spline, spline.derivative(), spline.derivative(2))
        duration = self.base.duration if duration is None else duration
        return Profile(self.base.start, self.base.angle, duration, shape)

    # Limits ------------------------------------------------------------------------------------

    def linearised(self, x, duration):
        """Torque and quasi-steady amplitudes at the grid's times: r + A x, exact in value at x, and in slope.

        Returns
        -------
        r : (k, n + m) array
        A : (k, n + m, c) array
        """
        b, T = self.basis, duration
        states = [(r + A @ x) for r, A in zip(b.constants[:3], b.matrices[:3], strict=True)]
        value = self._reduced(*states, T)
        slopes = []
        for i in range(3):
            # Forward differences: exact for the acceleration, which is linear, and near enough for the
            # others, whose change between two rounds goes to zero.
            step = 1.0 if i == 2 else _STEP
            ahead = list(states)
            ahead[i] = states[i] + step
            slopes.append((self._reduced(*ahead, T) - value) / step)
        A = sum(
            slope[:, :, None] * matrix[:, None, :]
            for slope, matrix in zip(slopes, b.matrices[:3], strict=True)
        )
        return value - A @ x, A

    def _reduced(self, sigma, rate, acceleration, duration):
        """Torque and quasi-steady amplitudes (k, n + m) of states of sigma, derivatives by s."""
        start, angle = self.base.start, self.base.angle
        states = zip(sigma, rate, acceleration, strict=True)
        try:
            rows = [
                np.concatenate(
                    excitation.reduced(
                        self.model, start + angle * s, angle * v / duration, angle * a / duration**2
                    )
                )
                for s, v, a in states
            ]
        except np.linalg.LinAlgError:
            raise DesignError(
                f"{self.model.arm.name}: in {duration:g} s the joints get so fast that the links lose their stiffness"
                " in this model, and the quasi-steady state does not exist: take a longer duration"
            ) from None
        return np.array(rows)

    def torque_rows(self, r, A):
        """Torque over its limit at all times and for all joints that have one: r (k,), A (k, c)."""
        n = self.model.n_joints
        bounded = np.flatnonzero(np.isfinite(self.torque_limit))
        scale = self.torque_limit[bounded]
        r, A = r[:, :n][:, bounded] / scale, A[:, :n][:, bounded] / scale[:, None]
        return r.ravel(), A.reshape(r.size, A.shape[2])

    def speed_bound(self, duration):
        """Largest sigma' by s that all joints' speeds allow."""
        moving = self.base.angle != 0.0
        return float(np.min(self.speed_limit[moving] / np.abs(self.base.angle[moving])) * duration)

    def check_feasible(self):
        """Refuse limits that no time law keeps, saying what would do."""
        T = self.base.duration
        shortest = T / self.speed_bound(T) if np.isfinite(self.speed_bound(T)) else 0.0
        # The quintic's peak speed is 15/8 of the mean.
        if 2.0 * shortest < T and self._excess(self.first) < 0.95:
            return
        need = np.inf if shortest >= T else self._least_factor(T)
        if need <= 1.0:
            return
        raise TrajectoryError(self._why_not(T, shortest, need))

    def _why_not(self, T, shortest, need):
        limits = self.torque_limit
        what = f"no motion of {T:g} s keeps within the limits: "
        if np.isfinite(need):
            enough = ", ".join(
                f"{name} {need * limit:.4g}"
                for name, limit in zip(self.model.joint_names, limits, strict=True)
                if np.isfinite(limit)
            )
            what += f"it wants {need:.4g} times the torque limits ({enough} N m)"
        else:
            what += (
                f"the speeds alone want {shortest:.4g} s"
                if shortest >= T
                else "the speed limits leave no time law"
            )
        hold = max(
            np.max(np.abs(excitation.reduced(self.model, q, 0 * q, 0 * q)[0]) / limits)
            for q in self.base.position(np.linspace(0.0, T, 33))
        )
        if hold >= 1.0:
            return what + f"; holding the arm on the way takes {hold:.4g} times them, however slow"
        duration = self._least_duration(max(T, shortest), need)
        return what + (f"; a duration of {duration:.4g} s would do" if duration else "")

    def _least_duration(self, below, need):
        """A duration that does, within 1 % of the least; None if there is none to be found."""
        # Torques of inertia fall as 1 / T^2.
        above = below * (1.005 * np.sqrt(need) if np.isfinite(need) else 1.005)
        for _ in range(12):
            if self._least_factor(above) <= 1.0:
                break
            below, above = above, 1.5 * above
        else:
            return None
        middle = 0.991 * above  # the guess is often right
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
            # A full step where it comes to rest; parts of it where it swings to and fro.
            part = max(0.5 * part, 0.1) if change > 0.7 * before else min(1.5 * part, 1.0)
            x, before = x + (part if change > _SETTLED else 1.0) * (new - x), change
            if change > _SETTLED:
                continue
            excess = self._excess(x)
            if excess <= 1.0 + _SLACK:
                return x, count
            # Between the times at which it is held the torque is above its limit by a little.
            tighter *= (1.0 - 0.1 * _SLACK) / excess
        raise self._unsettled(f"it still changes after {_ROUNDS} rounds")

    @staticmethod
    def _unsettled(why):
        return DesignError(
            f"the least-exciting motion does not settle ({why}): the torque changes too much along it; give a longer"
            " duration, a higher torque limit, or one configuration"
        )

    def _response(self, x):
        """The fast subsystem along the motion of x."""
        profile, times = self.profile(x), self.base.duration * self.basis.s
        q, qd = profile.position(times), profile.velocity(times)
        where = excitation.path_of(q, qd, self.configuration)
        return excitation.FastResponse(self.model, times[1], *where)

    def _excess(self, x):
        """Peak torque over its limit, by the full reduced model, between the grid's times as well."""
        profile = self.profile(x)
        times = np.linspace(0.0, profile.duration, 2 * (self.basis.s.size - 1) + 1)
        motion = (f(times) for f in (profile.position, profile.velocity, profile.acceleration))
        torque = [excitation.reduced(self.model, *state)[0] for state in zip(*motion, strict=True)]
        return float(np.max(np.abs(torque) / self.torque_limit))

    def _programme(self, x, tighter):
        """The convex programme linearised at x."""
        T, b, n = self.base.duration, self.basis, self.model.n_joints
        r, A = self.linearised(x, T)
        rows, sides = self._objective(r[:, n:], A[:, n:])
        torque, slopes = self.torque_rows(r, A)
        G, h = (
            [-slopes, slopes, b.matrices[1]],
            [torque - tighter, -torque - tighter, -b.constants[1]],
        )
        bound = self.speed_bound(T)
        if np.isfinite(bound):
            G.append(-b.matrices[1])
            h.append(b.constants[1] - bound)
        return least_squares(rows, sides, np.vstack(G), np.concatenate(h))

    def _objective(self, r, A):
        """Rows and right-hand sides whose squared difference the programme makes least."""
        b, k = self.basis, self.basis.s.size
        quintics = self.first
        jerk = b.matrices[3] / np.sqrt(k)
        jerk_constant = b.constants[3] / np.sqrt(k)
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

    Returns
    -------
    (c,) array

    Raises
    ------
    TrajectoryError
        If it does not converge: the inequalities contradict each other.
    """
    # Columns of Q in the place of those of E: the Hessian is the identity.
    Q, R = np.linalg.qr(E)
    C = np.linalg.solve(R.T, G.T).T
    scale = np.linalg.norm(C, axis=1)
    empty = scale <= 1e-12 * scale.max()  # at the ends nothing is free
    if (h[empty] > 1e-9).any():
        raise TrajectoryError("the limits leave no room at the ends: raise one of them")
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
            break  # forces without bound: nothing satisfies all
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
    raise TrajectoryError("the limits contradict each other: raise one of them")


def _reach(values, change):
    """How far positive values can go along a change before one is zero."""
    down = change < 0.0
    return float(np.min(-values[down] / change[down], initial=1e3))
