"""What the simulator measures: encoder and strain gauges."""

import numpy as np

from flexarm_dynamics.strain_map import gauge_rows


class Sensors:
    """Encoder counts and strains of a plant.

    Parameters
    ----------
    model : ArmModel
        The plant's model: gauges see all of its modes.
    noise : bool
        Whether gauges have the noise that the arm file states.
    seed : int
        Of the noise.
    """

    def __init__(self, model, noise=False, seed=0):
        arm = model.arm
        self.rows = gauge_rows(model, arm.gauges) * np.array(
            [[g.gain] for g in arm.gauges] or [[1.0]]
        )
        self.bias = np.array([g.bias for g in arm.gauges])
        self.sigma = np.array([g.noise if noise else 0.0 for g in arm.gauges])
        counts = np.array([j.encoder_counts for j in arm.joints], float)
        self._step = np.where(counts > 0, 2.0 * np.pi / np.where(counts > 0, counts, 1.0), 0.0)
        self._seed = seed
        self.reset()

    def reset(self):
        """Start the noise again."""
        self._random = np.random.default_rng(self._seed)

    def position(self, q, out):
        """Encoder reading of joint angles, rounded to counts where the arm file states them [rad]."""
        out[:] = q
        quantised = self._step > 0.0
        if quantised.any():
            out[quantised] = self._step[quantised] * np.round(q[quantised] / self._step[quantised])
        return out

    def strain(self, delta, out):
        """Gauge readings [strain]."""
        np.dot(self.rows, delta, out=out)
        out += self.bias
        if self.sigma.any():
            out += self.sigma * self._random.standard_normal(out.size)
        return out
