# SPDX-License-Identifier: Apache-2.0
r"""The modes that ring: their frequencies as a function of the joints, and the shaper that removes them.

Frequencies are interpolated between the configurations at which they were measured, by inverse squared distance in the
joints (Shepard 1968),

.. math:: f(q) = \frac{\sum_c w_c(q) f_c}{\sum_c w_c(q)}, \qquad w_c = \lVert q - q_c\rVert^{-2}.

The result is smooth, equals f_c at q_c, and lies between the smallest and the largest everywhere.
"""

import copy
from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import parameter

from ..motions import robust_shapers, shapers
from ..motions.shapers import NONE, SHAPERS

ROBUST, RETIMED = "robust", "retimed"
KINDS = (*SHAPERS, ROBUST, RETIMED, NONE)

#: Modes of several configurations that are closer than this fraction count as one for a shaper of all of them [-].
ALIKE = 0.02

PARAMETERS = (
    parameter("type", ROBUST, choices=KINDS).described(
        "Shaper: robust is optimal for the spread of all modes in shaper.periods; retimed gives straight motions from "
        "rest to rest a new time law, and shapes others as robust; none passes motions as they are."
    ),
    parameter("frequencies", [], "Hz", 0.01, 1000.0, kind="float_array").described(
        "Natural frequencies of the modes to shape; with configurations, one row of modes after the other."
    ),
    parameter("dampings", [0.0], "-", 0.0, 0.99).described(
        "Damping ratios, as many as frequencies, or one for all."
    ),
    parameter("configurations", [], "rad", -1e3, 1e3, kind="float_array").described(
        "Joint positions at which the frequencies were measured, one row after the other; empty: the same everywhere."
    ),
    parameter("spread", 0.15, "-", 0.0, 0.5).described(
        "For the types robust and retimed: fraction by which frequencies may be off."
    ),
    parameter("periods", 1.0, "-", 0.25, 3.0).described(
        "For the types robust and retimed: how much longer a motion gets, in periods of the lowest mode."
    ),
)


@dataclass(frozen=True, eq=False)
class Stage:
    """A shaper in the phase of one mode: an impulse at phase 2 pi comes a period after one at 0.

    Attributes
    ----------
    cycles : (k,) ndarray
        Times of the impulses, from 0, in periods of the mode [-].
    amplitudes : (k,) ndarray
    mode : int
        Column of the frequencies.
    """

    cycles: np.ndarray
    amplitudes: np.ndarray
    mode: int


class Modes:
    """Checked modes, and the shaper for them.

    Parameters
    ----------
    settings : mapping
        Checked values of `PARAMETERS`.
    joints : int
        Number n of joints in a configuration.

    Attributes
    ----------
    configurations : (c, n) ndarray
        Empty if the frequencies are the same everywhere.
    frequencies, dampings : (c, modes) ndarrays
        With at least one row [Hz], [-].
    spread, periods : float
        As in the settings [-].

    Raises
    ------
    ParameterError
        If the numbers of values don't fit together; it names the parameter.
    DesignError
        If there is no such shaper.
    """

    def __init__(self, settings, joints):
        self.kind = settings["type"]
        given = np.array(settings["configurations"], float)
        if given.size % joints:
            raise ParameterError(
                f"values are no rows of {joints} joints",
                field="shaper.configurations",
                value=given.size,
                hint=f"give {joints} joint positions for each configuration",
            )
        self.configurations = given.reshape(-1, joints)
        rows = max(len(self.configurations), 1)
        frequencies = np.array(settings["frequencies"], float)
        if self.kind != NONE and (not frequencies.size or frequencies.size % rows):
            raise ParameterError(
                f"values for {rows} configurations" if frequencies.size else "are not given",
                field="shaper.frequencies",
                value=frequencies.size,
                hint="give the same number of modes for each configuration",
            )
        dampings = np.array(settings["dampings"], float)
        if dampings.size not in (1, frequencies.size):
            raise ParameterError(
                "values",
                field="shaper.dampings",
                value=dampings.size,
                limit=f"{frequencies.size}, as frequencies, or 1",
            )
        if self.kind == NONE:
            frequencies, dampings = np.ones(rows), np.zeros(1)
        self.frequencies = frequencies.reshape(rows, -1)
        self.dampings = np.broadcast_to(dampings, frequencies.shape).reshape(rows, -1)
        self._refuse_same(self.configurations)
        self.spread, self.periods = settings["spread"], settings["periods"]
        self.stages = self._designed()

    @staticmethod
    def _refuse_same(configurations):
        for i, row in enumerate(configurations):
            same = np.flatnonzero((configurations[:i] == row).all(axis=1))
            if same.size:
                raise ParameterError(
                    f"row {i} is that of row {same[0]}",
                    field="shaper.configurations",
                    hint="give each configuration once",
                )

    def _designed(self):
        """Stages: one for each mode; for the types robust and retimed one for all modes, in the phase of the lowest."""
        frequencies, dampings = self.frequencies.mean(axis=0), self.dampings.mean(axis=0)
        if self.kind == NONE:
            return ()
        if self.kind in (ROBUST, RETIMED):
            lowest = int(np.argmin(frequencies))
            if (
                self.kind == RETIMED
            ):  # a motion that can't be retimed gets one shaper for the modes of all rows
                frequencies, dampings = _different(self.frequencies.ravel(), self.dampings.ravel())
            train = robust_shapers.robust(frequencies, dampings, self.spread, self.periods)
            unit = self.mean_frequencies[lowest]
            return (Stage(train.times * unit, train.amplitudes, lowest),)
        trains = [
            shapers.impulses(self.kind, f, d) for f, d in zip(frequencies, dampings, strict=True)
        ]
        shapers.convolve(trains)  # refuses too many
        return tuple(
            Stage(train.times * f, train.amplitudes, mode)
            for mode, (train, f) in enumerate(zip(trains, frequencies, strict=True))
        )

    def scaled(self, factors):
        """The same modes with all frequencies times `factors` (modes,)."""
        other = copy.copy(self)
        other.frequencies = self.frequencies * factors
        other.stages = other._designed()
        return other

    @property
    def varies(self):
        """Whether the shaper depends on the configuration."""
        if self.kind == RETIMED or not self.stages:
            return False
        return bool(np.ptp(self.frequencies, axis=0).any())

    @property
    def mean_frequencies(self):
        """Mean frequency of each mode over the configurations (modes,), for a shaper that does not vary [Hz]."""
        return self.frequencies.mean(axis=0)

    @property
    def delay(self):
        """Mean delay of the shaped motion, at the mean frequencies [s]."""
        mean = self.mean_frequencies
        return float(sum(s.cycles @ s.amplitudes / mean[s.mode] for s in self.stages))

    @property
    def max_duration(self):
        """Largest time by which a motion gets longer [s]."""
        low = self.frequencies.min(axis=0) if self.varies else self.mean_frequencies
        return float(sum(s.cycles[-1] / low[s.mode] for s in self.stages))

    def at(self, q):
        """Frequencies at joint positions (k, n), (k, modes) [Hz]."""
        q = np.asarray(q, float)
        if len(self.frequencies) == 1:
            return np.repeat(self.frequencies, len(q), axis=0)
        squared = ((q[:, None] - self.configurations) ** 2).sum(axis=2)
        # Products of the other distances stand for 1/distance^2: they are finite at the configurations, too.
        weights = np.stack(
            [np.delete(squared, c, axis=1).prod(axis=1) for c in range(squared.shape[1])], axis=1
        )
        weights /= weights.sum(axis=1, keepdims=True)
        return weights @ self.frequencies

    def along(self, q):
        """Frequencies [Hz] and damping ratios, (k, modes) each, at joint positions (k, n), for motions that pass them.

        Unlike those of `at`, they change evenly between two configurations: they are a linear combination of a constant
        and the distances from all configurations, kept between the smallest and the largest measured.
        """
        q, rows = np.asarray(q, float), len(self.frequencies)
        known = np.hstack([self.frequencies, self.dampings])
        if rows == 1:
            found = np.repeat(known, len(q), axis=0)
        else:
            system = np.ones((rows + 1, rows + 1))
            system[:-1, :-1], system[-1, -1] = (
                _distances(self.configurations, self.configurations),
                0.0,
            )
            weights = np.linalg.solve(system, np.vstack([known, np.zeros(known.shape[1])]))
            parts = np.column_stack([_distances(q, self.configurations), np.ones(len(q))])
            found = np.clip(parts @ weights, known.min(axis=0), known.max(axis=0))
        return np.hsplit(found, 2)

    def constant(self):
        """The `Shaper` of frequencies that are everywhere the same."""
        if not self.stages:
            return shapers.Shaper(np.zeros(1), np.ones(1))
        frequencies = self.mean_frequencies
        trains = [shapers.Shaper(s.cycles / frequencies[s.mode], s.amplitudes) for s in self.stages]
        return shapers.convolve(trains)


def _distances(q, other):
    """Distances (k, l) [rad] of positions (k, n) from others (l, n)."""
    return np.linalg.norm(q[:, None] - other, axis=2)


def _different(frequencies, dampings):
    """Modes (k,), without those that are `ALIKE` to a previous one."""
    kept = []
    for i, frequency in enumerate(frequencies):
        if all(abs(frequencies[j] / frequency - 1.0) > ALIKE for j in kept):
            kept.append(i)
    return frequencies[kept], dampings[kept]
