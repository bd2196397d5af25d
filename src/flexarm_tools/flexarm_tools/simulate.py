# SPDX-License-Identifier: Apache-2.0
"""``flexarm simulate``: runs the command of `flexarm_studies`, and writes the bag of ``--bag``, which needs ROS."""

from functools import partial

from flexarm_studies.commands import simulate as without_bag
from flexarm_studies.commands.simulate import add_arguments

from .identification.recording import read

__all__ = ["add_arguments", "simulate"]


def simulate(options):
    """Run the sub-command."""
    recorder = None
    if options.bag is not None:
        from .recording.loop_bag import LoopBag

        recorder = partial(LoopBag, options.bag)
    without_bag.simulate(options, recorder, read)
