# SPDX-License-Identifier: Apache-2.0
"""How much of the sensors' noise the gains pass on to the torque."""

import numpy as np

from flexarm_dynamics.arm.strain_map import StrainMap

from ..low_pass import POLES

#: Joint and strain noise assumed where the file states none [rad], [-].
ENCODER_NOISE, STRAIN_NOISE = 1.5e-5, 1e-6
#: Number of samples of the impulse response of the filters.
SAMPLES = 4096


class Noise:
    """Torque due to sensor noise, over the torque limit, and the penalty for too much of it.

    Parameters
    ----------
    slowest : Slowest
    model : ArmModel
    sampling : Sampling
    allowed : float
        Rms torque of the noise over the limit from which the penalty begins [-].
    omega_1 : float
        [rad/s]
    """

    def __init__(self, slowest, model, sampling, allowed, omega_1):
        n, m, arm = model.n_joints, model.n_modes, model.arm
        counts = np.array([j.encoder_counts for j in arm.joints], float)
        with np.errstate(divide="ignore"):
            joint = np.where(counts > 0, 2.0 * np.pi / counts / np.sqrt(12.0), ENCODER_NOISE)
        modal = np.zeros(m)
        if m:
            map_ = StrainMap(model)
            strain = np.array([g.uncertainty or STRAIN_NOISE for g in arm.gauges])
            modal = np.linalg.norm(map_.inverse * strain, axis=1)
        sigma = np.zeros(3 * n + 2 * m)
        position, joint_rate, modal_rate = (
            _passed(sampling, corner)
            for corner in (None, sampling.joint_corner, sampling.modal_corner)
        )
        sigma[:n], sigma[3 * n : 3 * n + m] = joint * position, modal * position
        sigma[n : 2 * n], sigma[3 * n + m :] = joint * joint_rate, modal * modal_rate
        limit, inertia = arm.torque_limits, np.diag(model.terms(np.zeros(n), np.zeros(n)).M)[:n]
        limit = np.where(np.isfinite(limit), limit, inertia * omega_1**2)
        self._share = sigma / limit[:, None]
        self._slowest, self._allowed = slowest, allowed

    def shares(self, K):
        """Rms torque of the noise over the limit, (..., n) [-]."""
        return np.sqrt(((K * self._share) ** 2).sum(axis=-1))

    def __call__(self, x):
        """The penalty of scaled gains, and its gradient."""
        slowest = self._slowest
        K = slowest.gains(x).reshape(-1, *slowest.scale.shape)
        shares = self.shares(K)
        over = np.log(np.maximum(shares / self._allowed, 1.0))
        slope = (2.0 * over / np.maximum(shares, self._allowed) ** 2)[..., None] * K
        slope *= self._share**2 * slowest.scale
        return float((over**2).sum()), slope[:, slowest.free].ravel()


def _passed(sampling, corner):
    """Rms noise after the torque's low pass, over the rms of a signal's white noise.

    With a `corner` [rad/s], the signal first passes a filtered derivative [1/s]; with None it does not [-].
    """
    from scipy.signal import lfilter  # with scipy.stats a third of a node's start

    pulse = np.zeros(SAMPLES)
    pulse[0] = 1.0
    if corner is not None:
        keep = np.exp(-corner * sampling.period)
        pulse = lfilter(np.array([1.0, -1.0]) * (1.0 - keep) / sampling.period, [1.0, -keep], pulse)
    keep = np.exp(-sampling.torque_corner * sampling.period)
    for _ in range(POLES):
        pulse = lfilter([1.0 - keep], [1.0, -keep], pulse)
    return np.linalg.norm(pulse)
