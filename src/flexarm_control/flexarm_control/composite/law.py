# SPDX-License-Identifier: Apache-2.0
r"""Composite control, (12) of Siciliano & Book (1986): u = u_slow(x) + u_fast(x, z_f).

The deflections that go with the slow motion, z_bar, are what the fast control holds on to: z_f = z - z_bar. The
paper takes their quasi-steady state (9); `manifold` has it and better ones. On the manifold z_f = 0 and u_fast = 0.
"""

import numpy as np

from ..manifold.quasi_steady import QuasiSteady


class CompositeControl:
    """Slow law, slow manifold and fast law together; every array of the last step stays readable.

    Parameters
    ----------
    model : ArmModel
    slow : SlowLaw
    fast : FastLaw
    manifold : Manifold, optional
        The paper's, `QuasiSteady`, if not given.
    feedforward : Feedforward, optional
        The motion that the arm is held to; the reference and the manifold's, if not given.

    Attributes
    ----------
    slow_torque, fast_torque, torque : ndarray, shape (n,)
        [N m]; the feed-forward of the manifold is part of the slow torque.
    quasi_steady : ndarray, shape (m,)
        delta_bar of the manifold [m, rad].
    deviation : ndarray, shape (2m,)
        z_f = z - z_bar [m, rad, m/s, rad/s].
    fast_share : float
        What part of the fast torque takes part, 0 to 1.
    """

    def __init__(self, model, slow, fast, manifold=None, feedforward=None):
        self.model, self.slow, self.fast = model, slow, fast
        self.fast_share = 1.0
        self._last = None  # reference and interval of the last step
        # Of what motion, and the slow law's torque on it.
        self._nominal = b"", np.zeros(model.n_joints)
        self.manifold = QuasiSteady(model, slow, {}) if manifold is None else manifold
        self.feedforward = feedforward
        if feedforward is not None:
            response = self.manifold.error_response(feedforward.settings.configuration)
            self._response, self._error = np.vstack(response), np.zeros(2 * model.n_joints)
        n, m = model.n_joints, model.n_modes
        self.slow_torque, self.fast_torque, self.torque = np.zeros(n), np.zeros(n), np.zeros(n)
        self.quasi_steady, self.deviation = np.zeros(m), np.zeros(2 * m)

    @property
    def limit(self):
        """Torque limit that the feed-forward keeps to, shape (n,) [N m]."""
        return None if self.feedforward is None else self.feedforward.limit

    @limit.setter
    def limit(self, value):
        if self.feedforward is not None:
            self.feedforward.limit = value

    def warnings(self):
        """What a user should know about these laws on this arm; each a sentence."""
        return [text for part in self._parts() for text in part.warnings()]

    def _parts(self):
        parts = self.slow, self.fast, self.feedforward
        return [part for part in parts if part is not None]

    def resume(self, other):
        """Go on from another control's states: a redesign does not begin anew."""
        for mine, its in (
            (self.slow, other.slow),
            (self.fast, other.fast),
            (self.feedforward, other.feedforward),
        ):
            if mine is not None and its is not None:
                mine.resume(its)
        self.limit, self.fast_share = other.limit, other.fast_share

    @property
    def needs_rates(self):
        """Whether the rates of the deflections are needed: an observer."""
        return self.fast.needs_rates

    @property
    def free(self):
        """Whether no law holds the joints to the reference."""
        return self.slow.drifts

    def reset(self):
        """A new session begins: the laws forget their own states."""
        self.slow.reset()
        self.fast.reset()
        if self.feedforward is not None:
            self.feedforward.reset()

    def step(self, q, qd, delta, delta_d, reference, dt=0.0):
        """Torque for one sample; the control path.

        Parameters
        ----------
        q, qd : ndarray, shape (n,)
            Joint position and velocity [rad], [rad/s].
        delta, delta_d : ndarray, shape (m,)
            Modal amplitude and rate [m, rad], [m/s, rad/s]; the rate may be None for a fast law without it.
        reference : object
            With `position`, `velocity`, `acceleration`, each (n,), and ``near``, as `Manifold.update` has it.
        dt : float
            Time since the last sample [s], for laws with states of their own; 0: the first one.

        Returns
        -------
        ndarray, shape (n,)
            u of (12) [N m]; before any limit. Overwritten by the next step.
        """
        m, self._last = delta.size, (reference, dt)
        if dt > 0.0:
            self.slow.advance(dt)
            self.fast.advance(dt)
        terms = self.slow.model.terms(q, qd)  # as the slow law believes the arm to be
        if self.feedforward is None:
            amplitude, rate = self._on_manifold(q, qd, reference, terms)
        else:
            amplitude, rate = self._on_motion(q, qd, reference, terms, dt)
        self.quasi_steady[:] = amplitude
        np.subtract(delta, amplitude, out=self.deviation[:m])
        if delta_d is None:
            self.deviation[m:] = np.nan
        else:
            np.subtract(delta_d, rate, out=self.deviation[m:])
        np.multiply(self.fast.torque(self.deviation, q), self.fast_share, out=self.fast_torque)
        np.add(self.slow_torque, self.fast_torque, out=self.torque)
        return self.torque

    def look_ahead(self):
        """Do beforehand what the next sample will need and what does not depend on it; call once the torque is sent.

        The reference at the next stamp is known if it comes as long after this one as this one came after the last;
        otherwise, or without this call, the next step does that work itself, with the same result to the last bit.
        """
        if self.feedforward is None or self._last is None:
            return
        foreseen = self.feedforward.look_ahead(*self._last)
        if foreseen is not None:
            self._nominal_torque(*foreseen)

    def _on_manifold(self, q, qd, reference, terms):
        """Slow torque, and z_bar of the manifold."""
        manifold = self.manifold
        self.slow_torque[:] = self.slow.torque(q, qd, reference, terms)
        manifold.update(q, qd, reference, terms, self.slow_torque)
        self.slow_torque += manifold.feedforward
        return manifold.amplitude, manifold.rate

    def _on_motion(self, q, qd, reference, terms, dt):
        """Slow torque about the feed-forward's motion, and z_bar: its deflections, moved by the tracking error."""
        motion, m = self.feedforward, self.model.n_modes
        motion.update(reference, dt)
        self.slow_torque[:] = self.slow.torque(q, qd, motion, terms)
        nominal = self._nominal_torque(motion.position, motion.velocity, motion.acceleration)
        self.slow_torque += motion.torque - nominal
        error, n = self._error, self.model.n_joints
        np.subtract(q, motion.position, out=error[:n])
        np.subtract(qd, motion.velocity, out=error[n:])
        moved = self._response @ error
        self.slow_torque += moved[2 * m :]
        return motion.amplitude + moved[:m], motion.rate + moved[m : 2 * m]

    def _nominal_torque(self, position, velocity, acceleration):
        """The slow law's torque on a motion, (n,); what was asked for last is remembered."""
        motion = position.tobytes() + velocity.tobytes() + acceleration.tobytes()
        if motion != self._nominal[0]:
            terms = self.model.terms(position, velocity)
            self._nominal = motion, np.array(self.slow.nominal(terms, acceleration))
        return self._nominal[1]
