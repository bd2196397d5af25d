# SPDX-License-Identifier: Apache-2.0
"""Observer node: `arm_state` in, `arm_state_estimate` and `observer/state` out."""

from dataclasses import replace
from time import perf_counter

from std_srvs.srv import Trigger

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError, MessageError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import sizes
from flexarm_msgs.msg import ArmState, ObserverState
from flexarm_ros import cdr
from flexarm_ros.messages import ObserverStateWriter, StateReader, StateWriter
from flexarm_ros.node import ARM, ArmNode, run
from flexarm_ros.start import leave

from ..composite import assembly
from ..loop.samples import ArmSample
from ..observers import arm_observer, gauge_health
from ..robust import default
from .observer_statistics import ObserverStatistics

RATE = replace(default.RATE, read_only=True).described(
    "Samples per second that the driver or simulator sends, as the controller's parameter of this name."
)


def parameter_groups():
    """Declared parameters of this node, by prefix."""
    return {
        "": (ARM, RATE, *default.PARAMETERS),
        "observer.": assembly.declarations("observer"),
    }


class ObserverNode(ArmNode):
    """Messages to arrays, one call of `ArmObserver`, arrays to messages."""

    def __init__(self):
        super().__init__("observer", parameter_groups())

    def build(self):
        parameters = self.parameters
        self.arm = arm_file.load(parameters["arm"])
        self.model = model.build(self.arm.known)
        parameters.resolve(sizes(self.model))
        kind = parameters["design.type"]
        self.designed = default.is_wanted(parameters["arm"], parameters.given, kind)
        if self.designed:
            settings, _ = default.task(self.arm, parameters.values())
            parameters.adopt(default.for_observer(self.model, settings))
        self._new_core().warm_up()
        self.core = self._new_core()
        parameters.on_change(self._changed)
        arm = self.arm
        self._states, self._reader = cdr.Reader(ArmState), StateReader(arm)
        self._sample = ArmSample(len(arm.joints), self.model.n_modes, len(arm.gauges))
        self._writer, self._state_writer = StateWriter(arm), ObserverStateWriter(arm)
        self._estimate = cdr.Writer(self._writer.message)
        self._statistics = ObserverStatistics(self.model.n_modes)
        self._estimate_pub = self.make_publisher(ArmState, "arm_state_estimate")
        self._state_pub = self.make_publisher(ObserverState, "observer/state")
        self.make_service(Trigger, "~/calibrate_gauges", self._on_calibrate)
        states = self.make_subscription(ArmState, "arm_state", self._on_state, raw=True)
        self.make_control_path(states)

    def _new_core(self):
        return assembly.observer(self.model, assembly.chosen("observer", self.parameters.values()))

    def _changed(self, names):
        """Replace the observer by a new one that continues from the old one's estimate."""
        self.core.settings = self.parameters.group("observer.", arm_observer.PARAMETERS)
        if names - {"observer." + name for name in self.core.settings}:
            observer = self._new_core().observer
            observer.resume(self.core.observer)
            self.core.observer = observer

    def start(self):
        designed = "designed: " if self.designed else ""
        kind = self.parameters["observer.type"]
        self.get_logger().info(f"arm {self.arm.name}, {designed}observer {kind}")

    def _on_state(self, raw):
        if not self.active:
            return
        started = perf_counter()
        sample, writer, core = self._sample, self._writer, self.core
        try:
            msg = self._states(raw)
        except MessageError as error:  # not even its number can be read: nothing to pass on
            self._statistics.refused(error)
            self.report(f"arm_state: {error}")
            return
        self._statistics.received(msg)
        try:
            self._reader.read(msg, sample)
            known = core.step(sample, later=True)
        except MessageError as error:
            self._statistics.refused(error)
            self.report(f"arm_state {msg.sequence}: {error}")
            self._forward_distrusted(self._states.message(raw), str(error))
            return
        if known is None:  # older than the last one: the controller can't use it
            return
        if sample.doubt:
            self.report(f"arm_state: {sample.doubt}")
        writer.head(sample.stamp_ns, sample.session, sample.sequence, sample.controller_id)
        writer.trust(sample.trust, sample.doubt)
        writer.message.clock_stopped = sample.clock_stopped
        writer.write("joint_position", core.position)
        writer.write("joint_velocity", core.velocity)
        writer.write("joint_torque", sample.torque)
        writer.write("strain", sample.strain)
        writer.write("modal_amplitude", core.amplitude)
        writer.write("modal_rate", core.rate if known else None)
        self._estimate_pub.publish(self._estimate())
        self._statistics.estimated(core.observer, perf_counter() - started)
        if self._state_pub.get_subscription_count():
            name = self.parameters["observer.type"]
            self._state_pub.publish(
                self._state_writer.fill(
                    sample, name, core.observer, sample.strain, core.gauges and core.gauges.health
                )
            )
        core.look_ahead()

    def _on_calibrate(self, request, response):
        """Service: set the gauges' bias from the last samples; answers at once."""
        core = self.core
        try:
            if not self.active:
                raise MessageError("not active")
            old, new = core.calibrate()
        except FlexarmError as error:
            response.success, response.message = False, str(error)
            return response
        names = self.arm.gauge_names
        text = gauge_health.calibration_text(names, old, new, core.calibration.samples)
        lines = gauge_health.calibration_yaml(names, new)
        self.get_logger().info(f"gauges calibrated; for the arm file:\n{lines}")
        response.success, response.message = True, text
        return response

    def _forward_distrusted(self, msg, doubt):
        """Pass a bad sample on, without modal states and with the reason, so that the controller disables at once."""
        for field in ("gauge_names", "strain", "mode_names", "modal_amplitude", "modal_rate"):
            setattr(msg, field, [])
        msg.trust, msg.doubt = ArmState.DISTRUSTED, doubt
        self._estimate_pub.publish(msg)

    def diagnose(self):
        return self._statistics.diagnose(self.core, self.parameters["observer.type"], self.active)


def main(args=None):
    """Entry point of ``ros2 run flexarm_control observer``."""
    leave(run(ObserverNode, args))
