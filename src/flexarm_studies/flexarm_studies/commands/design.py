# SPDX-License-Identifier: Apache-2.0
"""``flexarm design``: makes a controller file that allows for deviations from the arm file; shows what it bears."""

import argparse
import shlex
import sys
import time
from dataclasses import asdict

import numpy as np

from flexarm_dynamics.errors import FlexarmError

from .. import markdown
from .options import add_arm_arguments, angles, check_file, in_range, new_path, numbers, show

#: Comments of the controller file, by the start of a parameter's name.
COMMENTS = {
    "rate": "[Hz] samples per second that the design is for",
    "stability_margin": "[1/s] not checked again without filters and delay, for which these gains are not made",
    "feedforward": "preview: each motion is planned on receipt and ends at rest; model: rests a period later",
    "feedforward_modes": "per direction, that the feed-forward knows: one more than the file",
    "feedforward_level": "of the kinematics of bending, likewise, by the arm's loads; file: as the arm file has it",
    "feedforward_torque": "of the torque limits, that a plan takes: a heavier payload needs the rest",
    "motion_delay": "[s] the laws see the motion as late as the torque acts, by measurement, up to this",
    "saturation": "a joint at its torque limit scales the feedback of all: the gains are made for its direction",
    "slow.type": "slow control: stiffness, damping and integral of each joint",
    "slow.stiffness": "[N m/rad]",
    "slow.damping": "[N m s/rad]",
    "slow.integral": "[N m/(rad s)]",
    "slow.schedule": "[rad] configurations of the sets of gains, one after the other; interpolated between them",
    "slow.bandwidth": "[rad/s] low pass of what is fed back; 0.0: none",
    "manifold.type": "deflections of the reference's motion",
    "fast.type": "fast control: constant feedback of the deflections; none: slow control alone",
    "fast.gain": "for each joint: modal amplitudes, then their rates",
    "fast.configuration": "[rad] where the loop is checked",
    "fast.schedule": "[rad] as of the slow control",
    "fast.bandwidth": "[rad/s]",
    "observer.type": "rates as filtered derivatives: no model that could be wrong",
    "observer.bandwidth": "[rad/s]",
    "observer.joint_velocity_bandwidth": "[rad/s]",
    "observer.measured_velocity": "the gains are for joint speeds that the observer derives",
}
#: Options that change a design.
OF_THE_DESIGN = (
    "rate", "delay", "payload", "stiffness", "damping", "gain", "speed", "at", "effort", "feedforward",
)  # fmt: skip


def add_arguments(parser):
    """Arguments of ``design``."""
    parser.description = (
        "Designs slow law, fast law, feed-forward and observer for an arm file, so that the sampled loop holds for"
        " all that may differ from the file, and writes a controller file for the nodes."
    )
    parser.epilog = "example: flexarm design my_arm.yaml --payload 0.5:1.5 --rate 500 --delay 0.002 --out my.yaml"
    add = parser.add_argument
    add_arm_arguments(parser, "the design and what it bears as JSON")
    add("--out", metavar="FILE", help="controller file to write; not given: printed")
    add("--figure", metavar="FILE.png", help="draw it: poles, decay, what is borne, noise")
    add("--rate", type=float, default=1000.0, help="samples per second (1000)")
    add(
        "--delay",
        type=float,
        metavar="S",
        help="from a sample to its torque (one period and 1 ms) [s]",
    )
    for name, default in (
        ("payload", "0.7:1.3"),
        ("stiffness", "0.9:1.1"),
        ("damping", "0.3:3"),
        ("gain", "0.6:1.7"),
    ):
        add(
            f"--{name}",
            default=default,
            metavar="LEAST:MOST",
            help=f"factors of the file's ({default})",
        )
    add(
        "--speed",
        type=float,
        default=1.0,
        help="0 to 1: less asks less decay, makes less noise (1)",
    )
    add(
        "--at",
        action="append",
        metavar="Q1,Q2,...",
        help="configuration to design for [rad]; may be repeated (drawn from the position limits)",
    )
    add(
        "--speeds",
        metavar="S1,S2,...",
        help="a table of designs of several speeds: decay, what is borne, noise; writes no controller file",
    )
    add("--effort", type=float, default=1.0, help="of the search, 0.1 to 100 (1)")
    add(
        "--feedforward",
        choices=("preview", "model", "none"),
        default="preview",
        help="of the file: preview, which plans each motion on receipt to end at rest, or model (preview)",
    )


def design(options):
    """Run ``design``."""
    from flexarm_control.robust.card import card
    from flexarm_control.robust.design import design as find
    from flexarm_control.robust.settings import Settings
    from flexarm_control.robust.trade import trade
    from flexarm_control.robust.uncertain import Uncertainty
    from flexarm_control.robust.words import FROM_LIMITS
    from flexarm_dynamics.arm import arm_file

    arm = arm_file.load(options.arm)
    out = None if options.out is None else new_path(options.out, "--out")
    speeds = None if options.speeds is None else _speeds(options)
    figure = None if options.figure is None else check_file(options.figure, "--figure")
    rate = in_range("--rate", options.rate, 10.0, 20000.0)
    delay = None if options.delay is None else in_range("--delay", options.delay, 0.0, 0.1)
    at = tuple(tuple(angles(text, arm, "--at").tolist()) for text in options.at or ())
    settings = Settings(
        rate=rate,
        delay=delay,
        speed=in_range("--speed", options.speed, 0.0, 1.0),
        effort=in_range("--effort", options.effort, 0.1, 100.0),
        feedforward=options.feedforward,
        configurations=at,
    )
    uncertainty = Uncertainty(
        *(
            _factors(f"--{k}", getattr(options, k))
            for k in ("payload", "stiffness", "damping", "gain")
        )
    )
    begin = time.monotonic()

    def progress(fraction, decay):
        print(
            f"{100.0 * fraction:3.0f} %, {time.monotonic() - begin:.0f} s: slowest decay {decay:.3f} omega_1",
            file=sys.stderr,
        )

    if speeds is not None:
        return _trade(options, figure, trade(arm, speeds, settings, uncertainty, progress))
    found = find(arm, settings, uncertainty, progress)
    found.check()
    bears = card(found)
    lines = card_lines(found, bears)
    if found.slowed:
        lines.append(
            f"  speed               {found.settings.speed:.3g} in place of {settings.speed:.3g}: {FROM_LIMITS}"
        )
    text = controller_file(options.arm, found, lines, command(options))
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
    if not found.comes_back:
        lines.append(
            "warning: after a motion that takes much of its torque the arm swings for long; move it more slowly"
        )
    if found.hunts:
        lines.append(
            "warning: a vibration grows fast while some joints stick and others slide; the arm may hunt: choose a lower"
            " --speed, or a larger --effort"
        )
    cycles = _limit_cycles(found, arm, settings.delay)
    lines += [f"warning: {cycle.text}" for cycle in cycles]
    lines += ["", f"written to {out}" if out else text]
    if figure is not None:
        from .design_figure import draw

        lines += [f"figure {draw(found, bears, figure)}"]
    result = _result(found, bears) | {"limit_cycles": [asdict(cycle) for cycle in cycles]}
    show(options, _finite(result), lines, allow_nan=False)
    return 0


def _limit_cycles(found, arm, delay):
    """Effect of play on the designed loop."""
    from ..loop import scenario as scenarios
    from ..loop.judged import judge_of

    if arm.without_play is arm:
        return []
    loop = scenarios.loop_of(scenarios.Scenario(arm, found.parameters(), trajectory=""))
    return judge_of(loop, found.configurations, delay).limit_cycles()


def _result(found, bears):
    """What is printed as JSON."""
    from flexarm_control.robust.words import what_limits

    return {
        "parameters": found.parameters(),
        "decay": found.decay,
        "omega_1_rad_s": found.omega_1,
        "slowest": [
            {"loop": row.name, "pole": [row.pole.real, row.pole.imag], "value": row.value}
            for row in found.slowest
        ],
        "limited_by": what_limits(found),
        "left_rad_s": list(found.left),
        "noise": list(found.noise),
        "speed": found.settings.speed,
        "recovery": None
        if found.recovery is None
        else asdict(found.recovery) | {"comes_back": found.comes_back},
        "hunts": found.hunts,
        "gain": list(bears.gain),
        "payload": list(bears.payload),
        "stiffness": list(bears.stiffness),
        "delay_s": bears.delay,
        "damping": bears.damping,
        "phase_rad": bears.phase,
        "settling_s": bears.settling,
        "slowest_settling_s": bears.slowest,
        "torque_used": None if bears.torque_used is None else bears.torque_used.tolist(),
        "tip_stiffness_N_m": bears.tip_stiffness,
        "tip_stiffness_without_integral_N_m": bears.tip_stiffness_proportional,
    }


def _finite(value):
    """A value for JSON: null for no limit."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(one) for one in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value


def _speeds(options):
    if options.out is not None:
        hint = "leave one of them out; --speed S --out FILE makes the file of one speed"
        raise FlexarmError("writes no controller file", field="--speeds with --out", hint=hint)
    return [in_range("--speeds", v, 0.0, 1.0) for v in numbers("--speeds", options.speeds)]


#: Columns of the table of `--speeds`.
COLUMNS = (
    "speed", "worst decay [1/s]", "settling [s]", "gain x", "payload x", "delay [ms]", "phase margin [deg]",
    "noise [%]", "comes back from torque limits",
)  # fmt: skip


def _trade(options, figure, designs):
    """Print and draw what designs of several speeds bear."""
    from flexarm_control.robust.card import card

    designs[-1].check()
    rows = [(found, card(found)) for found in designs if found.holds]
    lines = markdown.table(
        COLUMNS,
        (
            (
                f"{found.settings.speed:g}",
                worst_decay(found),
                bears.settling,
                _span(bears.gain),
                _span(bears.payload),
                _number(1e3 * bears.delay),
                float(np.degrees(bears.phase)),
                100.0 * max(found.noise),
                "-" if found.recovery is None else "yes" if found.comes_back else "no",
            )
            for found, bears in rows
        ),
    )
    if figure is not None:
        from .design_figure import draw_trade

        lines += ["", f"figure {draw_trade(rows, figure)}"]
    result = [_result(found, bears) for found, bears in rows]
    show(options, _finite(result), lines, allow_nan=False)
    return 0


def worst_decay(found):
    """Decay of the pole that is slowest relative to its required decay [1/s]."""
    return -found.worst.pole.real


def _factors(option, text):
    values = numbers(option, text, ":")
    if len(values) != 2 or not 0.0 < values[0] <= 1.0 <= values[1]:
        hint = "write LEAST:MOST with 0 < LEAST <= 1 <= MOST"
        raise FlexarmError("is no range of factors", field=option, value=text, hint=hint)
    return tuple(values)


def card_lines(found, bears):
    """The properties of a design, in words."""
    from flexarm_control.robust.words import what_limits

    name, pole, *_ = found.worst
    hertz = found.omega_1 / (2.0 * np.pi)
    lines = [
        f"{found.arm.name}: first frequency with the joints locked {hertz:.3g} Hz; {len(found.slowest)} loops at"
        f" {len(found.configurations)} configurations, {found.settings.rate:g} Hz, delay"
        f" {1e3 * found.settings.delay:.3g} ms",
        f"  worst decay         {-pole.real:.3g} 1/s ({found.decay:.2f} of what is asked): {name}",
        f"  limited by          {what_limits(found)}",
        f"  expected settling   {bears.settling:.3g} s after a push at the tip, to 2 %, with the file's numbers;"
        f" slowest pole of all loops: {bears.slowest:.3g} s",
        f"  tip stiffness       {_number(bears.tip_stiffness)} N/m when the integral has acted, the links alone bend;"
        f" {_number(bears.tip_stiffness_proportional)} N/m without it",
        f"  damping ratio       {bears.damping:.2g} at least, with the file's numbers",
        f"  bears gain          x {_span(bears.gain)}",
        f"  bears payload       x {_span(bears.payload)}",
        f"  bears stiffness     x {_span(bears.stiffness)}",
        f"  bears delay         {_number(1e3 * bears.delay)} ms",
        f"  phase margin        {np.degrees(bears.phase):.2g} deg",
        f"  noise in the torque {', '.join(f'{100.0 * share:.2g} %' for share in found.noise)} of the limit, rms",
        f"  torque used         {_used(found, bears)}",
        f"  torque limits       {_recovery(found)}",
    ]
    if found.left:
        lines.append(f"  left to themselves  {_left(found)}")
    return lines


def _left(found):
    """The modes that no control damps, and what helps, in words."""
    listed = ", ".join(f"{omega / (2.0 * np.pi):.3g} Hz" for omega in found.left)
    return (
        f"{listed}: no torque reaches these modes, or no gauge sees them; feedforward preview plans motions that excite"
        " those out of reach little, and motions of at least three of their periods excite all of them little"
    )


def _used(found, bears):
    """The torque of a motion, in words."""
    from flexarm_control.robust.settling import ANGLE

    if bears.torque_used is None:
        return "not looked at: no link bends, or no joint has a limit"
    file, heaviest = (_largest(fractions, found.arm) for fractions in bears.torque_used)
    return (
        f"{file}; payload x {found.uncertainty.payload[1]:g}: {heaviest}; when one joint turns by"
        f" {np.degrees(ANGLE):.0f} deg in two locked periods"
    )


def _largest(fractions, arm):
    """The largest of the joints' fractions of their limits, in words."""
    if np.isnan(fractions).any():
        return "the arm does not rest"
    k = int(np.argmax(fractions))
    return f"{100.0 * fractions[k]:.2g} % of the limit of {arm.joints[k].name}"


def _recovery(found):
    """How the arm comes back from its torque limits, in words."""
    from flexarm_control.robust.recovery import WATCHED

    if found.recovery is None:
        return "not looked at: no link bends, a joint has no limit, or the weight takes all torque"
    with_, without = (
        f"{periods:.2g} locked periods" if np.isfinite(periods) else f"more than {WATCHED:g}"
        for periods in (found.recovery.limited, found.recovery.unlimited)
    )
    return (
        f"payload x {found.uncertainty.payload[1]:g}: settled after {with_}, without limits {without}, after motions"
        f" that take {found.uncertainty.torque_share:g} of them"
    )


def _number(value):
    return "any" if not np.isfinite(value) else f"{value:.3g}"


def _span(limits):
    low, high = limits
    return f"{low:.2g} to {'any' if not np.isfinite(high) else f'{high:.2g}'}"


def command(options):
    """The command line that makes the same design again."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    words = ["flexarm design", shlex.quote(options.arm)]
    for name in OF_THE_DESIGN:
        value = getattr(options, name)
        if value != parser.get_default(name):
            for one in value if isinstance(value, list) else [value]:
                text = f"{one:g}" if isinstance(one, float) else one
                words.append(f"--{name}{'=' if text.startswith('-') else ' '}{text}")
    return " ".join(words)


def controller_file(arm, found, lines, made_by):
    """Text of the nodes' parameter file."""
    out = [f"# Controller made by: {made_by}", "# What it was found to do:"]
    out += [f"# {line}" for line in lines]
    out += ["/**:", "  ros__parameters:", f"    arm: {arm}"]
    section = None
    for name, value in found.parameters().items():
        head, _, rest = name.rpartition(".")
        if head != section and head:
            out.append(f"    {head}:")
        section = head
        indent = "      " if head else "    "
        comment = COMMENTS.get(name)
        text = _yaml(value)
        out.append(f"{indent}{rest}: {text}" + (f"  # {comment}" if comment else ""))
    return "\n".join(out) + "\n"


def _yaml(value):
    if isinstance(value, list):
        return "[" + ", ".join(_yaml(v) for v in value) + "]"
    if isinstance(value, float):
        text = repr(value)
        # YAML reads 1e-05 as a string, and ROS an integer as one.
        if "e" in text and "." not in text.split("e")[0]:
            text = text.replace("e", ".0e", 1)
        return text
    return str(value)
