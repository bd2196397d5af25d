# SPDX-License-Identifier: Apache-2.0
r"""Maps strains to modal amplitudes and back.

For bending, a gauge at :math:`\eta` on a face at distance c from the neutral axis reads

.. math:: \varepsilon = -c\,y''(\eta) = -\frac{c}{L^2}\sum_i\phi_i''(\eta/L)\,\delta_i

(tension positive: a beam bent towards +y is compressed on its +y face), and for twist
:math:`\gamma = c\,\theta'(\eta)`. The rows R of all gauges give strain = gain * R delta + bias. The inverse map is
weighted least squares; each weight is one over the noise variance:

.. math:: \hat\delta = (R_o^T W R_o)^{-1} R_o^T W\,(\varepsilon - b)

where the rows include the gains. The variance of a reading is that of its noise, plus step^2/12 if the bridge rounds to
steps. The errors of different gauges are independent, so the amplitudes have the covariance :math:`(R_o^T W R_o)^{-1}`.
Modes that are not observed change the estimate by :math:`R_o^+R_u\delta_u`: spill-over.
"""

import numpy as np

from ..errors import ModelError, check_shape


def gauge_rows(model, gauges, mode_names=None):
    """Rows R with strain = R delta, without gains and biases.

    Parameters
    ----------
    model : ArmModel
        Its mode shapes are used.
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
            if gauge.point:
                rows[i, j] = shapes.strain(gauge.point)[mode.number - 1]
                continue
            if mode.direction == "twist":
                value = shapes(gauge.position / length, 1)[mode.number - 1] / length
                rows[i, j] = gauge.surface_distance * value
            else:
                value = shapes(gauge.position / length, 2)[mode.number - 1] / length**2
                rows[i, j] = -gauge.surface_distance * value
    return rows


def reading_rows(model, gauges, mode_names=None):
    """As `gauge_rows`, times the gain of each gauge: they give the readings without biases."""
    gains = np.array([gauge.gain for gauge in gauges], float)
    return gains[:, None] * gauge_rows(model, gauges, mode_names)


def reading_noise(gauges):
    """Rms error of each gauge's reading for the weights, shape (gauges,) [strain], and whether any gauge states it.

    A gauge that states neither noise nor bits has the weight of the most accurate gauge that does. If none does, all
    weights are equal.
    """
    noise = np.array([g.uncertainty for g in gauges])
    stated = noise > 0.0
    return np.where(stated, noise, noise[stated].min() if stated.any() else 1.0), bool(stated.any())


def confused(rows, mode_names):
    """Modes that gauges with these rows can't tell apart.

    Each column is first scaled to unit norm. So only the pattern of strain counts, not that a higher mode strains more.

    Parameters
    ----------
    rows : ndarray, shape (gauges, modes)
        Weighted rows.
    mode_names : sequence of str

    Returns
    -------
    unseen : tuple of str
        Modes that strain no gauge.
    alike : tuple of str
        Modes that can combine so that they strain no gauge; empty if there are none.
    """
    size = np.linalg.norm(rows, axis=0)
    seen = size > size.max(initial=0.0) / StrainMap.WORST_CONDITION
    unseen = tuple(n for n, s in zip(mode_names, seen, strict=True) if not s)
    names = [n for n, s in zip(mode_names, seen, strict=True) if s]
    if not names:
        return unseen, ()
    # If there are fewer gauges than modes, rows of zeros are needed to get the whole null space.
    scaled = np.vstack([rows[:, seen] / size[seen], np.zeros((len(names), len(names)))])
    _, values, directions = np.linalg.svd(scaled)
    null = directions[values < values[0] / StrainMap.WORST_CONDITION]
    share = np.linalg.norm(null, axis=0)
    return unseen, tuple(n for n, s in zip(names, share, strict=True) if s > 1e-3)


class StrainMap:
    """Strain to amplitudes of the observed modes.

    Parameters
    ----------
    model : ArmModel
        The model that the observer uses.

    Attributes
    ----------
    gauge_names, mode_names : tuple of str
        Order of the strains (input) and of the amplitudes (output).
    rows : ndarray, shape (gauges, modes)
        R_o, gain included.
    noise : ndarray, shape (gauges,)
        Rms error of a reading on which the weights are based [strain]; 1 if no gauge states one.
    noise_stated : bool
        Whether any gauge states one.
    inverse : ndarray, shape (modes, gauges)
        Weighted pseudo-inverse.
    condition : float
        Condition number of the weighted rows.
    """

    #: Condition number above which the gauges can't tell the modes apart, and noise hides the amplitudes.
    WORST_CONDITION = 1e6
    #: Number of sets of lost gauges for which inverses are kept.
    KEPT = 256

    def __init__(self, model):
        arm = model.arm
        self.gauge_names = arm.gauge_names
        self.mode_names = arm.observed_modes
        if len(arm.gauges) < len(self.mode_names):
            raise ModelError(
                f"can't give {len(self.mode_names)} modal amplitudes",
                field=f"gauges of {arm.name}",
                value=len(arm.gauges),
                hint="add gauges or list fewer observed_modes",
            )
        self.rows = reading_rows(model, arm.gauges, self.mode_names)
        self.noise, self.noise_stated = reading_noise(arm.gauges)
        weighted = self._weighted = self.rows / self.noise[:, None]
        self.condition = float(np.linalg.cond(weighted)) if weighted.size else 1.0
        if not self.condition < self.WORST_CONDITION:
            raise ModelError(
                f"can't tell {', '.join(self.mode_names)} apart: condition number {self.condition:.3g}",
                field=f"gauges of {arm.name}",
                limit=f"at most {self.WORST_CONDITION:g}",
                hint="move one away from a point where a mode has no curvature",
            )
        self.inverse = np.linalg.pinv(weighted) / self.noise[None, :]
        self.bias = [g.bias for g in arm.gauges]
        self._inverses = {}
        for i in range(len(arm.gauges)):
            self.inverse_without((i,))

    @property
    def bias(self):
        """Reading without strain, shape (gauges,) [strain]; setting it calibrates the map."""
        return self._bias

    @bias.setter
    def bias(self, bias):
        bias = np.array(bias, float)
        check_shape(bias, (len(self.gauge_names),), "bias")
        self._bias, self._offset = bias, self.inverse @ bias

    @property
    def amplitude_noise(self):
        """Rms noise of each amplitude, shape (modes,) [m, rad]; NaN if no gauge states its own."""
        if not self.noise_stated:
            return np.full(len(self.mode_names), np.nan)
        return np.linalg.norm(self.inverse * self.noise, axis=1)

    def amplitudes(self, strain, out=None):
        """Modal amplitudes, shape (modes,), from strains, shape (gauges,)."""
        out = np.dot(self.inverse, strain, out=out)
        out -= self._offset
        return out

    def possible_without(self, lost):
        """Whether the gauges that are not in `lost`, a tuple of indices, give all modes."""
        return self.inverse_without(lost) is not None

    def amplitudes_without(self, lost, strain, out=None):
        """Modal amplitudes from the other gauges only; strains of lost gauges may have any value.

        Parameters
        ----------
        lost : tuple of int
            Indices of gauges, ascending, for which `possible_without` holds.
        strain : ndarray, shape (gauges,)
        out : ndarray, shape (modes,), optional
            Written and returned if given.

        Returns
        -------
        ndarray, shape (modes,)
        """
        if not lost:
            return self.amplitudes(strain, out)
        difference = np.subtract(strain, self._bias)
        difference[list(lost)] = 0.0
        return np.dot(self.inverse_without(lost), difference, out=out)

    def inverse_without(self, lost):
        """`inverse` of the gauges that are not in `lost`, with zeros for the others; None if they don't suffice.

        The inverse for each single loss is prepared at the start. The inverse for several losses is computed when they
        first occur, in about 0.1 ms, and kept.
        """
        if not lost:
            return self.inverse
        if lost not in self._inverses:
            if len(self._inverses) >= self.KEPT:
                self._inverses.clear()
            self._inverses[lost] = self._make_inverse(lost)
        return self._inverses[lost]

    def _make_inverse(self, lost):
        left = np.setdiff1d(np.arange(len(self.gauge_names)), lost)
        weighted, modes = self._weighted[left], len(self.mode_names)
        inverse = np.zeros_like(self.inverse)
        if not modes:
            return inverse
        # Fewer gauges than modes would give a guess of minimum norm, which is not a measurement.
        if left.size < modes or not np.linalg.cond(weighted) < self.WORST_CONDITION:
            return None
        inverse[:, left] = np.linalg.pinv(weighted) / self.noise[left]
        return inverse

    def unobservable_without(self, lost):
        """Names of the modes that the gauges not in `lost` can't measure, or can't tell from one another."""
        left = np.setdiff1d(np.arange(len(self.gauge_names)), lost)
        unseen, alike = confused(self._weighted[left], self.mode_names)
        return tuple(n for n in self.mode_names if n in (*unseen, *alike))
