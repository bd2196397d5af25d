# SPDX-License-Identifier: Apache-2.0
"""Simulates a network that loses and delays samples between the arm and its control.

Each sample of `arm_state` is lost with a given probability, independently of the others; otherwise it arrives after
``delay`` and a random time, uniform from 0 to ``jitter``. A sample that arrives after a newer one is dropped, as by a
DDS reader. Observer and controller answer at arrival, as the nodes do, and the torque acts at once: a delay of the
torque would have the same effect on the arm as a delay of the sample.

The driver's rules are those of `flexarm_ros.torque_gate`: a torque acts until the next one, but no longer than
`TORQUE_TIMEOUT` after the sample that it answers; then each joint's safe action acts. As in its node, the
controller disables the torque after `STATE_TIMEOUT` without a sample.
"""

import math
from dataclasses import replace
from heapq import heappop, heappush

import numpy as np

from flexarm_control.loop.samples import ArmSample
from flexarm_dynamics.errors import FlexarmError, MessageError

from .closed_loop import ClosedLoop

#: Maximum age of the sample that a torque answers [s].
TORQUE_TIMEOUT = 0.05
#: The controller disables the torque after this long without a sample [s].
STATE_TIMEOUT = 0.5
#: Time from sending a trajectory to its start [s].
LEAD = 0.1


class Network:
    """Loses and delays samples; the same seed loses the same ones.

    A sample is lost with the probability `loss` [-]; it is late by `delay` and a time uniform from 0 to `jitter` [s].
    """

    #: A longer delay than this is refused as a mistake [s].
    MAX_TIME = 1.0

    def __init__(self, loss=0.0, delay=0.0, jitter=0.0, seed=0):
        if not 0.0 <= loss <= 1.0:
            raise FlexarmError("is no probability", field="loss", value=loss, limit="from 0 to 1")
        for name, value in (("delay", delay), ("jitter", jitter)):
            if not 0.0 <= value <= self.MAX_TIME:
                limit = f"from 0 to {self.MAX_TIME:g} s"
                raise FlexarmError(f"s is no usable {name}", field=name, value=value, limit=limit)
        self.loss, self.delay, self.jitter = loss, delay, jitter
        # A separate stream, beside those of the sensors' noise.
        self._random = np.random.default_rng([seed, 2])
        self._on_the_way = []
        self._newest = -1
        self.sent = self.lost = self.dropped = 0

    def send(self, sample):
        """Take a sample that leaves the arm at its stamp."""
        self.sent += 1
        # Both are drawn for each sample, so a longer delay does not change which samples are lost.
        lost, late = self._random.random(2)
        if lost < self.loss:
            self.lost += 1
            return
        arrival = sample.stamp_ns + round(1e9 * (self.delay + late * self.jitter))
        heappush(self._on_the_way, (arrival, sample.sequence, sample))

    def receive(self, until_ns):
        """The next sample to arrive up to a time, and its arrival time; None if there is none."""
        while self._on_the_way and self._on_the_way[0][0] <= until_ns:
            arrival, sequence, sample = heappop(self._on_the_way)
            if sequence > self._newest:
                self._newest = sequence
                return arrival, sample
            self.dropped += 1
        return None


class NetworkedLoop(ClosedLoop):
    """A `ClosedLoop`, without a `delay` of its own, with a `network` between simulator and observer.

    Attributes
    ----------
    timeouts : int
        How often the driver took the safe action because there was no fresh torque.
    """

    def __init__(self, *args, network, **others):
        super().__init__(*args, **others)
        self.network = network
        self.timeouts = 0
        self._sent, self._last_arrival_ns = -1, self.simulator.stamp_ns
        self._torque, self._until_ns = None, 0

    def follow(self, trajectory, duration):
        """As `ClosedLoop.follow`, but it starts with the first torque: until then the controller knows no arm to move.

        A trajectory with stamp 0 gets a stamp `LEAD` ahead. The controller knows it by then, so the motion starts with
        a sample of the arm.
        """
        simulator = self.simulator
        latest = simulator.time + self.MAX_START
        while not self._answer():
            if simulator.time > latest:
                reason = self.controller.reason or "no sample has arrived"
                raise MessageError(f"no torque within {self.MAX_START:g} s: {reason}")
            self._advance(None)
        if not trajectory.stamp_ns:
            ahead = math.ceil(1e9 * LEAD / simulator.period_ns) * simulator.period_ns
            trajectory = replace(trajectory, stamp_ns=simulator.stamp_ns + ahead)
        return super().follow(trajectory, duration)

    def _why_lost(self):
        """As `ClosedLoop._why_lost`, but the controller's samples are older: the motion may not have begun."""
        waits = self.controller.enabled and self.controller.reference.pending
        return "" if waits else super()._why_lost()

    def _answer(self):
        """Send the present sample and answer those that have arrived by now; return whether torque is enabled."""
        simulator, now = self.simulator, self.simulator.stamp_ns
        if simulator.sequence != self._sent:
            self._sent = simulator.sequence
            self.network.send(copied(self.measure()))
        while arrived := self.network.receive(now):
            self._take(*arrived)
        if now - self._last_arrival_ns > 1e9 * STATE_TIMEOUT and self.controller.enabled:
            self.controller.distrust(f"no sample for {STATE_TIMEOUT:g} s")
            self._torque = None
        return self.controller.enabled

    def _take(self, now_ns, sample):
        """Let observer and controller answer a sample that arrives, and the driver take their torque."""
        self._last_arrival_ns = now_ns
        enabled = self._answer_to(sample)
        self._torque = self.controller.torque.copy() if enabled else None
        self._until_ns = sample.stamp_ns + round(1e9 * TORQUE_TIMEOUT)

    def _advance(self, torque):
        """Advance the plant by one period; a torque that arrives within it acts from its arrival on."""
        period = self.simulator.period_ns
        time = self.simulator.stamp_ns
        end, parts = time + period, []
        while arrived := self.network.receive(end - 1):
            parts += self._acting(time, arrived[0])
            time = arrived[0]
            self._take(*arrived)
        parts += self._acting(time, end)
        self.simulator.advance_in_parts([(u, span / period) for u, span in parts])

    def _acting(self, start, end):
        """(torque or None, span [ns]) one after the other from start to end [ns]."""
        if self._torque is None or end <= self._until_ns:
            return [(self._torque, end - start)]
        fresh = max(self._until_ns - start, 0)
        parts = [(self._torque, fresh), (None, end - start - fresh)]
        self._torque = None
        self.timeouts += 1
        return parts


def copied(sample):
    """A sample that the next measurement does not change."""
    out = ArmSample(sample.position.size)
    for name in ArmSample.__slots__:
        value = getattr(sample, name)
        setattr(out, name, value.copy() if isinstance(value, np.ndarray) else value)
    return out
