# SPDX-License-Identifier: Apache-2.0
r"""Finds the shaper that leaves least of several modes with uncertain frequencies, in a given time.

Impulses :math:`A_k \ge 0` at equal spacing over the time allowed, :math:`\sum_k A_k = 1`, are chosen by a linear
programme. It minimises the largest residual V (module `shapers`) over all frequencies within the spread of any mode:

.. math:: \min_{A,\,\epsilon} \epsilon \quad\text{with}\quad
    \mathrm{Re}\,\bigl(e^{-j\varphi} \sum_k A_k e^{\zeta\omega(t_k - t_n)} e^{j\omega_d t_k}\bigr) \le \epsilon

for closely spaced frequencies and for directions :math:`\varphi` around the circle. The polygon of these directions
gives V with a relative error of at most 1 - cos(pi / `DIRECTIONS`). At each mode's own frequency V is at most
:math:`\epsilon` times `AT_DESIGN`. Minimax designs instead of several conditions are due to Singhose, Seering & Singer
(1994) for one mode, and as linear programmes to Singh (2008), *Minimax input shaper design using linear programming*.
"""

import numpy as np
from scipy.optimize import linprog

from flexarm_dynamics.errors import DesignError

from .shapers import Shaper, half_period

#: Numbers of impulses over the whole time, frequencies over the spread of a mode, and directions around the circle.
IMPULSES, FREQUENCIES, DIRECTIONS = 65, 13, 16
#: V at a mode's own frequency, over the largest V within its spread [-].
AT_DESIGN = 0.3
#: A linear programme is given up after this many iterations; some 100 are usual. This is a count, so that a busy
#: computer finds the same shaper.
ITERATIONS = 10_000
#: Impulses below this fraction are left out [-].
NEGLIGIBLE = 1e-6


def robust(frequencies, dampings, spread, periods) -> Shaper:
    """Return the shaper of several modes whose largest residual is smallest.

    Parameters
    ----------
    frequencies : (m,) array_like
        Natural frequencies, above 0 [Hz].
    dampings : (m,) array_like
        Damping ratios, at least 0 and below 1 [-].
    spread : float
        Fraction by which the frequencies may be off [-].
    periods : float
        Largest length of the shaper, in damped periods of the lowest mode [-].

    Raises
    ------
    DesignError
        If a mode does not vibrate, or grows.
    """
    modes = sorted(zip(frequencies, dampings, strict=True))
    for frequency, damping in modes:
        half_period(2.0 * np.pi * frequency, damping)  # refuses
    lowest = 2.0 * half_period(2.0 * np.pi * modes[0][0], modes[0][1])[0]
    times = np.linspace(0.0, periods * lowest, IMPULSES)
    around = np.exp(-2j * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)
    rows, limits = [], []
    for frequency, damping in modes:
        for ratio in np.linspace(1.0 - spread, 1.0 + spread, FREQUENCIES):
            w = 2.0 * np.pi * frequency * ratio
            left = np.exp(damping * w * (times - times[-1]))
            left = left * np.exp(1j * w * np.sqrt(1.0 - damping**2) * times)
            rows.append((around[:, None] * left).real)
            own = abs(ratio - 1.0) < 1e-9
            limits.append(np.full(DIRECTIONS, AT_DESIGN if own else 1.0))
    bound = np.column_stack([np.concatenate(rows), -np.concatenate(limits)])
    cost = np.zeros(IMPULSES + 1)
    cost[-1] = 1.0
    total = np.append(np.ones(IMPULSES), 0.0)[None]
    found = linprog(
        cost, bound, np.zeros(len(bound)), total, [1.0],
        method="highs", options={"maxiter": ITERATIONS},
    )  # fmt: skip
    if not found.success:
        raise DesignError(f"not found: {found.message}", field="robust shaper")
    amplitudes = found.x[:-1]
    kept = amplitudes > NEGLIGIBLE
    amplitudes = amplitudes[kept] / amplitudes[kept].sum()
    return Shaper(times[kept] - times[kept][0], amplitudes)
