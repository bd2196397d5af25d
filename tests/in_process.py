# SPDX-License-Identifier: Apache-2.0
"""The nodes in this process, joined by a queue in place of DDS: the same node code, one message at a time.

What the nodes do with their input does not depend on how it reaches them. A family of cases is therefore tested here,
in order, without processes, threads or waiting; one case of each family is tested over DDS as well.
"""

import contextlib
import gc
import heapq
import itertools
from collections import deque
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import rclpy
from harness import Nodes
from rclpy.serialization import deserialize_message, serialize_message
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from flexarm_control.nodes.controller import ControllerNode
from flexarm_control.nodes.observer import ObserverNode
from flexarm_control.nodes.shaper import ShaperNode
from flexarm_ros.session import WaitError
from flexarm_sim.nodes.hardware import HardwareNode
from flexarm_sim.nodes.simulator import SimulatorNode
from flexarm_studies.loop.closed_loop import TRAJECTORY_START_NS
from flexarm_tools.recording.recorder import Recorder, raw_stamp_ns
from flexarm_tools.replay.node import ReplayNode
from flexarm_tools.running.processes import arguments, own_domain

CLASSES = {
    "simulator": SimulatorNode,
    "hardware": HardwareNode,
    "observer": ObserverNode,
    "controller": ControllerNode,
    "replay": ReplayNode,
    "shaper": ShaperNode,
}


class Queue:
    """Messages, calls and timers of all nodes, served in order; time is what the messages take.

    Attributes
    ----------
    time : float
        [s]
    """

    #: What a message takes [s].
    MESSAGE = 1e-4

    def __init__(self):
        self.time, self.taps = 0.0, {}
        self._readers, self._calls, self._waiting, self._timers = {}, deque(), deque(), []
        self._order = itertools.count()

    def publish(self, kind, topic, message):
        """Put a message at the end of the queue, as bytes: the publisher may write its next one at once."""
        raw = message if isinstance(message, bytes) else serialize_message(message)
        self._waiting.append(lambda: self._deliver(kind, topic, raw))

    def _deliver(self, kind, topic, raw):
        self.time += self.MESSAGE
        readers = list(self._readers.get(topic, ()))
        if topic in self.taps:
            readers.append(self.taps[topic])
        message = None if all(r.raw for r in readers) else deserialize_message(raw, kind)
        for reader in readers:
            reader.take(raw if reader.raw else message)

    def publisher(self, kind, topic):
        """A publisher, as far as nodes and tools use one."""
        return SimpleNamespace(
            publish=lambda message: self.publish(kind, topic, message),
            get_subscription_count=lambda: self.readers(topic),
            wait_for_all_acked=lambda timeout: True,
            topic_name=topic,
        )

    def readers(self, topic):
        """Number of those that get a topic's messages."""
        return len(self._readers.get(topic, ())) + (topic in self.taps)

    def subscribe(self, topic, callback, raw=False):
        """Have a callback called with a topic's messages."""
        reader = SimpleNamespace(take=callback, raw=raw, topic_name=topic)
        self._readers.setdefault(topic, []).append(reader)
        return reader

    def unsubscribe(self, reader):
        self._readers[reader.topic_name].remove(reader)

    def call_soon(self, callback, *args):
        """Call before the next message is delivered."""
        self._calls.append((callback, args))

    def add_timer(self, period, callback):
        """Call a callback again and again; the timer."""
        timer = SimpleNamespace(period=period, callback=callback, alive=True)
        self._start(timer)
        return timer

    def _start(self, timer):
        heapq.heappush(self._timers, (self.time + timer.period, next(self._order), timer))

    def clear(self):
        """Forget all readers, messages, calls and timers, and with them the nodes."""
        for kept in (self._readers, self._calls, self._waiting, self._timers):
            kept.clear()

    @property
    def busy(self):
        """Whether messages or calls wait."""
        return bool(self._calls or self._waiting)

    def serve(self):
        """Serve what is next: a call, a timer that is due, a message, or, while there is none, the next timer."""
        if self._calls:
            callback, args = self._calls.popleft()
            callback(*args)
        elif self._waiting and not (self._timers and self._timers[0][0] <= self.time):
            self._waiting.popleft()()
        elif self._timers:
            due, _, timer = heapq.heappop(self._timers)
            self.time = max(self.time, due)
            if timer.alive:
                timer.callback()
                self._start(timer)
        else:
            raise AssertionError("no message, no timer: nothing can happen any more")


class Tap:
    """Collects the messages of a topic, as `flexarm_ros.session.Tap`."""

    def __init__(self, raw=False):
        self.raw, self.messages = raw, []

    def take(self, message):
        """Add a message."""
        self.messages.append(message)

    @property
    def newest(self):
        """The last message; None before the first."""
        return self.messages[-1] if self.messages else None


class AtOnce:
    """In place of a thread of the node: does its work when it is submitted."""

    def submit(self, function, *args):
        function(*args)

    def shutdown(self, wait=True, cancel_futures=False):
        pass


class _OnQueue:
    """What a node makes for its topics, timers and threads, on the queue `queue`."""

    queue = None

    def _publisher(self, kind, topic, *_, **__):
        return self.queue.publisher(kind, self.resolve_topic_name(topic))

    def make_subscription(self, kind, topic, callback, *_, raw=False, **__):
        topic = self.resolve_topic_name(topic)
        reader = self.queue.subscribe(topic, callback, raw)
        return self._keep(self.queue.unsubscribe, reader)

    def make_timer(self, period, callback):
        def end(timer):
            timer.alive = False

        return self._keep(end, self.queue.add_timer(period, callback))

    def hand_over(self, callback, *args):
        self.queue.call_soon(callback, *args)

    def build(self):
        super().build()
        for worker in getattr(self, "_workers", ()):
            if hasattr(worker, "_thread"):
                worker._thread.shutdown()
                worker._thread = AtOnce()


class _Log:
    """A node's log, as `rclpy` prints it."""

    def __init__(self, name):
        self._name, self.text = name, ""

    def _add(self, severity, text):
        self.text += f"[{severity}] [0.0] [{self._name}]: {text}\n"

    def get_child(self, name):
        """The log of a part of the node: the same."""
        return self

    def info(self, text):
        self._add("INFO", text)

    def warning(self, text):
        self._add("WARN", text)

    def error(self, text):
        self._add("ERROR", text)


def participants():
    """Number of the middleware's participants in this process, by their threads for events."""
    count = 0
    for path in Path("/proc/self/task").glob("*/comm"):
        with contextlib.suppress(OSError):  # a thread that has just ended
            count += path.read_text().startswith("dds.ev")
    return count


class InProcess(Nodes):
    """The part of `harness.Bench` that tests of families use, with the nodes in this process."""

    def __init__(self):
        self.queue, self.nodes, self._contexts = Queue(), {}, []
        self._participants = participants()
        self._domain = own_domain()
        self.domain = self._domain.__enter__()

    def start(self, name, parameters=None, *, key=None, file=None, remaps=()):
        """Make a node and activate it, unless `autostart` is false.

        A controller designs in a thread: a process of its own would take seconds to start.
        """
        if name == "controller":
            parameters = {"design_process": False, **(parameters or {})}
        return self.start_with(arguments(parameters, file, remaps), name, key)

    def start_with(self, args, name, key=None):
        """Make a node of a command line's arguments."""
        context = rclpy.Context()
        self._contexts.append(context)
        rclpy.init(context=context, args=args, domain_id=self.domain)
        kind = type(CLASSES[name].__name__, (_OnQueue, CLASSES[name]), {"queue": self.queue})
        with mock.patch("rclpy.node.get_default_context", lambda **_: context):
            node = kind()
        node._logger = _Log(node.get_fully_qualified_name().lstrip("/"))
        self.nodes[key or name] = node
        assert node.autostart(), node.failure
        return node

    def log(self, key):
        """What a node has logged."""
        return self.nodes[key].get_logger().text

    def check(self):
        """The nodes live as long as this process."""

    def tap(self, kind, topic, raw=False):
        """Collects the messages of a topic from now on; one for each topic."""
        return self.queue.taps.setdefault(f"/{topic.lstrip('/')}", Tap(raw))

    def publisher(self, kind, topic, readers=1):
        """A publisher of a topic."""
        topic = f"/{topic.lstrip('/')}"
        assert self.queue.readers(topic) >= readers
        return self.queue.publisher(kind, topic)

    def call(self, kind, service, /, **request):
        """Call a service between two messages; its answer."""
        for node in self.nodes.values():
            for offered in node.services:
                if offered.service_name == f"/{service}":
                    return offered.callback(kind.Request(**request), kind.Response())
        raise AssertionError(f"no service {service}")

    def wait_for(self, what, condition, patience=20.0, hint=""):
        """Serve until a condition holds; its value."""
        end = self.queue.time + patience
        while not (value := condition()):
            if self.queue.time > end:
                logs = "\n".join(node.get_logger().text for node in self.nodes.values())
                raise WaitError(f"waited {patience:g} s in vain for {what}", hint=hint + logs)
            self.queue.serve()
        return value

    def start_node(self, name, parameters, file):
        """Start a node, as `flexarm_tools.running.processes.Processes` does."""
        self.start(name, parameters, file=file)

    def record(self, message, duration):
        """Offer a trajectory that starts at `TRAJECTORY_START_NS`, and run; the samples as of `LockstepRun.run`."""
        end = TRAJECTORY_START_NS + round(duration * 1e9)
        recorder = Recorder(self)
        self.wait_for("every topic", recorder.complete)
        begin = recorder.latest_ns
        self.publisher(JointTrajectory, "joint_trajectory").publish(message)
        self.wait_for("the trajectory", lambda: "accepted" in self.log("controller"))
        assert self.call(SetBool, "simulator/pause", data=False).success

        def complete():
            return all(raw_stamp_ns(messages[-1]) >= end for messages in recorder.raw.values())

        self.wait_for("the end", complete)
        return recorder.samples(begin, end)

    def close(self):
        """End the nodes."""
        for node in self.nodes.values():
            if node.active:
                node.stop()
            node.destroy_node()
            del node
        self.nodes.clear()
        self.queue.clear()
        gc.unfreeze()  # a node that starts freezes what there is
        gc.collect()
        # Nothing refers to the contexts any more: with them go the participants of the middleware and their threads.
        for context in self._contexts:
            rclpy.try_shutdown(context=context)
            context.destroy()
        # What is left behind makes discovery in this process unreliable.
        assert participants() <= self._participants, "something refers to a node still"
        self._domain.__exit__(None, None, None)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
