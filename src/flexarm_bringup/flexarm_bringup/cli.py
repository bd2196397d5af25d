# SPDX-License-Identifier: Apache-2.0
"""The command line: ``./flexarm``, or ``ros2 run flexarm_bringup flexarm``.

`COMMANDS` lists the commands. A command's module is imported only when that command is used, so that ``--help`` is
quick and commands that need no ROS work without it.
"""

import argparse
import difflib
import importlib
import os
import re
import signal
import sys
from dataclasses import dataclass

from flexarm_dynamics.errors import FlexarmError

#: Below the options of every command.
EXIT_CODES = (
    "exit code: 0 done, 1 an error or a failed check, reported on standard error, 2 wrong usage, 130 Ctrl-C,"
    " 143 terminated"
)


@dataclass(frozen=True)
class Command:
    """A sub-command.

    Attributes
    ----------
    module : str
        Where its functions are.
    run : str
        Function that runs it, called with the parsed options. What it returns is the exit code.
    help : str
        What it does, in a line.
    arguments : str
        Function that gives a parser its description, its examples (the epilog) and its arguments.
    """

    module: str
    run: str
    help: str
    arguments: str = "add_arguments"

    def __call__(self, options):
        """Run it; what its function returns is the exit code."""
        return self._function(self.run)(options)

    def add_arguments(self, parser):
        """Give a parser its arguments."""
        self._function(self.arguments)(parser)

    def _function(self, name):
        if self.module.startswith("benchmarks."):
            _find_benchmarks()
        return getattr(importlib.import_module(self.module), name)


def _find_benchmarks():
    """Make the benchmarks importable: they are part of a checkout, not of an installed package."""
    root = os.environ.get("FLEXARM_ROOT", "")
    if not os.path.isdir(os.path.join(root, "benchmarks")):
        hint = "run this command as ./flexarm in a checkout of flexarm"
        raise FlexarmError("the benchmarks are not installed", hint=hint)
    if root not in sys.path:
        sys.path.append(root)


COMMANDS = {
    "demo": Command(
        "flexarm_tools.case_study.demo",
        "run_demo",
        "run the paper's case study with three nodes; figures, bags and a table beside the published numbers",
    ),
    "simulate": Command(
        "flexarm_tools.simulate",
        "simulate",
        "simulate an arm under given torques, moved as prescribed, or under a controller",
    ),
    "frequencies": Command(
        "flexarm_studies.commands.inspect_arm",
        "frequencies",
        "natural frequencies of an arm, joints locked or free",
        "add_frequency_arguments",
    ),
    "show": Command(
        "flexarm_studies.commands.inspect_arm",
        "show",
        "masses, inertias, modes, frequencies, gauges and warnings of an arm file",
        "add_show_arguments",
    ),
    "urdf": Command(
        "flexarm_studies.commands.urdf_file",
        "urdf",
        "the arm as a URDF whose links bend: chains of short rigid pieces",
    ),
    "gauges": Command(
        "flexarm_studies.commands.gauges",
        "gauges",
        "how well the strain gauges tell the modes, and where they would do it best",
    ),
    "observers": Command(
        "flexarm_studies.commands.observer_table",
        "observers",
        "errors of the observers of an arm, by noise, rate and delay",
    ),
    "robustness": Command(
        "flexarm_studies.commands.robustness",
        "robustness",
        "which other arms, how many lost samples, and how much random delay, a loop bears",
    ),
    "analyze": Command(
        "flexarm_studies.analysis.command",
        "analyze",
        "time scales, a bound on mu, margins, domain of attraction and Monte Carlo of a design",
    ),
    "design": Command(
        "flexarm_studies.commands.design",
        "design",
        "a controller file for an arm, made for what may differ from the arm file",
    ),
    "attack": Command(
        "flexarm_studies.attack.command",
        "attack",
        "a driver that lies, users and strangers that interfere: what the arm does until it rests",
    ),
    "compare": Command(
        "flexarm_studies.comparison.command",
        "compare",
        "controllers and tuned baselines on plants that are not their models, and on their models: who wins what",
    ),
    "arms": Command(
        "flexarm_studies.random_arms.command",
        "arms",
        "random arms under several controllers, on plants that are not their models: how many settle, and when",
    ),
    "vibration": Command(
        "flexarm_studies.vibration.command",
        "vibration",
        "arms behind a position loop: how much they swing after motions, shaped and not",
    ),
    "publish": Command(
        "flexarm_tools.publish_trajectory",
        "publish",
        "publish a trajectory to a running controller",
    ),
    "check_driver": Command(
        "flexarm_tools.check_driver.command",
        "check_driver",
        "whether a running driver keeps its contract; with --allow-motion, whether its arm moves rightly",
    ),
    "identify": Command(
        "flexarm_tools.identification.command",
        "identify",
        "find an arm's parameters, with intervals, from a recorded motion",
    ),
    "excite": Command(
        "flexarm_tools.identification.excite",
        "excite",
        "shake a running arm to identify it by, and record a bag",
    ),
    "record": Command(
        "flexarm_tools.recording.record",
        "record",
        "record the topics of a running arm to a bag, driver or simulator, until Ctrl-C",
    ),
    "recording": Command(
        "flexarm_tools.recording.show",
        "recording",
        "what a recording shows, a bag or a CSV file: gaps, rest, noise, drift, delays, ring-downs, spectra",
    ),
    "resonance": Command(
        "flexarm_tools.resonance.command",
        "resonance",
        "frequencies and damping of what rings in an arm, and the shaper that takes it out; no arm file",
    ),
    "replay": Command(
        "flexarm_tools.replay.command",
        "replay",
        "publish a recording as a driver does: observer, view and report run on it; no torque is applied",
    ),
    "report": Command(
        "flexarm_tools.report.command",
        "report",
        "what recorded runs show, on one page of HTML: numbers, figures, animation; several are compared",
    ),
    "view": Command(
        "flexarm_tools.view.command",
        "view",
        "an arm in the browser, live: its shape, errors, torques; gains, motions and stops by hand",
    ),
    "run": Command(
        "flexarm_tools.running.processes",
        "run",
        "start one node, as `ros2 run` does, without a ROS installation",
    ),
    "latency": Command(
        "benchmarks.latency.command",
        "latency",
        "measurement to torque of the running loop, beside a bare relay of the same messages",
    ),
    "parameters": Command(
        "flexarm_tools.parameter_tables",
        "parameters",
        "tables of all parameters, from their declarations",
    ),
}


class Help(argparse.HelpFormatter):
    """Leaves examples as they are, one per line, to be copied; wraps all other text."""

    def _fill_text(self, text, width, indent):
        lines = []
        for line in text.splitlines():
            keep = line.startswith(("example", "  "))
            lines.append(indent + line if keep else super()._fill_text(line, width, indent))
        return "\n".join(lines)


def parser(only=None):
    """The argument parser.

    Parameters
    ----------
    only : str, optional
        The command whose arguments are wanted; the others are listed by name and help alone. Not given: all of them.
    """
    top = argparse.ArgumentParser(
        prog="flexarm",
        description="Models, simulates, observes and controls arms whose links bend.",
    )
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        sub = commands.add_parser(name, help=command.help, formatter_class=Help)
        if only in (None, name):
            command.add_arguments(sub)
            sub.epilog += f"\n{EXIT_CODES}"
            sub.set_defaults(function=command)
    return top


def refuse_unknown(name):
    """Exit as for wrong usage if there is no such command, and suggest a similar one."""
    if not name or name.startswith("-") or name in COMMANDS:
        return
    near = difflib.get_close_matches(name, COMMANDS, 1)
    hint = f"did you mean {near[0]}?" if near else "flexarm --help lists the commands"
    parser(only=name).error(f"{name!r} is no command; {hint}")


#: Options whose value may begin with a minus.
ANGLES = ("--at", "--initial", "--to", "--from", "--tip", "--via")


def bind_angles(words):
    """Join ``--at -1,2`` to ``--at=-1,2``: argparse would read the angles as an option."""
    out = []
    for word in words:
        if out and out[-1] in ANGLES and re.match(r"-[\d.]", word):
            out[-1] += f"={word}"
        else:
            out.append(word)
    return out


def _has_ros():
    try:
        importlib.import_module("rclpy")
    except ImportError:
        return False
    return True


def main(argv=None):
    """Entry point; exit code 0, 1 for an error that has been reported, 2 for wrong usage."""
    words = bind_angles(sys.argv[1:] if argv is None else argv)
    name = words[0] if words else ""
    # Like Ctrl-C: started processes are stopped on the way out.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        refuse_unknown(name)
        # --help needs no command's arguments.
        options = parser(only=name).parse_args(words)
        code = options.function(options)
    except BrokenPipeError:  # the reader has enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except (FlexarmError, OSError) as error:
        print(f"flexarm {name}: {error}", file=sys.stderr)
        sys.exit(1)
    except ImportError as error:
        if _has_ros():
            raise
        print(
            f"flexarm {name}: needs ROS 2, which is not installed here ({error})", file=sys.stderr
        )
        print("a checkout of flexarm sets it up: there, type ./flexarm " + name, file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("\nstopped", file=sys.stderr)
        sys.exit(130)
    sys.exit(code if isinstance(code, int) else 0)


def entry():
    """Entry point of the process."""
    from flexarm_ros.start import leave_after

    leave_after(main)


if __name__ == "__main__":
    entry()
