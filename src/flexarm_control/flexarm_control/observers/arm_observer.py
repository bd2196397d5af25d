# SPDX-License-Identifier: Apache-2.0
"""Observer of an arm: maps strains to amplitudes, orders the samples, calls the chosen observer."""

import numpy as np

from flexarm_dynamics.arm.strain_map import StrainMap
from flexarm_dynamics.errors import MessageError, ModelError
from flexarm_dynamics.parameters import check_all, parameter

from .. import kernels
from ..component import make
from ..loop.samples import WRAP, ArmSample, SampleOrder, clock_jumped
from . import gauge_health
from .base import need_torque
from .motion import Motion
from .plausibility import monitor

OBSERVERS = "flexarm.observers"

#: Parameters that all observers share.
PARAMETERS = (
    parameter("joint_velocity_bandwidth", 500.0, "rad/s", 1.0, 1e6).described(
        "Corner of the filtered derivative of the joint positions, for a source without joint velocities."
    ),
    parameter("measured_velocity", True).described(
        "Use the joint velocities that the source sends; false: as if it sent none. They are checked in both cases."
    ),
    parameter("delay", 0.0, "s", 0.0, 0.1).described(
        "Time from a sample's stamp until its torque acts; the estimate is predicted ahead by this time."
    ),
    parameter("smooth_position", True).described(
        "Use the observer's joint positions, if it estimates them, instead of the encoders'."
    ),
    *gauge_health.PARAMETERS,
    *monitor.PARAMETERS,
)


def design_observer(name, model, values):
    """Make the observer with this `name`, see `component.make`."""
    return make(OBSERVERS, name, model, values, "observer.")


def observe(model, name, values):
    """The `ArmObserver` for an observer's `name` and parameters, which include those of `PARAMETERS`.

    Raises
    ------
    UnknownComponentError, ParameterError, DesignError, ModelError
    """
    common = {p.name for p in PARAMETERS}
    settings = {k: v for k, v in values.items() if k in common}
    law = design_observer(name, model, {k: v for k, v in values.items() if k not in common})
    return ArmObserver(model, law, check_all(PARAMETERS, settings, prefix="observer."))


class ArmObserver:
    r"""Estimates modal amplitudes and rates, sample by sample.

    If the source does not report joint velocities, or the settings say not to use them, the observer's estimate takes
    their place. If the observer makes none, the filtered derivative of the positions does.

    With a `delay`, the estimate is the state at the stamp plus the delay. It is predicted by `motion`, under the
    reported torque, which is held constant. Torques sent since then are unknown here.

    Parameters
    ----------
    model : ArmModel
        Model of the arm file's arm.
    observer : Observer
    settings : mapping
        Checked values of `PARAMETERS`.

    Attributes
    ----------
    observer : Observer
    settings : mapping
        Both may be replaced between two samples.
    gauges : GaugeHealth or None
        Health of each gauge; None for an arm without gauges.
    calibration : BiasCalibration or None
        The last samples, for `calibrate`.
    monitor : Monitor
        Judges whether the readings can be true together, if the settings ask for it.
    calibrated : bool
        Whether the strains are mapped with a bias from `calibrate`. Amplitudes from the source are then ignored,
        since they are computed with the arm file's bias.
    position, velocity : ndarray, shape (n,)
        Joint positions and velocities, measured or estimated, predicted ahead by the delay [rad], [rad/s].
    amplitude, rate : ndarray, shape (m,)
        The observer's estimate, predicted ahead by the delay.
    """

    def __init__(self, model, observer, settings):
        self.model, self.observer, self.settings = model, observer, settings
        self.strain_map = self.gauges = self.calibration = None
        if model.arm.gauges:
            self.strain_map = map_ = StrainMap(model)
            self.gauges = gauge_health.GaugeHealth(model, map_, settings["stuck_samples"])
            samples = settings["calibration_samples"]
            self.calibration = gauge_health.BiasCalibration(model, map_, samples)
        self.calibrated = False
        observed = model.arm.observed_modes
        if tuple(observed) != tuple(model.mode_names):
            missing = [n for n in model.mode_names if n not in observed]
            raise ModelError(
                f"of {model.arm.name} lacks {', '.join(missing)}: a controller's arm has only modes that it observes",
                field="observed_modes",
                hint="lower `modes` in links[].flexible",
            )
        self.monitor = monitor.Monitor(
            model, self.strain_map, self.gauges, settings["payload_tolerance"]
        )
        n, m = model.n_joints, model.n_modes
        self._state, self._kernels = np.zeros(2 * (n + m)), kernels.compiled()
        self.position, self.amplitude, self.velocity, self.rate = np.split(
            self._state, (n, n + m, 2 * n + m)
        )
        self._measured, self._derivative = np.zeros(n), np.zeros(n)
        self._derived, self._sent = np.zeros(n), np.zeros(n)
        self._mapped, self._nothing = np.zeros(m), np.zeros(0)
        self._motion = Motion(model)
        self._order = SampleOrder()
        self._taken = None  # a sample that the monitor is to remember

    def step(self, sample, later=False):
        """Take one sample, on the control path.

        Parameters
        ----------
        sample : ArmSample
            Its `amplitude` is filled in from the strains if it is None. Readings that can't be true are replaced, and
            `trust` and `doubt` are set: see `plausibility.monitor`. Errors that only show over several samples are
            reported with the next one.
        later : bool
            Leave the search for those errors to `look_ahead`. Call it before the next sample, with this one unchanged.

        Returns
        -------
        bool or None
            Whether `velocity`, `amplitude` and `rate` are a converged estimate. A repeated (session, sequence)
            changes nothing; nor does a sample that is older than the last one, for which the result is None.

        Raises
        ------
        MessageError
            If the sample can't be used; the estimate is unchanged.
        """
        last_stamp = self._order.stamp_ns
        if sample.amplitude is None and not self.model.n_modes:
            sample.amplitude = self._nothing  # read as unknown, but there are none
        self._check(sample)
        verdict = self._order.judge(sample)
        if verdict == SampleOrder.REPEAT:
            if self._judges:
                self.monitor.mark(sample)
            return self.observer.converged
        if verdict == SampleOrder.STALE:
            return None
        if verdict == SampleOrder.FOREIGN:
            raise self._order.two_sources(sample)
        # After a jump of the clock or a long silence the past is useless.
        gap = sample.stamp_ns - last_stamp > MAX_GAP_NS
        restart = gap or verdict in (SampleOrder.RESTART, SampleOrder.JUMP)
        dt = 0.0 if restart else self._step_of(sample)
        judges = self._judges
        if judges and self._judge(sample, dt):
            restart, dt = True, 0.0
        self._map_strain(sample, restart)
        if restart:
            self.observer.reset()
        if self.settings["delay"] and not restart:
            need_torque(sample.torque, "observer.delay", "set observer.delay to 0.0")
        if sample.velocity_known and self.settings["measured_velocity"]:
            self._estimate(sample, dt, sample.velocity_known)
            self._derivative[:] = sample.velocity
        else:
            if sample.velocity_known:
                self._sent[:] = sample.velocity
            sample.velocity[:] = self._derived[:] = self._joint_velocity(sample, dt)
            try:
                self._estimate(sample, dt, False)
            finally:
                if sample.velocity_known:
                    sample.velocity[:] = self._sent
            self._derivative[:] = self._derived
        # This comes last, so that a refused sample changes nothing, not even the time step.
        if judges:
            self.monitor.mark(sample)
            self._taken = sample
        if not later:
            self._take()
        self._order.take(sample)
        self._measured[:] = sample.position
        if sample.strain is not None and self.calibration is not None:
            self.calibration.push(sample)
        return self.observer.converged

    def look_ahead(self):
        """Do what `step` left, and compute ahead for the next sample; call once the estimate is sent."""
        self._take()
        self.observer.look_ahead()

    def _take(self):
        """Let the monitor remember the last sample, if it judged it."""
        sample, self._taken = self._taken, None
        if sample is not None:
            self.monitor.take(sample)

    @property
    def _judges(self):
        return self.settings["plausibility"]

    def _judge(self, sample, dt):
        """Let the monitor judge the readings of a new sample; returns whether the observer has to start again."""
        order = self._order
        if self.monitor.stamp_ns != order.stamp_ns:  # the monitor was off until now
            dt = 0.0
        return self.monitor.judge(sample, dt, (sample.sequence - order.sequence) % WRAP)

    def _step_of(self, sample):
        """Time since the last sample [s], by the stamps, or by the numbers if the source's clock has jumped.

        After a jump the estimate goes on as if no time had been lost. After a pause of the source it is predicted over
        the pause, although the torque in it is unknown.
        """
        order = self._order
        dt = 1e-9 * (sample.stamp_ns - order.stamp_ns)
        expected = self.monitor.jumps.period * ((sample.sequence - order.sequence) % WRAP)
        if not (self._judges and 0.0 < JUMP_PERIODS * expected < dt):
            return dt
        moved = sample.position - self._measured
        return expected if clock_jumped(moved, self._derivative, expected, dt) else dt

    def warm_up(self):
        """Take samples so that all compiled code is loaded; discard the observer afterwards.

        The first three are of an arm at rest, the others of one that swings a little, until the strains are compared
        with the motion.
        """
        arm = self.model.arm
        sample = ArmSample(len(arm.joints), self.model.n_modes, len(arm.gauges))
        sample.velocity_known, sample.rate = False, np.zeros(self.model.n_modes)
        sample.torque[:] = 0.0
        for k in range(WARM_UP):
            sample.stamp_ns, sample.sequence = WARM_UP_NS * (k + 1), k
            if k >= 3:
                for values in (sample.position, sample.velocity, sample.strain, sample.amplitude):
                    if values is not None:
                        values[:] = 1e-6 * np.sin(k + np.arange(values.size))
            sample.trust, sample.doubt = ArmSample.TRUSTED, ""
            self.step(sample)

    def _map_strain(self, sample, restart):
        """Judge the gauges, and fill in the amplitudes unless the source's are used."""
        if sample.strain is None or self.gauges is None:
            return
        if restart:
            self.gauges.reset()
            self.calibration.reset()
        self.gauges.update(sample.strain)
        if sample.amplitude is None or self.calibrated:
            sample.amplitude = self.gauges.amplitudes(sample.strain, out=self._mapped)
            if self.gauges.lost != self.observer.gauges_lost:
                self.observer.leave_out(self.gauges.lost)
            if self._judges:
                self.monitor.correct(
                    sample.amplitude, self.strain_map.inverse_without(self.gauges.lost)
                )

    def calibrate(self):
        """Set the gauges' bias from the last samples, which must be of an arm at rest; not on the control path.

        The estimate changes with the bias, so that its rates don't jump.

        Returns
        -------
        old, new : ndarray, shape (gauges,)
            The bias before and now [strain].

        Raises
        ------
        MessageError, ModelError
            If there is nothing to calibrate, or the arm is not at rest; then nothing changes.
        """
        if self.calibration is None:
            raise MessageError(f"the arm file of {self.model.arm.name} has none", field="gauges")
        old, new = self.strain_map.bias, self.calibration.bias()
        self.strain_map.bias = new
        self.calibrated = True
        self.monitor.calibrated()
        self.observer.rest_at(self.strain_map.amplitudes(self.calibration.last))
        return old, new

    def _estimate(self, sample, dt, measured):
        """Update the observer and set the output; `measured`: whether the joint velocities are measured."""
        self._update(sample, dt)
        self._pass_on(sample, measured)

    def _pass_on(self, sample, measured):
        """Set the output: the observer's estimate or the sample's values, predicted ahead by the delay."""
        observer = self.observer
        smooth = self.settings["smooth_position"] and observer.joint_position is not None
        estimated = not measured and observer.joint_velocity is not None
        position = observer.joint_position if smooth else sample.position
        velocity = observer.joint_velocity if estimated else sample.velocity
        amplitude, rate = observer.amplitude, observer.rate
        if self.settings["delay"] and observer.converged:
            x = np.concatenate([position, amplitude, velocity, rate])
            x = self._predicted(x, sample.torque, self.settings["delay"])
            n, p = position.size, x.size // 2
            position, amplitude, velocity, rate = np.split(x, (n, p, p + n))
        if not self._kernels.join(position, amplitude, velocity, rate, self._state):
            # Without a reset the estimate would never be finite again.
            observer.reset()
            name = type(observer).__name__
            problem = "has lost the arm: its estimate is not finite"
            raise MessageError(problem, field=f"observer {name}")

    def _predicted(self, x, torque, delay):
        """The state after the delay."""
        count = int(np.ceil(delay / MAX_PREDICTION))
        part = delay / count
        for _ in range(count):
            x = self._motion.advance(x, torque, part, self._motion.step_for(part, x[: torque.size]))
        return x

    def _update(self, sample, dt):
        try:
            self.observer.update(sample, dt)
        except MessageError as error:
            # The monitor may have taken out the reading that the observer needs.
            doubt = self.monitor.doubts.text if self._judges else ""
            if doubt:
                raise MessageError(f"{doubt}; {error}") from error
            raise
        except Exception as error:  # an error of third-party code costs this sample, not the node
            raise MessageError(
                f"failed: {type(error).__name__}: {error}",
                field=f"observer {type(self.observer).__name__}",
            ) from error

    def _check(self, sample):
        sample.check(self.model)
        if sample.amplitude is None and sample.strain is None:
            problem = "neither strain nor modal_amplitude is given"
            raise MessageError(problem, hint="give one of them")
        if sample.amplitude is None and self.strain_map is None:
            problem = f"can't be mapped: the arm file of {self.model.arm.name} has no gauges"
            raise MessageError(problem, field="strain")
        if self._kernels.is_beyond(sample.torque, MAX_TORQUE):  # NaN means unknown, and passes
            i = int(np.argmax(np.abs(sample.torque) >= MAX_TORQUE))
            raise MessageError(
                "is beyond any arm's torque",
                field=f"joint_torque of {self.model.joint_names[i]}",
                value=float(sample.torque[i]),
                limit=MAX_TORQUE,
            )

    def _joint_velocity(self, sample, dt):
        """Filtered derivative of the joint positions, shape (n,) [rad/s]; zero at a start."""
        if dt == 0.0:
            return np.zeros_like(self._derivative)
        difference = (sample.position - self._measured) / dt
        bandwidth = self.settings["joint_velocity_bandwidth"]
        return difference + (self._derivative - difference) * np.exp(-bandwidth * dt)


#: Samples of a warm-up, and the time between them [ns]; together they exceed a strain filter's settling time.
WARM_UP, WARM_UP_NS = 250, 4_000_000
#: If the step by the stamps is more than this many times as long as by the numbers, the clock may have jumped [-].
JUMP_PERIODS = 20.0
#: After a longer silence an observer starts again [ns].
MAX_GAP_NS = 500_000_000
#: A longer delay is predicted in parts, each with the forces at its start [s].
MAX_PREDICTION = 0.01
#: A larger torque can't be that of an arm [N m].
MAX_TORQUE = 1e9
