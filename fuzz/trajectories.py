# SPDX-License-Identifier: Apache-2.0
"""Readers of motions: messages, files, written motions, and the reference that follows them."""

import copy
from array import array

import numpy as np
import yaml

from flexarm_control import trajectory
from flexarm_control.trajectory import ReferenceGenerator, files, specs
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import TrajectoryError
from flexarm_dynamics.models import model

from . import odd
from .reader import FileReader, Reader, demand

JOINTS = ("joint1", "joint2")
LOW, HIGH, FASTEST = (-3.0, -2.0), (3.0, 2.0), (4.0, 5.0)
POINT_WORDS = ("positions", "velocities", "accelerations", "effort", "time_from_start", "position")
WORDS = (*POINT_WORDS, "velocity", "points", "joint", "stamp", "trajectory", "line")


def good_points(rng, joints=JOINTS):
    """Points as the controller passes them on: integer times, arrays of messages."""
    n, fields = len(joints), rng.randint(1, 3)
    time, points = 0, []
    for _ in range(rng.randint(1, 5)):
        time += rng.randint(1, 3) * 500_000_000
        values = [array("d", [rng.uniform(-0.4, 0.4) for _ in range(n)]) for _ in range(fields)]
        values += [array("d")] * (4 - fields)
        points.append([time, *values])
    for field in (2, 3):
        if len(points[-1][field]):
            points[-1][field] = array("d", [0.0] * n)
    return points


def spoil_points(rng, points):
    """Change a few entries of points, in place."""
    for _ in range(rng.choice((1, 1, 2))):
        if not points:
            break
        at, kind = rng.randrange(len(points)), rng.randrange(10)
        point = points[at]
        if not isinstance(point, list) or len(point) != 5:
            continue  # spoilt already
        if kind < 4:
            field = rng.randint(1, 4)
            point[field] = odd.floats(rng, point[field])
        elif kind < 6:
            point[0] = rng.choice((*odd.INTS, *odd.HUGE_INTS, -5, 10**9))
        elif kind == 6:
            point[rng.randint(0, 4)] = odd.anything(rng)
        elif kind == 7:
            del points[at]
        elif kind == 8:
            points.insert(at, list(point))
        else:
            points[at] = odd.anything(rng)
    return points


def check_trajectory(made, joints, low, high, fastest):
    """Check what the reference relies on."""
    n, times = len(joints), made.times_ns
    demand(made.joint_names == tuple(joints), "joints")
    demand(times.dtype == np.int64 and times[0] >= 0, f"times {times}")
    demand((np.diff(times) > 0).all(), "times that do not increase")
    demand(made.stamp_ns >= 0 and made.stamp_ns + int(times[-1]) < 2**63, "stamps beyond int64")
    for field in (made.positions, made.velocities, made.accelerations):
        if field is not None:
            demand(field.shape == (times.size, n), f"shape {field.shape}")
            demand(np.isfinite(field).all() and np.abs(field).max() <= 1e9, "values")
    demand((made.positions >= low).all() and (made.positions <= high).all(), "position limits")
    if made.velocities is not None:
        demand((np.abs(made.velocities) <= fastest).all(), "velocity limits")
        demand(np.abs(made.velocities[-1]).max() < 1e-6, "it does not end at rest")
    demand(made.velocities is not None or made.accelerations is None, "fields")


class Points(Reader):
    """`trajectory.validate`, with values that a message can hold and with others."""

    name, weight, error, words = "trajectory message", 16.0, TrajectoryError, WORDS

    def make(self, rng):
        points = good_points(rng)
        joints, stamp = list(JOINTS), rng.choice((0, 0, 10**9))
        kind = rng.randrange(8)
        if kind == 0:
            joints = odd.names(rng, joints)
        elif kind == 1:
            stamp = odd.scalar(rng)
        elif kind == 2:
            joints = odd.anything(rng, known=JOINTS)
        else:
            points = spoil_points(rng, points)
        if rng.random() < 0.9:
            points = [tuple(p) if isinstance(p, list) else p for p in points]
        return joints, stamp, points if rng.random() < 0.98 else odd.anything(rng)

    def read(self, given):
        joints, stamp, points = given
        return trajectory.validate(joints, JOINTS, stamp, points, LOW, HIGH, FASTEST)

    def check(self, given, result):
        check_trajectory(result, JOINTS, LOW, HIGH, FASTEST)
        joints, _, points = given
        for k, point in enumerate(points):
            wanted = [point[1][joints.index(name)] for name in JOINTS]
            demand(result.positions[k].tolist() == [float(v) for v in wanted], "joint order")


class Reference(Reader):
    """`ReferenceGenerator`: any offers, stops and stamps, one after the other."""

    name, weight, batch = "reference", 8.0, 10

    def run(self, rng):
        fastest = rng.choice((None, FASTEST))
        reference = ReferenceGenerator(JOINTS, 0.01, fastest, rng.choice((0.0, 0.5)))
        refused, now = 0, rng.choice((0, 10**9, 2**62))
        velocity = rng.choice((None, [rng.uniform(-1.0, 1.0) for _ in JOINTS]))
        reference.start([rng.uniform(-0.4, 0.4) for _ in JOINTS], now, velocity)
        self.given = history = [("start", now, velocity)]
        for _ in range(self.batch):
            kind = rng.randrange(6)
            if kind == 0:
                refused += self._stop(rng, reference, now, history)
            elif kind < 4:
                refused += self._offer(rng, reference, now, history)
            for _ in range(2):
                now = min(now + rng.choice((0, 1, 10**6, 10**9, 10**12)), 2**63 - 1)
                history.append(("sample", now))
                reference.sample(now)
                demand(np.isfinite(_numbers(reference)).all(), "a reference that is not finite")
                demand(np.isfinite(reference.near(0.01)).all(), "near is not finite")
        return refused

    def _stop(self, rng, reference, now, history):
        deceleration = rng.choice((1.0, 20.0, [1.0, 2.0], 1e-9, *odd.FLOATS, [1.0], "a", None))
        given = rng.random() < 0.5
        history.append(("stop", now, deceleration, given))
        before = _numbers(reference)
        try:
            reference.stop(now, deceleration, given)
        except TrajectoryError as error:
            self.check_message(error)
            demand(np.array_equal(before, _numbers(reference)), "a refused stop has moved it")
            return 1
        return 0

    def _offer(self, rng, reference, now, history):
        points, stamp = good_points(rng), rng.choice((0, 0, now, max(0, now - 5), now + 10**9))
        if rng.random() < 0.5:
            points = spoil_points(rng, points)
        history.append(("offer", stamp, copy.deepcopy(points)))
        try:
            made = trajectory.validate(JOINTS, JOINTS, stamp, [tuple(p) for p in points])
        except TrajectoryError:
            return 1
        except TypeError:  # a point that is no sequence: `tuple` raises it here, not the reader
            return 1
        before = (*_numbers(reference), reference.pending)
        verdict = reference.offer(made)
        demand(verdict.reason, "a verdict without a reason")
        if not verdict.accepted:
            demand(before == (*_numbers(reference), reference.pending), "a refused offer counts")
        return not verdict.accepted


def _numbers(reference):
    state = (reference.position, reference.velocity, reference.acceleration)
    flags = (reference.active, reference.finished, reference.stopping, reference.accepted_id)
    return (*np.concatenate(state).tolist(), *map(float, flags))


class _Files(FileReader):
    """Files of a trajectory: good ones with bytes or entries changed."""

    error, words = TrajectoryError, (*WORDS, "YAML", ".yaml", ".csv", "column")

    def read(self, given):
        self.path.write_bytes(given)
        return files.read(self.path, JOINTS, LOW, HIGH, FASTEST)

    def check(self, given, result):
        check_trajectory(result, JOINTS, LOW, HIGH, FASTEST)


class YamlFiles(_Files):
    """`trajectory.files`, YAML."""

    name, weight, suffix = "trajectory YAML", 1.5, ".yaml"

    def make(self, rng):
        points = []
        for time, positions, velocities, accelerations, _ in good_points(rng):
            point = {"positions": list(positions), "velocities": list(velocities)}
            point["accelerations"] = list(accelerations)
            sec, nanosec = divmod(time, 10**9)
            points.append(point | {"time_from_start": {"sec": sec, "nanosec": nanosec}})
        tree = {"joint_names": list(JOINTS), "points": points}
        if rng.random() < 0.5:
            odd.altered(rng, tree, known=(*JOINTS, *POINT_WORDS))
        text = dump(tree)
        return odd.mangled(rng, text) if rng.random() < 0.5 else text


class CsvFiles(_Files):
    """`trajectory.files`, CSV."""

    name, weight, suffix = "trajectory CSV", 4.0, ".csv"

    def make(self, rng):
        rows = ["t,q1,q2,qd1,qd2"]
        for time, positions, *_ in good_points(rng):
            rows.append(",".join(map(repr, [time * 1e-9, *positions, 0.0, 0.0])))
        if rng.random() < 0.5:
            at = rng.randrange(len(rows))
            words = rows[at].split(",")
            words[rng.randrange(len(words))] = str(
                odd.text(rng, ("t", "q1", "qd2", "nan", "1e400"))
            )
            rows[at] = ",".join(words)
        text = "\n".join(rows).encode(errors="replace")
        return odd.mangled(rng, text) if rng.random() < 0.6 else text


class Written(Reader):
    """`specs.from_spec`: motions written in a line."""

    name, weight = "written motion", 0.3
    GOOD = (
        "quintic:to=0.5;0.3,duration=2,points=11",
        "paper:to=0.5,duration=1.5,points=21",
        "smooth:to=0.2;0.2,smoothness=3,points=5",
        "quintic:from=0.1;0.1,to=0.4,duration=1,points=9",
        "line:tip=0.6;0.6;0.0,duration=2,points=5",
        "arc:tip=0.6;0.6;0.0,via=0.7;0.5;0.0,points=4",
        "quintic:to=0.3,shaper=zv,shape-modes=1,points=7",
        "quintic:to=0.3,shaper=zvd,points=7",
    )

    def __init__(self):
        self.model = model.build(arm_file.load("two_link"))

    def make(self, rng):
        family, _, rest = rng.choice(self.GOOD).partition(":")
        settings = [item.split("=") for item in rest.split(",")]
        for _ in range(rng.randint(1, 2)):
            kind, at = rng.randrange(5), rng.randrange(len(settings))
            if kind < 3:
                words = ("1", "0", "-1", "1e-9", "0.5;0.5", "3;3;3", "7", "99")
                settings[at][-1] = rng.choice((*words, odd.text(rng), str(odd.floating(rng))))
            elif kind == 3:
                settings[at][0] = odd.text(
                    rng, ("to", "duration", "points", "shaper", "tip", "from")
                )
            elif rng.random() < 0.3:
                family = odd.text(rng, tuple(specs.FAMILIES))
        made = f"{family}:" + ",".join("=".join(item) for item in settings)
        # Optimising a motion takes seconds, so it is only parsed here.
        return made if not made.strip().startswith("least") else made + ",to"

    def read(self, given):
        return specs.from_spec(given, self.model)

    def check(self, given, result):
        check_trajectory(result, self.model.joint_names, *specs.limits(self.model))


def dump(tree):
    """YAML of a tree with anything in it, as bytes."""
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    try:
        return yaml.dump(tree, Dumper=dumper, sort_keys=False).encode(errors="replace")
    except ValueError:  # an integer that Python does not write in decimals
        return b"points: [0x" + b"f" * 5000 + b"]\n"
