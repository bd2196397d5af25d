# SPDX-License-Identifier: Apache-2.0
r"""The sampled loop with its observer, its delay and a law of any type, linearised about rest by finite differences.

Observer and law are called as they are. Their states x are the arrays that change. These and the measurements
:math:`y = (q, \dot q, \hat\delta, \dot\delta, u_{applied})`, as far as the source sends them, are changed one by one.
The differences give

.. math:: x_{k+1} = A x_k + B y_k, \qquad u_k = C x_k + D y_k

for their own `step`, filters, integrals and compensators included. The feed-forward rests. The arm (2), linear about
rest (`linear_plant`), is sampled exactly, and a torque acts after the delay, as in `loop`.
"""

import copy
from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.arm.encoders import encoder_rows
from flexarm_dynamics.errors import DesignError, FlexarmError
from flexarm_dynamics.linear import linear_plant, sampled, state_at_rest, static_torque

from ..loop.samples import ArmSample, SampleOrder
from ..low_pass import LowPass
from ..trajectory import ReferenceGenerator
from .loop import measured_amplitudes

#: Steps of the differences [rad, m, N m, …]; the smaller one is used if friction is curved within the larger one. An
#: entry that is no larger than `NONE` counts as zero.
STEPS, NONE = (1e-6, 1e-8), 1e-12
#: If an answer jumps, the differences are taken at this distance instead [rad]. An answer jumps if its second
#: difference is larger than `JUMP`, relative to the first difference [-].
BESIDE, JUMP = (0.0, 1e-3, -2e-3), 1e-3
#: An observer must converge within `CONVERGING` samples. Then at most `SETTLING` samples follow, until no array changes
#: by more than the fraction `SETTLED` in `EACH` samples.
CONVERGING, SETTLING, EACH, SETTLED = 20_000, 3000, 50, 1e-9
#: A pole counts as growing beyond this value, absolute [1/s] plus relative to its size [-]: differences are inexact.
ROUNDING = 1e-5


@dataclass(frozen=True)
class Source:
    """Whether the arm's driver sends joint speeds, and rates of the deflections."""

    velocity: bool = True
    rate: bool = False


@dataclass(frozen=True)
class LinearController:
    """Observer and law, linear about rest in q; see the module."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    q: np.ndarray
    model: object
    source: Source
    period: float
    separate: bool  # the slow law compensates no friction, see `full_order`


class _JumpError(Exception):
    """An answer jumps, so it has no derivative."""


class _Asked:
    """An observer and a law that are called sample by sample, and can be put back to their state at rest."""

    def __init__(self, law, observer, q, period, source):
        self.law, self.observer, self.source = law, observer, source
        self.model = model = law.model
        self.period_ns = round(1e9 * period)
        self.reference = ReferenceGenerator(model.joint_names)
        self.reference.start(q, 1)
        n, rest = model.n_joints, state_at_rest(model, q)
        self.at_rest = np.concatenate(
            [
                q,
                np.zeros(n * source.velocity),
                rest[n : n + model.n_modes],
                np.zeros(model.n_modes * source.rate),
                static_torque(model, q),
            ]
        )
        self.count = 0
        observer.settings = observer.settings | {"plausibility": False}
        observer._order = SampleOrder()
        observer.observer.reset()
        law.reset()
        law.limit = np.full(n, np.inf)
        laws = [law.slow, law.fast]
        filters = [f for part in laws for f in vars(part).values() if isinstance(f, LowPass)]
        self.parts = [observer, observer.observer, *laws, *filters]
        self._converge()
        self.kept = [(part, _arrays(part), dict(vars(part))) for part in self.parts]
        self.order, self.begun = copy.copy(observer._order), self.count

    def _converge(self):
        n, m = self.model.n_joints, self.model.n_modes
        self.sample = ArmSample(n, m)
        for _ in range(CONVERGING):
            if self.ask(self.at_rest)[0]:
                break
        else:
            raise DesignError("does not converge at rest", field="the observer")
        before = None
        for k in range(SETTLING):
            if k % EACH == 0:
                now = [values for part in self.parts for values in _arrays(part).values()]
                if before is not None and all(map(_same, now, before)):
                    return
                before = now
            self.ask(self.at_rest)

    def ask(self, y):
        """Whether the estimate has converged, and the torque for measurements y."""
        n, m, s = self.model.n_joints, self.model.n_modes, self.sample
        sizes = [n, n * self.source.velocity, m, m * self.source.rate]
        position, velocity, amplitude, rate, torque = np.split(y, np.cumsum(sizes))
        s.stamp_ns, s.session, s.sequence = 1 + self.count * self.period_ns, 1, self.count
        s.position[:], s.torque[:], s.strain = position, torque, None
        s.velocity_known = self.source.velocity
        if self.source.velocity:
            s.velocity[:] = velocity
        s.amplitude, s.rate = amplitude.copy(), rate.copy() if self.source.rate else None
        observer, dt = self.observer, 1e-9 * self.period_ns if self.count else 0.0
        self.count += 1
        self.reference.sample(s.stamp_ns)
        if not observer.step(s):
            return False, None
        u = self.law.step(
            observer.position,
            observer.velocity,
            observer.amplitude,
            observer.rate,
            self.reference,
            dt,
        )
        return True, np.array(u)

    def put_back(self):
        """Restore the state in which the observer had settled."""
        for part, arrays, attributes in self.kept:
            vars(part).update(attributes)
            for name, values in arrays.items():
                np.copyto(getattr(part, name), values)
        self.observer._order, self.count = copy.copy(self.order), self.begun

    def _vectors(self):
        """Vectors that were finite at rest. Others are limits that the arm file leaves open, and not states."""
        for part, arrays, _ in self.kept:
            for name, values in arrays.items():
                if values.ndim == 1 and np.isfinite(values).all():
                    yield getattr(part, name)

    def states(self):
        """All vectors of observer and law, joined, (N,)."""
        return np.concatenate([np.zeros(0), *self._vectors()])

    def move(self, i, by):
        """Change entry i of `states`."""
        for vector in self._vectors():
            if i < vector.size:
                vector[i] += by
                return
            i -= vector.size


def _same(values, others):
    if not np.isfinite(others).all():
        return np.array_equal(values, others, equal_nan=True)
    scale = np.abs(values).max(initial=1e-6)
    return bool((np.abs(values - others) <= SETTLED * scale).all())


def _arrays(part):
    """Copies of an object's own writeable arrays of floats."""
    return {
        name: value.copy()
        for name, value in vars(part).items()
        if isinstance(value, np.ndarray) and value.dtype == float and value.flags.writeable
    }


def linear_controller(law, observer, q, period, source=None):
    """A `law` and an `ArmObserver`, linear about rest. This changes the states of both: reset them afterwards.

    Parameters
    ----------
    law : CompositeControl
    observer : ArmObserver
    q : ndarray, shape (n,)
        [rad]
    period : float
        [s]
    source : Source, optional
        If not given, with joint speeds and without rates.

    Returns
    -------
    LinearController

    Raises
    ------
    DesignError
        If the observer does not converge, the law leaves the joints free, or an answer jumps everywhere.
    FlexarmError
        If the arm does not rest there, or a sample is refused.
    """
    if law.free:
        raise DesignError("leaves the joints free: there is no loop", field="the slow law")
    q, source = np.asarray(q, float), source or Source()
    for beside in BESIDE:
        place = q + beside * np.cos(1.0 + np.arange(q.size))
        with law.slow.without_friction():
            asked = _Asked(law, observer, place, period, source)
            for step in STEPS:
                found = _differenced(asked, step)
                if found is not None:
                    return found
    raise DesignError("jumps at rest: there is no linear loop", field="observer or law")


def _differenced(asked, step):
    """As `linear_controller`; None if an answer jumps at q: some observers keep one model per tenth of a radian."""
    size, inputs = asked.states().size, asked.at_rest.size

    def answered(state, y):
        ahead, here, back = [], [], []
        for sign, out in ((1.0, ahead), (0.0, here), (-1.0, back)):
            asked.put_back()
            if state is not None:
                asked.move(state, sign * step)
            move = np.zeros(inputs)
            if y is not None:
                move[y] = sign * step
            converged, u = asked.ask(asked.at_rest + move)
            if not converged:
                raise DesignError("loses the arm at rest", field="the observer")
            out += [asked.states(), u]
        for a, c, b in zip(ahead, here, back, strict=True):
            scale = np.abs(c).max(initial=1.0)
            most = JUMP * (np.abs(a - b).max(initial=0.0) + step * scale)
            if (np.abs(a - 2.0 * c + b) > most).any():
                raise _JumpError
        return [(a - b) / (2.0 * step) for a, b in zip(ahead, back, strict=True)]

    try:
        columns = [answered(i, None) for i in range(size)]
        rows = [answered(None, j) for j in range(inputs)]
    except _JumpError:
        return None
    finally:
        asked.put_back()
    A = np.array([c[0] for c in columns]).T.reshape(size, size)
    C = np.array([c[1] for c in columns]).T.reshape(-1, size)
    B = np.array([r[0] for r in rows]).T.reshape(size, inputs)
    D = np.array([r[1] for r in rows]).T
    # Keep only states that something depends on and that something else changes: others are outputs or constants.
    kept = np.arange(size)
    while True:
        felt = (np.abs(A[np.ix_(kept, kept)]) > NONE).any(0) | (np.abs(C[:, kept]) > NONE).any(0)
        moved = (np.abs(A[np.ix_(kept, kept)] * (1 - np.eye(kept.size))) > NONE).any(1)
        moved |= (np.abs(B[kept]) > NONE).any(1)
        if (felt & moved).all():
            break
        kept = kept[felt & moved]
    return LinearController(
        A[np.ix_(kept, kept)], B[kept], C[:, kept], D, asked.reference.position.copy(),
        asked.model, asked.source, 1e-9 * asked.period_ns, asked.law.slow.separate,
    )  # fmt: skip


class WholeLoop:
    """Closed loops of a `LinearController` with its own model or with arms that differ from it.

    Parameters
    ----------
    controller : LinearController
    delay : float
        From a measurement until its torque acts [s].
    """

    def __init__(self, controller, delay=0.0):
        self.controller, self.delay, self._plants = controller, delay, {}

    def plant(self, model, key=None):
        """A and B of an arm at rest, the map from deflections to amplitudes, and that from (q, delta) to the encoders.

        The result is kept under the `key`.
        """
        if key is None or key not in self._plants:
            c = self.controller
            A, B = linear_plant(model, c.q, not c.separate)
            if model.n_modes == c.model.n_modes:
                seen = np.eye(model.n_modes)
            elif c.model.n_modes:
                seen = measured_amplitudes(c.model, model)
            else:
                seen = np.zeros((0, model.n_modes))
            self._plants[key] = A, B, seen, encoder_rows(model)
        return self._plants[key]

    def matrix(self, plant=None, gain=1.0, delay=None):
        """Transition matrix of (s, x, torques under way, newest first); a complex `gain` turns the phase.

        Parameters
        ----------
        plant : tuple, optional
            As `plant` returns it; the controller's model if not given.
        gain : complex
            Factor of the torque on its way to the arm [-].
        delay : float, optional
            [s]; that of the loop if not given.
        """
        c, T = self.controller, self.controller.period
        A, B, seen, turned = self.plant(c.model, "model") if plant is None else plant
        n, mp, size, x = c.model.n_joints, seen.shape[1], len(A), len(c.A)
        delay = self.delay if delay is None else delay
        whole = int(delay / T + 1e-9)
        late = delay - whole * T
        split = late > 1e-12
        count = whole + 1 + split
        total = size + x + n * count
        place = lambda age: slice(size + x + n * (age - 1), size + x + n * age)  # noqa: E731
        # y, from (s, x, torques)
        rows = [np.hstack([turned, np.zeros((n, n + mp))])]
        if c.source.velocity:
            rows.append(np.hstack([np.zeros((n, n + mp)), turned]))
        rows.append(np.hstack([np.zeros((len(seen), n)), seen, np.zeros((len(seen), n + mp))]))
        if c.source.rate:
            rows.append(np.hstack([np.zeros((len(seen), 2 * n + mp)), seen]))
        y = np.zeros((sum(map(len, rows)) + n, total), complex)
        y[:-n, :size] = np.vstack(rows)
        y[-n:, place(whole + 1)] = (1.0 - late / T) * np.eye(n)
        if split:
            y[-n:, place(whole + 2)] = late / T * np.eye(n)
        u = c.D @ y
        u[:, size : size + x] += c.C
        F = np.zeros((total, total), complex)
        later, end = sampled(A, B, T - late)
        F[:size, :size] = sampled(A, B, T)[0]

        def acts(matrix, age):
            if age:
                F[:size, place(age)] += gain * matrix
            else:
                F[:size] += gain * matrix @ u

        acts(end, whole)
        if split:
            acts(later @ sampled(A, B, late)[1], whole + 1)
        F[size : size + x] = c.B @ y
        F[size : size + x, size : size + x] += c.A
        F[place(1)] = u
        for age in range(2, count + 1):
            F[place(age), place(age - 1)] = np.eye(n)
        return F if np.iscomplexobj(gain) else F.real

    def poles(self, **off):
        """Poles of `matrix`, converted to continuous time [1/s], slowest first."""
        z = np.linalg.eigvals(self.matrix(**off)).astype(complex)
        s = np.log(z[np.abs(z) > 1e-9]) / self.controller.period
        return s[np.argsort(-s.real)]

    def stable(self, **off):
        """Whether no pole grows."""
        try:
            s = self.poles(**off)
        except (FlexarmError, np.linalg.LinAlgError):
            return False
        return bool((s.real < ROUNDING * (1.0 + np.abs(s))).all())

    def growing(self):
        """The fastest growing pole s [1/s], and the joint or mode that moves most in it."""
        F, c = self.matrix(), self.controller
        z, vectors = np.linalg.eig(F)
        s = np.log(z.astype(complex) + 1e-300) / c.period
        k = int(np.argmax(s.real))
        half = c.model.n_joints + c.model.n_modes
        weight = np.sqrt(np.diag(c.model.terms(c.q, np.zeros(c.model.n_joints)).M))
        moved = np.abs(vectors[:half, k]) * weight
        return s[k], [*c.model.joint_names, *c.model.mode_names][int(np.argmax(moved))]
