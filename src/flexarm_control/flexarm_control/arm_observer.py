"""Observer of an arm: strains to amplitudes, order of samples, and the chosen observer."""

import numpy as np

from flexarm_dynamics import registry
from flexarm_dynamics.errors import MessageError, ModelError
from flexarm_dynamics.parameters import Parameter, check_all
from flexarm_dynamics.strain_map import StrainMap

from .composite import sizes
from .samples import SampleOrder

OBSERVERS = "flexarm.observers"

#: Parameters of the observer that belong to no single law.
PARAMETERS = (
    Parameter(
        "joint_velocity_bandwidth",
        "float",
        500.0,
        "Corner of the filtered derivative of the joint positions, for a source without joint velocities.",
        unit="rad/s",
        low=1.0,
        high=1e6,
    ),
)


def design_observer(name, model, values):
    """Find an observer by name, check its parameters and design it.

    Raises
    ------
    UnknownComponentError, ParameterError, DesignError
    """
    law = registry.find(OBSERVERS, name)
    return law(model, check_all(law.PARAMETERS, values, sizes(model), "observer."))


class ArmObserver:
    """Turns a sample of the arm into one with modal amplitudes and rates filled in.

    Parameters
    ----------
    model : ArmModel
        The arm as the arm file has it.
    observer : Observer
    joint_velocity_bandwidth : float
        [rad/s]

    Attributes
    ----------
    observer : Observer
        May be replaced whole between two samples.
    estimate : ArmSample fields
        `velocity` (n,), and the observer's `amplitude` and `rate`.
    """

    def __init__(self, model, observer, joint_velocity_bandwidth=500.0):
        self.model, self.observer = model, observer
        self.strain_map = StrainMap(model) if model.arm.gauges else None
        observed = model.arm.observed_modes
        if tuple(observed) != tuple(model.mode_names):
            missing = [n for n in model.mode_names if n not in observed]
            raise ModelError(
                f"{model.arm.name}: {', '.join(missing)} in links[].flexible but not in observed_modes: the"
                " controller's arm has just the modes that it observes; lower `modes`"
            )
        self.bandwidth = joint_velocity_bandwidth
        self.velocity = np.zeros(model.n_joints)
        self._position = np.zeros(model.n_joints)
        self._mapped = np.zeros(model.n_modes)
        self._order = SampleOrder()
        self.reason = ""

    def step(self, sample):
        """Take one sample; the control path.

        Parameters
        ----------
        sample : ArmSample
            Its `amplitude` is filled in from the strains when it is None.

        Returns
        -------
        bool
            Whether `velocity`, `observer.amplitude` and `observer.rate` are a converged estimate. A repeated
            (session, sequence) leaves everything as it was.

        Raises
        ------
        MessageError
            When the sample can't be used; the estimate stays as it was.
        """
        last_stamp = self._order.stamp_ns
        self._check(sample)
        verdict = self._order.judge(sample)
        if verdict == SampleOrder.REPEAT:
            return self.observer.converged
        if verdict == SampleOrder.STALE:
            raise MessageError(
                f"state {sample.sequence} of {sample.stamp_ns * 1e-9:.6f} s is not newer than"
                f" {self._order.sequence} of {last_stamp * 1e-9:.6f} s: left out"
            )
        restart = verdict == SampleOrder.RESTART
        if restart:
            self.observer.reset()
        dt = 0.0 if restart else 1e-9 * (sample.stamp_ns - last_stamp)
        if sample.amplitude is None:
            sample.amplitude = self.strain_map.amplitudes(sample.strain, out=self._mapped)
        if not sample.velocity_known:
            sample.velocity[:] = self._joint_velocity(sample, dt)
        self._update(sample, dt)
        # Only now: a sample that the observer refused has left nothing behind, its time step included.
        self._order.take(sample)
        self.velocity[:] = sample.velocity
        self._position[:] = sample.position
        return self.observer.converged

    def _update(self, sample, dt):
        try:
            self.observer.update(sample, dt)
        except MessageError:
            raise
        except Exception as error:  # anybody's observer: it costs this sample, not the node
            name = type(self.observer).__name__
            raise MessageError(
                f"observer {name} failed: {type(error).__name__}: {error}"
            ) from error

    def _check(self, sample):
        arm = self.model.arm
        check_finite(sample.position, arm.joint_names, "joint_position")
        if sample.velocity_known:
            check_finite(sample.velocity, arm.joint_names, "joint_velocity")
        if sample.amplitude is not None:
            check_finite(sample.amplitude, arm.mode_names, "modal_amplitude")
        elif sample.strain is None:
            raise MessageError("neither strain nor modal_amplitude is given: one of them is needed")
        else:
            if self.strain_map is None:
                raise MessageError(
                    f"strain is given, but the arm file of {arm.name} has no gauges to map it"
                )
            check_finite(sample.strain, arm.gauge_names, "strain", LARGEST_STRAIN)
        if sample.rate is not None:
            check_finite(sample.rate, arm.mode_names, "modal_rate")

    def _joint_velocity(self, sample, dt):
        """Filtered derivative of the joint positions, shape (n,) [rad/s]; zero at a start."""
        if dt == 0.0:
            return np.zeros_like(self.velocity)
        slope = (sample.position - self._position) / dt
        return slope + (self.velocity - slope) * np.exp(-self.bandwidth * dt)


#: No arm strains by a tenth: such a number is in microstrain, or a broken bridge's [-].
LARGEST_STRAIN = 0.1
#: Values beyond this are no measurement of an arm (rad, m, strain, and their rates).
HUGE = 1e6


def check_finite(values, names, field, largest=HUGE):
    """Raise, naming the first bad entry, unless all values are finite and of a sane size."""
    if not np.abs(values).max(initial=0.0) < largest:  # false for NaN too
        i = int(np.argmin(np.abs(values) < largest))
        raise MessageError(f"{field} of {names[i]} is {values[i]}: not a usable measurement")
