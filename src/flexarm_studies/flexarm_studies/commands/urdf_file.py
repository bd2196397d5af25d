# SPDX-License-Identifier: Apache-2.0
"""``flexarm urdf``: the URDF of an arm file, links that bend as chains of short rigid pieces. No ROS."""

import json
from pathlib import Path

from flexarm_dynamics.arm.urdf import PieceChain
from flexarm_dynamics.models import model

from .options import add_model_arguments, load_arm


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Writes a URDF; the node shape publishes the joint states that bend it as the arm is bent."
    )
    parser.epilog = "example: flexarm urdf two_link --out two_link.urdf"
    parser.add_argument("arm", metavar="ARM", help="arm file: a shipped name or a path")
    parser.add_argument(
        "--pieces", type=int, default=8, help="rigid pieces of each flexible link (default 8)"
    )
    parser.add_argument("--out", metavar="FILE", help="write it there instead of printing it")
    parser.add_argument("--json", action="store_true", help="print joints and text as JSON")
    add_model_arguments(parser)


def urdf(options):
    """Run the sub-command."""
    chain = PieceChain(model.build(load_arm(options)), options.pieces)
    text = chain.urdf()
    if options.out:
        Path(options.out).write_text(text, encoding="utf-8")
    if options.json:
        print(json.dumps({"out": options.out, "joints": list(chain.joint_names), "urdf": text}))
    elif not options.out:
        print(text, end="")
    else:
        print(f"{options.out}: {len(chain.joint_names)} joints, frames from base_link on")
