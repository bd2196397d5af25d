# SPDX-License-Identifier: Apache-2.0
"""Node `replay`: plays a recording as a driver; a controller's torques are kept beside the measured, not applied."""

from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.parameters import parameter
from flexarm_msgs.msg import ArmState
from flexarm_ros.driver import JOINT_STATES_RATE, Driver, Sample
from flexarm_ros.messages import TorqueReader
from flexarm_ros.node import ARM, OK, WARN, run
from flexarm_ros.start import leave
from flexarm_ros.torque_gate import TorqueGate
from flexarm_studies.recordings import mapping as mappings

from ..identification import recording as recordings
from .playback import Playback, part

#: The answer for which a sample waits in lockstep.
NONE, OBSERVER, CONTROLLER = "none", "observer", "controller"
#: In lockstep: wall time after which a sample without an answer is sent again, and after which this is reported [s].
RESEND, UNANSWERED = 0.1, 5.0
#: Time for which the first sample waits for a subscription [s].
LISTENERS = 2.0

OWN = (
    parameter("recording", "", read_only=True).described("A bag's folder, or a CSV file."),
    parameter("mapping", "", read_only=True).described(
        "Mapping file, by path or shipped name, with the meaning of the columns of a CSV file."
    ),
    parameter("begin", 0.0, "s", 0.0, 1e9, read_only=True).described(
        "Time after the recording's first sample at which to begin."
    ),
    parameter("duration", 0.0, "s", 0.0, 1e9, read_only=True).described(
        "Duration that is played; 0.0: to the recording's end."
    ),
    parameter("lockstep", NONE, choices=(NONE, OBSERVER, CONTROLLER), read_only=True).described(
        "Each sample waits for the estimate of the observer, or for the controller's torque; none: real time."
    ),
    parameter("real_time_factor", 1.0, "-", 0.001, 100.0, read_only=True).described(
        "In real time: seconds of the recording per second of wall time."
    ),
)
PARAMETERS = (ARM, JOINT_STATES_RATE, *OWN)


class ReplayNode(Driver):
    """A driver whose device is a recording.

    Its states name no controller, so no controller acts. In real time the samples come on their grid; in lockstep one
    comes after each answer, with the same stamps in every run.

    Attributes
    ----------
    playback : Playback
    """

    def __init__(self):
        super().__init__("replay", PARAMETERS)
        self.playback = None

    def open(self):
        values = self.parameters
        mapping = mappings.load(values["mapping"]) if values["mapping"] else None
        made = recordings.read(values["recording"], self.arm, mapping)
        self.playback = Playback(part(made, values["begin"], values["duration"]))
        self.period = made.period
        self._sample = Sample(number=-1, stamp_ns=0, position=self.playback.position[0])
        self._reader, self._waited, self._origin = TorqueReader(self.arm), 0.0, 0
        self.notes = made.notes

    def make_gate(self):
        return TorqueGate(self.arm, self.period)  # only for the session

    @property
    def lockstep(self):
        """Whether samples wait for an answer."""
        return self.parameters["lockstep"] != NONE

    def connect(self, torques):
        estimates = self.make_subscription(ArmState, "arm_state_estimate", self._on_estimate)
        if self.lockstep:
            self.make_control_path(
                estimates if self.parameters["lockstep"] == OBSERVER else torques
            )
            self.make_timer(RESEND, self._resend)
        else:
            period = self.period / self.parameters["real_time_factor"]
            self.make_control_path(torques, period, self._on_period)

    def start(self):
        for note in self.notes:
            self.get_logger().warning(note)
        mode = f"lockstep with the {self.parameters['lockstep']}" if self.lockstep else "real time"
        rate = f"{1.0 / self.period:.6g} Hz"
        self.get_logger().info(
            f"arm {self.arm.name}, {len(self.playback)} samples at {rate}, {mode}"
        )
        # In lockstep the stamps are the same in every run; in real time they are those of this machine's clock.
        first = round(1e9 * max(self.playback.recording.start, 0.0))
        self._origin = first if self.lockstep else self.get_clock().now().nanoseconds

    def _on_period(self):
        self._waited += self.period / self.parameters["real_time_factor"]
        listened = self.state_publisher.get_subscription_count() or self._waited > LISTENERS
        if self.active and (listened or self.playback.next):
            self._play()

    def _play(self):
        """Publish the sample that is due; after the last one the node ends."""
        played = self.playback
        if played.over:
            self._end()
            return
        self._waited = 0.0
        k, sample = played.take(), self._sample
        sample.number, sample.stamp_ns = k, self._origin + round(1e9 * self.period * k)
        sample.position, sample.torque = played.position[k], played.torque[k]
        sample.velocity = None if played.velocity is None else played.velocity[k]
        sample.strain = None if played.strain is None else played.strain[k]
        self.publish(sample)

    def _end(self):
        if not self.fault and isinstance(self.stopped, list) and not self.stopped:
            self.get_logger().info("the recording is over")
            self.stopped.append(True)

    def publish(self, sample):
        self.fill(sample, 0)
        self.state_publisher.publish(self.writer.message)
        self.publish_joints(sample)

    def _resend(self):
        if not self.active:
            return
        if self._sample.number < 0:
            self._play()
            return
        self._waited += RESEND
        if self.playback.over and self._waited > 10.0 * RESEND:
            self._end()  # the last sample has no answer
        elif self._waited >= 2.0 * RESEND:
            self.writer.message.clock_stopped = True
            self.state_publisher.publish(self.writer.message)
            self.writer.message.clock_stopped = False
        if self._waited >= UNANSWERED:
            self._waited = 2.0 * RESEND
            who = self.parameters["lockstep"]
            self.report(f"the {who} answers nothing: is it running, on this domain, with this arm?")

    def _answered(self, message, by):
        """Play the next sample if, in lockstep, a message answers the newest one of this session."""
        newest = (self.gate.session, self._sample.number)
        if (message.session, message.sequence) == newest and self.parameters["lockstep"] == by:
            self._play()

    def _on_estimate(self, message):
        if self.active:
            self._answered(message, OBSERVER)

    def _on_torque(self, raw):
        if not self.active:
            return
        try:
            message = self.torques(raw)
            if message.session != self.gate.session:
                return
            self.playback.answer(message.sequence, self._reader.read(message))
        except MessageError as error:
            self.report(str(error))
            return
        self._answered(message, CONTROLLER)

    def apply(self, torque):
        """Nothing is applied: the motion is in the past."""

    def make_safe(self):
        """Nothing to do: nothing moves."""

    def details(self):
        played, k = self.playback, max(self._sample.number, 0)
        values = {"samples played": f"{played.next} of {len(played)}"}
        for what, torque in (("sent", played.sent), ("measured", played.torque)):
            # The answer to the newest sample may be on its way.
            row = torque[max(k - 1, 0)]
            values[
                f"torque {what}, not applied [N m]" if what == "sent" else "torque measured [N m]"
            ] = " ".join(f"{v:.4g}" for v in row)
        return values

    def judge(self, samples):
        if self.playback.over:
            return OK, "the recording is over"
        return (
            (OK, "")
            if samples
            else (WARN, "nothing is played: no node subscribes to arm_state, or none answers")
        )


def main(args=None):
    """Entry point of ``ros2 run flexarm_bringup replay``."""
    leave(run(ReplayNode, args))


if __name__ == "__main__":
    main()
