# SPDX-License-Identifier: Apache-2.0
"""Base class of fast laws."""

import numpy as np

from ..component import Law


class FastLaw(Law):
    """Fast control u_fast of (12) and (15), designed on the boundary layer (11).

    A fast law is registered by name in the entry-point group ``flexarm.fast_laws``. Its parameters are
    ``fast.<name>`` in the controller node. The constructor solves Riccati equations; `torque` runs on the control
    path. u_fast is zero where z_f is zero: the constraint of (12).

    Attributes
    ----------
    K_f : ndarray, shape (n, 2m)
        Feedback gain of (15), u_fast = K_f z_f [N m/m, N m s/m]. A law whose gain depends on q overrides `gain`; a law
        with states of its own overrides `torque`.
    """

    #: False for a law that uses the amplitudes alone and so runs without an observer.
    needs_rates = True

    @property
    def configuration(self):
        """Joint configuration that the law is designed for, shape (n,) [rad]; the full-order loop is checked there."""
        return np.array(self.parameters.get("configuration", np.zeros(self.model.n_joints)))

    def torque(self, z_f, q):
        """Fast torque.

        Parameters
        ----------
        z_f : ndarray, shape (2m,)
            z - z_bar [m, rad, m/s, rad/s]; the rates are NaN for a law that needs none.
        q : ndarray, shape (n,)
            Joint position, for gains that depend on it [rad].

        Returns
        -------
        ndarray, shape (n,)
            [N m]
        """
        return self.gain(q) @ z_f

    def gain(self, q):
        """K_f in configuration q; None for a law with states of its own, described by `state_space` instead."""
        return self.K_f

    def state_space(self, dt):
        r"""Discrete compensator of a law with states: :math:`w' = A w + B z_f,\; u_f = C w + D z_f`.

        None for a law without states.

        Parameters
        ----------
        dt : float
            Sampling period [s].

        Returns
        -------
        A, B, C, D : ndarray or None
        """
        return None
