# SPDX-License-Identifier: Apache-2.0
r"""Robust gains: a design for an arm that differs from its arm file.

The control has a fixed structure: stiffness, damping and integral of each joint (`slow.type: joint_pid`) and a constant
feedback of modal amplitudes and rates (`fast.type: fixed_gain`), both about the motion of the feed-forward. One search
finds its gains for a whole set of sampled loops (multi-model design). Payload, stiffness, damping, loop gain, delay and
configuration vary; the arm has one mode more per direction than the file; filters and delay are part of each loop
(`loop`). The search makes the slowest pole of all loops as fast as possible (`decay`). It minimises this nonsmooth
function by BFGS (`nonsmooth`) from several starts. The noise that the gains pass on to the torque is bounded.

In the literature this is static output feedback by minimisation of the spectral abscissa (Burke, Henrion, Lewis &
Overton 2006, HIFOO; Ackermann 1980 for the multi-model idea).
"""

from dataclasses import replace

import numpy as np

from .further import LEAST, later, leaves, leaving_less, rings_longer
from .settings import SLOWEST, Settings
from .task import Task
from .uncertain import Uncertainty

#: If the decay of the first search is less than `POOR` times the speed, low passes with a corner below omega_c are
#: tried. Modes beyond such a corner are only asked to keep their own damping. The result is used if its decay is more
#: than `WORTH` times larger, motions leave no more behind than with the first result, and no mode rings longer [-].
POOR, WORTH = 0.25, 1.2
#: If gains scheduled with such low passes reach less decay than this, one set for all configurations is tried as well.
#: One set without these low passes is tried if the best decay so far is below `further.LEAST`, or, if there are no such
#: low passes, below this [-].
LITTLE = 0.08
#: If the arm does not come back from its torque limits (`recovery`), designs at these fractions of the speed follow.
SLOWER = (0.7, 0.5, 0.35)
#: Progress at the end of the first design; slower designs may follow. Then, within one design, progress at the end of
#: the usual search, of the attempts after a poor result, of the search from nearby gains, and of the search for gains
#: with which motions leave less.
FIRST, USUAL, OTHERWISE, NEARBY, LESS = 0.7, 0.6, 0.75, 0.85, 0.93


def design(arm, settings=None, uncertainty=None, progress=None, gains=None):
    """Gains for the arm of an arm file.

    If the arm would not come back from its torque limits (`recovery`), slower gains are searched for (`SLOWER`).

    Parameters
    ----------
    arm : Arm
    settings : Settings, optional
    uncertainty : Uncertainty, optional
    progress : callable, optional
        Called with the fraction of the work that is done and the decay that is reached.
    gains : ndarray, shape (n, 3n + 2m), optional
        An additional start.

    Returns
    -------
    Design
        The best one found, even if it is unstable: see its `decay`. Its `settings` have the speed that was used.

    Raises
    ------
    DesignError
        If the arm rests in no configuration, or nothing measures its bending.
    """
    settings, uncertainty = settings or Settings(), uncertainty or Uncertainty()
    say = _Progress(progress)
    found = design_at(arm, settings, uncertainty, say.part(0.0, FIRST), gains)
    for k, part in enumerate(SLOWER):
        slower = replace(settings, speed=part * settings.speed)
        if found.comes_back or slower.speed < SLOWEST:
            break
        begin = FIRST + (1.0 - FIRST) * k / len(SLOWER)
        now = say.part(begin, begin + (1.0 - FIRST) / len(SLOWER))
        # With its own starts: from the faster gains the search would end at gains that also ask for much torque.
        other = design_at(arm, slower, uncertainty, now, asked=settings.speed)
        if other.holds and (other.comes_back or other.recovery.limited < found.recovery.limited):
            found = replace(other, slowed=True)
    say.part(0.0, 1.0)(1.0, found.decay)
    return found


def design_at(arm, settings, uncertainty, progress=None, gains=None, asked=None):
    """A `Design` with the speed of the settings, whether or not the arm comes back from its torque limits.

    Parameters
    ----------
    arm, settings, uncertainty, progress, gains
        As for `design`.
    asked : float, optional
        The requested speed, if the settings have a lower one because of the torque limits [-].

    Returns
    -------
    Design
    """
    task, say = Task(arm, settings, uncertainty), _Progress(progress)
    found = task.found(say.part(0.0, USUAL), gains, -np.inf)
    if found.decay < POOR * task.speed:
        short, other = Task(arm, settings, uncertainty, short=True), None
        if short.low_passes:
            other = short.found(say.part(USUAL, OTHERWISE), gains, LITTLE)
        reached = other.decay if other is not None else -np.inf
        if max(found.decay, reached) < (LEAST if short.low_passes else LITTLE):
            found = task.found_alone(say.part(USUAL, OTHERWISE), gains, found)
        better = reached > max(WORTH * found.decay, 0.0)
        if better and not _rings(task, found, short, other):
            task, found = short, other
    if task.slow(found):
        task = Task(arm, settings, replace(uncertainty, edges=True), task.short)
        found = task.from_nearby(say.part(OTHERWISE, NEARBY), found)
    if task.hunts(found):
        more = task.at_once()
        other = more.from_nearby(say.part(OTHERWISE, NEARBY), found)
        if other.decay > 0.0:
            task, found = more, other
    kept, made = found, task.design(found)
    if found.decay > 0.0 and task.nominal.n_modes:
        edged = Task(arm, settings, replace(task.uncertainty, edges=True), task.short)
        other = leaving_less(edged, found, say.part(NEARBY, LESS), asked)
        if other is not None and edged.hunts(other):
            edged = edged.at_once()
            other = leaving_less(edged, found, say.part(NEARBY, LESS), asked)
        if other is not None:
            sooner = edged.design(other)
            if not later(sooner.recovery, made.recovery):
                kept, made = other, sooner
    if task.hunts_apart(kept):
        made = _steadied(task, kept, made, asked, say.part(LESS, 1.0))
    say.part(0.0, 1.0)(1.0, made.decay)
    return made


def _rings(task, found, short, other):
    """Whether the gains `other` of the task `short` leave more behind than the `found` ones of `task`, or ring longer.

    Modes beyond the corner of a low pass may ring long after a motion, although the decay that is asked of the others
    is larger. Nothing is compared with unstable gains, and ringing is not compared if the `found` gains have less decay
    than `further.LEAST`.
    """
    if found.decay <= 0.0 or not task.nominal.n_modes:
        return False
    more = leaves(short, other) > leaves(task, found)
    return more or (found.decay >= LEAST and rings_longer(task, found, short, other))


def _steadied(task, found, made, asked, progress):
    """The design that goes on from the `found` gains until no vibration grows while some joints stick.

    It is `made`, the design with the `found` gains, if there are no such gains, or if with them the arm no longer comes
    back from its torque limits; then it is marked: it `hunts`. The requested speed is `asked`, as in `design_at`.
    """
    loops = replace(task.uncertainty, edges=True, at_once=True, apart=True)
    apart = Task(task.arm, task.settings, loops, task.short)
    other = apart.from_nearby(progress, found)
    made = replace(made, hunts=True)
    if other.decay < min(found.decay, LEAST):
        return made
    steady = apart.design(other)
    if task.nominal.n_modes:
        less = leaving_less(apart, other, progress, asked)
        sooner = steady if less is None else apart.design(less)
        if not later(sooner.recovery, steady.recovery):
            steady = sooner
    return steady if steady.comes_back or not made.comes_back else made


class _Progress:
    """Turns the progress of each part into that of the whole; the fraction never decreases."""

    def __init__(self, progress):
        self._progress, self._most = progress, 0.0

    def part(self, begin, end):
        """A callable for the part from `begin` to `end`: takes its fraction, and the decay that is reached."""

        def say(fraction, decay):
            self._most = max(self._most, begin + (end - begin) * fraction)
            if self._progress is not None:
                self._progress(self._most, decay)

        return say
