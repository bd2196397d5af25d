# SPDX-License-Identifier: Apache-2.0
r"""Composite control, (12) of Siciliano & Book (1986): u = u_slow(x) + u_fast(x, z_f).

The fast control holds the deflections to those of the slow motion, z_bar, by z_f = z - z_bar. The paper takes their
quasi-steady state (9); `manifold` has it and better ones. On the manifold z_f = 0 and u_fast = 0.

Two jumps are made to fade (module `fading`):

- A control that replaces another one adds to its slow torque the old control's torque minus its own at that sample. If
  it is for another payload, this difference fades within two periods of the lowest mode with locked joints, so that the
  arm does not ring; if the reference also rests, the slow law's integral first takes as much of it as it can.
- Without a feed-forward, slow torque and manifold jump where the reference changes to another polynomial with another
  jerk and snap. The jump is the value for the previous polynomial, continued to this sample, minus the value for the
  new one. A feed-forward lets jumps fade in its own motion.
"""

import numpy as np

from .. import kernels
from ..arrays import clip, some
from ..component import at_rest
from ..fading import Fading, fading_rate, lowest
from ..feedforward.model import At
from ..manifold.quasi_steady import QuasiSteady
from ..trajectory.path import Path
from ..trajectory.values import SECOND
from .seen import SeenMotion

#: Ratio of the rate at which the torque of another payload fades to the lowest locked frequency: a hundredth is left
#: after two periods.
PAYLOAD_FADING = 8.4 / (4.0 * np.pi)


class CompositeControl:
    """Slow law, slow manifold and fast law together; every array of the last step stays readable.

    Parameters
    ----------
    model : ArmModel
    slow : SlowLaw
    fast : FastLaw
    manifold : Manifold, optional
        If not given, that of the paper, `QuasiSteady`.
    feedforward : Feedforward, optional
        The motion that the arm is held to; if not given, the reference and its manifold.
    seen : dict, optional
        How the observer would show that motion: the further arguments of `SeenMotion`; if not given, as it is.
    together : bool
        Whether a joint at its torque limit scales the feedback of all joints, or is clipped alone; used only with a
        feed-forward.

    Attributes
    ----------
    slow_torque, fast_torque, torque : ndarray, shape (n,)
        [N m]; the feed-forward of the manifold is part of the slow torque.
    quasi_steady : ndarray, shape (m,)
        delta_bar of the manifold [m, rad].
    deviation : ndarray, shape (2m,)
        z_f = z - z_bar [m, rad, m/s, rad/s].
    fast_fraction : float
        Fraction of the fast torque that is applied, 0 to 1.
    """

    def __init__(
        self, model, slow, fast, manifold=None, feedforward=None, seen=None, together=False
    ):
        self.model, self.slow, self.fast = model, slow, fast
        self.fast_fraction, self._together = 1.0, together
        self._last = None  # reference of the feed-forward, and interval, of the last step
        self._delay, self._lead_ns = np.nan, 0  # of the torque [s], and of that reference [ns]
        n, rate = model.n_joints, fading_rate(model)
        self._limit = np.full(n, np.inf)
        # Jump of the torque from the replaced control, which is `_before` until the first step of this one.
        self._exchanged, self._before = Fading(n, rate), None
        self._other_payload = False  # whether the replaced control had another payload
        # Jumps of (slow torque, delta_bar, its rate); path, piece, stamp and position of the last step.
        self._pieces, self._source = Fading(n + 2 * model.n_modes, rate), None
        # A motion as bytes, and the slow law's torque on it.
        self._nominal, self._no_torque = (b"", np.zeros(n)), np.zeros(n)
        self.manifold = QuasiSteady(model, slow, {}) if manifold is None else manifold
        self.feedforward = self._seen = feedforward
        if feedforward is not None:
            self._seen = feedforward if seen is None else SeenMotion(feedforward, **seen)
            response = self.manifold.error_response(feedforward.settings.configuration)
            self._response, self._bar = np.vstack(response), np.zeros(2 * model.n_modes)
        n, m = model.n_joints, model.n_modes
        self.slow_torque, self.fast_torque, self.torque = np.zeros(n), np.zeros(n), np.zeros(n)
        self._wanted = np.zeros(n)
        self.quasi_steady, self.deviation = np.zeros(m), np.zeros(2 * m)

    @property
    def limit(self):
        """Torque limit that the feed-forward keeps to, shape (n,) [N m]; infinite: none."""
        return self._limit

    @limit.setter
    def limit(self, value):
        self._limit = value
        if self.feedforward is not None:
            self.feedforward.limit = value

    def take_delay(self, delay):
        """Take the measured time from a sample until the torque that answers it acts [s]; NaN: not known."""
        self._delay = delay

    def warnings(self):
        """What a user should know about these laws on this arm; each a sentence."""
        return [text for part in self._parts() for text in part.warnings()]

    def _parts(self):
        parts = self.slow, self.fast, self.feedforward
        return [part for part in parts if part is not None]

    def resume(self, other):
        """Go on from another control's states and torque, so that a redesign does not start over."""
        self.slow.resume(other.slow)
        self.fast.resume(other.fast)
        if self.feedforward is not None and other.feedforward is not None:
            self.feedforward.resume(other.feedforward)
            if isinstance(self._seen, SeenMotion) and isinstance(other._seen, SeenMotion):
                self._seen.take(other._seen)
        self.limit, self.fast_fraction = other.limit, other.fast_fraction
        self._pieces.take(other._pieces)
        self._source = other._source
        self._delay, self._lead_ns = other._delay, other._lead_ns
        self._other_payload = other.model.payload_scale != self.model.payload_scale
        if self._other_payload:
            self._exchanged.rate = PAYLOAD_FADING * lowest(self.model)
        # A control that has had no sample has nothing to go on from.
        self._before = other if other._last is not None else other._before

    @property
    def needs_rates(self):
        """Whether the rates of the deflections, and so an observer, are needed."""
        return self.fast.needs_rates

    @property
    def free(self):
        """Whether no law holds the joints to the reference."""
        return self.slow.drifts

    def reset(self):
        """Begin a new session: the laws forget their own states."""
        for part in self._parts():
            part.reset()
        self._exchanged.clear()
        self._pieces.clear()
        self._last = self._before = self._source = None

    def step(self, q, qd, delta, delta_d, reference, dt=0.0):
        """Torque for one sample; runs on the control path.

        Parameters
        ----------
        q, qd : ndarray, shape (n,)
            Joint position and velocity [rad], [rad/s].
        delta, delta_d : ndarray, shape (m,)
            Modal amplitude and rate [m, rad], [m/s, rad/s]; the rate may be None for a fast law that needs none.
        reference : object
            With `position`, `velocity`, `acceleration`, each (n,), and ``near``, as for `Manifold.update`.
        dt : float
            Time since the last sample [s], for laws with states of their own; 0: the first sample.

        Returns
        -------
        ndarray, shape (n,)
            u of (12) [N m], not clipped to the torque limit; with `together`, the feedback about a feed-forward is
            already scaled to it. Overwritten by the next step.
        """
        before, self._before = self._before, None
        self._advance(reference, dt)
        if self.feedforward is None:
            u_slow, delta_bar, rate_bar = self._slow_on_manifold(q, qd, reference, dt)
        else:
            u_slow, delta_bar, rate_bar = self._slow_about_motion(q, qd)
        z_f = self._deviation(delta, delta_d, delta_bar, rate_bar)  # z - z_bar
        u_fast = np.multiply(self.fast.torque(z_f, q), self.fast_fraction, out=self.fast_torque)
        np.add(u_slow, u_fast, out=self.torque)  # (12)
        wanted = self.torque
        if self._together and self.feedforward is not None:
            wanted = self._within_limit(u_slow, u_fast)
        if self._goes_over(before, (q, qd, delta, delta_d, reference, dt)):
            u_slow += self._exchanged.left
            np.add(u_slow, u_fast, out=self.torque)
        self.slow.saw(wanted)
        return self.torque

    def _within_limit(self, u_slow, u_fast):
        """Scale the feedback of all joints so that no torque is beyond its limit; return the torque for `SlowLaw.saw`.

        Gains that couple all joints are designed for the direction of their torque. If one joint alone were clipped,
        the others might drive the arm on. Meanwhile no integral grows in the direction of its joint's torque: with all
        gains reduced, a loop may be stable only without integrals.
        """
        scaled = kernels.compiled().together(
            self.feedforward.torque, self._limit, u_slow, u_fast, self.torque, self._wanted
        )
        return self._wanted if scaled else self.torque

    def _goes_over(self, before, sample):
        """Whether torque of a replaced control still fades at this `sample`; `before` is that control, or None."""
        fading = self._exchanged
        fading.advance(sample[-1])
        if before is not None and sample[-1] > 0.0:
            old = before.step(*sample).copy()
            clip(old, -self._limit, self._limit)  # as the old control's torque is sent
            old -= self.torque
            if self._other_payload and not sample[4].velocity.any():
                taken = self.slow.absorb(old)
                self.slow_torque += taken
                self.torque += taken
                old -= taken
            fading.jump(old)
        return some(fading.left)

    def _advance(self, reference, dt):
        """Advance the states of the laws, and the feed-forward's motion, to this sample."""
        if dt > 0.0:
            self.slow.advance(dt)
            self.fast.advance(dt)
        if self.feedforward is not None:
            reference = self._led(reference)
            self.feedforward.update(reference, dt)
            if self._seen is not self.feedforward:
                self._seen.update(dt)
        self._last = reference, dt

    def _led(self, reference):
        """The reference that the feed-forward follows: so far ahead that the arm, whose torque is late, is on time.

        The delay that has been measured by then is taken while no trajectory is followed, and kept until its end.
        """
        path, stamp_ns = getattr(reference, "path", None), getattr(reference, "stamp_ns", 0)
        if path is not None and path.piece(stamp_ns) != Path.END:
            return At(path, stamp_ns + self._lead_ns) if self._lead_ns else reference
        self._lead_ns = 0
        if isinstance(self._seen, SeenMotion):
            self._seen.be_late(self._delay)
            self._lead_ns = round(self._seen.late * SECOND)
        return reference

    def _slow_on_manifold(self, q, qd, reference, dt):
        """Slow torque towards the reference, including the manifold's torque, and the manifold's z_bar."""
        terms = self.slow.model.terms(q, qd)  # of the arm as the slow law estimates it
        fading, source = self._pieces, self._source
        fading.advance(dt)
        path, stamp_ns = getattr(reference, "path", None), getattr(reference, "stamp_ns", 0)
        piece = None if path is None else path.piece(stamp_ns)
        self._source = path, piece, stamp_ns, reference.position.copy()
        old = None
        if source is not None and dt > 0.0 and (path, piece) != source[:2]:
            old = np.concatenate(self._towards(q, qd, self._continued(source, dt), terms))
        u, amplitude, rate = self._towards(q, qd, reference, terms)
        if old is not None:
            fading.jump(old - np.concatenate([u, amplitude, rate]))
        if not some(fading.left):
            return u, amplitude, rate
        n, m = self.model.n_joints, self.model.n_modes
        more = np.split(fading.left, [n, n + m])
        u += more[0]
        return u, amplitude + more[1], rate + more[2]

    def _towards(self, q, qd, reference, terms):
        """Slow torque towards a reference, including the manifold's, (n,); delta_bar and its rate, (m,)."""
        u, manifold = self.slow_torque, self.manifold
        u[:] = self.slow.torque(q, qd, reference, terms)
        manifold.update(q, qd, reference, terms, u)
        u += manifold.feedforward
        return u, manifold.amplitude, manifold.rate

    def _continued(self, source, dt):
        """The reference that the last step's polynomial would give now, `dt` [s] after that step."""
        path, _, stamp_ns, position = source
        return at_rest(position) if path is None else At(path, stamp_ns, dt)

    def _slow_about_motion(self, q, qd):
        """Slow torque about the feed-forward's motion, and that motion's deflections moved by the tracking error.

        The motion's torque replaces the slow law's torque on the motion. The manifold's response to the tracking error
        is added to torque and deflections.
        """
        u, motion, m, seen = self.slow_torque, self.feedforward, self.model.n_modes, self._seen
        if self.slow.separate:
            u[:], nominal = self.slow.feedback(q, qd, seen), self._no_torque
        else:
            u[:] = self.slow.torque_at(q, qd, motion)
            nominal = self._nominal_torque(motion.position, motion.velocity, motion.acceleration)
        kernels.compiled().about_motion(
            q, qd, seen.position, seen.velocity, motion.torque, nominal, self._response, seen.amplitude,
            seen.rate, u, self._bar,
        )  # fmt: skip
        return u, self._bar[:m], self._bar[m:]

    def _deviation(self, delta, delta_d, delta_bar, rate_bar):
        """z_f = z - z_bar, shape (2m,); unknown rates are NaN."""
        z_f, m = self.deviation, delta.size
        if delta_d is not None:
            kernels.compiled().deviation(
                delta, delta_d, delta_bar, rate_bar, self.quasi_steady, z_f
            )
            return z_f
        self.quasi_steady[:] = delta_bar
        np.subtract(delta, delta_bar, out=z_f[:m])
        z_f[m:] = np.nan
        return z_f

    def look_ahead(self):
        """Compute ahead what the next step needs but does not depend on its sample; call once the torque is sent.

        The reference at the next stamp is known if the time to the next sample equals the time since the last one.
        Otherwise, or without this call, the next step does the work itself, with the same result to the last bit.
        """
        if self.feedforward is None or self._last is None:
            return
        foreseen = self.feedforward.look_ahead(*self._last)
        if foreseen is not None and not self.slow.separate:
            self._nominal_torque(*foreseen)

    def _nominal_torque(self, position, velocity, acceleration):
        """The slow law's torque on a motion, (n,); the last result is cached."""
        motion = position.tobytes() + velocity.tobytes() + acceleration.tobytes()
        if motion != self._nominal[0]:
            torque = self.slow.nominal_at(position, velocity, acceleration)
            self._nominal = motion, np.array(torque)
        return self._nominal[1]
