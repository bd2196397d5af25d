# SPDX-License-Identifier: Apache-2.0
"""``flexarm urdf``: writes the URDF of an arm file; flexible links are chains of short rigid pieces."""

import json
from pathlib import Path

from flexarm_dynamics.arm.urdf import PieceChain
from flexarm_dynamics.models import model

from .options import add_arm_arguments, add_model_arguments, load_arm


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Writes a URDF; the node shape publishes the joint states that bend it like the arm."
    )
    parser.epilog = "example: flexarm urdf two_link --out two_link.urdf"
    add_arm_arguments(parser, "print joints and text as JSON")
    parser.add_argument(
        "--pieces", type=int, default=8, help="rigid pieces of each flexible link (default 8)"
    )
    parser.add_argument(
        "--out", metavar="FILE", help="write the URDF to this file instead of printing it"
    )
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
