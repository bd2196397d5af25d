# SPDX-License-Identifier: Apache-2.0
r"""``flexarm latency``: from measurement to torque, in real time, beside a bare relay of the same messages.

A loop consists of the shipped nodes with the shipped control and a moving arm: simulator, observer and controller as
three processes, or observer and controller in one. In the relay (`flexarm_tools.running.relay`), two plain nodes answer
each message with a ready-made one of the same type, size and quality of service. The same simulator, with the same
plant, sends the relay's states. Latency is measured in the simulator's process, on its steady clock: from just before
the state is published to the callback of the torque that answers it. Relay and loops take turns in short windows of one
run, so other load on the machine slows all of them. The result is the ratio of each round's medians.
"""

import contextlib
import json
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies import markdown
from flexarm_studies.loop import parameter_files

from . import processor

#: Percentiles of the latency.
NAMES = ("p50", "p95", "p99")
#: Chains that take turns: the processes beside the simulator, and whether they are nodes of the loop.
CHAINS = {
    "relay": ("observer", "controller"),
    "three processes": ("observer", "controller"),
    "observer and controller in one": ("observer_controller",),
}


@dataclass(frozen=True)
class Case:
    """One arm, control and rate.

    Attributes
    ----------
    arm : str
    file : str
        Controller file; empty: the nodes' defaults.
    rate : float
        [Hz]
    begin, end : tuple of float
        Endpoints of the motion [rad].
    window : float
        Duration of one window [s].
    pace : float
        Simulated seconds per second.
    """

    arm: str
    file: str
    rate: float
    begin: tuple
    end: tuple
    window: float
    pace: float = 1.0

    @property
    def name(self):
        """Name of the case in tables."""
        pace = "" if self.pace == 1.0 else f" x {self.pace:g}"
        return f"{self.arm}, {self.rate:g} Hz{pace}"


R = {"arm": "R", "file": "", "begin": (0.0,), "end": (1.5,)}
LONG_REACH = {
    "arm": "long_reach",
    "file": "long_reach",
    "begin": (0.0, 1.2, 0.8, -0.8),
    "end": (1.0472, 0.1528, 1.8472, 0.2472),
}
CASES = (
    *(Case(**R, rate=rate, window=1.5) for rate in (200.0, 500.0, 1000.0)),
    # The controller plans a motion of this arm for seconds when it receives it, so one motion of two seconds serves all
    # windows. The arm tolerates no torque that is late by more than a period, so the simulation runs slower than
    # real time: the control then works on a busy machine, too.
    Case(**LONG_REACH, rate=500.0, window=1.6, pace=0.25),
)


#: Limits are opened: a machine that is too slow must show in the latencies, and must not stop the arm.
OPEN = {
    "state_timeout": 60.0,
    "max_gap": 60.0,
    "tracking_error_limit": 100.0,
    "velocity_margin": 100.0,
    "position_margin": 10.0,
    "saturation_time": 1e4,
    "limit_patience": 1e3,
}


class Chain:
    """One loop or relay on a domain of its own, paused between windows."""

    #: Timeout of a single wait [s].
    PATIENCE = 180.0

    def __init__(self, stack, name, case, directory, relay_spin):
        from flexarm_ros.session import Session
        from flexarm_tools.running.processes import Processes, own_domain

        self.name, self.case = name, case
        self.processes = stack.enter_context(
            Processes(stack.enter_context(own_domain()), directory / name)
        )
        self._start(relay_spin)
        self.session = stack.enter_context(
            Session(
                "latency",
                domain=self.processes.domain,
                processes=self.processes,
                patience=self.PATIENCE,
                period=0.05,
            )
        )
        self.session.ask_again = self.PATIENCE  # a design takes long, and must be made only once
        self.wait_for = self.session.wait_for

    def _start(self, relay_spin):
        from flexarm_tools.running import relay
        from flexarm_tools.running.processes import arguments

        case, start = self.case, self.processes.start_module
        file = parameter_files.find(case.file) if case.file else None
        given = {"arm": case.arm, "rate": case.rate, "real_time_factor": case.pace}
        given["initial_position"] = list(case.begin)
        timed = f"{__package__}.nodes"
        start("simulator", timed, "simulator", *arguments(given, file))
        for role in CHAINS[self.name]:
            if self.name == "relay":
                start(role, relay.__name__, role, case.arm, relay_spin)
            else:
                given = {"arm": case.arm, "rate": case.rate, **OPEN}
                start(role, timed, role, *arguments(given, file))

    def get_ready(self):
        """Wait for the nodes. The first calls, which load code, are not measured."""
        for topic in ("arm_state", "arm_state_estimate", "joint_torque"):
            self.wait_for(
                f"a publisher of {topic}", lambda t=topic: self.session.node.count_publishers(t)
            )
        wanted = "latencies" if self.name == "relay" else "enabled"
        self.wait_for("a torque", lambda: self.window(0.2)[wanted])

    def pause(self, paused):
        """Call the simulator's `~/pause`."""
        from std_srvs.srv import SetBool

        self.session.call(SetBool, "simulator/pause", data=paused)

    def offer(self, duration):
        """Offer a motion of this `duration` [s], which begins with the next window."""
        from trajectory_msgs.msg import JointTrajectory

        from flexarm_control.motions.profiles import quintic
        from flexarm_msgs.msg import CompositeState
        from flexarm_tools.running.lockstep import trajectory_message

        states = self.session.tap(CompositeState, "controller/state").messages
        self.wait_for("the controller to be ready", lambda: any(s.supervisor_state for s in states))
        joints = arm_file.load(self.case.arm).joint_names
        profile = quintic(np.array(self.case.begin), np.array(self.case.end), duration)
        publisher = self.session.publisher(JointTrajectory, "joint_trajectory", readers=1)
        publisher.publish(trajectory_message(joints, profile))
        del states[:]
        self.wait_for(
            "the motion to be accepted",
            lambda: any(s.accepted_trajectory_id for s in states[-3:]),
        )
        self.session.untap("controller/state")

    def window(self, seconds):
        """Run for this number of `seconds`; return what the simulator measured."""
        before, meter = len(self.figures()), processor.Meter(self.processes.running)
        self.pause(False)
        time.sleep(seconds)
        self.pause(True)
        taken = meter.taken()
        found = self.wait_for("the simulator's figures", lambda: self.figures()[before:])
        return {**found[-1], "processor": taken}

    def figures(self):
        """What the simulator measured in each window so far."""
        return self._figures_of("simulator")

    def _figures_of(self, name):
        lines = self.processes.log(name).splitlines()
        return [json.loads(line) for line in lines if line.startswith("{") and line.endswith("}")]

    def mathematics(self):
        """End the processes; median time of one call of observer, controller and law [s]."""
        logs = CHAINS[self.name]
        self.processes.stop()
        found = {}
        for name in logs:
            for times_of in self._figures_of(name):
                for part, times in times_of.items():
                    # The first calls include the loading of code.
                    found[part] = statistics.median(times[20:] or times or [float("nan")])
        return found


def measure(case, rounds, chains, relay_spin, moving, fraction):
    """Measure a case in turns: chain to ``{"windows": [simulator's measurement …], "mathematics": {part: s}}``.

    Parameters
    ----------
    case : Case
    rounds : int
    chains : sequence of str
        Of `CHAINS`; the relay first.
    relay_spin : str
        How the relay's nodes are served: ``executor``, by rclpy; ``line``, as the loop's nodes are.
    moving : bool
        Whether the arm moves.
    fraction : callable
        Called with the fraction that is done, from 0 to 1.
    """
    out = {}
    with TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        made = [Chain(stack, name, case, Path(folder), relay_spin) for name in chains]
        for chain in made:
            chain.get_ready()
            if moving and chain.name != "relay":
                chain.offer((rounds + 0.5) * case.window * case.pace)
        for chain in made:
            out[chain.name] = {"windows": []}
        for i in range(rounds):
            # The order changes each time, so that no chain always comes first.
            for chain in made[i % len(made) :] + made[: i % len(made)]:
                out[chain.name]["windows"].append(chain.window(case.window))
            fraction((i + 1) / rounds)
        for chain in made:
            out[chain.name]["mathematics"] = chain.mathematics()
    return out


def percentiles(windows):
    """Percentiles `NAMES` of the latency in each window, shape (windows, 3) [s]."""
    return np.array([np.percentile(w["latencies"], (50.0, 95.0, 99.0)) for w in windows])


def medians(values):
    """Medians over the windows of `values`, as `percentiles` returns them, by `NAMES`."""
    return dict(zip(NAMES, np.median(values, axis=0).tolist(), strict=True))


def summary(case, found):
    """Rows of the table of one case, and the numbers behind them.

    `found` is what `measure` returned.

    Returns
    -------
    list of dict
        One for each chain; times in milliseconds.
    """
    for name, chain in found.items():
        for window in chain["windows"]:
            if not window["latencies"]:
                raise FlexarmError(f"no torque came back in a window of {name}", field=case.name)
    bare = percentiles(found["relay"]["windows"])
    rows = []
    for name, chain in found.items():
        windows = chain["windows"]
        each = percentiles(windows)
        answered = sum(len(w["latencies"]) for w in windows)
        sent = answered + sum(w["missed"] for w in windows)
        row = {
            "case": case.name,
            "arm": case.arm,
            "rate": case.rate,
            "chain": name,
            "rounds": len(windows),
            "samples": answered,
            "latency_ms": medians(1e3 * each),
            "ratio": medians(each / bare),
            "missed": sum(w["missed"] for w in windows) / max(sent, 1),
            "lost": sum(w["lost"] for w in windows) / max(sent, 1),
            "enabled": sum(w["enabled"] for w in windows) / answered,
        }
        relay = found["relay"]["windows"]
        row["processor_ms"], row["processor_ratio"] = processor.summary(windows, relay)
        base = float(np.median(bare[:, 0]))
        for part, seconds in chain.get("mathematics", {}).items():
            row[f"{part}_ms"] = 1e3 * seconds
            row[f"{part}_share"] = seconds / base
        rows.append(row)
    return rows


def table(rows):
    """Markdown table of `summary` rows."""
    head = ("arm, rate", "", "p50 [ms]", "p95", "p99", "ratio of p50", "of p95", "late or missed")
    head += ("controller's step [ms]", "of relay's p50", "the law in it [ms]", "of relay's p50")
    lines = []
    for row in rows:
        t, r = row["latency_ms"], row["ratio"]
        cells = [row["case"], row["chain"], *(f"{t[p]:.2f}" for p in NAMES)]
        if row["chain"] == "relay":
            cells += ["1", "1"]
        else:
            cells += [f"{r['p50']:.2f}", f"{r['p95']:.2f}"]
        cells.append(f"{100.0 * row['missed']:.1f} %")
        for part in ("controller", "law"):
            took = row.get(f"{part}_ms")
            share = "" if took is None else f"{100 * row[f'{part}_share']:.0f} %"
            cells += ["" if took is None else f"{took:.3f}", share]
        lines.append(cells)
    return "\n".join(markdown.table(head, lines))
