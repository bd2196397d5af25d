# SPDX-License-Identifier: Apache-2.0
"""Simulator node: `joint_torque` in, `arm_state` and `joint_states` out; in lockstep or in real time."""

import os
from array import array

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import MessageError, ModelError, ParameterError
from flexarm_dynamics.parameters import parameter
from flexarm_msgs.msg import ArmState, JointTorque
from flexarm_ros import qos
from flexarm_ros.messages import StateWriter, TorqueReader, set_stamp
from flexarm_ros.node import ERROR, OK, WARN, ArmNode, run
from flexarm_ros.start import leave
from flexarm_ros.torque_gate import Controllers, TorqueGate, TorqueLimit

from .. import simulator
from ..fault_injector import FIELDS, FaultInjector, Sample

#: In lockstep, after two controllers were heard in turn one has to be silent for so many samples.
ALONE_SAMPLES = 100
#: In lockstep, where no message reaches a controller, so many periods are run between two looks at other calls.
AT_ONCE = 200
#: Sequence numbers on the topics are uint32.
WRAP = 2**32

PARAMETERS = (
    parameter("lockstep", False, read_only=True).described(
        "One period per torque that answers the last state, as fast as the machine goes; false: real time."
    ),
    parameter("pause_at", 0.0, "s", -1.0, 1e6, read_only=True).described(
        "In lockstep, pause at this simulated time, once, until `~/pause` is called with data false;"
        " negative: never."
    ),
    parameter("resend_period", 0.1, "s", 0.01, 10.0, read_only=True).described(
        "In lockstep or paused, the state is sent again after so long without an answer (wall time)."
    ),
    parameter("real_time_factor", 1.0, "-", 0.001, 100.0, read_only=True).described(
        "In real time: seconds simulated per second of wall time."
    ),
    parameter("torque_timeout", 0.05, "s", 0.001, 10.0, read_only=True).described(
        "In real time: a torque that answers a state older than this is too late; the safe action follows."
    ),
    parameter("joint_states_rate", 50.0, "Hz", 0.1, 20000.0, read_only=True).described(
        "Rate of joint_states, in simulated time; at most the control rate."
    ),
    parameter("allow_faults", False, read_only=True).described(
        "Whether `faults` may be set: for tests of what comes after the simulator."
    ),
    parameter("faults", [], kind="string_array").described(
        'Faults put into arm_state, each "SIGNAL KIND [key=value ...]": docs/fault_injection.md.'
    ),
)


class SimulatorNode(ArmNode):
    """Messages to arrays, one call of `Simulator`, arrays to messages."""

    def __init__(self):
        self._injector = None
        super().__init__("simulator", {"": (*simulator.PARAMETERS, *PARAMETERS)})
        self.add_on_set_parameters_callback(self._check_faults)

    def build(self):
        parameters = self.parameters
        self.arm = arm_file.load(parameters["arm"])
        parameters.resolve({"joints": len(self.arm.joints)})
        names = {p.name for p in simulator.PARAMETERS}
        self.sim = simulator.Simulator(parameters.group("", names))
        parameters.on_change(self._changed)
        self._injector = FaultInjector(self.arm, self._allowed(parameters["faults"]))
        self._lockstep = parameters["lockstep"]
        self._rates, self._velocity = (
            parameters["publish_rates"],
            parameters["publish_joint_velocity"],
        )
        self._amplitude = self.sim.strain_map is not None and parameters["publish_modal_amplitude"]
        # A restart is a new session; so is a reset.
        self._session = int.from_bytes(os.urandom(4), "little")
        self._pause_first()
        self._answered = None  # sequence of the state whose answer is kept while paused
        self._answer = None
        self._safe = True  # in real time: whether the last period had the safe action
        self._sent, self._awaited = (
            [],
            None,
        )  # messages of the last sample; in lockstep, the sequence to be answered
        self._writer, self._reader = StateWriter(self.arm), TorqueReader(self.arm)
        self._joint_state = JointState(name=list(self.arm.joint_names))
        self._fill()
        self._late, self._refused, self._waited, self._before = 0, 0, 0, 0
        real_time = round(1e9 * TorqueGate.ALONE)
        alone = ALONE_SAMPLES * self.sim.period_ns if self._lockstep else real_time
        self._controllers, self._limit = Controllers(alone), TorqueLimit(self.arm)
        self._several = False  # since the last diagnostics
        self._fault = ""
        self._make_topics()

    def _make_topics(self):
        options = qos.overridable()
        self._state_pub = self.make_publisher(
            ArmState, "arm_state", qos.LINE, qos_overriding_options=options
        )
        self._joint_pub = self.make_publisher(
            JointState, "joint_states", 10, qos_overriding_options=options
        )
        torques = self.make_subscription(
            JointTorque, "joint_torque", self._on_torque, qos.LINE, qos_overriding_options=options
        )
        self.make_service(Trigger, "~/reset", self._on_reset)
        self.make_service(SetBool, "~/pause", self._on_pause)
        parameters = self.parameters
        every = parameters["rate"] / parameters["joint_states_rate"]
        self._joint_states_every = max(1, round(every))
        self._timeout_samples = max(1, round(parameters["torque_timeout"] * parameters["rate"]))
        if self._lockstep:
            self.make_line(torques)
        else:
            period = 1e-9 * self.sim.period_ns / parameters["real_time_factor"]
            self.make_line(torques, period, self._on_period)
        self.make_timer(parameters["resend_period"], self._resend)

    def _pause_first(self):
        """Where the first pause comes, counted in samples: the same in every run."""
        at = self.parameters["pause_at"]
        pauses = self._lockstep and at >= 0.0
        self._pause_sequence = round(at * 1e9 / self.sim.period_ns) if pauses else None
        self._paused = self._pause_sequence == 0

    def _changed(self, names):
        if "initial_position" in names:
            self.sim.settings["initial_position"] = self.parameters["initial_position"]
        if "faults" in names:
            self._injector.set(self.parameters["faults"])

    def _allowed(self, lines):
        """The faults, where there may be any."""
        if lines and not self.parameters["allow_faults"]:
            raise ParameterError("faults: start the simulator with allow_faults:=true to set them")
        return lines

    def _check_faults(self, parameters):
        """Refuse what the injector would not take; its type has been looked at elsewhere."""
        for given in parameters:
            lines = given.value if given.name == "faults" else None
            texts = isinstance(lines, list) and lines and all(isinstance(x, str) for x in lines)
            if self._injector is None or not texts:
                continue
            try:
                FaultInjector(self.arm, self._allowed(lines))
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def start(self):
        mode = "lockstep" if self._lockstep else "real time"
        self.get_logger().info(f"arm {self.arm.name}, {mode}, {self.parameters['rate']:g} Hz")
        self._publish()
        self._go_on()

    # Torque in, state out --------------------------------------------------------------------

    def _on_torque(self, msg):
        if not self.active or msg.session != self._session:
            return
        try:
            torque = self._reader.read(msg)
            torque = None if torque is None else self._limit.clip(torque)
        except MessageError as error:
            self._refused += 1
            self.report(f"joint_torque {msg.sequence}: {error}: the safe action is applied")
            torque = None
        if self._in_turn(msg.controller_id):
            torque = None
        if self._lockstep:
            if msg.sequence != self._awaited:
                return  # an answer to a state that was sent again
            if self._paused:
                return  # the state is sent again after the pause, and answered from the cache
            self._answered = msg.sequence
            self._answer = None if torque is None else torque.copy()
            self._step(self._fresh())
            self._go_on()
        elif self._age(msg.sequence) <= min(self._age(self._answered), WRAP // 2):
            self._answered = msg.sequence
            self._answer = None if torque is None else torque.copy()

    def _step(self, torque):
        """In lockstep: one period, and the state after it."""
        self._advance(torque)
        self._paused = self._paused or self.sim.sequence == self._pause_sequence
        self._publish()

    def _go_on(self):
        """In lockstep: where no message went out there is no answer to wait for; the last torque acts on and ages."""
        for _ in range(AT_ONCE):
            if not self._lockstep or self._paused or self._awaited is not None:
                return
            self._step(self._fresh())

    def _fresh(self):
        """The last torque, while what it answers is not too old; else None: the safe action."""
        return self._answer if self._age(self._answered) <= self._timeout_samples else None

    def _age(self, sequence):
        """Samples since state `sequence`, as uint32 count; one from the future is very old, none older still."""
        return WRAP if sequence is None else (self.sim.sequence - sequence) % WRAP

    def _on_period(self):
        """Real time: the newest torque, if it is fresh, else the safe action."""
        if not self.active or self._paused:
            return
        fresh = self._age(self._answered) <= self._timeout_samples
        if not fresh and self._answered is not None:
            self._late += 1
        applied = self._answer if fresh else None
        if applied is None and not self._safe:
            self.report("no fresh torque: the safe action is applied")
        self._safe = applied is None
        self._advance(applied)
        self._publish()

    def _advance(self, torque):
        self._waited = 0
        if self._fault:
            return
        try:
            self.sim.advance(torque)
        except ModelError as error:
            self._fault = str(error)
            self.get_logger().error(f"stopped: {error}")
            self._paused = True
            return
        self._fill()

    def _fill(self):
        """The present sample into the message."""
        sim, writer = self.sim, self._writer
        writer.head(sim.stamp_ns, self._session, sim.sequence)
        writer.write("joint_position", sim.position)
        writer.write("joint_velocity", sim.velocity if self._velocity else None)
        writer.write("joint_torque", sim.torque)
        writer.write("strain", sim.strain)
        writer.write("modal_amplitude", sim.amplitude if self._amplitude else None)
        writer.write("modal_rate", sim.rate if self._rates else None)

    def _publish(self):
        sim = self.sim
        self._sent = self._outgoing()
        for message in self._sent:
            self._state_pub.publish(message)
        # Of several the newest, which one that comes after its successor is not.
        self._awaited = max((m.sequence for m in self._sent), default=None)
        if (
            sim.sequence % self._joint_states_every == 0
            and self._joint_pub.get_subscription_count()
        ):
            msg = self._joint_state
            set_stamp(msg.header.stamp, sim.stamp_ns)
            msg.position = array("d", sim.position)
            msg.velocity = array("d", sim.velocity)
            msg.effort = array("d", sim.torque)
            self._joint_pub.publish(msg)

    def _outgoing(self):
        """Messages of the present sample: its own, or what faults make of it."""
        message = self._writer.message
        if self._injector.idle:
            return [message]
        names = {key: getattr(message, key) for key in set(FIELDS.values())}
        values = {
            key: np.array(getattr(message, key)) if len(getattr(message, key)) else None
            for key in (*FIELDS, "modal_rate")
        }
        sample = Sample(self.sim.sequence, self.sim.stamp_ns, names, values)
        return [self._message(s) for s in self._injector.outgoing(sample, self.sim.time)]

    def _message(self, sample):
        """An `ArmState` of its own, with what a faulty sample says."""
        message = ArmState(session=self._session, sequence=sample.sequence)
        message.header.frame_id = self._writer.message.header.frame_id
        set_stamp(message.header.stamp, sample.stamp_ns)
        for key, names in sample.names.items():
            setattr(message, key, names)
        for key, values in sample.values.items():
            setattr(message, key, array("d", () if values is None else values))
        return message

    def _resend(self):
        """Steady clock: send an unanswered state again, and say so when nobody answers."""
        if not self.active or not (self._lockstep or self._paused):
            return
        self._waited += 1
        if self._awaited is None:
            self._go_on()
            return
        for message in self._sent:
            self._state_pub.publish(message)
        seconds = self._waited * self.parameters["resend_period"]
        if not self._paused and seconds >= 5.0:
            self.report(
                f"no joint_torque answers state {self.sim.sequence} for 5 s: are observer and controller"
                " running, on this domain, with this arm?"
            )

    def _in_turn(self, controller_id):
        """Whether two controllers send in turn: then neither moves the arm."""
        controllers = self._controllers
        if not controllers.heard(controller_id, self.sim.stamp_ns):
            return False
        self._several = True
        ids = ", ".join(str(i) for i in controllers.pair)
        self.report(
            f"joint_torque comes from several controllers ({ids}): the safe action is applied; stop all but one"
        )
        return True

    # Services --------------------------------------------------------------------------------

    def _on_reset(self, request, response):
        self.sim.reset()
        self._session = (self._session + 1) % 2**32
        self._answered, self._answer, self._fault = None, None, ""
        self._controllers.forget()
        self._several = False
        self._injector.reset()
        self._pause_first()
        self._fill()
        self._publish()
        self._go_on()
        response.success, response.message = True, f"session {self._session}"
        return response

    def _on_pause(self, request, response):
        if self._fault and not request.data:
            response.success, response.message = False, f"call ~/reset first: {self._fault}"
            return response
        self._paused = request.data
        response.success, response.message = True, "running"
        if request.data:
            response.message = f"paused at sample {self.sim.sequence}"
        if not request.data:
            self._resend()
        return response

    def diagnose(self):
        done, self._before = self.sim.sequence - self._before, self.sim.sequence
        values = {
            "mode": "lockstep" if self._lockstep else "real time",
            "simulated time [s]": f"{self.sim.time:.3f}",
            "samples per second": done,
            "periods without a fresh torque": self._late,
            "torques refused": self._refused,
            "torques clipped": self._limit.clipped,
            "controllers seen": len(self._controllers.ids),
        }
        if self.line is not None and not self._lockstep:
            values["periods lost"] = self.line.lost
        if not self._injector.idle:
            values["faults"] = "; ".join(str(f) for f in self._injector.faults)
        if self._fault:
            return ERROR, self._fault, values
        several, self._several = self._several, False
        if several:
            return ERROR, "several controllers publish joint_torque: stop all but one", values
        if self._paused:
            return OK, "paused: call ~/pause with data false", values
        if done == 0 or (not self._lockstep and self._safe):
            return WARN, "no fresh torque: the safe action is applied", values
        return OK, "", values


def main(args=None):
    """Entry point of ``ros2 run flexarm_sim simulator``."""
    leave(run(SimulatorNode, args))


if __name__ == "__main__":
    main()
