# SPDX-License-Identifier: Apache-2.0
r"""Runs an arm on a plant that is not the controller's model, and computes the numbers by which it is judged.

The plants are those of `plants.VARIANTS`.

The tip should come to rest where the plant's tip rests, bent by the plant's own weight, with every joint exactly at the
end of the reference. A heavier payload sags more. Joint torques can't change this and need not: it is not an error.
Joint errors and vibration are errors. The tip is settled when it is within `TOLERANCE` of the reach from that place,
and stays so until the run's end, `WINDOW` locked periods after the motion, and at least `MIN_WINDOW`.

The torque does not return in a ramp here (`return_time` 0): a motion begins with the first torque. A real arm is held
before its motion, so the ramp is over by then. Where sensors have noise, the arm is held for `HELD` before its motion:
its torque then changes, and the control measures the delay of the loop.

Integration: dop853 is used if a few substeps are short enough for the highest mode and for the friction of light hubs.
Friction damps a joint that reverses at the rate :math:`f_cH/v_0`, with the inverse H of the mass matrix and the
smoothing speed v_0 (`description.Friction`). Otherwise the implicit method is used in substeps of `STEP`. The phase of
a mode of 625 Hz changes by 0.1 rad in one substep; the method removes faster modes, like the current loop of a drive.
An explicit method would take a hundred substeps per sample for these, and a day for the table. The steps are shorter if
Coulomb friction would move a light hub farther than `KICK` in one, because friction reverses only at the end of a step.
In longer steps, joints that come to rest hunt: one by 0.25 deg in implicit steps of 0.25 ms, but not in steps of 0.18
ms; another one by 0.09 deg in steps of 2 ms of dop853, by 0.04 deg in steps of 1 ms, but not in steps of 0.67 ms.

The implicit method treats the stiffness that the loads of a motion add to a bent arm explicitly. If its steps are too
long, a fast mode that should decay grows. Such an arm is lost by the method and not by its control. So a lost run is
repeated in steps `SHORTER` times as short, and the arm counts as lost if it is lost then, too.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from flexarm_control.loop.supervisor import State
from flexarm_dynamics.arm.description import Arm
from flexarm_dynamics.errors import FlexarmError, ModelError
from flexarm_dynamics.models import levels, model
from flexarm_sim.integrators import substeps, turning_rate

from ..loop import scenario as scenarios
from ..loop.metrics import joint_error, residual_vibration, tip_path
from .plants import plant_of

#: Distance of the tip from its place of rest, as a fraction of the reach, within which it is settled [-].
TOLERANCE = 1e-3
#: Run after the motion, and its last part in which rest is judged, in periods of the lowest locked mode [-].
WINDOW, REST = 6.0, 1.0
#: The run after the motion is at least this long: a loop may be slow on a fast arm [s].
MIN_WINDOW = 2.0
#: An arm with noise is held this long before its motion [s].
HELD = 0.3
#: To find the effect of noise alone, the arm is only held, for this many times the window after the motion. By then
#: every other vibration has died out [-].
HOLD = 2.0
#: Start and end of its motion, which has no distance and is short: a long motion takes long to plan [s].
SHORT = 0.1, 0.2
#: Joints are at rest within this of the reference [deg].
JOINT_REST = 0.02
#: Samples per second, if neither the controller's parameter ``rate`` nor the variant states another number [Hz].
RATE = 1000.0
#: The arm counts as lost at this joint error [rad]. It is generous, because shaped baselines are late by their shaper.
MAX_ERROR = 2.0
#: Substeps per sample up to which the explicit method is used, and longest step of the implicit one [s].
EXPLICIT, STEP = 4, 2.5e-5
#: Largest product of the rate at which friction damps a joint that reverses and a step of dop853 [-].
DAMPED = 1.0
#: A lost run of the implicit method is repeated in steps this many times as short.
SHORTER = 3
#: Largest angle by which friction moves a hub in one step [rad].
KICK = np.radians(0.01)
#: Numbers of a run that was lost before they could be judged.
NOT_REACHED = {
    "peak_joint_error_deg": None,
    "settling_s": None,
    "settling_periods": None,
    "rest_joint_deg": None,
    "rest_tip": None,
    "residual_tip": None,
    "settled": False,
    "at_rest": False,
}


@dataclass(frozen=True)
class ArmTask:
    """An arm and its motion, as a run needs them; a `RandomArm` has the same attributes.

    Attributes
    ----------
    name : str
    arm : Arm
        As the controller knows it.
    motion : str
        As `Scenario.trajectory`.
    """

    name: str
    arm: Arm
    motion: str

    def read(self):
        """The arm."""
        return self.arm

    @cached_property
    def period(self):
        """Period of the lowest mode, joints locked, the longer of both ends of the motion [s]; 0.0: a rigid arm."""
        known = model.build(self.arm)
        if not known.n_modes:
            return 0.0
        motion = scenarios.trajectory_of(self.motion, known, np.zeros(known.n_joints))
        ends = np.array(motion.positions)[[0, -1]]
        return 2.0 * np.pi / min(known.frequencies(q, locked=True)[0] for q in ends)


def window_of(case):
    """Time for which the arm is watched after its motion [s]."""
    return max(WINDOW * case.period, MIN_WINDOW)


def run(case, setup, variant, seed=0):
    """Run a controller on an arm.

    Parameters
    ----------
    case : RandomArm or ArmTask
    setup : Setup
    variant : Variant
    seed : int
        Of the noise.

    Returns
    -------
    dict
        Ready for JSON: the numbers of `judged`, ``lost`` with the reason if the arm was lost, or only ``refused``.
    """
    try:
        shorter = 1
        loop, record, wanted, end = _followed(case, setup, variant, seed, shorter)
        if loop.lost and loop.simulator.plant.implicit:
            shorter = SHORTER
            loop, record, wanted, end = _followed(case, setup, variant, seed, shorter)
    except FlexarmError as error:
        return {"refused": str(error)}
    if record is None:  # lost before its motion
        return NOT_REACHED | {"lost": loop.lost}
    with np.errstate(over="ignore", invalid="ignore"):
        found = judged(case, loop.simulator.plant_model, _as_wanted(record, wanted, loop), end)
    if loop.lost:
        return found | {"lost": loop.lost}
    if variant.sensors:
        last = wanted.positions[-1]
        found["noise_tip"] = of_noise_alone(case, setup, variant, last, seed, shorter)
    return found


def _followed(case, setup, variant, seed, shorter):
    """The loop after its run with steps `shorter` times as short, the record, the wanted motion, and its end."""
    loop = _prepared(case, setup, variant, seed)
    loop.simulator.plant.substeps *= shorter
    wanted = scenarios.trajectory_of(case.motion, loop.model, loop.simulator.position)
    motion = wanted if setup.motion is None else setup.motion(loop.model)
    loop.simulator.reset(wanted.positions[0])
    if variant.sensors and (reason := _lost_while_held(loop)):
        loop.lost = reason
        return loop, None, wanted, 0.0
    end = 1e-9 * int(wanted.times_ns[-1])
    return loop, loop.follow(motion, end + window_of(case)), wanted, end


def _lost_while_held(loop):
    """Hold the arm for `HELD`; return why it was lost, or nothing."""
    for _ in range(round(1e9 * HELD / loop.simulator.period_ns)):
        try:
            loop.step()
        except ModelError as error:
            return str(error)
        if loop.controller.state == State.FAULT:
            return loop.controller.reason
    return ""


def of_noise_alone(case, setup, variant, q, seed=0, shorter=1):
    """Rms of the tip about its mean, as a fraction of the reach [-], of an arm that is only held at `q` [rad].

    It is taken over all periods of the last window, and not over one like ``residual_tip`` of a run of the same case,
    setup and variant, because vibration that noise makes grows and decays by chance. Of two arms with the same noise,
    each taken over one period, one in ten would have more than three times the other's. None if the arm can't be held.
    The steps are `shorter` times as short as usual.
    """
    try:
        loop = _prepared(case, setup, variant, seed)
        loop.simulator.plant.substeps *= shorter
        loop.simulator.reset(q)
        length = HOLD * window_of(case)
        points = {"times": list(SHORT), "positions": [q, q]}
        record = loop.follow(scenarios.trajectory_of(points, loop.model, q), length)
    except FlexarmError:
        return None
    if loop.lost:
        return None
    window = window_of(case)
    period = REST * case.period or window
    ends = record.time[-1] - period * np.arange(int(window / period) + 1)
    each = []
    for end, begin in pairwise(ends):
        part = (record.time >= begin) & (record.time <= end)
        tip = tip_path(
            loop.simulator.plant_model, record.plant_position[part], record.plant_amplitude[part]
        )
        each.append(residual_vibration(tip))
    return _finite(np.sqrt(np.mean(np.square(each))) / case.read().reach)


def _prepared(case, setup, variant, seed):
    """The loop with the setup's own law, if it has one."""
    loop = loop_of(case, setup, variant, seed)
    if setup.law is not None:
        loop.controller.law = setup.law(loop.model)
    return loop


def loop_of(case, setup, variant, seed=0):
    """The `ClosedLoop` of a run, before its first sample."""
    known = case.read()
    given = dict(setup.controller)
    if variant.sensors:
        given["publish_joint_velocity"] = False
    rate = variant.rate or given.get("rate", RATE)
    plant = plant_of(known, variant)
    count = _explicit_substeps(model.build(plant), 1.0 / rate)
    explicit = count <= EXPLICIT
    # A real arm has been held for some time when its motion begins.
    given["return_time"] = 0.0
    given["level"] = levels.level_of(plant)
    given["integrator"] = "dop853" if explicit else "implicit"
    scenario = scenarios.Scenario(
        known,
        given,
        plant_arm=plant,
        noise=variant.sensors,
        seed=seed,
        rate=rate,
        delay=variant.delay,
    )
    loop = scenarios.loop_of(scenario)
    loop.MAX_ERROR = MAX_ERROR
    if not explicit:
        step = longest_step(loop.simulator.plant_model, loop.simulator.position)
        # Play in a transmission may need more.
        count = max(loop.simulator.plant.substeps, int(np.ceil(1.0 / rate / step - 1e-9)))
    loop.simulator.plant.substeps = count
    return loop


def _explicit_substeps(plant, period):
    """Substeps per period that dop853 needs for modes and friction."""
    turning = int(np.ceil(turning_rate(plant) * period / DAMPED))
    return max(substeps(plant, period, undamped=True), turning)


def _mobility(plant, q):
    """Diagonal of the inverse mass matrix for the joints, (n,) [1/(kg m^2)]."""
    n = plant.n_joints
    return np.diag(np.linalg.inv(plant.terms(q, np.zeros(n)).M))[:n]


def longest_step(model, q):
    r"""Step of the implicit method, :math:`\min(h, \sqrt{\kappa/f_cH})` [s].

    h is `STEP`, :math:`\kappa` is `KICK`, :math:`f_c` the Coulomb friction, and H the diagonal of the inverse mass
    matrix.

    Parameters
    ----------
    model : ArmModel
        Of the plant.
    q : ndarray, shape (n,)
        Joint angles at the beginning [rad].
    """
    kick = np.max(model.friction_table()[:, 1] * _mobility(model, q), initial=0.0)
    return min(STEP, np.sqrt(KICK / kick)) if kick > 0.0 else STEP


def _as_wanted(record, wanted, loop):
    """The record with the wanted motion as its reference, not a shaped one."""
    return replace(record, reference=positions(wanted, record.time))


def positions(motion, time):
    """Positions of a trajectory at times (k,) from its start, held before and after, (k, n) [rad]."""
    knots = 1e-9 * np.asarray(motion.times_ns, float)
    return np.column_stack(
        [np.interp(time, knots, column) for column in np.array(motion.positions).T]
    )


def judged(case, plant, record, end):
    """The numbers of a run whose motion ends at `end` [s].

    Returns
    -------
    dict
        ``peak_joint_error_deg``
            The largest of all joints, from the motion's start on, relative to the wanted motion.
        ``settling_s``, ``settling_periods``
            From the motion's end until the tip stays within the tolerance; None: not within the window.
        ``rest_joint_deg``
            Largest joint error over the last `REST` period; None for a record that does not reach it.
        ``rest_tip``
            Largest distance of the tip from its place of rest in that time, as a fraction of the reach [-].
        ``residual_tip``
            Rms of the tip about its own mean over that time, as a fraction of the reach [-].
        ``settled``, ``at_rest``
            Whether the tip settled, and whether the joints came within `JOINT_REST`.
    """
    moving = record.time >= -1e-9
    error = np.degrees(joint_error(record.reference, record.plant_position)[moving])
    found = NOT_REACHED | {"peak_joint_error_deg": _finite(error.max(initial=0.0))}
    if record.time[-1] < end + window_of(case) - 0.01:
        return found  # lost on the way
    reach = plant.arm.reach
    after = record.time >= end - 1e-9
    time, target = record.time[after] - end, record.reference[-1]
    tip = tip_path(plant, record.plant_position[after], record.plant_amplitude[after])
    distance = np.linalg.norm(
        tip - plant.tip_position(target, plant.static_deflection(target)), axis=1
    )
    last = time >= time[-1] - REST * case.period
    outside = np.flatnonzero(distance > TOLERANCE * reach)
    if not outside.size or outside[-1] < len(time) - 1:
        settling = float(time[outside[-1] + 1]) if outside.size else 0.0
        found |= {
            "settling_s": settling,
            "settling_periods": settling / case.period if case.period else None,
            "settled": True,
        }
    rest = float(error[after[moving]][last].max())
    return found | {
        "rest_joint_deg": _finite(rest),
        "rest_tip": _finite(distance[last].max() / reach),
        "residual_tip": _finite(residual_vibration(tip[last]) / reach),
        "at_rest": bool(rest <= JOINT_REST),
    }


def _finite(value):
    return float(value) if np.isfinite(value) else None
