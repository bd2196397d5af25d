# SPDX-License-Identifier: Apache-2.0
"""Base class of every node: lifecycle with autostart, diagnostics, clean exit on signals."""

import gc
import re
import signal
import sys
import time
import traceback
from collections import deque
from concurrent.futures import Future, wait
from contextlib import contextmanager
from functools import partial
from threading import Thread

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import Transition
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions

from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.parameters import parameter

from . import ending, qos, scheduling
from .parameters import NodeParameters
from .spin import ControlPath, spin

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

#: Names of the transitions that a user can ask for, by number.
TRANSITIONS = {
    Transition.TRANSITION_CONFIGURE: "configure",
    Transition.TRANSITION_CLEANUP: "cleanup",
    Transition.TRANSITION_ACTIVATE: "activate",
    Transition.TRANSITION_DEACTIVATE: "deactivate",
    Transition.TRANSITION_UNCONFIGURED_SHUTDOWN: "shutdown while unconfigured",
    Transition.TRANSITION_INACTIVE_SHUTDOWN: "shutdown while inactive",
    Transition.TRANSITION_ACTIVE_SHUTDOWN: "shutdown while active",
}
NUMBER = re.compile(r"[-+]?\d[\d.e+-]*")
REPORT_EVERY = 10_000_000_000  # [ns]
#: Long work of a configuration is logged after the first of these times, and then at intervals of the second [s].
FIRST_NOTICE, NEXT_NOTICE = 0.5, 10.0

ARM = parameter("arm", "", read_only=True).described(
    "Arm file: a shipped name, such as R or two_link, or a path."
)
AUTOSTART = parameter("autostart", True, read_only=True).described(
    "Configure and activate at the start; false: wait for a lifecycle manager."
)
#: Parameters of every node.
COMMON = (AUTOSTART, *scheduling.PARAMETERS)


class ArmNode(LifecycleNode):
    """A lifecycle node that is configured completely or not at all.

    Subclasses implement `build` (parameters to objects, publishers, subscriptions), `start`, `stop` and `diagnose`.
    What they create with the ``create_*`` methods is destroyed on clean-up.

    Parameters
    ----------
    name : str
    groups : mapping
        Prefix to declared parameters, see `NodeParameters`.
    """

    def __init__(self, name, groups):
        super().__init__(name)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._system = Clock(clock_type=ClockType.SYSTEM_TIME)
        groups = {**groups, "": (*COMMON, *groups.get("", ()))}
        self.parameters = given = NodeParameters(self, groups)
        scheduling.apply(
            given["cpu_affinity"], given["realtime_priority"], self.get_logger().warning
        )
        self.stopped = ()  # holds something once the process is to end
        self.active = False
        self.control_path = None  # while active
        self._control_path = None
        self._made = []
        self._reported = {}
        self._handed = deque()
        self._mismatches = qos.Mismatches(self)
        self._diagnostics = self._publisher(DiagnosticArray, "/diagnostics", 10)
        self.failure = ""

    # What subclasses implement ----------------------------------------------------------------

    def build(self):
        """Build everything from the parameters; raise a FlexarmError to refuse."""

    def start(self):
        """The node was activated."""

    def stop(self):
        """The node is being deactivated or is ending: leave the arm safe."""

    def diagnose(self):
        """Return (level, message, {key: value}) for `/diagnostics`."""
        return OK, "", {}

    # Long work in `build` --------------------------------------------------------------------

    def wait_for(self, work, what):
        """For `build`: call the function `work`, which takes long, in a thread of its own, and return its result.

        Meanwhile the log and the diagnostics report `what` the node does, and for how long. During an autostart, the
        node's parameters and life cycle are served, too.

        Raises
        ------
        FlexarmError
            If the process is to end; the thread goes on. Otherwise the errors of `work`.
        """
        future = _in_thread(work)
        began, notice, shown = time.monotonic(), FIRST_NOTICE, 0.0
        with self._served() as serve:
            while not future.done():
                serve(future)
                if self.stopped or not self.context.ok():
                    raise FlexarmError(f"stopped while {what}")
                so_far = time.monotonic() - began
                if so_far >= notice and not future.done():
                    self.get_logger().info(f"{what}, {so_far:.0f} s so far: no torque meanwhile")
                    notice = so_far + NEXT_NOTICE
                if so_far >= shown + 1.0:
                    shown = so_far
                    self._publish_status(WARN, f"{what}, {so_far:.0f} s so far", {})
        if notice != FIRST_NOTICE:
            self.get_logger().info(f"{what}: done after {time.monotonic() - began:.0f} s")
        return future.result()

    @contextmanager
    def _served(self):
        """A function that waits a moment for a `Future`; it serves the node if nothing else does."""
        if self.executor is not None:  # a requested transition: its answer waits, too
            yield lambda future: wait([future], 0.05)
            return
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self)
        try:
            yield lambda future: executor.spin_once(timeout_sec=0.05)
        finally:
            executor.remove_node(self)
            executor.shutdown()

    # Made and unmade with the configuration ----------------------------------------------------

    def make_publisher(self, kind, topic, profile=None, **kwargs):
        """A publisher that lives until clean-up; incompatible subscriptions are shown in diagnostics.

        `topic`, message `kind` and `kwargs` are as in rclpy. The default `profile` is that of the control path; the
        user may override it.
        """
        return self._keep(self.destroy_publisher, self._publisher(kind, topic, profile, **kwargs))

    def make_subscription(self, kind, topic, callback, profile=None, **kwargs):
        """A subscription that calls `callback`; otherwise as `make_publisher`."""
        create = partial(self.create_subscription, kind, topic, callback)
        subscription = self._topic_end(False, create, topic, profile, kwargs)
        return self._keep(self.destroy_subscription, subscription)

    def make_service(self, *args, **kwargs):
        """A service that lives until clean-up."""
        return self._keep(self.destroy_service, self.create_service(*args, **kwargs))

    def make_timer(self, period, callback):
        """A timer on the steady clock that lives until clean-up."""
        return self._keep(
            self.destroy_timer, self.create_timer(period, callback, clock=self._steady)
        )

    def make_control_path(self, subscription, period=None, on_period=None):
        """Name the subscription that is the control path, see `spin.ControlPath`."""
        self._control_path = ControlPath(subscription, period, on_period)

    def _publisher(self, kind, topic, profile, **kwargs):
        return self._topic_end(
            True, partial(self.create_publisher, kind, topic), topic, profile, kwargs
        )

    def _topic_end(self, publishes, create, topic, profile, kwargs):
        """A publisher or subscription that notices when the other end is incompatible."""
        if profile is None:
            profile, kwargs["qos_overriding_options"] = qos.CONTROL_PATH, qos.overridable()
        events, take = self._mismatches.callbacks(publishes, "qos_overriding_options" in kwargs)
        end = qos.made(lambda own: create(own, event_callbacks=events, **kwargs), topic, profile)
        take(end)
        return end

    def _keep(self, destroy, thing):
        self._made.append((destroy, thing))
        return thing

    def _unmake(self):
        self._mismatches.forget(thing for _, thing in self._made)
        while self._made:
            self._tried("not cleaned up", *self._made.pop())

    # Life cycle ------------------------------------------------------------------------------

    def on_configure(self, state):
        """Build the node's objects from its parameters; if this fails, the node stays unconfigured."""
        if not self._tried("not configured", self.build):
            self._unmake()
            return TransitionCallbackReturn.FAILURE
        self.make_timer(1.0, self._publish_diagnostics)
        return super().on_configure(state)

    def on_activate(self, state):
        """Let the node answer; if `start` fails, it stays inactive."""
        self.active, self.control_path = True, self._control_path
        if not self._tried("not activated", self.start):
            self._halt()
            return TransitionCallbackReturn.FAILURE
        # The objects made so far stay: the garbage collector need not visit them on the control path.
        gc.collect()
        gc.freeze()
        return super().on_activate(state)

    def on_deactivate(self, state):
        """Stop answering; what was built stays."""
        self._halt()
        return super().on_deactivate(state)

    def on_cleanup(self, state):
        """Drop what was built."""
        self._unmake()
        self._control_path = None
        return super().on_cleanup(state)

    def on_shutdown(self, state):
        """Stop, and drop what was built."""
        if self.active:
            self._halt()
        self._unmake()
        return super().on_shutdown(state)

    def _halt(self):
        self._tried("not stopped", self.stop)
        self.active, self.control_path = False, None

    def _tried(self, what, call, *args):
        """Call, and return whether it did not raise; rclpy silently drops what a transition raises."""
        try:
            call(*args)
        except Exception as error:  # for example of a user's law or device
            known = isinstance(error, FlexarmError)
            self.failure = str(error) if known else traceback.format_exc()
            self.get_logger().error(f"{what}: {self.failure}")
            return False
        return True

    # rclpy 7.1 of Jazzy lets the error of a wrong transition, for example activate while active, end the process: issue
    # 1209 of ros2/rclpy. Pull request 1319 fixed it in 8.0.0 (Kilted). The next two methods override those of
    # LifecycleNodeMixin by their mangled names. Remove them when Jazzy is no longer supported.

    def _LifecycleNodeMixin__change_state(self, transition_id):
        try:
            return super()._LifecycleNodeMixin__change_state(transition_id)
        except rclpy_implementation.RCLError:
            name = TRANSITIONS.get(transition_id, "unknown")
            self._refuse_transition(f"{transition_id} ({name})")
            return TransitionCallbackReturn.ERROR

    def _LifecycleNodeMixin__on_change_state(self, request, response):
        label = request.transition.label
        try:
            if label:
                self._state_machine.get_transition_by_label(label)
        except rclpy_implementation.RCLError:  # rclpy answers it silently
            self._refuse_transition(label)
            response.success = False
            return response
        return super()._LifecycleNodeMixin__on_change_state(request, response)

    def _refuse_transition(self, wanted):
        _, state = self._state_machine.current_state
        text = f"transition {wanted} is not possible while {state}: nothing has changed"
        self.get_logger().error(text)

    def autostart(self):
        """Configure and activate; False if that failed."""
        if not self.parameters["autostart"]:
            return True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                return False
        return True

    # From other threads -------------------------------------------------------------------------

    def hand_over(self, callback, *args):
        """From another thread: let the node's own thread call this between two samples; calls keep their order."""
        self._handed.append((callback, args))
        # rclpy runs the newest task first: each task takes the oldest call.
        self.executor.create_task(self._take_over)

    def _take_over(self):
        callback, args = self._handed.popleft()
        callback(*args)

    # Diagnostics -----------------------------------------------------------------------------

    def _publish_diagnostics(self):
        self._publish_status(*self.diagnose())

    def _publish_status(self, level, message, values):
        level, message, values = self._with_mismatches(level, message, values)
        status = DiagnosticStatus(
            level=level,
            name=self.get_fully_qualified_name().lstrip("/"),
            hardware_id=self.arm.name if getattr(self, "arm", None) else "",
            message=message or "ok",
            values=[KeyValue(key=str(k), value=str(v)) for k, v in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._now().to_msg()
        self._diagnostics.publish(array)

    def _now(self):
        """ROS time, for stamps that people read; the system's time while `use_sim_time` waits for /clock."""
        now = self.get_clock().now()
        return now if now.nanoseconds else self._system.now()

    def _with_mismatches(self, level, message, values):
        """The node's own status, and the topics with an incompatible publisher or subscription."""
        found = self._mismatches.texts()
        if not found:
            return level, message, values
        shown = {f"incompatible QoS on {topic}": text for topic, text in found.items()}
        message = "; ".join(filter(None, (message, *found.values())))
        return max(level, WARN), message, {**values, **shown}

    def report(self, text, info=False):
        """Log a warning or info: a new text at once, one that differs only in its numbers at most every ten seconds."""
        kind = NUMBER.sub("#", text)
        now = self._steady.now().nanoseconds
        if now - self._reported.get(kind, -REPORT_EVERY) >= REPORT_EVERY:
            if len(self._reported) > 100:  # a message may contain any names
                self._reported.clear()
            self._reported[kind] = now
            if info:
                self.get_logger().info(text)
            else:
                self.get_logger().warning(text)


def _in_thread(work):
    """The `Future` of a function that is called in a thread; the thread does not keep the process from ending."""
    future = Future()

    def call():
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    Thread(target=call, name="work", daemon=True).start()
    return future


def run(node_class, args=None):
    """Run a node, or several in one process, until SIGINT or SIGTERM; return the exit code of the process.

    Parameters
    ----------
    node_class : callable
        Makes the node, or a list of nodes in the order in which they are configured and activated.
    args : list of str, optional
        Command line.

    Returns
    -------
    int
        0 after a signal, 1 if the node could not start.
    """
    stopped = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.append(True))
    nodes = []
    try:
        try:
            rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        except RuntimeError as error:  # rcl's error about a command line or parameter file
            print(f"{node_class.__name__}: {error}", file=sys.stderr)
            return 1
        made = node_class()
        nodes = list(made) if isinstance(made, (list, tuple)) else [made]
        for node in nodes:
            node.stopped = stopped
        if not all(node.autostart() for node in nodes):
            return 0 if stopped else 1
        spin(nodes, stopped)
        return 0
    except (FlexarmError, ParameterException) as error:
        print(f"{node_class.__name__}: {error}", file=sys.stderr)
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except Exception:
        traceback.print_exc()
        return 1
    finally:
        for node in nodes:
            if node.active:
                node.stop()
        with ending.bounded():
            for node in nodes:
                node.destroy_node()
            rclpy.try_shutdown()
