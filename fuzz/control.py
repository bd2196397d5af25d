# SPDX-License-Identifier: Apache-2.0
"""The control path: observers, the controller and designs, with any samples and any parameters."""

import numpy as np

from flexarm_control import trajectory
from flexarm_control.composite.design import FAST, MANIFOLD, SLOW, design
from flexarm_control.loop.arm_controller import PARAMETERS, ArmController
from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers import arm_observer
from flexarm_control.observers.arm_observer import observe
from flexarm_dynamics import registry
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError, MessageError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import check_all, sizes
from flexarm_ros.messages import CompositeStateWriter
from flexarm_studies.loop.closed_loop import ClosedLoop

from . import odd
from .files import Parameters
from .reader import Reader, demand

#: Designs that hold the arms, from the documentation.
R_LAW = ({"type": "linear_model_following"}, {"type": "lqr"}, {"type": "corrected"})
TWO_LINK_LAW = (
    {"type": "model_following", "kp": [2.25], "kv": [3.0]},
    {"type": "lqr", "alpha": 2.0, "q": [0.0] * 4 + [0.001] * 4, "configuration": [0.8, 0.8]},
    {"type": "corrected", "order": 1},
)
LOOPS = (("R", R_LAW, "model"), ("two_link", TWO_LINK_LAW, "none"), ("R", R_LAW, "preview"))

FIELDS = ("position", "velocity", "torque", "strain", "amplitude", "rate")
#: The latest stamp that a message can have [ns]: its seconds are an int32.
LAST_STAMP = (2**31 - 1) * 10**9


def healthy(arm, law, samples):
    """Measured samples of a loop that holds its arm, and the estimates computed from them."""
    slow, fast, manifold = law
    loop = ClosedLoop(
        arm,
        slow,
        fast,
        {"type": "luenberger"},
        {"publish_rates": True},
        {"feedforward": "none", "trajectory_torque_margin": 0.0},
        manifold,
    )
    measured, estimated = [], []
    for _ in range(SETTLED):
        loop.step()
    n = loop.model.n_joints
    point = (500_000_000, [0.3] * n, [0.0] * n, [0.0] * n, [])
    names = loop.model.joint_names
    verdict = loop.controller.offer(trajectory.validate(names, names, 0, [point]))
    demand(verdict.accepted, verdict.reason)
    for _ in range(samples):
        loop.step()
        measured.append(_kept(loop._measured))
        estimated.append(_kept(loop._estimate))
    return loop.model, measured, estimated


#: The observer has converged, and the motion has begun to bend the links [samples].
SETTLED = 120


def _kept(sample):
    """A copy of a sample as plain data."""
    out = {f: None if (v := getattr(sample, f)) is None else np.array(v) for f in FIELDS}
    return out | {"stamp_ns": sample.stamp_ns, "sequence": sample.sequence, "velocity_known": True}


def sample_of(kept, session):
    """An `ArmSample` of plain data."""
    sample = ArmSample(kept["position"].size)
    for field in FIELDS:
        value = kept[field]
        setattr(sample, field, None if value is None else value.copy())
    sample.stamp_ns, sample.sequence = kept["stamp_ns"], kept["sequence"]
    sample.session, sample.velocity_known = session, kept["velocity_known"]
    return sample


def spoil(rng, sample, session):
    """Change a few fields of a sample, in place."""
    for _ in range(rng.choice((1, 1, 2))):
        kind = rng.randrange(12)
        if kind < 6:
            values = getattr(sample, rng.choice(FIELDS))
            if values is not None and values.size:
                values[rng.randrange(values.size)] = odd.floating(rng)
        elif kind == 6:
            setattr(sample, rng.choice(("strain", "amplitude", "rate")), None)
        elif kind == 7:
            sample.velocity_known = False
        elif kind == 8:
            sample.stamp_ns = rng.choice(
                (0, 1, -5, LAST_STAMP, sample.stamp_ns - 1, sample.stamp_ns + 10**12)
            )
        elif kind == 9:
            sample.sequence = rng.choice((sample.sequence, sample.sequence + 1, odd.unsigned(rng)))
        elif kind == 10:
            sample.session = rng.choice((session, odd.unsigned(rng)))
        else:
            getattr(sample, rng.choice(("position", "velocity", "torque")))[:] *= rng.choice(
                (1e3, 1e5, -1.0)
            )
    return sample


class _Path(Reader):
    """Gives an object good samples, bad ones, and then a new session, in which it must recover."""

    batch, GOOD, HEALING = 20, 4, 12

    def __init__(self):
        self.built, self.wanted = {}, {}
        self.session = 1

    def ready(self, key):
        """The object of a key. At the first call it is built, and the result of a healthy session is stored."""
        if key not in self.built:
            self.built[key] = self.build(key)
            self.wanted[key] = self.live(key, range(self.HEALING))
        return self.built[key]

    def renew(self):
        self.built, self.wanted = {}, {}

    def live(self, key, steps):
        """Run a new session of good samples; return the results."""
        self.session = self.session % (2**32 - 1) + 1
        return [self.good(key, k) for k in steps]

    def run(self, rng):
        key = rng.choice(self.keys)
        self.ready(key)
        self.live(key, range(self.GOOD))
        self.given, refused = [key], 0
        for k in range(self.batch):
            sample = sample_of(self.data(key)[self.GOOD + k], self.session)
            if rng.random() < 0.8:
                spoil(rng, sample, self.session)
            self.given.append({f: getattr(sample, f) for f in ArmSample.__slots__})
            self.given[-1] = {f: _plain(v) for f, v in self.given[-1].items()}
            refused += self.bad(rng, key, sample)
        healed = self.live(key, range(self.HEALING))
        for k, (got, wanted) in enumerate(zip(healed, self.wanted[key], strict=True)):
            demand(
                np.array_equal(got, wanted, equal_nan=True),
                f"a new session is not healthy at sample {k}: {got}, not {wanted}",
            )
        return refused


def _plain(value):
    return value.tolist() if hasattr(value, "tolist") else value


class Observers(_Path):
    """`ArmObserver.step` of every observer: an estimate, or a refusal that leaves it as it was."""

    name, weight, error = "observer", 4.0, MessageError
    words = ("joint_", "modal_", "strain", "state", "observer", "covariance", "source")

    def __init__(self):
        super().__init__()
        names = registry.names(arm_observer.OBSERVERS)
        self.loops = {arm: healthy(arm, law, 40) for arm, law, _ in LOOPS[:2]}
        self.keys = [
            (arm, name, delay) for arm in self.loops for name in names for delay in (0.0, 0.004)
        ]

    def data(self, key):
        return self.loops[key[0]][1]

    def build(self, key):
        arm, name, delay = key
        return observe(self.loops[arm][0], name, {"delay": delay})

    def outputs(self, key):
        core = self.built[key]
        return np.concatenate([core.position, core.velocity, core.amplitude, core.rate])

    def good(self, key, k):
        converged = self.built[key].step(sample_of(self.data(key)[k], self.session))
        return [float(converged), *self.outputs(key)]

    def bad(self, rng, key, sample):
        core, before = self.built[key], self.outputs(key)
        try:
            converged = core.step(sample)
        except MessageError as error:
            self.check_message(error)
            demand(
                np.array_equal(self.outputs(key), before), "a refused sample has moved the estimate"
            )
            return 1
        demand(
            not converged or np.isfinite(self.outputs(key)).all(),
            f"converged on {self.outputs(key)}",
        )
        return 0


class Controllers(_Path):
    """`ArmController.step`: every sample is answered, and no torque but a finite one within the limits."""

    name, weight = "controller", 4.0

    def __init__(self):
        super().__init__()
        self.loops = [healthy(arm, law, 40) for arm, law, _ in LOOPS]
        self.keys = list(range(len(LOOPS)))

    def data(self, key):
        return self.loops[key][2]

    def build(self, key):
        _, law, feedforward = LOOPS[key]
        arm_model = self.loops[key][0]
        slow, fast, manifold = law
        made = design(arm_model, slow, fast, manifold, {"feedforward": feedforward})
        limits = {"torque_limit": [2.0], "torque_rate_limit": [500.0]}
        limits["trajectory_torque_margin"] = 0.0  # allow motions at that limit and beyond it
        settings = check_all(PARAMETERS, limits, sizes(arm_model))
        core = ArmController(arm_model, made, settings)
        return core, CompositeStateWriter(arm_model)

    def good(self, key, k):
        core, _ = self.built[key]
        if k == 0:  # a source that restarts elsewhere is a fault
            core.fail("for a new session")
            core.recover()
        enabled = core.step(sample_of(self.data(key)[k], self.session))
        return [float(enabled), *core.torque]

    def bad(self, rng, key, sample):
        core, writer = self.built[key]
        if rng.random() < 0.1:
            _offer(rng, core)
        before = core.torque.copy()
        was, stamp, session = core.enabled, core._last_ns, core._order.session
        if rng.random() < 0.2:
            core.recover()
        enabled = core.step(sample)
        if enabled is None:  # an old sample: it was answered before
            demand(np.array_equal(core.torque, before), "an old sample has changed the torque")
            return 1
        demand(enabled == core.enabled, "two answers")
        if not enabled:
            demand(not core.torque.any(), "disabled with a torque")
            demand(core.reason, "disabled for no reason")
            demand(
                len(core.reason) <= self.MAX_LENGTH, f"a reason of {len(core.reason)} characters"
            )
            return 1
        demand(np.isfinite(core.torque).all(), f"a torque of {core.torque}")
        demand(
            (np.abs(core.torque) <= core.torque_limit).all(), f"{core.torque} is beyond the limit"
        )
        if was and core._last_ns > stamp and core._order.session == session:
            most = 500.0 * 1e-9 * (core._last_ns - stamp)
            step = np.abs(core.torque - before).max()
            demand(step <= most * (1.0 + 1e-9) + 1e-12, f"a step of {step}, beyond {most}")
        demand(np.isfinite(sample.position).all() and np.isfinite(sample.velocity).all(), "enabled")
        message = writer.fill(sample, core, 0.0)
        demand(np.isfinite(np.array(message.torque)).all(), "controller/state")
        return 0


def _offer(rng, core):
    """A motion from where the arm is."""
    n = core.model.n_joints
    end = [rng.uniform(-1.0, 1.0) for _ in range(n)]
    point = (10**9, end, [0.0] * n, [0.0] * n, [])
    made = trajectory.validate(core.model.joint_names, core.model.joint_names, 0, [point])
    plan = None
    if core.plans:
        try:
            plan = core.prepare(made)
        except FlexarmError:
            plan = None
    core.offer(made, plan)


class Designs(Reader):
    """`composite.design`: any law with any parameters in range is made, or refused with a reason."""

    name, weight = "design", 0.15

    def __init__(self):
        self.models = {arm: model.build(arm_file.load(arm)) for arm in ("R", "two_link", "rigid")}
        self.groups = {
            g: {n: registry.find(g, n) for n in registry.names(g)} for g in (SLOW, FAST, MANIFOLD)
        }

    def make(self, rng):
        arm = rng.choice(tuple(self.models))
        chosen = []
        for group in (SLOW, FAST, MANIFOLD):
            name = rng.choice(tuple(self.groups[group]))
            chosen.append(
                {"type": name, **self._values(rng, self.groups[group][name].PARAMETERS, arm)}
            )
        # A preview is planned at receipt of a trajectory; a design with it is one with the model.
        settings = {
            "feedforward": rng.choice(("none", "model")),
            "rate": rng.choice((1000.0, 500.0, 1.0, 20000.0)),
        }
        return arm, chosen, rng.choice((None, settings, settings))

    def _values(self, rng, group, arm):
        lengths, out = sizes(self.models[arm]), {}
        for parameter in rng.sample(group, min(len(group), rng.choice((0, 1, 2)))):
            if parameter.name == "grid":
                continue  # many designs: slow, and they run no other code
            value = Parameters.value(rng, parameter)
            if isinstance(value, list) and parameter.length and rng.random() < 0.8:
                value = value[:1] or [1.0]
            try:
                check_all([parameter], {parameter.name: value}, lengths)
            except FlexarmError:
                if rng.random() < 0.9:
                    continue
            out[parameter.name] = value
        return out

    def read(self, given):
        arm, (slow, fast, manifold), settings = given
        return design(self.models[arm], slow, fast, manifold, settings)

    def check(self, given, result):
        arm = self.models[given[0]]
        n, m = arm.n_joints, arm.n_modes
        limits = check_all(PARAMETERS, {"torque_limit": [1.0]}, sizes(arm))
        core = ArmController(arm, result, limits)
        for k in range(4):
            sample = ArmSample(n, m)
            sample.stamp_ns, sample.sequence, sample.session = 10**9 + k * 10**6, k, 1
            sample.position[:], sample.velocity[:] = 0.1 * k, 0.1
            sample.amplitude, sample.rate = np.full(m, 1e-3), np.full(m, 1e-2)
            enabled = core.step(sample)
            demand("failed" not in core.reason, core.reason)
            demand(np.isfinite(core.torque).all(), f"a torque of {core.torque}")
            demand(enabled or not core.torque.any(), "disabled with a torque")
