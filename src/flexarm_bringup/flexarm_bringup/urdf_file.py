# SPDX-License-Identifier: Apache-2.0
"""``flexarm urdf``: the URDF of an arm file, links that bend as chains of short rigid pieces. No ROS."""

from pathlib import Path

from flexarm_dynamics import model
from flexarm_dynamics.urdf import PieceChain

from .simulate import add_model_arguments, load_arm


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.add_argument("arm", metavar="ARM", help="arm file: a shipped name or a path")
    parser.add_argument(
        "--pieces", type=int, default=8, help="rigid pieces of each flexible link (default 8)"
    )
    parser.add_argument("--out", metavar="FILE", help="write it there instead of printing it")
    add_model_arguments(parser)


def urdf(options):
    """Run the sub-command."""
    chain = PieceChain(model.build(load_arm(options)), options.pieces)
    text = chain.urdf()
    if not options.out:
        print(text, end="")
        return
    Path(options.out).write_text(text, encoding="utf-8")
    print(f"{options.out}: {len(chain.joint_names)} joints, frames from base_link on")
