# SPDX-License-Identifier: Apache-2.0
"""Simulator node: the simulated arm as a driver, in lockstep or in real time."""

from flexarm_dynamics.models import levels
from flexarm_ros.driver import Driver, Sample
from flexarm_ros.node import ERROR, OK, WARN, run
from flexarm_ros.start import leave
from flexarm_ros.torque_gate import WRAP, TorqueGate

from .. import simulator
from . import clock, faults, pacing, services

PARAMETERS = (*pacing.PARAMETERS, *clock.PARAMETERS, *faults.PARAMETERS)


class SimulatorNode(Driver):
    """A driver whose device is a `Simulator`: to apply torque is to advance it by one period.

    Attributes
    ----------
    paused : bool
    sent : list of ArmState
        Messages of the present sample: one, or what the faults make of it.
    awaited : int or None
        Sequence of the state whose answer is awaited; None: no message was sent for this sample.
    """

    def __init__(self):
        self.faults = None
        super().__init__("simulator", (*simulator.PARAMETERS, *PARAMETERS))
        self.add_on_set_parameters_callback(lambda new: faults.check(self.faults, new))

    def open(self):
        parameters = self.parameters
        self.sim = sim = simulator.Simulator(parameters.group("", simulator.PARAMETERS))
        self.period = 1e-9 * sim.period_ns
        self.faults = faults.Faults(self.arm, parameters)
        rate = parameters["clock_rate"]
        self.clock = clock.Clock(self, rate) if rate else None
        self.pacing = (pacing.Lockstep if parameters["lockstep"] else pacing.RealTime)(self)
        parameters.on_change(self._changed)
        amplitude = sim.strain_map is not None and parameters["publish_modal_amplitude"]
        self._sample = Sample(
            number=0,
            stamp_ns=0,
            position=sim.position,
            velocity=sim.velocity if parameters["publish_joint_velocity"] else None,
            torque=sim.torque,
            strain=sim.strain,
            amplitude=sim.amplitude if amplitude else None,
            rate=sim.rate if parameters["publish_rates"] else None,
        )
        self.sent, self.awaited = [], None
        self._range_reported = False
        self.paused = self.pacing.pauses_at(0)

    def make_gate(self):
        samples = max(1, round(self.parameters["torque_timeout"] * self.parameters["rate"]))
        # Counted in samples, plus half a sample so that rounding does not decide.
        return TorqueGate(self.arm, (samples + 0.5) * self.period, self.pacing.alone())

    def connect(self, torques):
        self.pacing.connect(torques)
        services.make(self)
        self.make_timer(self.parameters["resend_period"], self.pacing.resend)

    def _changed(self, names):
        if "initial_position" in names:
            self.sim.settings["initial_position"] = self.parameters["initial_position"]
        if "faults" in names:
            self.faults.set(self.parameters["faults"])
        if "pause_at" in names:
            self.pacing.set_pause(self.parameters["pause_at"])

    # The device --------------------------------------------------------------------------------

    def now(self):
        """Simulated time: a torque gets older with the samples, not while they wait [s]."""
        return self.sim.time

    def apply(self, torque):
        self.sim.advance(torque)

    def make_safe(self):
        self.sim.advance(None)

    def start(self):
        rate = self.parameters["rate"]
        level = levels.level_of(self.sim.plant_model.arm)
        self.get_logger().info(
            f"arm {self.arm.name}, level {level}, {self.pacing.name}, {rate:g} Hz"
        )
        if self.sim.friction_warning:
            self.get_logger().warning(self.sim.friction_warning)
        self._publish_sample()
        self.pacing.go_on()

    def stop(self):
        """Forget the torque; the simulated arm stands still with the node."""
        self.gate.begin(self.gate.session)

    # Torque in, state out ----------------------------------------------------------------------

    def answered(self, message):
        self.pacing.answered(message)

    def refused(self, reason):
        """Log that a message can't be used; DISABLED, and answers to states sent again, are normal here."""
        if reason == self.gate.reason != self.gate.DISABLED:
            self.report(f"{reason}: the safe action is applied")

    def step(self):
        """Advance by one period under the torque that acts, and publish the state after it."""
        self.actuate()
        if self.fault:
            self.get_logger().error(f"stopped: {self.fault}")
            self.paused = True
            return
        if self.sim.range.warning and not self._range_reported:
            self._range_reported = True
            self.get_logger().warning(f"t = {self.sim.time:.3f} s: {self.sim.range.warning}")
        self.paused = self.paused or self.pacing.pauses_at(self.sim.sequence)
        self._publish_sample()

    def _publish_sample(self):
        self._sample.number, self._sample.stamp_ns = self.sim.sequence, self.sim.stamp_ns
        self.publish(self._sample)

    def publish(self, sample):
        now = self.now()
        self.fill(sample, self.gate.controller_id(now))
        self.sent = self.faults.outgoing(self.writer.message, now)
        if self.faults.restarted:
            self.gate.begin((self.gate.session + 1) % WRAP)
        self.send()
        # The newest of several: the others belong to earlier samples.
        self.awaited = max((m.sequence for m in self.sent if self._is_own(m)), default=None)
        self.publish_joints(sample)
        if self.clock is not None:
            self.clock.publish(sample.stamp_ns, sample.number == 0)

    def send(self, again=False):
        """Send the messages of the present sample, for the first time or, while simulated time stands still, again."""
        now = self.now()
        for message in self.sent:
            age = (self.sim.sequence - message.sequence) % WRAP  # a fault may have delayed it
            then = now - age * self.period
            if self._is_own(message):
                message.controller_id = self.gate.sent(message.sequence, then)
            message.clock_stopped = again
            true = message is self.writer.message
            self.state_publisher.publish(self.state_bytes() if true else message)

    def _is_own(self, message):
        """Whether a state is this driver's, and not that of a second one that a fault plays."""
        return message.session == self.gate.session

    # Services, diagnostics ---------------------------------------------------------------------

    def reset(self):
        """Start again at sample 0 of a new session; return the number of the session."""
        self.sim.reset()
        self.gate.begin((self.gate.session + 1) % WRAP)
        self.faults.reset()
        self.fault, self._range_reported = "", False
        self.paused = self.pacing.pauses_at(0)
        self._publish_sample()
        self.pacing.go_on()
        return self.gate.session

    def pause(self, paused):
        """Pause or go on; return whether that was possible, and a sentence for the caller."""
        if self.fault and not paused:
            return False, f"call ~/reset first: {self.fault}"
        self.paused = paused
        if paused:
            return True, f"paused at sample {self.sim.sequence}"
        self.pacing.resend()
        return True, "running"

    def details(self):
        values = {
            "mode": self.pacing.name,
            "simulated time [s]": f"{self.sim.time:.3f}",
            "level": levels.level_of(self.sim.plant_model.arm),
            "left out by the level at the tip [mm]": f"{1e3 * self.sim.range.error:.2g}",
            "periods without a fresh torque": self.pacing.late,
            "controllers seen": len(self.gate.controllers.ids),
        }
        if self.control_path is not None and self.control_path.period:
            values["periods lost"] = self.control_path.lost
        return values | ({"faults": str(self.faults)} if str(self.faults) else {})

    def judge(self, samples):
        if problem := self.fault or self.gate.controllers.doubt(self.now()):
            return ERROR, problem
        if self.paused:
            return OK, "paused: call ~/pause with data false"
        if not samples or (self.safe and not self.parameters["lockstep"]):
            return WARN, "no fresh torque: the safe action is applied"
        return OK, ""


def main(args=None):
    """Entry point of ``ros2 run flexarm_sim simulator``."""
    leave(run(SimulatorNode, args))
