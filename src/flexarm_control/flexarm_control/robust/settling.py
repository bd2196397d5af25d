# SPDX-License-Identifier: Apache-2.0
r"""How soon the tip settles after a motion, for arms that differ from the file; and the gradient by the gains.

The feed-forward moves the arm of the file, :math:`M\ddot z + Kz = Bu` with :math:`z = (q, \delta)`. For an arm with the
matrices :math:`M', K'` the same torque leaves the forces

.. math:: f = (M - M')\,\ddot z + (K_{\cdot2} - K'_{\cdot2})\,\delta

to the feedback. They are zero after the end of the motion, and the vibration that they have excited decays. The motion
is a quintic of one joint by `ANGLE` in `MOTION` locked periods. Its bending is taken as quasi-static,
:math:`\delta = -K_{22}^{-1}M_{21}\ddot q`. The change of the weight along the motion and the difference in damping are
left out. The sampled loop (`loop`) with gains K, linear about one configuration, moves from sample to sample by
:math:`X_{k+1} = AX_k + Sf_k`. The tip moves by :math:`y_k = CX_k`, in units of the distance within which it counts as
settled. The search minimises a number J. It is about the time from the end of the motion until the tip has settled, in
locked periods T, with one motion j of each joint:

.. math:: J^3 = \frac{3}{T^3}\int_0^{6T} t^2\,\ln\Bigl(1 + \sum_j|y_j(t)|^2\Bigr)\,dt .

If the logarithm is one until :math:`t = sT` and then zero, J = s. The gradient by the gains follows from the adjoint
recursion

.. math:: \Lambda_k = A^T\Lambda_{k+1} + C^T\frac{\partial J}{\partial y_k}, \qquad
    \frac{\partial J}{\partial A} = \sum_k\Lambda_{k+1}X_k^T, \qquad
    \frac{\partial J}{\partial S} = \sum_k\Lambda_{k+1}f_k^T .

If a locked period has many samples, several samples are taken as one step: A and S of two steps are :math:`A^2` and
:math:`S + AS`. After the motion the steps are longer still.
"""

import numpy as np

from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.linear import linear_plant, sampled
from flexarm_dynamics.models.model import build

from ..kernels import compiled
from .decay import eigenvalues
from .loop import sampled_loop
from .tip import Tip
from .uncertain import richer

#: A motion turns one joint by this angle [rad], in this many locked periods. Then the tip is watched for this many.
ANGLE, MOTION, WATCHED = np.radians(75.0), 2.0, 6.0
#: The tip has settled within this fraction of the reach [-].
TOLERANCE = 1e-3
#: Samples are combined into longer steps as long as a locked period still has at least `STEPS` steps. If it has, a step
#: after the motion combines two to the power of `LONGER` steps.
STEPS, LONGER = 32, 1
#: The tip's distance is weighted by this power of the time: the latest part counts most.
LATE = 2
#: An arm with Coulomb friction is also tested with friction as a damper, at these fractions of the damper at rest. Its
#: J is then multiplied by `RUBS`: friction damps so strongly only in movements smaller than this motion.
RUBBING, RUBS = (0.1, 0.3), 0.7
#: A pole rings if its imaginary part is between these multiples of the lowest locked frequency.
RING = 0.5, 6.0
#: Power of J in the sum over all arms and configurations: the worst counts most.
POWER = 8.0


class Residual:
    """Movement of one arm's tip after a motion that ends in one configuration, under gains K.

    Parameters
    ----------
    loop : Loop
        Of the arm in that configuration.
    forces : ndarray, shape (k, h, n)
        Forces on joints and modes in each step of the motion of each joint [N m], [N].
    push : ndarray, shape (s, h)
        Change of the plant's state in one sample by a unit of each force.
    tip : ndarray, shape (3, h)
        Jacobian of the tip by joints and deflections, over the tolerance.
    period : float
        Of the lowest mode, joints locked [s].
    doublings : int
        A step of the motion is two to the power of this many samples. After the motion the power is higher by
        `LONGER`, if a period has at least `STEPS` steps.
    share : float
        Factor of J.

    Attributes
    ----------
    rubs : bool
        Whether friction damps its joints.
    """

    def __init__(self, loop, forces, push, tip, period, doublings, share=1.0):
        self.loop, self._doublings, self._share = loop, doublings, share
        self.rubs, self._omega = share < 1.0, 2.0 * np.pi / period
        self._forces = np.ascontiguousarray(forces.transpose(0, 2, 1))  # as rows, as the states
        self._S = np.zeros((len(loop.F), push.shape[1]))
        self._S[: len(push)] = push
        self._C = np.zeros((3, len(loop.F)))
        self._C[:, : tip.shape[1]] = tip
        step = loop.period * 2.0**doublings / period
        self._longer = LONGER if STEPS * step <= 1.0 else 0
        step *= 2.0**self._longer
        self._after = int(np.ceil(WATCHED / step))
        self._time = step * np.arange(self._after + 1)
        self._weight = (LATE + 1.0) * step * self._time**LATE

    def _moved(self, K):
        """A and S after each doubling of the step, and the states X of all steps as rows, (steps + 1, n, N)."""
        A, S = self.loop.F - self.loop.G @ (K @ self.loop.N), self._S
        doubled = [(A, S)]
        for _ in range(self._doublings + self._longer):
            A, S = A @ A, S + A @ S
            doubled.append((A, S))
        count, n, _ = self._forces.shape
        X = np.zeros((count + self._after + 1, n, len(A)))
        A, S = doubled[self._doublings]
        steps = compiled().steps
        steps(np.ascontiguousarray(A.T), self._forces @ S.T, X[: count + 1])
        steps(np.ascontiguousarray(doubled[-1][0].T), X[:0], X[count:])
        return doubled, X

    def distance(self, K):
        """Distance of the tip from its goal over the tolerance, in each step from the end of the motion on."""
        X = self._moved(K)[1][len(self._forces) :]
        return np.sqrt(((X @ self._C.T) ** 2).sum(axis=(1, 2)))

    def settling(self, K):
        """Locked periods from the end of the motion until the tip has settled; infinite: not within `WATCHED`."""
        outside = np.flatnonzero(~(self.distance(K) <= 1.0))
        if not outside.size:
            return 0.0
        return np.inf if outside[-1] == self._after else float(self._time[outside[-1] + 1])

    def ringing(self, K):
        """Decay of the slowest pole that rings (`RING`), over the lowest locked frequency; infinite: none rings [-]."""
        s = np.log(eigenvalues(self.loop, K)[1].astype(complex)) / self.loop.period / self._omega
        low, high = RING
        return -s.real[(s.imag > low) & (s.imag < high)].max(initial=-np.inf)

    def __call__(self, K):
        """J, and its gradient by K; J is infinite if the tip's movement overflows."""
        with np.errstate(over="ignore", invalid="ignore"):
            doubled, X = self._moved(K)
            first = len(self._forces)
            y = X[first:] @ self._C.T
            square = (y**2).sum(axis=(1, 2))
            whole = self._weight @ np.log1p(square)
        if not 0.0 < whole < np.inf:
            return (0.0 if whole == 0.0 else np.inf), np.zeros_like(K)
        value = self._share * whole ** (1.0 / (LATE + 1.0))
        by_square = value / whole / (LATE + 1.0) * self._weight / (1.0 + square)
        slope = (y * (2.0 * by_square)[:, None, None]) @ self._C
        last, steps = np.zeros_like(X), compiled().steps  # Lambda of each step, the last one first
        last[0] = slope[-1]
        steps(doubled[-1][0], np.ascontiguousarray(slope[-2::-1]), last[: self._after + 1])
        steps(doubled[self._doublings][0], slope[:0], last[self._after :])
        ahead = last[::-1]
        to_A = _outer(ahead[first + 1 :], X[first:-1])
        for A, _ in doubled[self._doublings : -1][::-1]:
            to_A = to_A @ A.T + A.T @ to_A
        to_A += _outer(ahead[1 : first + 1], X[:first])
        to_S = _outer(ahead[1 : first + 1], self._forces)
        for A, S in doubled[: self._doublings][::-1]:
            to_A = to_A @ A.T + A.T @ to_A + to_S @ S.T
            to_S = to_S + A.T @ to_S
        return float(value), -(self.loop.G.T @ to_A @ self.loop.N.T)


def _outer(left, right):
    """Sum of the outer products of corresponding rows of two stacks of matrices."""
    return left.reshape(-1, left.shape[2]).T @ right.reshape(-1, right.shape[2])


def together(values):
    r"""J of all arms and configurations, :math:`(\sum_i J_i^8)^{1/8}`, from the `values` :math:`J_i`; 0 for none."""
    most = max(values, default=0.0)
    if not 0.0 < most < np.inf:
        return float(most)
    return float(most * ((np.array(values) / most) ** POWER).sum() ** (1.0 / POWER))


def rings(residuals, K):
    """Least `Residual.ringing` of the arms whose joints friction damps; infinite: there are none [-].

    Parameters
    ----------
    residuals : sequence of (int, Residual)
        Each after the number of its set of gains.
    K : ndarray, shape (k, n, 3n + 2m)
    """
    return min((one.ringing(K[k]) for k, one in residuals if one.rubs), default=np.inf)


class AfterMotion:
    r"""J of all arms and configurations of a design, :math:`(\sum_i J_i^8)^{1/8}`, as a function of scaled gains.

    Parameters
    ----------
    slowest : SlowestScheduled
        Scales the gains.
    residuals : sequence of (int, Residual)
        Each after the number of its set of gains.
    """

    def __init__(self, slowest, residuals):
        self._slowest, self._residuals = slowest, residuals

    def __call__(self, x):
        """J, and its gradient by the scaled gains x."""
        K = self._slowest.gains(x)
        rows = [residual(K[k]) for k, residual in self._residuals]
        value = together([value for value, _ in rows])
        if not np.isfinite(value):
            return np.inf, np.zeros_like(x)
        slope = np.zeros_like(K)
        for (k, _), (one, by_gains) in zip(self._residuals, rows, strict=True):
            if one:
                slope[k] += (one / value) ** (POWER - 1.0) * by_gains
        scale, free = self._slowest.scale, self._slowest.free
        return float(value), np.concatenate([(one * scale)[free] for one in slope])

    def ringing(self, x):
        """`rings` of all arms with scaled gains x [-]."""
        return rings(self._residuals, self._slowest.gains(x))

    def settling(self, x):
        """Longest settling time of all, in locked periods."""
        K = self._slowest.gains(x)
        return max(residual.settling(K[k]) for k, residual in self._residuals)


def residuals(nominal, q, sampling, uncertainty):
    """A `Residual` for each arm of which only payload or only stiffness differs, in configuration q (n,) [rad]."""
    arm = richer(nominal.arm.whole)
    period = 2.0 * np.pi / nominal.frequencies(q, locked=True)[0]
    doublings = max(0, int(np.log2(max(period / STEPS / sampling.period, 1.0))))
    motion = Motion(build(arm), q, period, sampling.period * 2.0**doublings)
    (p0, p1), (k0, _) = uncertainty.payload, uncertainty.stiffness
    parts = (0.0, *(RUBBING if any(joint.friction.coulomb for joint in arm.joints) else ()))
    found = []
    for payload, stiffness in ((p0, 1.0), (p1, 1.0), (1.0, k0)):
        plant = build(scaled(arm, payload, stiffness))
        try:
            forces, push = motion.leaves(plant, sampling.period)
        except ModelError:  # too heavy to rest there
            continue
        tip = Tip(plant, q).J / (TOLERANCE * arm.reach)
        for part in parts:
            loop = sampled_loop(nominal, plant, q, sampling, sticking=part)
            share = RUBS if part else 1.0
            found.append(Residual(loop, forces, push, tip, period, doublings, share))
    return found


class Motion:
    """For each joint a motion of the file's arm that ends in one configuration, and the forces that it takes.

    Parameters
    ----------
    model : ArmModel
        One mode richer than the file's.
    q : ndarray, shape (n,)
        [rad]
    period : float
        Of the lowest mode, joints locked [s].
    step : float
        Of the motion [s].

    Attributes
    ----------
    torque : ndarray, shape (k, n, n)
        Joint torques (last) in each step of the motion of each joint [N m].
    """

    def __init__(self, model, q, period, step):
        n, length = model.n_joints, MOTION * period
        s = np.minimum((np.arange(int(np.ceil(length / step))) + 0.5) * step / length, 1.0)
        self._acceleration = ANGLE * (60.0 * s - 180.0 * s**2 + 120.0 * s**3) / length**2
        self._snap = ANGLE * (720.0 * s - 360.0) / length**4
        self._q, (self._M, self._K, _) = q, _matrices(model, q)
        bent = -np.linalg.solve(self._K[n:, n:], self._M[n:, :n])  # by joint accelerations
        self._bending = np.vstack([np.zeros((n, n)), bent])
        self._moved = np.vstack([np.eye(n), np.zeros_like(bent)])
        self.torque = self._forces(self._M, self._K)[:, :n].transpose(0, 2, 1)

    def _forces(self, M, K):
        """Forces (k, h, n) that move an arm with these matrices, in each step of the motion of each joint."""
        by_acceleration = M @ self._moved + K @ self._bending
        forces = np.multiply.outer(self._acceleration, by_acceleration)
        return forces + np.multiply.outer(self._snap, M @ self._bending)

    def leaves(self, plant, period):
        """Forces (k, h, n) that the motion's torque leaves to the feedback of a `plant`, and their effect in a sample.

        The effect, (2h, h), is the change of the plant's state by a unit of each force for a `period` [s].

        Raises
        ------
        ModelError
            If the plant does not rest there.
        """
        M, K, A = _matrices(plant, self._q)
        push = np.vstack([np.zeros_like(M), np.linalg.inv(M)])
        return self._forces(self._M - M, self._K - K), sampled(A, push, period)[1]


def _matrices(model, q):
    """Mass and stiffness of a model at rest in q, (h, h) each, and A of its linear state."""
    A, _ = linear_plant(model, q, coulomb=False)
    size, n = len(A) // 2, model.n_joints
    bent = model.static_deflection(q)
    M = model.terms(q, np.zeros(n), bent, np.zeros_like(bent)).M
    return M, -M @ A[size:, :size], A
