# SPDX-License-Identifier: Apache-2.0
"""Designs of several speeds for one arm: what a faster loop costs in robustness and noise."""

from dataclasses import replace

from .design import Settings, design_at
from .uncertain import Uncertainty


def trade(arm, speeds, settings=None, uncertainty=None, progress=None):
    """A `Design` for each of the `speeds`, from the slowest on; each search also starts from the gains of the last one.

    A faster design asks for more decay and allows more noise, so that the gains of a slower one are never worse than a
    start of its own. None is replaced by a slower one for its torque limits.

    Parameters
    ----------
    arm : Arm
    speeds : sequence of float
        See `Settings.speed`.
    settings : Settings, optional
        Of all of them.
    uncertainty : Uncertainty, optional
    progress : callable, optional
        As for `design`, with the fraction of all the work.

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
