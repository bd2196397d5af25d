"""The loop without ROS: the very objects that the nodes call, sample by sample; and the continuous loop."""

import numpy as np

from flexarm_control.arm_controller import PARAMETERS as CONTROLLER_PARAMETERS
from flexarm_control.arm_controller import ArmController
from flexarm_control.arm_observer import ArmObserver, design_observer
from flexarm_control.composite import design, typed
from flexarm_control.samples import ArmSample
from flexarm_dynamics import arm_file
from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.parameters import check_all
from flexarm_sim.integrators import integrate
from flexarm_sim.simulator import PARAMETERS as SIMULATOR_PARAMETERS
from flexarm_sim.simulator import Simulator

from .metrics import Record

#: Where a recorded trajectory starts on the simulator's clock [ns]: the observer has converged by then.
TRAJECTORY_START_NS = Simulator.START_NS + 100_000_000


class ClosedLoop:
    """Simulator, observer and controller in one process, in lockstep.

    Parameters
    ----------
    arm : str
        Arm file of all three: shipped name or path.
    slow, fast, observer : mapping
        ``{"type": …, parameters…}``.
    simulator, controller : mapping, optional
        Further parameters of the simulator and of the controller.
    """

    def __init__(self, arm, slow, fast, observer, simulator=None, controller=None):
        sizes = {"joints": len(arm_file.load(arm).joints)}
        settings = check_all(SIMULATOR_PARAMETERS, {"arm": str(arm), **(simulator or {})}, sizes)
        self.simulator = Simulator(settings)
        model = self.model = self.simulator.nominal
        name, values = typed(observer, "observer")
        self.observer = ArmObserver(model, design_observer(name, model, values))
        limits = check_all(CONTROLLER_PARAMETERS, controller or {}, {"joints": model.n_joints})
        self.controller = ArmController(model, design(model, slow, fast), limits)
        n, m, g = model.n_joints, model.n_modes, len(model.arm.gauges)
        self._measured, self._estimate = ArmSample(n, m, g), ArmSample(n, m)
        self._publish_rates = settings["publish_rates"]
        self._publish_velocity = settings["publish_joint_velocity"]

    def measure(self):
        """The present sample as `arm_state` has it."""
        s, sim = self._measured, self.simulator
        s.stamp_ns, s.session, s.sequence = sim.stamp_ns, 1, sim.sequence
        s.position[:] = sim.position
        s.velocity_known = self._publish_velocity
        s.velocity[:] = sim.velocity
        s.torque[:] = sim.torque
        has_gauges = sim.strain_map is not None
        s.strain = sim.strain if has_gauges else None
        s.amplitude = sim.amplitude if has_gauges else None
        s.rate = sim.rate if self._publish_rates else None
        return s

    def estimate(self, measured):
        """The sample as `arm_state_estimate` has it; rates are None until the observer has converged."""
        e, observer = self._estimate, self.observer
        converged = observer.step(measured)
        e.stamp_ns, e.session, e.sequence = measured.stamp_ns, measured.session, measured.sequence
        e.position[:] = measured.position
        e.velocity[:] = observer.velocity
        e.amplitude = observer.observer.amplitude
        e.rate = observer.observer.rate if converged else None
        return e

    #: The observer has this long to converge [s].
    LONGEST_START = 10.0

    def step(self):
        """One sample: measure, estimate, control, and advance the plant; returns the torque sent or None."""
        torque = self.controller.torque if self._answer() else None
        self.simulator.advance(torque)
        return torque

    def _answer(self):
        """Measure, estimate, control: whether torque is enabled; a sample that was answered is answered alike."""
        try:
            return self.controller.step(self.estimate(self.measure()))
        except MessageError as error:
            self.controller.disable(str(error))
            return False

    def run(self, trajectory, duration):
        """Offer a trajectory and record `duration` seconds from its start.

        Parameters
        ----------
        trajectory : JointTrajectoryData
            With its stamp on the simulator's clock.
        duration : float
            [s]

        Returns
        -------
        Record
        """
        self._answer()
        verdict = self.controller.offer(trajectory)
        if not verdict.accepted:
            raise MessageError(f"trajectory refused: {verdict.reason}")
        simulator, length = self.simulator, round(duration * 1e9)
        start, stamps, rows = trajectory.stamp_ns or None, [], []
        while start is None or simulator.stamp_ns <= start + length:
            if start is None and simulator.time > self.LONGEST_START:
                raise MessageError(f"the trajectory does not start: {self.controller.reason}")
            stamps.append(simulator.stamp_ns)
            self.step()
            rows.append(self._row())
            if start is None and self.controller.reference.active:
                start = stamps[-1]  # "now": with the first torque
        if not (self.controller.reference.active or self.controller.reference.finished):
            raise MessageError(f"the trajectory was not followed: {self.controller.reason}")
        time = 1e-9 * (np.array(stamps) - start)
        return split_record(np.column_stack([time, rows]), self.model.n_joints, self.model.n_modes)

    def _row(self):
        """What a `Record` holds of the sample that was just answered, time aside."""
        controller, law = self.controller, self.controller.law
        estimate = self._estimate
        rate = np.full(self.model.n_modes, np.nan) if estimate.rate is None else estimate.rate
        return np.concatenate(
            [
                controller.reference.position,
                controller.reference.velocity,
                self._measured.position,
                estimate.velocity,
                estimate.amplitude,
                rate,
                law.quasi_steady,
                law.slow_torque,
                law.fast_torque,
                controller.torque,
            ]
        )


def split_record(rows, n, m):
    """A `Record` from rows of time and all its vectors in order."""
    widths = [1, n, n, n, n, m, m, m, n, n, n]
    parts = np.split(rows, np.cumsum(widths)[:-1], axis=1)
    return Record(parts[0][:, 0], *parts[1:])


class _ProfileReference:
    """A one-joint motion profile as the reference of a slow law."""

    def __init__(self, profile):
        self._profile = profile

    def at(self, t):
        """Set position, velocity and acceleration to those of time t; held after the end."""
        p = self._profile
        t = self._t = min(max(t, 0.0), p.duration)
        self.position = np.atleast_1d(p.position(t))
        self.velocity = np.atleast_1d(p.velocity(t))
        self.acceleration = np.atleast_1d(p.acceleration(t))
        return self

    def near(self, offset):
        """State (3, n) at an offset [s] from the time of `at`."""
        p, t = self._profile, self._t + offset
        return np.array([p.position(t), p.velocity(t), p.acceleration(t)]).reshape(3, -1)


def continuous_loop(model, law, profile, times):
    """The composite loop in continuous time, full state, error-controlled: what the paper simulates.

    Parameters
    ----------
    model : ArmModel
        Plant and controller's model alike.
    law : CompositeControl
    profile : object
        Motion profile with `duration`, `position`, `velocity`, `acceleration`.
    times : ndarray, shape (k,)
        Where samples are wanted, from 0 [s].

    Returns
    -------
    Record
    """
    n, m = model.n_joints, model.n_modes
    reference = _ProfileReference(profile)

    def torque(t, state):
        q, delta, qd, delta_d = np.split(state, [n, n + m, 2 * n + m])
        return law.step(q, qd, delta, delta_d, reference.at(t))

    # The profile's jerk jumps at its end: integrate the two smooth pieces apart.
    end = profile.duration
    moving = np.union1d(times[times < end], end)
    resting = np.union1d(times[times > end], end)
    # Seven digits of every metric, at half the time of the default.
    tolerance = {"rtol": 1e-8, "atol": 1e-10}
    states = integrate(model, np.zeros(2 * (n + m)), torque, moving, **tolerance)
    rest = integrate(model, states[-1], torque, resting, **tolerance)
    states = np.vstack([states, rest[1:]])
    states = states[np.searchsorted(np.union1d(moving, resting), times)]
    rows = []
    for t, s in zip(times, states, strict=True):
        u = torque(t, s)
        q, delta, qd, delta_d = np.split(s, [n, n + m, 2 * n + m])
        ref = [reference.position, reference.velocity]
        control = [law.quasi_steady, law.slow_torque, law.fast_torque, u]
        rows.append(np.concatenate([[t], *ref, q, qd, delta, delta_d, *control]))
    return split_record(np.array(rows), n, m)
