# SPDX-License-Identifier: Apache-2.0
r"""Safety supervisor: the controller's state, and the limits that stop the arm.

States and transitions:

- INACTIVE: no torque until there are a valid state and a converged observer, then READY. Entered and left
  automatically.
- READY, TRACKING, HOLDING: torque, before, during and after a trajectory.
- STOPPING: torque. The *reference* is brought to rest from where it is (not from the measurement) while the fast
  control continues to damp; then HOLDING.
- FAULT: no torque, so that each joint's safe action acts, until `Supervisor.recover`.

The arm is stopped smoothly when a limit is exceeded, that is, when one of these ratios is above 1:

.. math:: |q_r - q|/e_{max},\; |\dot q|/\dot q_{max},\; |\delta|/\delta_{max},\; |\varepsilon|/\varepsilon_{max},\;
          t_{saturated}/t_{max}

The range of the joints is checked with the braking distance, by :math:`q + \dot q|\dot q|/2D`. D is the deceleration
that the joint's torque limit allows a straight arm. If the largest acceleration of the followed motion is larger, D is
that: the motion's torque was checked on receipt, in its own configurations and with the torques of the other joints.
While a joint follows a motion that brakes, :math:`\dot q_r^2 \le 2D|q_{end} - q_r|`. So a motion within the range is
not stopped.

A ratio above `FAULT_RATIO` is a fault, and so is a limit that stays exceeded for `limit_patience`, or a state that
can't be trusted.
"""

from enum import IntEnum
from itertools import pairwise

import numpy as np

from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import slow_subsystem

from .. import kernels

#: A limit that is exceeded by this factor is a fault at once.
FAULT_RATIO = 1.5
#: Deceleration of a joint whose torque has no limit [rad/s^2].
FREE_DECELERATION = 10.0
#: A smooth stop uses this fraction of the deceleration that the torque limit allows.
STOP_FRACTION = 0.5

PARAMETERS = (
    parameter("tracking_error_limit", 0.5, "rad", 0.0, 100.0).described(
        "Largest distance of a joint from its reference; beyond it the arm is stopped. 0.0: no limit."
    ),
    parameter("velocity_margin", 1.2, "-", 0.0, 100.0).described(
        "Largest measured joint velocity, as a multiple of the arm file's limits.velocity; 0.0: no limit."
    ),
    parameter("position_margin", 0.05, "rad", 0.0, 10.0).described(
        "How far a joint may leave the arm file's limits.position, braking distance included; 0.0: not watched."
    ),
    parameter("deflection_limit", [0.0], "m, rad", 0.0, 1e3, length="modes").described(
        "Largest modal amplitude, per mode; 0.0: no limit."
    ),
    parameter("strain_limit", 0.0, "-", 0.0, 1.0).described(
        "Largest strain that the deflections cause at a gauge; 0.0: the gauge's full_scale in the arm file."
    ),
    parameter("saturation_time", 2.0, "s", 0.0, 1e4).described(
        "Longest time that a torque may stay at its limit; then the arm is stopped. 0.0: no limit."
    ),
    parameter("limit_patience", 1.0, "s", 0.0, 1e3).described(
        "A limit that stays exceeded for this long, in spite of the stop, is a fault."
    ),
    parameter("max_gap", 0.5, "s", 1e-3, 1e4).described(
        "Longest time between the stamps of two states; a longer one is a fault."
    ),
    parameter("synchronised_clocks", False, read_only=True).described(
        "Whether stamps are times of this machine's clock. If so, a state's age is checked, otherwise only its order."
    ),
    parameter("max_age", 0.1, "s", 1e-4, 1e3).described(
        "With synchronised_clocks, a state that is older than this, or this far in the future, is a fault."
    ),
    parameter("stop_deceleration", [0.0], "rad/s^2", 0.0, 1e5, length="joints").described(
        "Largest deceleration of a smooth stop, per joint; 0.0: one that keeps to about the motion's own acceleration"
        " and jerk."
    ),
)


class State(IntEnum):
    """State of the controller, as in CompositeState."""

    INACTIVE = 0
    READY = 1
    TRACKING = 2
    HOLDING = 3
    STOPPING = 4
    FAULT = 5


#: First and last of the states with torque.
FIRST_RUNNING, LAST_RUNNING = State.READY, State.STOPPING


class Supervisor:
    """State and limits of one controller.

    Parameters
    ----------
    model : ArmModel
        n joints, m modes.
    settings : mapping
        Checked values of `PARAMETERS`.
    torque_limit : ndarray, shape (n,)
        Active limits [N m]; infinite where there is none.

    Attributes
    ----------
    state : State
    reason : str
        Why there is no torque, or why the arm was stopped; empty otherwise.
    stops, faults : int
        Numbers of stops and faults so far.
    deceleration : ndarray, shape (n,)
        Deceleration of a smooth stop [rad/s^2]: the parameter, or half of what the torque limit allows, or
        `FREE_DECELERATION` without a torque limit.
    deceleration_given : ndarray, shape (n,), bool
        Whether the parameter gives it.

    Raises
    ------
    ParameterError
        If there is a strain limit for an arm without gauges.
    """

    def __init__(self, model, settings, torque_limit):
        self.model = model
        self.state, self.reason = State.INACTIVE, ""
        self.stops = self.faults = 0
        joints = model.joint_names
        watched = (
            ("tracking error of", joints, " rad"),
            ("velocity of", joints, " rad/s"),
            ("position of", joints, " rad"),
            ("deflection of", model.mode_names, ""),
            ("strain of", model.arm.gauge_names, ""),
            ("", ["time at the torque limit"], " s"),
        )
        self._names = [
            (f"{what} {name}".lstrip(), unit) for what, names, unit in watched for name in names
        ]
        bounds = np.cumsum([0, *(len(names) for _, names, _ in watched)])
        self._parts = [slice(a, b) for a, b in pairwise(bounds)]
        self._ratio, self._value = np.zeros((2, len(self._names)))
        self._no_error, self._kernels = np.zeros(model.n_joints), kernels.compiled()
        self._rows = gauge_rows(model, model.arm.gauges)
        self._of_motion = np.zeros(model.n_joints)
        self.forget()
        self.configure(settings, torque_limit)

    def configure(self, settings, torque_limit):
        """Take all new limits, or raise an error and keep the old ones."""
        arm = self.model.arm

        def or_none(values):
            values = np.asarray(values, float)
            return np.where(values > 0.0, values, np.inf)

        strain = settings["strain_limit"]
        if strain > 0.0 and not arm.gauges:
            raise ParameterError(
                f"can't be watched: {arm.name} has no gauges",
                field="strain_limit",
                value=strain,
                hint="set deflection_limit, or write 0.0",
            )
        n = self.model.n_joints
        able = _deceleration(self.model, torque_limit)
        wanted = np.array(settings["stop_deceleration"])
        finite = np.where(np.isfinite(able), STOP_FRACTION * able, FREE_DECELERATION)
        limit = np.concatenate(
            [
                np.full(n, or_none(settings["tracking_error_limit"])),
                arm.velocity_limits * or_none(settings["velocity_margin"]),
                np.full(n, or_none(settings["position_margin"])),
                or_none(settings["deflection_limit"]),
                or_none([strain or g.full_scale for g in arm.gauges]),
                [or_none(settings["saturation_time"])],
            ]
        )
        self.settings = dict(settings)
        # Range, braking deceleration and margin of each joint.
        low, high = arm.position_limits.T
        margin = limit[self._parts[2]]
        self._able = np.maximum(able, np.finfo(float).tiny)
        ranges = np.stack([low, high, self._able, 0.99 * FAULT_RATIO * margin], axis=1)
        self._ranges = ranges[: n if margin[0] < np.inf else 0]
        self.expect(self._of_motion)
        self._limit, self._inverse = limit, 1.0 / limit
        watches_strain = np.isfinite(limit[self._parts[4]]).any()
        self._watched_rows = self._rows[: None if watches_strain else 0]
        self.deceleration = np.where(wanted > 0.0, wanted, finite)
        self.deceleration_given = wanted > 0.0

    def expect(self, acceleration):
        """Take the largest accelerations of the followed motion, (n,) [rad/s^2]: the arm can brake with them, too."""
        self._of_motion = acceleration
        self._ranges[:, 2] = np.maximum(self._able, acceleration)[: len(self._ranges)]

    def forget(self):
        """Forget for how long limits have been exceeded."""
        self._exceeded_for = self._saturated_for = 0.0

    # Transitions -----------------------------------------------------------------------------

    @property
    def running(self):
        """Whether there is torque."""
        return FIRST_RUNNING <= self.state <= LAST_RUNNING

    def wait(self, reason):
        """Give no torque until the next valid state; a fault stays a fault."""
        if self.state != State.FAULT:
            self.state, self.reason = State.INACTIVE, reason
        self.forget()

    def fail(self, reason):
        """Hard stop: no torque until `recover`. The first reason stays."""
        if self.state != State.FAULT:
            self.state, self.reason = State.FAULT, reason
            self.faults += 1
        self.forget()

    def doubt(self, reason):
        """Note that the state can't be trusted: a fault if there was torque, otherwise no torque yet."""
        self.fail(reason) if self.running else self.wait(reason)

    def recover(self):
        """Leave a fault; returns whether there was one."""
        if self.state != State.FAULT:
            return False
        self.state, self.reason = State.INACTIVE, ""
        self.forget()
        return True

    def begin(self):
        """Begin with torque, since there are a valid state and a converged observer."""
        self.state, self.reason = State.READY, ""
        self.forget()

    def stop(self, reason):
        """Begin a smooth stop; the caller brakes the reference."""
        self.state, self.reason = State.STOPPING, reason
        self.stops += 1

    def follow(self, reference):
        """Set the state from that of the reference."""
        if reference.stopping:
            self.state = State.STOPPING
        elif reference.active:
            if self.state != State.TRACKING:
                self.reason = ""
            self.state = State.TRACKING
        elif self.state != State.READY or reference.finished:
            self.state = State.HOLDING

    # Limits ----------------------------------------------------------------------------------

    def watch(self, q, qd, amplitude, error, saturated, dt):
        """Judge one sample; runs on the control path.

        Parameters
        ----------
        q, qd : ndarray, shape (n,)
            Joint positions and velocities [rad], [rad/s].
        amplitude : ndarray, shape (m,)
            [m, rad]
        error : ndarray, shape (n,) or None
            Reference minus position [rad]; None if the law does not make the joints follow it.
        saturated : bool
            Whether a torque was at its limit.
        dt : float
            Time since the last sample [s].

        Returns
        -------
        verdict : State or None
            STOPPING: bring the arm to rest; FAULT: no torque; None: go on.
        reason : str
        """
        value = self._value
        value[-1] = self._saturated_for = self._saturated_for + dt if saturated else 0.0
        error = self._no_error if error is None else error
        if not self._kernels.watched(
            error,
            q,
            qd,
            amplitude,
            self._ranges,
            self._watched_rows,
            self._inverse,
            value,
            self._ratio,
        ):
            self._exceeded_for = 0.0
            return None, ""
        self._exceeded_for += dt
        worst = int(np.argmax(self._ratio))
        text = self._text(worst)
        if self._ratio[worst] > FAULT_RATIO:
            return State.FAULT, f"{text}, by more than {FAULT_RATIO:g} times"
        if self._exceeded_for > self.settings["limit_patience"]:
            return State.FAULT, f"{text}, for {self._exceeded_for:.3g} s in spite of the stop"
        return State.STOPPING, text

    def _text(self, i):
        """Text that names the exceeded limit."""
        (name, unit), value, limit = self._names[i], self._value[i], self._limit[i]
        if name.startswith("position"):
            return (
                f"{name} is {value:.3g} rad out of its range, or will be, {limit:g} rad are allowed"
            )
        return f"{name} is {value:.6g}{unit}, beyond its limit of {limit:.6g}{unit}"


def _deceleration(model, torque_limit):
    """Deceleration that the torque limits allow a straight arm, (n,) [rad/s^2]; infinite where there is no limit."""
    n = model.n_joints
    a, B = slow_subsystem(model.terms(np.zeros(n), np.zeros(n)))
    most = np.diag(B) * torque_limit
    # Gravity takes some of it; assume that at least a fifth is left.
    return np.maximum(most - np.abs(a), 0.2 * most)


def longest_period(model):
    """Period of the lowest bending mode with straight, locked joints [s]; 0 for a rigid arm."""
    if not model.n_modes:
        return 0.0
    return 2.0 * np.pi / float(model.frequencies(locked=True)[0])
