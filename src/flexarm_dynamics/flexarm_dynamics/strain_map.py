r"""Gauges to modal amplitudes and back.

A gauge at :math:`\eta` on a face at distance c from the neutral axis reads, for bending,

.. math:: \varepsilon = -c\,y''(\eta) = -\frac{c}{L^2}\sum_i\phi_i''(\eta/L)\,\delta_i

(tension positive: a beam bent towards +y is compressed on its +y face), and for twist
:math:`\gamma = c\,\theta'(\eta)`. The rows R of all gauges give strain = gain * R delta + bias; the map back
is weighted least squares, weights one over the noise variance:

.. math:: \hat\delta = (R_o^T W R_o)^{-1} R_o^T W\,(\varepsilon - b)/g .

Modes that the arm has but does not observe leak into the estimate by :math:`R_o^+R_u\delta_u`: spill-over.
"""

import numpy as np

from .errors import ModelError


def gauge_rows(model, gauges, mode_names=None):
    """Rows R with strain = R delta, gains and biases aside.

    Parameters
    ----------
    model : ArmModel
        Whose mode shapes bend.
    gauges : sequence of Gauge
    mode_names : sequence of str, optional
        Columns; all of the model's modes if not given.

    Returns
    -------
    ndarray, shape (gauges, modes)
        [1/m] for bending.
    """
    modes = [m for m in model.arm.modes if mode_names is None or m.name in mode_names]
    rows = np.zeros((len(gauges), len(modes)))
    for i, gauge in enumerate(gauges):
        length = model.arm.link(gauge.link).length
        for j, mode in enumerate(modes):
            if (mode.link, mode.direction) != (gauge.link, gauge.direction):
                continue
            shapes = model.mode_shapes(mode.link, mode.direction)
            if mode.direction == "twist":
                value = shapes(gauge.position / length, 1)[mode.number - 1] / length
                rows[i, j] = gauge.surface_distance * value
            else:
                value = shapes(gauge.position / length, 2)[mode.number - 1] / length**2
                rows[i, j] = -gauge.surface_distance * value
    return rows


class StrainMap:
    """Strain to amplitudes of the observed modes.

    Parameters
    ----------
    model : ArmModel
        The model that the observer believes in.

    Attributes
    ----------
    gauge_names, mode_names : tuple of str
        Order of strains in and amplitudes out.
    rows : ndarray, shape (gauges, modes)
        R_o, gain included.
    inverse : ndarray, shape (modes, gauges)
        Weighted pseudo-inverse.
    condition : float
        Condition number of the weighted rows.
    """

    #: Above this the gauges can't tell the modes apart and noise drowns the amplitudes.
    WORST_CONDITION = 1e6

    def __init__(self, model):
        arm = model.arm
        self.gauge_names = arm.gauge_names
        self.mode_names = arm.observed_modes
        if len(arm.gauges) < len(self.mode_names):
            raise ModelError(
                f"{arm.name}: {len(arm.gauges)} gauges can't give {len(self.mode_names)} modal"
                " amplitudes; add gauges or list fewer observed_modes"
            )
        gains = np.array([g.gain for g in arm.gauges])
        self.bias = np.array([g.bias for g in arm.gauges])
        self.rows = gains[:, None] * gauge_rows(model, arm.gauges, self.mode_names)
        # A gauge without a stated noise weighs as the quietest one that has it.
        noise = np.array([g.noise for g in arm.gauges])
        stated = noise[noise > 0.0]
        noise = np.where(noise > 0.0, noise, stated.min() if stated.size else 1.0)
        weighted = self.rows / noise[:, None]
        self.condition = float(np.linalg.cond(weighted)) if weighted.size else 1.0
        if not self.condition < self.WORST_CONDITION:
            raise ModelError(
                f"{arm.name}: the gauges can't tell {', '.join(self.mode_names)} apart (condition number"
                f" {self.condition:.3g}); move one away from a point where a mode has no curvature"
            )
        self.inverse = np.linalg.pinv(weighted) / noise[None, :]
        self._offset = self.inverse @ self.bias

    def amplitudes(self, strain, out=None):
        """Modal amplitudes, shape (modes,), from strains, shape (gauges,)."""
        out = np.dot(self.inverse, strain, out=out)
        out -= self._offset
        return out
