# SPDX-License-Identifier: Apache-2.0
"""Connects the live view to the nodes, in one thread, without a callback per sample."""

import time
from dataclasses import dataclass

import numpy as np
import sensor_msgs.msg
from rcl_interfaces.msg import Log, ParameterEvent
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParametersAtomically,
)
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

import flexarm_msgs.msg
from flexarm_control.loop.samples import ArmSample
from flexarm_control.loop.supervisor import State
from flexarm_dynamics import registry
from flexarm_dynamics.errors import FlexarmError, MessageError
from flexarm_msgs.msg import ArmState, CompositeState
from flexarm_ros.messages import set_stamp, stamp_ns
from flexarm_ros.session import Latest, Session, parameter_messages, plain

from ..shape.amplitudes import Amplitudes
from . import foxglove, gains

#: A gain that was turned is sent when its slider has rested for this long [s].
REST = 0.25


@dataclass(frozen=True)
class Snapshot:
    """The newest values of the topics; arrays in the arm's order, SI."""

    time: float
    session: int
    q: np.ndarray
    delta: np.ndarray
    state: str
    reason: str
    trajectory: int
    saturated: bool
    reference: np.ndarray
    slow: np.ndarray
    fast: np.ndarray


class Link:
    """Reads the loop's topics, and publishes and calls services for the page.

    Parameters
    ----------
    namespace : str
        Of the loop's nodes.
    domain : int, optional
        ROS_DOMAIN_ID; not given: that of the environment.
    processes : Processes, optional
        Watched while this serves.
    say : callable
        Shows a message to the user; called with the text, and whether it is an error.
    """

    def __init__(self, namespace="", domain=None, processes=None, say=lambda text, bad: None):
        # Woken by what arrives: nothing else has to be checked.
        self.session = Session(
            "view", namespace=namespace, domain=domain, processes=processes, period=1.0
        )
        node = self.session.node
        self.say, self.on_values = say, lambda values: None
        create = node.create_subscription
        self._states = Latest(create, ArmState, "arm_state_estimate")
        self._controls = Latest(create, CompositeState, "controller/state")
        self._trajectories = self.session.publisher(JointTrajectory, "joint_trajectory")
        self._planned = Latest(create, JointTrajectory, "joint_trajectory")
        self._controller = node.resolve_service_name("controller")
        create(ParameterEvent, "/parameter_events", self._on_event, 100)
        create(Log, "/rosout", self._on_log, 100)
        self._turned, self._turned_at, self._setting = {}, 0.0, False
        self.values = {}
        self.control = None
        self._arm = None

    # Listening -------------------------------------------------------------------------------

    def watch(self, arm):
        """Expect states of this arm."""
        self._arm = arm
        self._amplitudes = Amplitudes(arm)
        self._sample = ArmSample(len(arm.joints), len(arm.modes))

    def take(self):
        """The newest state, and what the controller computed from one; None without a new state.

        Raises
        ------
        MessageError
            If they are of another arm.
        """
        control, msg = self._controls.take(), self._states.take()
        if control is not None:
            if list(control.joint_names) != list(self._arm.joint_names):
                raise MessageError(
                    f"are not those of {self._arm.name}",
                    field="controller/state joint_names",
                    value=list(control.joint_names),
                )
            self.control = control
        if msg is None or self.control is None:
            return None
        delta = self._amplitudes.read(msg, self._sample).copy()
        c = self.control
        return Snapshot(
            time=1e-9 * stamp_ns(msg.header.stamp),
            session=msg.session,
            q=self._sample.position.copy(),
            delta=delta,
            state=State(c.supervisor_state).name,
            reason=c.rejected_reason,
            trajectory=c.accepted_trajectory_id,
            saturated=c.saturated,
            reference=np.array(c.reference_position),
            slow=np.array(c.slow_torque),
            fast=np.array(c.fast_torque),
        )

    def take_planned(self):
        """Joint positions of the newest trajectory on the topic, (k, n) in the arm's order [rad].

        None without a new one. A trajectory without the arm's joint names gives None, too; the controller will refuse
        it.
        """
        message = self._planned.take()
        names = list(self._arm.joint_names)
        if message is None or sorted(message.joint_names) != sorted(names) or not message.points:
            return None
        order = [list(message.joint_names).index(name) for name in names]
        rows = [p.positions for p in message.points if len(p.positions) == len(names)]
        return np.array(rows, float).reshape(-1, len(names))[:, order]

    def sources(self):
        """The loop's topics as they are published, for Foxglove."""
        create, found = self.session.node.create_subscription, []
        for topic, kind in foxglove.TOPICS.items():
            package, _, name = kind.split("/")
            message = getattr({"sensor_msgs": sensor_msgs.msg}.get(package, flexarm_msgs.msg), name)
            found.append(
                foxglove.Source(topic, kind, Latest(create, message, topic, raw=True).take)
            )
        return found

    def serve(self, seconds):
        """Serve services and slow topics for `seconds`; send gains that were changed."""
        self.session.serve(seconds)
        if self._turned and not self._setting and time.monotonic() > self._turned_at + REST:
            self._send_turned()

    def _on_event(self, event):
        if event.node == self._controller:
            names = [p for p in event.changed_parameters if p.name in self.values]
            self._take_values({p.name: plain(p.value) for p in names})

    def _on_log(self, msg):
        if msg.name == self._controller.strip("/").replace("/", ".") and msg.level >= 30:
            self.say(f"controller: {msg.msg}", True)

    # Commands --------------------------------------------------------------------------------

    def move(self, target, duration):
        """Publish a motion from the present reference to the joint angles `target` [rad] in `duration` [s]."""
        message = JointTrajectory(joint_names=list(self._arm.joint_names))
        zero = [0.0] * len(target)
        point = JointTrajectoryPoint(
            positions=[float(v) for v in target], velocities=zero, accelerations=list(zero)
        )
        set_stamp(point.time_from_start, round(duration * 1e9))
        message.points = [point]
        if not self._trajectories.get_subscription_count():
            self.say("no controller listens to joint_trajectory", True)
            return
        self._trajectories.publish(message)
        self.say("a motion was sent", False)

    def stop(self):
        """Call ~/stop."""
        self._ask(Trigger, "stop", self._say_answer)

    def recover(self):
        """Call ~/recover."""
        self._ask(Trigger, "recover", self._say_answer)

    def enable_fast(self, on):
        """Call ~/enable_fast."""
        self._ask(SetBool, "enable_fast", self._say_answer, data=bool(on))

    def turn(self, name, index, value):
        """Note that a gain was turned to a value; the value is sent when the slider rests."""
        self._turned[name, index] = value
        self._turned_at = time.monotonic()

    def _say_answer(self, answer):
        self.say(answer.message, not answer.success)

    def _send_turned(self):
        self._setting = True
        wanted = gains.changed(self.values, self._turned)
        self._turned = {}
        messages = parameter_messages(wanted)

        def done(answer):
            self._setting = False
            if answer.result.successful:
                self._take_values(wanted)
                shown = ", ".join(f"{name} = {show(value)}" for name, value in wanted.items())
                self.say(f"set: {shown}", False)
            else:
                self.say(f"refused: {answer.result.reason}", True)
                self.on_values(self.values)

        self._ask(SetParametersAtomically, "set_parameters_atomically", done, parameters=messages)

    def _take_values(self, values):
        self.values.update(values)
        if values:
            self.on_values(values)

    # Questions -------------------------------------------------------------------------------

    def find_arm(self, then):
        """Ask the controller for its arm; ``then(name)``."""
        self._ask(
            GetParameters,
            "get_parameters",
            lambda answer: then(plain(answer.values[0])),
            names=["arm"],
        )

    def find_gains(self, then):
        """Ask the controller which gains can be changed; ``then(list of Gain)``."""

        def listed(answer):
            names = sorted(answer.result.names)
            self._ask(
                DescribeParameters,
                "describe_parameters",
                lambda described: self._ask(
                    GetParameters,
                    "get_parameters",
                    lambda got: self._gains(names, described.descriptors, got.values, then),
                    names=names,
                ),
                names=names,
            )

        prefixes = [prefix.strip(".") for prefix in gains.LAWS]
        self._ask(ListParameters, "list_parameters", listed, prefixes=prefixes, depth=0)

    def _gains(self, names, descriptors, values, then):
        given = dict(zip(names, map(plain, values), strict=True))
        ranges, hints, owners = {}, {}, {}
        for d in descriptors:
            hints[d.name] = d.description
            owners[d.name] = gains.owners_of(d.additional_constraints, self._arm)
            found = gains.range_of(d.additional_constraints)
            if d.floating_point_range:
                r = d.floating_point_range[0]
                found = r.from_value, r.to_value
            if found and not d.read_only:
                ranges[d.name] = found
        out = gains.of_parameters(given, ranges, hints, laws_in_use(given), owners)
        self.values = {gain.name: given[gain.name] for gain in out}
        then(out)

    def _ask(self, kind, name, then, **request):
        self.session.ask(kind, f"controller/{name}", then, **request)

    def close(self):
        """Leave the graph."""
        self.session.close()


def show(value):
    """A number, or several, for reading."""
    many = isinstance(value, list)
    return "[" + ", ".join(f"{v:.6g}" for v in value) + "]" if many else f"{value:.6g}"


def laws_in_use(values):
    """Names of the parameters that the active laws declare, by prefix; without laws that are not installed here."""
    out = {}
    for prefix, group in gains.LAWS.items():
        try:
            law = registry.find(group, values[f"{prefix}type"])
        except (FlexarmError, KeyError):
            continue
        out[prefix] = {parameter.name for parameter in law.PARAMETERS}
    return out
