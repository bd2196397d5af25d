# SPDX-License-Identifier: Apache-2.0
"""Designs with several speeds for one arm: they show what a faster loop costs in robustness and noise."""

from dataclasses import replace

from .design import design_at
from .settings import Settings
from .uncertain import Uncertainty


def trade(arm, speeds, settings=None, uncertainty=None, progress=None):
    """A `Design` for each of the `speeds`, the slowest first; each search also starts from the gains of the last one.

    A faster design asks for more decay and allows more noise. So the gains of a slower design are never a worse start
    than its own starts. No design is replaced by a slower one because of the torque limits.

    Parameters
    ----------
    arm : Arm
    speeds : sequence of float
        See `Settings.speed`.
    settings : Settings, optional
        Of all designs; their speed is replaced.
    uncertainty : Uncertainty, optional
    progress : callable, optional
        As for `design`, with the fraction of the work for all designs.

    Returns
    -------
    list of Design
    """
    settings, found, gains = settings or Settings(), [], None
    uncertainty = uncertainty or Uncertainty()
    speeds = sorted(speeds)
    for i, speed in enumerate(speeds):

        def of_all(fraction, decay, i=i):
            progress((i + fraction) / len(speeds), decay)

        one = replace(settings, speed=speed)
        say = None if progress is None else of_all
        found.append(design_at(arm, one, uncertainty, say, gains))
        gains = found[-1].K if found[-1].holds else gains
    return found
