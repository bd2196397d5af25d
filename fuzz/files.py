# SPDX-License-Identifier: Apache-2.0
"""Readers of files: arms, parameter files, declared parameters, recordings."""

import copy
import csv
import io
import tempfile
from array import array
from fractions import Fraction
from pathlib import Path

import numpy as np
import yaml
from rclpy.serialization import serialize_message

from flexarm_control.composite import assembly
from flexarm_control.nodes import controller, observer
from flexarm_dynamics.arm import arm_file, reduced
from flexarm_dynamics.errors import ArmFileError, FlexarmError, ParameterError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import check_all
from flexarm_msgs.msg import JointTorque
from flexarm_sim.nodes import simulator
from flexarm_sim.simulator import PARAMETERS as PLANT
from flexarm_studies.commands import gauges
from flexarm_studies.identification import recording
from flexarm_studies.loop import parameter_files
from flexarm_tools.check_driver import listening
from flexarm_tools.check_driver.samples import Received, Verdict, samples
from flexarm_tools.identification.recording import of_contents
from flexarm_tools.recording import bag

from . import odd
from .messages import good_state, spoil_state
from .reader import FileReader, Reader, demand
from .trajectories import dump

ARMS = ("R", "one_link", "two_link", "long_reach", "rigid")


class Arms(Reader):
    """`arm_file.parse`, and the model and gauges of an arm that it takes."""

    name, weight, error = "arm file", 0.8, ArmFileError

    def __init__(self):
        folder = arm_file.arms_directories()[0]
        self.texts = [(folder / f"{name}.yaml").read_bytes() for name in ARMS]
        self.trees = [yaml.safe_load(text) for text in self.texts]
        self.keys = tuple(sorted({str(k) for t in self.trees for p in odd.places(t) for k in p}))

    def make(self, rng):
        at = rng.randrange(len(ARMS))
        if rng.random() < 0.3:
            return odd.mangled(rng, self.texts[at]).decode(errors="replace")
        tree = odd.altered(rng, copy.deepcopy(self.trees[at]), known=self.keys)
        return dump(tree).decode(errors="replace")

    def read(self, given):
        return arm_file.parse(given)

    def check(self, given, result):
        demand(len(result.joints) == len(result.links) >= 1, "joints and links")
        for joint in result.joints:
            demand(np.isfinite([*joint.axis, *joint.origin_xyz, joint.hub_inertia]).all(), "joint")
            demand(joint.limits.torque > 0.0, "torque limit")
        for link in result.links:
            demand(0.0 < link.length < np.inf and link.mass_per_length > 0.0, "link")
        demand(set(result.observed_modes) <= set(result.mode_names), "observed modes")


class Models(Arms):
    """`model.build` and `gauges.study` of arms whose numbers are altered."""

    name, weight = "arm's model", 0.1
    error = FlexarmError

    def make(self, rng):
        # Only numbers: for an arm of another structure, code is compiled for seconds.
        tree = copy.deepcopy(self.trees[rng.randrange(len(ARMS))])
        there = odd.places(tree)
        for path in rng.sample(there, min(len(there), rng.randint(1, 4) * 5)):
            *way, key = path
            holder = tree
            for step in way:
                holder = holder[step]
            if isinstance(holder[key], float):
                holder[key] *= rng.choice((0.0, -1.0, 1e-3, 1e3, 1e-12, 1e12, 1.0, 0.5, 2.0))
        return dump(tree).decode()

    def read(self, given):
        arm = super().read(given)
        made = model.build(arm)
        if arm.gauges and arm.observed_modes:
            gauges.study(made, arm.observed_modes)
        return made

    def check(self, given, result):
        terms = result.terms(np.full(result.n_joints, 0.1), np.full(result.n_joints, 0.2))
        for name in ("M", "f1", "f2", "C1", "C2", "K1", "K2"):
            values = getattr(terms, name, None)
            demand(values is None or np.isfinite(values).all(), f"{name} is not finite")


class Archives(Reader):
    """`reduced.read` of archives of reduced matrices whose arrays or bytes are altered."""

    name, weight, error = "reduced matrices", 0.5, ArmFileError

    def __init__(self):
        path = arm_file.arms_directories()[0] / "solid_boom.npz"
        self.bytes = path.read_bytes()
        with np.load(path) as archive:
            self.arrays = dict(archive)
        self.folder = Path(tempfile.mkdtemp(prefix="flexarm_fuzz_"))

    def make(self, rng):
        if rng.random() < 0.4:
            return odd.mangled(rng, self.bytes)
        arrays = dict(self.arrays)
        for name in rng.sample(sorted(arrays), rng.randint(1, 3)):
            value = arrays[name]
            odd_ones = (
                value[..., :1] if value.ndim else value[None],
                -value if value.dtype.kind == "f" else value[:0],
                value.astype(str),
                np.full(value.shape, np.nan),
                np.zeros(value.shape),
                value[None],
                np.array(1.0),
            )
            arrays[name] = rng.choice(odd_ones)
            if rng.random() < 0.2:
                del arrays[name]
        file = io.BytesIO()
        np.savez(file, **arrays)
        return file.getvalue()

    def read(self, given):
        path = self.folder / "link.npz"
        path.write_bytes(given)
        return reduced.read(path, "links[0].reduced.file")

    def check(self, given, result):
        demand(1 <= result.modes <= reduced.MAX_MODES, "modes")
        numbers = (v for v in result.arrays.values() if v.dtype.kind == "f")
        demand(all(np.isfinite(v).all() for v in numbers), "not finite")


def declared():
    """Every group of declared parameters, by prefix."""
    controllers, observers = controller.parameter_groups(), observer.parameter_groups()
    return {
        "simulator ": (*PLANT, *simulator.PARAMETERS),
        "controller ": controllers[""],
        **{k: v for k, v in controllers.items() if k},
        **{k: v for k, v in observers.items() if k},
    }


SIZES = {"joints": 2, "modes": 4, "z": 8, "gauges": 4}


class Parameters(Reader):
    """`check_all` of every declared group: the values that files, services and callers give."""

    name, weight, error = "parameters", 20.0, ParameterError

    def __init__(self):
        self.groups = {prefix.replace(" ", ""): group for prefix, group in declared().items()}
        self.words = (*(p.name for group in self.groups.values() for p in group), "such")

    def make(self, rng):
        prefix = rng.choice(tuple(self.groups))
        group = self.groups[prefix]
        values = {}
        for parameter in rng.sample(group, min(len(group), rng.randint(1, 4))):
            values[parameter.name] = self.value(rng, parameter)
        if rng.random() < 0.05:
            values[odd.text(rng, self.words)] = odd.scalar(rng)
        return prefix, values

    @staticmethod
    def value(rng, parameter):
        """A value near the declared one, or anything."""
        if rng.random() < 0.4:
            return rng.choice(
                (
                    odd.anything(rng, known=parameter.choices),
                    np.float32(odd.floating(rng)) if rng.random() < 0.1 else Fraction(1, 3),
                    np.array(rng.choice((1.0, [1.0, 2.0], [[1.0]], [1], "a", None))),
                    array("d", [odd.floating(rng)]),
                    b"\x01",
                    {1, 2},
                    1j,
                )
            )
        low = -10.0 if parameter.low is None else parameter.low
        high = 10.0 if parameter.high is None else parameter.high
        number = rng.choice((low, high, rng.uniform(low, high), 0.5 * low, odd.floating(rng, high)))
        if parameter.kind == "float":
            return number
        if parameter.kind == "int":
            return int(number) if abs(number) < 1e18 else rng.choice(odd.HUGE_INTS)
        if parameter.kind == "float_array":
            return [number] * rng.choice((0, 1, 1, 2, 2, 3, 8))
        if parameter.kind == "string_array":
            return [odd.text(rng)] * rng.randint(0, 3)
        if parameter.kind == "bool":
            return rng.choice((True, False, 1, "true"))
        return odd.text(rng, parameter.choices)

    def read(self, given):
        prefix, values = given
        return check_all(self.groups[prefix], values, SIZES, prefix)

    def check(self, given, result):
        prefix, _ = given
        group = self.groups[prefix]
        demand(set(result) == {p.name for p in group}, "names")
        for parameter in group:
            self._check_one(parameter, result[parameter.name])
        again = check_all(group, result, SIZES, prefix)
        demand(again == result, "what was taken is refused or changed the second time")

    @staticmethod
    def _check_one(parameter, value):
        kinds = {"float": float, "int": int, "bool": bool, "string": str}
        if parameter.kind in kinds:
            demand(type(value) is kinds[parameter.kind], f"{parameter.name} {value!r}")
            numbers = [value] if parameter.kind in ("float", "int") else []
        else:
            demand(type(value) is list, f"{parameter.name} {value!r}")
            numbers = value if parameter.kind == "float_array" else []
            wanted = SIZES.get(parameter.length)
            demand(wanted in (None, len(value)), f"{parameter.name} has {len(value)} values")
        for number in numbers:
            demand(np.isfinite(number), f"{parameter.name} {number}")
            demand(parameter.low is None or number >= parameter.low, f"{parameter.name} too low")
            demand(parameter.high is None or number <= parameter.high, f"{parameter.name} too high")


class ParameterFiles(FileReader):
    """`parameter_files.load`, and the check of what it finds."""

    name, weight, error, suffix = "parameter file", 0.8, ParameterError, ".yaml"

    def __init__(self):
        super().__init__()
        self.texts = [p.read_bytes() for p in sorted(parameter_files.directory().glob("*.yaml"))]
        self.trees = [yaml.safe_load(text) for text in self.texts]
        controllers = controller.parameter_groups()
        self.declared = [
            (prefix.rstrip("."), group) for prefix, group in controllers.items() if prefix
        ]

    def make(self, rng):
        at = rng.randrange(len(self.texts))
        if rng.random() < 0.3:
            return odd.mangled(rng, self.texts[at])
        known = ("controller", "/**", "ros__parameters", "slow", "fast", "kp", "type")
        return dump(odd.altered(rng, copy.deepcopy(self.trees[at]), known=known))

    def read(self, given):
        self.path.write_bytes(given)
        nodes = parameter_files.load(self.path)
        for prefix, group in self.declared:
            found = assembly.under(nodes["controller"], prefix)
            names = {p.name for p in group}
            check_all(group, {k: v for k, v in found.items() if k in names}, None, f"{prefix}.")
        return nodes

    def check(self, given, result):
        demand(set(result) == set(parameter_files.PREFIXES), "nodes")
        for values in result.values():
            demand(all(isinstance(name, str) for name in values), "names that are no text")


class Csv(FileReader):
    """`recording.read_csv`."""

    name, weight, suffix = "recording CSV", 1.0, ".csv"

    def __init__(self):
        super().__init__()
        self.arm = arm_file.load("two_link")
        self.head = recording.columns(self.arm)
        rng = np.random.default_rng(1)
        table = rng.uniform(-1.0, 1.0, (25, len(self.head)))
        table[:, 0] = 0.001 * np.arange(25)
        self.table = table.tolist()

    def make(self, rng):
        rows = [list(self.head), *(list(map(repr, row)) for row in self.table)]
        for _ in range(rng.randint(0, 3)):
            row = rng.choice(rows)
            word = (
                repr(odd.floating(rng)) if rng.random() < 0.6 else odd.text(rng, tuple(self.head))
            )
            row[rng.randrange(len(row))] = word
            if rng.random() < 0.2:
                row.pop()
        out = io.StringIO()
        csv.writer(out).writerows(rows)
        text = out.getvalue().encode(errors="replace")
        return odd.mangled(rng, text) if rng.random() < 0.4 else text

    def read(self, given):
        self.path.write_bytes(given)
        return recording.read_csv(self.path, self.arm)

    def check(self, given, result):
        check_recording(result, self.arm)


def check_recording(made, arm):
    """Check what an identification relies on."""
    rows = len(made.position)
    demand(rows >= 20 and 0.0 < made.period < np.inf, f"{rows} rows of {made.period} s")
    demand(made.position.shape == (rows, len(arm.joints)), "position")
    demand(made.torque.shape == (rows, len(arm.joints)), "torque")
    demand(made.strain.shape == (rows, len(arm.gauges)), "strain")
    known = np.isfinite(made.torque).all(axis=1)
    demand(np.isfinite(made.position).all() and known.all() == known.any(), "not finite")


def spoilt_run(rng, arm, rows):
    """Messages of a run, a few of them spoilt."""
    out = []
    for k in range(rows):
        msg = good_state(rng, arm)
        msg.sequence = k
        msg.header.stamp.sec, msg.header.stamp.nanosec = 1, 1_000_000 * k
        out.append(msg)
    for _ in range(rng.randint(0, 3)):
        spoil_state(rng, rng.choice(out))
    if rng.random() < 0.1:
        del out[rng.randint(0, rows) :]
    return out


class Messages(Reader):
    """The messages of a bag: decoded, and made a `Recording`."""

    name, weight, ROWS = "recording messages", 0.5, 24

    def __init__(self):
        self.arm = arm_file.load("two_link")

    def make(self, rng):
        states = spoilt_run(rng, self.arm, self.ROWS)
        mode = rng.choice((1, 1, 0, 7))
        torques = [
            JointTorque(session=7, sequence=m.sequence, mode=mode)
            for m in states
            if rng.random() < 0.98
        ]
        return states, rng.choice((torques, []))

    def read(self, given):
        names = ("arm_state", "joint_torque")
        raw = {
            name: [serialize_message(m) for m in messages]
            for name, messages in zip(names, given, strict=True)
        }
        return of_contents(bag.from_messages(raw, self.arm), self.arm)

    def check(self, given, result):
        check_recording(result, self.arm)


class Driver(Reader):
    """``check_driver`` on a driver's messages: it must return findings and never raise an error."""

    name, weight, error, ROWS = "check_driver", 0.5, (), 12

    def __init__(self):
        self.arm = arm_file.load("two_link")

    def make(self, rng):
        return spoilt_run(rng, self.arm, self.ROWS)

    def read(self, given):
        found = listening.check_layout(self.arm, given)
        if given and not any(f.verdict is Verdict.FAIL for f in found):
            received = [Received(m, 0.001 * k, 10**9 + 10**6 * k) for k, m in enumerate(given)]
            found.append(listening.check_finite(self.arm, samples(self.arm, received)))
        return found

    def check(self, given, result):
        for finding in result:
            demand(isinstance(finding.verdict, Verdict), "verdict")
            demand(0 < len(finding.text) <= self.MAX_LENGTH, f"{len(finding.text)} characters")
