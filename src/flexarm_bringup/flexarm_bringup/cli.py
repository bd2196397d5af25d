# SPDX-License-Identifier: Apache-2.0
"""The command line: ``./flexarm``, or ``ros2 run flexarm_bringup flexarm``."""

import argparse
import json
import os
import re
import signal
import sys

from flexarm_dynamics.errors import FlexarmError

#: Below the options of every command.
EXIT_CODES = (
    "exit code: 0 done, 1 an error or a failed check, said on standard error, 2 wrong usage, 130 Ctrl-C,"
    " 143 terminated"
)


class Help(argparse.HelpFormatter):
    """Leaves examples as they are, a line each, to be copied; fills the rest."""

    def _fill_text(self, text, width, indent):
        lines = []
        for line in text.splitlines():
            keep = line.startswith(("example", "  "))
            lines.append(indent + line if keep else super()._fill_text(line, width, indent))
        return "\n".join(lines)


def _demo(options):
    from .case_study import demo
    from .progress import Progress

    demo(options.out, Progress(), nodes=not options.without_ros, as_json=options.json)


def _publish(options):
    from .publish_trajectory import publish

    publish(options)


def _run(options):
    from .processes import executable

    path = executable(options.package, options.executable)
    os.execv(path, [path, *options.arguments])


def _simulate(options):
    from .simulate import simulate

    simulate(options)


def _frequencies(options):
    from .inspect_arm import frequencies

    frequencies(options)


def _show(options):
    from .inspect_arm import show

    show(options)


def _urdf(options):
    from .urdf_file import urdf

    urdf(options)


def _view(options):
    from .view.command import view

    view(options)


def _gauges(options):
    from .gauges import gauges

    gauges(options)


def _check_driver(options):
    from .check_driver.command import check_driver

    sys.exit(check_driver(options))


def _observers(options):
    from .observer_table import observers

    observers(options)


def _robustness(options):
    from .robustness import robustness

    robustness(options)


def _analyze(options):
    from .analysis.command import analyze

    analyze(options)


def _compare(options):
    from .comparison.command import compare

    compare(options)


def _identify(options):
    from .identification.command import identify

    identify(options)


def _excite(options):
    from .identification.excite import excite

    excite(options)


def _latency(options):
    from .latency import latency

    latency(options)


def _record(options):
    from .record import record

    record(options)


def _report(options):
    from .report.command import report

    report(options)


def _parameters(options):
    from .parameter_tables import plain, tables, write

    if options.write:
        write(options.write)
    elif options.json:
        print(json.dumps(plain(), indent=1))
    else:
        print(tables())


def parser():
    """The argument parser of all sub-commands."""
    top = argparse.ArgumentParser(
        prog="flexarm",
        description="Models, simulates, observes and controls arms whose links bend.",
    )
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    demo = commands.add_parser(
        "demo",
        help="run the paper's case study with three nodes; figures, bags and a table beside print",
        description="The case study of Siciliano & Book (1986): three nodes, seven runs, about a minute.",
        epilog="example: flexarm demo --out results/case_study",
    )
    demo.add_argument("--out", default="results/case_study", help="directory of the results")
    demo.add_argument(
        "--without-ros",
        action="store_true",
        help="the same objects in one process, no DDS, no bags",
    )
    demo.add_argument("--json", action="store_true", help="print summary.json, not the tables")
    demo.set_defaults(function=_demo)

    _add_arm_commands(commands)
    _add_analyze(commands)
    _add_compare(commands)

    from .publish_trajectory import add_arguments

    publish = commands.add_parser(
        "publish",
        help="publish a trajectory to a running controller",
        description="Publishes a motion on joint_trajectory once, and waits until it is received.",
        epilog="example: flexarm publish quintic --to 1.57 --duration 3",
    )
    add_arguments(publish)
    publish.set_defaults(function=_publish)

    from .check_driver.command import add_arguments as add_check_arguments

    check = commands.add_parser(
        "check_driver",
        help="whether a running driver keeps its contract; with --allow-motion, whether its arm moves rightly",
        description="Listens to a running driver (or simulator) and judges what it sends; with --allow-motion pushes"
        " each joint a little and compares with the model of the arm file. Exit code 1 when a check fails.",
        epilog="example: flexarm check_driver R --rate 200 --allow-motion",
    )
    add_check_arguments(check)
    check.set_defaults(function=_check_driver)

    _add_identification(commands)
    _add_record_and_report(commands)

    from .view.command import add_arguments as add_view_arguments

    view = commands.add_parser(
        "view",
        help="an arm in the browser, live: its shape, errors, torques; gains, motions and stops by hand",
        description="Starts simulator, observer and controller in real time, and a page on this machine that shows"
        " and handles them; with --attach, the page alone, of nodes that run.",
        epilog="examples:\n  flexarm view two_link\n  flexarm view R --attach --namespace left",
    )
    add_view_arguments(view)
    view.set_defaults(function=_view)

    run = commands.add_parser(
        "run",
        help="start one node, as `ros2 run` does, without a ROS installation",
        description="Starts an installed executable of the workspace; what follows it is passed on.",
        epilog="example: flexarm run flexarm_sim simulator --ros-args -p arm:=R",
    )
    run.add_argument("package")
    run.add_argument("executable")
    run.add_argument("arguments", nargs=argparse.REMAINDER)
    run.set_defaults(function=_run)

    from .latency import add_arguments as add_latency_arguments

    latency = commands.add_parser(
        "latency",
        help="measurement to torque of the running loop, beside a bare relay of the same messages",
        description="Runs loop and relay in real time, in turns, at several rates; three to four minutes.",
        epilog="example: flexarm latency --quick --json results/latency.json",
    )
    add_latency_arguments(latency)
    latency.set_defaults(function=_latency)

    parameters = commands.add_parser(
        "parameters",
        help="tables of all parameters, from their declarations",
        description="Prints every node's parameters as Markdown, or writes them between a file's markers.",
        epilog="example: flexarm parameters --write docs/parameters.md",
    )
    parameters.add_argument("--write", metavar="FILE", help="rewrite the tables of this file")
    parameters.add_argument("--json", action="store_true", help="print the declarations as JSON")
    parameters.set_defaults(function=_parameters)
    for command in commands.choices.values():
        command.formatter_class = Help
        command.epilog += f"\n{EXIT_CODES}"
    return top


def _add_arm_commands(commands):
    """What needs an arm file and no ROS."""
    from . import gauges, inspect_arm, observer_table, robustness, simulate, urdf_file

    command = commands.add_parser(
        "simulate",
        help="simulate an arm under given torques, moved as prescribed, or under a controller",
        description="Simulates an arm from rest: under torques over time, with its joints moved as prescribed, or"
        " in a loop with an observer and a controller, of which it tells how well they did.",
        epilog="examples:\n  flexarm simulate two_link --torque torque.csv --duration 4 --out run.csv"
        "\n  flexarm simulate R --controller paper_composite --trajectory paper --payload-scale 2",
    )
    simulate.add_arguments(command)
    command.set_defaults(function=_simulate)
    command = commands.add_parser(
        "frequencies",
        help="natural frequencies of an arm, joints locked or free",
        description="Undamped natural frequencies of the straight arm at given joint angles, gravity left out.",
        epilog="example: flexarm frequencies two_link --at 0,1.57 --locked",
    )
    inspect_arm.add_frequency_arguments(command)
    command.set_defaults(function=_frequencies)
    command = commands.add_parser(
        "show",
        help="masses, inertias, modes, frequencies, gauges and warnings of an arm file",
        description="Says what an arm file describes, and what to mind.",
        epilog="example: flexarm show long_reach --at 0,0.5,0,0 --plot",
    )
    inspect_arm.add_show_arguments(command)
    command.set_defaults(function=_show)
    command = commands.add_parser(
        "urdf",
        help="the arm as a URDF whose links bend: chains of short rigid pieces",
        description="Writes a URDF; the node shape publishes the joint states that bend it as the arm is bent.",
        epilog="example: flexarm urdf two_link --out two_link.urdf",
    )
    urdf_file.add_arguments(command)
    command.set_defaults(function=_urdf)
    command = commands.add_parser(
        "gauges",
        help="how well the strain gauges tell the modes, and where they would do it best",
        description="Noise and condition number of the present gauges, and the best positions on each link.",
        epilog="example: flexarm gauges R --count 3 --plot results/gauges.png",
    )
    gauges.add_arguments(command)
    command.set_defaults(function=_gauges)
    command = commands.add_parser(
        "observers",
        help="errors of the observers of an arm, by noise, rate and delay",
        description="Simulates an arm that is shaken, and compares what each observer makes of its samples.",
        epilog="example: flexarm observers R --rates 1000,250 --delays 0,0.01",
    )
    observer_table.add_arguments(command)
    command.set_defaults(function=_observers)
    command = commands.add_parser(
        "robustness",
        help="how many lost samples, and how much random delay, a loop bears",
        description="Carries out a motion with samples lost at random, and separately with random delays, at rising"
        " levels, and tells where the loop breaks.",
        epilog="example: flexarm robustness R --controller paper_composite --loss 0:0.1:0.9 --delay 0:4:40",
    )
    robustness.add_arguments(command)
    command.set_defaults(function=_robustness)


def _add_analyze(commands):
    from .analysis import command

    analyze = commands.add_parser(
        "analyze",
        help="time scales, a bound on mu, margins, domain of attraction and Monte Carlo of a design",
        description="What can be said of an arm and a controller before the arm moves; some of it by short runs.",
        epilog="example: flexarm analyze R paper_composite --out results/analysis --monte-carlo 100",
    )
    command.add_arguments(analyze)
    analyze.set_defaults(function=_analyze)


def _add_compare(commands):
    from .comparison import command

    compare = commands.add_parser(
        "compare",
        help="composite control beside joint PID, input shaping, LQR and rigid adaptive control, all tuned alike",
        description="Runs every controller on the same arms, motions, limits and sensors, and writes a table.",
        epilog="example: flexarm compare --arms R --json results/compare.json",
    )
    command.add_arguments(compare)
    compare.set_defaults(function=_compare)


def _add_identification(commands):
    from .identification import command, excite

    identify = commands.add_parser(
        "identify",
        help="find an arm's parameters, with intervals, from a recorded motion",
        description="Fits the arm file's model to a bag or CSV file: stiffness, damping, inertias, payload, friction,"
        " gauges, each with its 95 % interval; writes an arm file with them.",
        epilog="example: flexarm identify results/sweep my_arm.yaml --out identified.yaml --plot fit.png",
    )
    command.add_arguments(identify)
    identify.set_defaults(function=_identify)
    shake = commands.add_parser(
        "excite",
        help="shake a running arm to identify it by, and record a bag",
        description="Runs the node `excite` on a running driver or simulator; records while its torque is applied.",
        epilog="example: flexarm excite my_arm.yaml --kind sweep --amplitude 2 --out results/sweep --allow-motion",
    )
    excite.add_arguments(shake)
    shake.set_defaults(function=_excite)


def _add_record_and_report(commands):
    from . import record
    from .report import command

    take = commands.add_parser(
        "record",
        help="record the topics of a running arm to a bag, driver or simulator, until Ctrl-C",
        description="Subscribes to the arm's topics and writes what comes to a rosbag2 bag (MCAP), with the arm file in"
        " it; nothing of the running nodes changes.",
        epilog="example: flexarm record --out results/run1 --duration 20",
    )
    record.add_arguments(take)
    take.set_defaults(function=_record)
    tell = commands.add_parser(
        "report",
        help="what recorded runs show, on one page of HTML: numbers, figures, animation; several are compared",
        description="Reads bags of `flexarm record`, `flexarm simulate --bag`, `flexarm demo` or `ros2 bag record`, and"
        " writes one page that needs no network.",
        epilog="example: flexarm report results/run1 results/run2 --out results/report.html",
    )
    command.add_arguments(tell)
    tell.set_defaults(function=_report)


#: Options whose value may begin with a minus.
ANGLES = ("--at", "--initial", "--to", "--from", "--tip", "--via")


def bind_angles(words):
    """Join ``--at -1,2`` to ``--at=-1,2``: argparse would take the angles for an option."""
    out = []
    for word in words:
        if out and out[-1] in ANGLES and re.match(r"-[\d.]", word):
            out[-1] += f"={word}"
        else:
            out.append(word)
    return out


def main(argv=None):
    """Entry point; exit code 0, 1 for an error that has been said, 2 for wrong usage."""
    options = parser().parse_args(bind_angles(sys.argv[1:] if argv is None else argv))
    # As Ctrl-C: what was started is stopped on the way out.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        options.function(options)
    except FlexarmError as error:
        print(f"flexarm {options.command}: {error}", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:  # whoever reads it has enough, `head` say
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except OSError as error:
        print(f"flexarm {options.command}: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("\nstopped", file=sys.stderr)
        sys.exit(130)
    sys.exit(0)


def entry():
    """Entry point of the process."""
    from flexarm_ros.start import leave_after

    leave_after(main)


if __name__ == "__main__":
    entry()
