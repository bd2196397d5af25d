# SPDX-License-Identifier: Apache-2.0
"""Describes and makes one run of an arm under control, from plain data, for `flexarm simulate --controller`.

A scenario states the arm, the parameters of observer and controller, the motion, and how the simulated arm differs from
the arm that its controller knows. It can be written as JSON and sent to other processes; the same scenario gives the
same samples, to the last bit.
"""

import difflib
from dataclasses import asdict, dataclass, field, replace

import numpy as np
import yaml

from flexarm_control import trajectory
from flexarm_control.composite.assembly import COMPONENTS, chosen, declared, type_of
from flexarm_control.composite.design import PARAMETERS as DESIGN_PARAMETERS
from flexarm_control.loop.arm_controller import PARAMETERS as CONTROLLER_PARAMETERS
from flexarm_control.loop.arm_controller import START_TOLERANCE
from flexarm_control.loop.supervisor import State
from flexarm_control.robust import default
from flexarm_control.trajectory import specs
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Arm, scaled
from flexarm_dynamics.errors import ParameterError, TrajectoryError
from flexarm_sim.simulator import PARAMETERS as SIMULATOR_PARAMETERS

from . import parameter_files
from .closed_loop import ClosedLoop
from .metrics import tracking_metrics
from .network import Network, NetworkedLoop

#: Parameters of the nodes themselves: they do not affect the loop.
OF_NODES = ("arm", "autostart", "state_timeout", "lockstep", "use_sim_time")
CONTROLLER = (*CONTROLLER_PARAMETERS, START_TOLERANCE, *DESIGN_PARAMETERS, *default.PARAMETERS)
#: Parameters that are fields of a scenario.
OF_SCENARIOS = ("plant_arm", "plant_modes", "noise", "seed")


@dataclass(frozen=True)
class Scenario:
    """One run; every field is plain data.

    Attributes
    ----------
    arm : str or Arm
        Arm file, as observer and controller know it: shipped name or path. An `Arm` that was read can be sent to other
        processes, but not through JSON.
    controller : dict
        Parameters of the loop by their names in a parameter file, flat: ``{"slow.type": "model_following",
        "slow.kp": [6.25], "observer.type": "luenberger", "torque_limit": [5.0], "rate": 500.0, …}``; see
        `parameters`. Without laws, they are those of a design for the arm, as in the nodes: `robust.default`.
    trajectory : str or dict
        A motion in a line, such as ``paper`` or ``quintic:to=1.5,duration=2`` (`trajectory.specs`); a file, .csv or
        .yaml (`trajectory.files`); or a mapping with ``times`` [s], ``positions`` [rad] and, if wanted,
        ``velocities`` and ``accelerations``. The arm starts where the motion starts, unless `controller` has an
        ``initial_position``.
    payload_scale, stiffness_scale, damping_scale : float
        Factors of the simulated arm alone, see `arm.scaled` [-].
    plant_arm : str or Arm
        Arm file of the simulated arm, if it is another one; it is scaled as well.
    plant_modes : int
        Modes per flexible direction of the simulated arm; 0: as in its file.
    noise : bool
        Whether sensors have the noise that the arm file states.
    seed : int
        Seed of the noise, and of the network's losses and delays.
    rate : float or None
        Samples per second; None: as in `controller`, otherwise 1000 [Hz].
    delay : float
        From a measurement until its torque begins to act [s].
    loss : float
        Probability that a sample is lost on its way to the observer, independently of others [-]; see `network`.
    jitter : float
        Every sample is delayed further, by a time uniform from 0 to this [s].
    duration : float or None
        Duration from the motion's start; None: to the end of the `window` [s].
    window : float
        Time after the motion over which the rest is judged [s].
    tolerance : float
        Tolerance of the tip, for the settling time [m].
    repeat : int
        Number of times that the motion is run, for laws that learn; in between the arm returns on the same path.
    """

    arm: str
    controller: dict = field(default_factory=dict)
    trajectory: str | dict = "paper"
    payload_scale: float = 1.0
    stiffness_scale: float = 1.0
    damping_scale: float = 1.0
    plant_arm: str = ""
    plant_modes: int = 0
    noise: bool = False
    seed: int = 0
    rate: float | None = None
    delay: float = 0.0
    loss: float = 0.0
    jitter: float = 0.0
    duration: float | None = None
    window: float = 3.0
    tolerance: float = 1e-3
    repeat: int = 1

    def as_dict(self):
        """The fields, ready for JSON; ``Scenario(**fields)`` gives the same scenario."""
        return asdict(self)


def parameters(file, settings=(), arm=""):
    """Flat parameters for `Scenario.controller`, from a parameter file and settings beyond it.

    Parameters
    ----------
    file : str or Path or None
        Parameter file of the nodes: shipped name or path. Each parameter is taken from the section of its node. None:
        only the settings.
    settings : sequence of str
        ``name=value`` each, the value as YAML, as `ros2 param set` takes it; for a float or an array of them also
        plain numbers: ``slow.kp=9``, one for all joints, or ``slow.kp=9,4``.
    arm : str
        Arm file: without laws, the settings change those of a design for it.

    Returns
    -------
    dict

    Raises
    ------
    ParameterError
        For a file that can't be read, and for a setting that is not a parameter of the chosen components.
    """
    nodes = {} if file is None else parameter_files.load(file)
    nodes = {node: nodes.get(node, {}) for node in parameter_files.PREFIXES}
    of_simulator = {p.name for p in SIMULATOR_PARAMETERS}
    found = {k: v for k, v in nodes["controller"].items() if k in {p.name for p in CONTROLLER}}
    # The rate is that of the simulator; the controller's parameter of the same name is for other sources.
    found |= {k: v for k, v in nodes["simulator"].items() if k in of_simulator}
    for node in ("observer", "controller"):
        own = parameter_files.PREFIXES[node]
        found |= {k: v for k, v in nodes[node].items() if k.split(".")[0] in own}
    found = {k: v for k, v in found.items() if k not in (*OF_NODES, *OF_SCENARIOS)}
    set_here = dict(map(_setting, settings))
    found |= set_here
    known = _with_types(arm, found)
    for name, value in set_here.items():
        found[name] = _as_declared(_parameter(name, known), value)
    return found


def _with_types(arm, values):
    """Flat parameters, with the laws of a design if one is to be made."""
    kind = values.get("design.type", default.AUTO)
    return default.TYPES | values if default.is_wanted(arm, values, kind) else values


def _setting(text):
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ParameterError(
            "is no setting", value=text, hint="write name=value, such as slow.kp=6.25"
        )
    try:
        return name.strip(), yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise ParameterError(f"is not YAML: {error}", field=name, value=value) from None


def _as_declared(parameter, value):
    """A setting's value; plain numbers become the float or the list of floats that the parameter is."""
    try:
        if parameter.kind == "float" and not isinstance(value, bool):
            return float(str(value))
        if parameter.kind == "float_array" and not isinstance(value, (bool, list)):
            return [float(word) for word in str(value).split(",")]
    except ValueError:
        pass  # to be refused where parameters are checked
    return value


def _parameter(name, values):
    """The declaration of a parameter of the loop or of one of the chosen components, by its name in a file."""
    prefix = name.split(".")[0]
    if prefix in COMPONENTS:
        known = {
            f"{prefix}.{p.name}": p for p in (COMPONENTS[prefix].type, *declared(prefix, values))
        }
        there, what = known, f" of {type_of(prefix, values)!r}"
    else:
        known = {p.name: p for p in (*CONTROLLER, *SIMULATOR_PARAMETERS)}
        known = {k: p for k, p in known.items() if k not in (*OF_NODES, *OF_SCENARIOS)}
        there, what = [*known, *(f"{p}.…" for p in COMPONENTS)], ""
    if name in known:
        return known[name]
    close = difflib.get_close_matches(name, known, 1)
    hint = f"there are {', '.join(there)}" + (f"; did you mean {close[0]}?" if close else "")
    raise ParameterError(f"no such parameter{what}", field=name, hint=hint)


def design_task(scenario):
    """Task for which the control of a scenario is designed, see `default.wanted_task`; None without a design."""
    return default.wanted_task(_name(scenario.arm), _read(scenario.arm), _given(scenario))


def _given(scenario):
    values = dict(scenario.controller)
    if scenario.rate is not None:
        values["rate"] = scenario.rate
    return values


def loop_of(scenario):
    """The scenario's `ClosedLoop` before its first sample; `designed` is the `Default` made for it, or None.

    A design that is not in the cache takes seconds to minutes.
    """
    arm, given = _read(scenario.arm), _given(scenario)
    known = _with_types(_name(scenario.arm), given)
    for name in given:
        if name.split(".")[0] not in COMPONENTS:
            _parameter(name, known)
    values, designed = default.complete(_name(scenario.arm), arm, given)
    simulator, controller = {}, {}
    for name, value in values.items():
        if name in {p.name for p in CONTROLLER}:
            controller[name] = value
        if name in {p.name for p in SIMULATOR_PARAMETERS}:  # `rate` is both nodes'
            simulator[name] = value
    simulator |= {"noise": scenario.noise, "seed": scenario.seed}
    simulator["plant_modes"] = scenario.plant_modes
    controller.setdefault("feedforward", "model")
    if type_of("observer", values) == "true_rates":
        simulator["publish_rates"] = True
    groups = {prefix: chosen(prefix, values) for prefix in COMPONENTS}
    plant = scaled(
        _read(scenario.plant_arm) if scenario.plant_arm else arm,
        scenario.payload_scale,
        scenario.stiffness_scale,
        scenario.damping_scale,
    )
    parts = {**groups, "simulator": simulator, "controller": controller, "plant_arm": plant}
    if scenario.loss or scenario.jitter:
        network = Network(scenario.loss, scenario.delay, scenario.jitter, scenario.seed)
        loop = NetworkedLoop(arm, **parts, network=network)
    else:
        loop = ClosedLoop(arm, **parts, delay=scenario.delay)
    loop.designed = designed
    return loop


def _read(arm):
    """An arm, as given or from its file."""
    return arm if isinstance(arm, Arm) else arm_file.load(arm)


def _name(arm):
    """Name or path by which an arm was given; empty for an `Arm` that was read."""
    return "" if isinstance(arm, Arm) else arm


def run(scenario):
    """Run a scenario.

    Returns
    -------
    record : SimulatedRecord
        Record of the last run of the motion.
    metrics : dict
        Of that record, ready for JSON: those of `tracking_metrics`, and

        ``lost``, ``reason``
            Whether the loop lost the arm (torque disabled, motion given up, arm bent or turned too far, numbers no
            longer finite), and why; the record then ends there.
        ``state``
            State of the controller's supervisor at the end.
        ``motion_s``, ``simulated_s``
            Time until the reference's end, and until the record's end.
        ``passes``
            With `repeat` above 1: the metrics of each run of the motion.

    Raises
    ------
    FlexarmError
        For a scenario that can't be run: an arm, a parameter, a `repeat`, a design or a trajectory that is refused,
        or an observer that does not converge. A loop that loses its arm is not an error.
    """
    return run_loop(scenario)[:2]


def run_loop(scenario, recorder=None):
    """As `run`, and the `ClosedLoop` in which it ran.

    A `recorder` is called with the loop, the arm file's name and the observer's name, and returns a context manager
    that records the run: ``functools.partial(flexarm_tools.recording.loop_bag.LoopBag, folder)``.
    """
    if not (isinstance(scenario.repeat, int) and scenario.repeat >= 1):
        raise ParameterError(
            "is no count", field="repeat", value=scenario.repeat, limit="an integer, at least 1"
        )
    loop = loop_of(scenario)
    motion = trajectory_of(scenario.trajectory, loop.model, loop.simulator.position)
    if "initial_position" not in scenario.controller and motion.times_ns[0] == 0:
        loop.simulator.reset(motion.positions[0])
    back = _returning(motion, loop.simulator.position)
    end = 1e-9 * int(motion.times_ns[-1])
    duration = end + scenario.window if scenario.duration is None else scenario.duration
    _check_times(scenario, duration)
    if recorder is None:
        return _passes(scenario, loop, motion, back, end, duration)
    # An `Arm` that was read no longer has a file.
    arm = scenario.arm if isinstance(scenario.arm, str) else ""
    with recorder(loop, arm, type_of("observer", scenario.controller)):
        return _passes(scenario, loop, motion, back, end, duration)


def _passes(scenario, loop, motion, back, end, duration):
    """Run the motion as often as wanted; as `run_loop`."""
    passes = []
    for i in range(scenario.repeat):
        if i and back is not None and not loop.lost:
            loop.follow(_next(back, loop), duration)
        if i and loop.lost:
            break
        record = loop.follow(_next(motion, loop) if i else motion, duration)
        passes.append(_metrics(scenario, loop, record, end, duration))
    metrics = passes[-1] | {"lost": bool(loop.lost), "reason": loop.lost}
    if scenario.repeat > 1:
        metrics["passes"] = passes
    return record, metrics, loop


def _check_times(scenario, duration):
    limited = {"window": scenario.window, "tolerance": scenario.tolerance, "duration": duration}
    for name, value in limited.items():
        if not 0.0 <= value <= 1e5:
            raise ParameterError("is out of range", field=name, value=value, limit="from 0 to 1e5")


def _metrics(scenario, loop, record, end, duration):
    found = {
        "lost": bool(loop.lost),
        "reason": loop.lost,
        "state": State(record.state[-1]).name,
        "motion_s": end,
        "simulated_s": float(record.time[-1]),
    }
    window = min(scenario.window, max(duration - end, 0.0))
    plant = loop.simulator.plant_model
    # A lost arm may be anywhere: squares of its numbers need not be finite.
    with np.errstate(over="ignore", invalid="ignore"):
        found |= tracking_metrics(record, loop.model, plant, end, window, scenario.tolerance)
    return found


# Trajectories ----------------------------------------------------------------------------------


def trajectory_of(given, model, start):
    """A `JointTrajectoryData` with stamp 0, now, from what is `given` as in `Scenario.trajectory`.

    `model` is that of the arm that follows it, with its limits; its joints are at `start` (n,) [rad].
    """
    if isinstance(given, str):
        return specs.load(given, model, start)
    names = model.joint_names
    return trajectory.validate(names, names, 0, _points(given), *specs.limits(model))


def _points(given):
    unknown = set(given) - {"times", "positions", "velocities", "accelerations"}
    if unknown or not {"times", "positions"} <= set(given):
        names = "times, positions, velocities, accelerations"
        raise TrajectoryError("has other fields", field="trajectory", value=[*given], limit=names)
    times = [round(1e9 * t) for t in given["times"]]
    fields = [given.get(k, [()] * len(times)) for k in ("positions", "velocities", "accelerations")]
    return [(*point, ()) for point in zip(times, *fields, strict=True)]


def _returning(motion, start):
    """The motion back; None if a motion ends at its start."""
    if np.abs(motion.positions[-1] - start).max() < 1e-9:
        return None
    last = int(motion.times_ns[-1])
    signs = {"positions": 1.0, "velocities": -1.0, "accelerations": 1.0}
    at = {"positions": start, "velocities": 0.0 * start, "accelerations": 0.0 * start}
    first = int(motion.times_ns[0])
    fields = []
    for name, sign in signs.items():
        values = getattr(motion, name)
        if values is None:
            fields.append([()] * (len(motion.times_ns) + bool(first)))
            continue
        values = np.vstack([at[name], values]) if first else values
        fields.append(sign * values[::-1])
    times = np.append(0, motion.times_ns) if first else motion.times_ns
    points = [(int(last - t), *f, ()) for t, *f in zip(times[::-1], *fields, strict=True)]
    names = motion.joint_names
    return trajectory.validate(names, names, 0, points)


def _next(motion, loop):
    """The motion from the next sample on."""
    return replace(motion, stamp_ns=loop.simulator.stamp_ns + loop.simulator.period_ns)
