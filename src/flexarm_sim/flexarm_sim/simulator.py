# SPDX-License-Identifier: Apache-2.0
"""Simulates the arm with its sensors, sample by sample: the mathematics of the simulator node."""

from dataclasses import replace

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Arm
from flexarm_dynamics.arm.encoders import encoder_rows, motors_at_rest
from flexarm_dynamics.arm.strain_map import StrainMap
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.models import levels, model
from flexarm_dynamics.parameters import parameter

from . import integrators
from .plant import Plant
from .sensors import Sensors

#: How often the range of the simulated arm's level is checked [s].
CHECK_PERIOD = 0.01

PARAMETERS = (
    parameter("arm", "", read_only=True).described(
        "Arm file: a shipped name, such as R or two_link, or a path. Names and the strain map come from it."
    ),
    parameter("plant_arm", "", read_only=True).described(
        "Arm file of the simulated arm itself, when it differs from `arm`; empty: the same."
    ),
    parameter("plant_modes", 0, "-", 0, 20, read_only=True).described(
        "Modes per flexible direction of the simulated arm; 0: as in its file."
    ),
    parameter("level", levels.AUTO, choices=levels.LEVELS, read_only=True).described(
        "Kinematics of bending of the simulated arm: first_order; stiffening (links keep their length); finite_slope"
        " (curvature and tips' angles are exact as well); auto: what its loads need (docs/dynamics.md)."
    ),
    parameter("rate", 1000.0, "Hz", 1.0, 20000.0, read_only=True).described(
        "Control rate: samples per second of simulated time."
    ),
    parameter("integrator", "dop853", choices=tuple(integrators.METHODS), read_only=True).described(
        "Fixed-step method. dop853 and rk4 take substeps short enough for the highest mode, and up to 16 times as many"
        " for the friction of light joints. implicit damps modes that are too fast for the period, in one step; this"
        " step may be too long for a bent arm or a light hub (docs/dynamics.md)."
    ),
    parameter("initial_position", [0.0], "rad", -100.0, 100.0, length="joints").described(
        "Joint angles after a start or reset."
    ),
    parameter("noise", False, read_only=True).described(
        "Whether gauges have the noise and drift of the arm file."
    ),
    parameter("seed", 0, "-", 0, 2**31 - 1, read_only=True).described("Seed of the noise."),
    parameter("publish_rates", False, read_only=True).described(
        "Publish the true rates of the observed modes in modal_rate: for tests; no real arm has them."
    ),
    parameter("publish_joint_velocity", True, read_only=True).described(
        "Publish joint velocities; false: like a driver that has only encoders."
    ),
    parameter("publish_modal_amplitude", True, read_only=True).described(
        "Publish the modal amplitudes that the simulator maps from the strains; false: the observer maps them."
    ),
)


class Simulator:
    """A plant, its sensors, and time counted in samples.

    Parameters
    ----------
    settings : mapping
        Checked values of `PARAMETERS`; `arm` and `plant_arm` may each be an `Arm` instead of a name.

    Attributes
    ----------
    sequence : int
        Number of the present sample.
    range : levels.Range
        Its `warning` states when the simulated arm has left the range of its level.
    friction_warning : str
        States that friction may make a light joint of the simulated arm hunt; empty where it does not.
    stamp_ns : int
        Time of the present sample [ns]: `START_NS` plus sequence times the period.
    position, velocity, torque, strain, amplitude, rate : ndarray
        The present sample: joint position (n,) [rad], velocity (n,) [rad/s], of motors or links as the encoders
        measure them, torque applied until now (n,) [N m], strain (gauges,), modal amplitudes derived from the strains,
        and true rates of the observed modes (m,).
    """

    #: Simulated time starts here, not at 0: a stamp of 0 means "now" in a trajectory.
    START_NS = 1_000_000_000

    def __init__(self, settings):
        self.settings = dict(settings)
        arm = _arm(settings["arm"])
        self.arm = arm
        self.nominal = model.build(arm.known)
        plant_arm = (_arm(settings["plant_arm"]) if settings["plant_arm"] else arm).whole
        if settings["plant_modes"]:
            plant_arm = plant_arm.with_modes(settings["plant_modes"])
        self._same_names(plant_arm)
        # The gauges are in the order of the controller's arm file.
        gauges = {g.name: g for g in plant_arm.gauges}
        plant_arm = replace(plant_arm, gauges=tuple(gauges[name] for name in arm.gauge_names))
        self.plant_model = model.build(levels.simulated(plant_arm, settings["level"]))
        self.range = levels.Range(self.plant_model)
        self.period_ns = round(1e9 / settings["rate"])
        self._samples_per_check = max(1, round(CHECK_PERIOD * settings["rate"]))
        self.plant = Plant(self.plant_model, 1e-9 * self.period_ns, settings["integrator"])
        self.friction_warning = integrators.friction_warning(
            self.plant_model, self.plant.period, settings["integrator"]
        )
        self.sensors = Sensors(
            self.plant_model, settings["noise"], settings["seed"], 1e-9 * self.period_ns
        )
        self.strain_map = StrainMap(self.nominal) if arm.gauges else None
        n, m = len(arm.joints), len(arm.observed_modes)
        self.position, self.velocity = np.zeros(n), np.zeros(n)
        self.torque, self.strain = np.zeros(n), np.zeros(len(arm.gauges))
        self.amplitude, self.rate = np.zeros(m), np.zeros(m)
        slack = encoder_rows(self.plant_model)[:, n:]
        self._slack = slack if slack.any() else None
        self._observed = [self.plant_model.mode_names.index(name) for name in arm.observed_modes]
        self.reset()

    def _same_names(self, plant_arm):
        for what in ("joint_names", "gauge_names"):
            mine, its = getattr(self.arm, what), getattr(plant_arm, what)
            if set(mine) != set(its) or (what == "joint_names" and mine != its):
                raise ModelError(
                    f"are not the {what} of arm {self.arm.name}",
                    field=f"plant_arm {plant_arm.name}",
                    value=list(its),
                    limit=list(mine),
                )
        missing = set(self.arm.observed_modes) - set(plant_arm.mode_names)
        if missing:
            raise ModelError(
                f"lacks the modes {', '.join(sorted(missing))} that arm {self.arm.name} observes",
                field=f"plant_arm {plant_arm.name}",
                hint="raise plant_modes",
            )

    @property
    def time(self):
        """Time since the start of the session [s]."""
        return 1e-9 * (self.stamp_ns - self.START_NS)

    def reset(self, position=None):
        """Put the arm at rest at `position` [rad], by default the initial one; sequence and time start again.

        The `position` is what the encoders read.
        """
        position = self.settings["initial_position"] if position is None else position
        if self._slack is None:
            self.plant.reset(position)
        else:
            self.plant.reset(*motors_at_rest(self.plant_model, position))
        self.sensors.reset()
        self.range.reset()
        self.sequence, self.stamp_ns = 0, self.START_NS
        self.torque[:] = 0.0
        self._measure()

    def advance(self, torque, before=None, delay=0.0):
        """Advance by one period under `torque` (n,) [N m]; None: under the safe actions.

        When the torque comes late, `before` acts during the first part of the period, of which `delay` is the
        fraction [-]. The torque of the next sample is the mean over the period.
        """
        if delay > 0.0:
            self.advance_in_parts([(before, delay), (torque, 1.0 - delay)])
            return
        if torque is None:
            self.torque[:] = 0.0
            self.plant.advance_safely()
        else:
            self.torque[:] = torque
            self.plant.advance(torque)
        self._next_sample()

    def advance_in_parts(self, parts):
        """Advance by one period under several torques in turn; `parts` are pairs (torque or None, fraction)."""
        self.torque[:] = 0.0
        for torque, fraction in parts:
            if torque is None:
                self.plant.advance_safely(fraction)
            else:
                self.plant.advance(torque, fraction)
                self.torque += fraction * np.asarray(torque)
        self._next_sample()

    def advance_with(self, drive):
        """Advance by one period by ``drive(plant, time)``, which moves the plant and returns the mean torque (n,)."""
        self.torque[:] = drive(self.plant, self.time)
        self._next_sample()

    def _next_sample(self):
        self.sequence = (self.sequence + 1) % 2**32  # a uint32 on the topic
        self.stamp_ns += self.period_ns
        if self.sequence % self._samples_per_check == 0:
            self.range.check(self.plant.q, self.plant.qd, self.plant.delta)
        self._measure()

    def _measure(self):
        plant = self.plant
        position, self.velocity[:] = plant.q, plant.qd
        if self._slack is not None:
            position = position + self._slack @ plant.delta
            self.velocity += self._slack @ plant.delta_d
        self.sensors.position(position, self.position)
        self.sensors.strain(plant.delta, self.strain)
        if self.strain_map is not None:
            self.strain_map.amplitudes(self.strain, self.amplitude)
        self.rate[:] = plant.delta_d[self._observed]


def _arm(given):
    """An `Arm`, as given or from its file."""
    return given if isinstance(given, Arm) else arm_file.load(given)
