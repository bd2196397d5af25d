# SPDX-License-Identifier: Apache-2.0
"""Writes tables of all parameters in Markdown, from the declarations with which the nodes validate."""

import json

from flexarm_studies.markdown import write_between

BEGIN, END = "<!-- parameters: begin -->", "<!-- parameters: end -->"


def groups():
    """Node name to its declared parameters by prefix."""
    from flexarm_control.nodes import controller, excite, goals, observer, shaper
    from flexarm_ros.node import ARM, COMMON
    from flexarm_sim import position_loop, simulator
    from flexarm_sim.nodes import hardware
    from flexarm_sim.nodes import simulator as simulator_node

    from .replay import node as replay

    given = {
        "simulator": {"": (*simulator.PARAMETERS, *simulator_node.PARAMETERS)},
        "hardware": {"": (*position_loop.PARAMETERS, *hardware.OWN)},
        "observer": observer.parameter_groups(),
        "controller": controller.parameter_groups(),
        "goals": {"": (ARM, *goals.PARAMETERS)},
        "excite": excite.parameter_groups(),
        "shaper": shaper.parameter_groups(),
        "replay": {"": replay.PARAMETERS},
    }
    return {node: {**groups, "": (*COMMON, *groups[""])} for node, groups in given.items()}


def tables():
    """One table per node."""
    lines = []
    for node, by_prefix in groups().items():
        lines += [f"**`{node}`**", "", "| parameter | default | unit | range | what it does |"]
        lines += ["|---|---|---|---|---|"]
        for prefix, declared in by_prefix.items():
            lines += [_row(prefix, p) for p in declared]
        lines.append("")
    return "\n".join(lines).rstrip()


def plain():
    """The declarations as plain data: node to a list of parameters."""
    fields = ("default", "unit", "low", "high", "choices", "read_only", "description")
    return {
        node: [
            {"name": prefix + p.name, "type": p.kind} | {f: getattr(p, f) for f in fields}
            for prefix, declared in by_prefix.items()
            for p in declared
        ]
        for node, by_prefix in groups().items()
    }


def _row(prefix, p):
    default = f"`{p.default!r}`".replace("'", '"').replace("True", "true").replace("False", "false")
    if p.choices:
        span = ", ".join(f"`{c}`" for c in p.choices)
    elif p.low is not None or p.high is not None:
        span = f"{p.low:g} … {p.high:g}"
    else:
        span = ""
    text = p.description + ("" if not p.read_only else " *Read-only.*")
    return f"| `{prefix}{p.name}` | {default} | {p.unit} | {span} | {text} |"


def write(file):
    """Put the tables between the markers of a Markdown file.

    Raises
    ------
    FlexarmError
        If the file has no markers.
    """
    write_between(file, BEGIN, END, tables())


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Prints every node's parameters as Markdown, or writes them between a file's markers."
    )
    parser.epilog = "example: flexarm parameters --write docs/parameters.md"
    parser.add_argument("--write", metavar="FILE", help="rewrite the tables of this file")
    parser.add_argument("--json", action="store_true", help="print the declarations as JSON")


def parameters(options):
    """Run the sub-command."""
    if options.write:
        write(options.write)
    elif options.json:
        print(json.dumps(plain(), indent=1))
    else:
        print(tables())
