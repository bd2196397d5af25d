# SPDX-License-Identifier: Apache-2.0
"""Gives a program a session beside running nodes: it collects topics, publishes, calls services and waits.

The commands and the tests' harness use this one class. Every wait is bounded: it ends when its condition holds, when
its time is over, or at once when one of the watched processes has died.
"""

import time

import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

from flexarm_dynamics.errors import FlexarmError

from . import ending, qos

#: Loses no message even if a reader falls behind for seconds.
DEEP = QoSProfile(
    history=QoSHistoryPolicy.KEEP_LAST, depth=20_000, reliability=QoSReliabilityPolicy.RELIABLE
)
#: For a reader that must never slow the loop: publishers do not wait for it.
LOOKING_ON = QoSProfile(
    history=QoSHistoryPolicy.KEEP_LAST, depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT
)


class WaitError(FlexarmError):
    """An expected event did not happen in time."""


class Unserved(CallbackGroup):
    """The group of subscriptions whose messages are taken by `Tap` and `Latest`, not by an executor."""

    def can_execute(self, entity):
        """Whether an executor may take it: never."""
        return False

    def beginning_execution(self, entity):
        """Nothing to do."""
        return False

    def ending_execution(self, entity):
        """Nothing to do."""


#: Max. duration of `taken` [s]. If messages arrive as fast as they are read, it would otherwise not end, and a session
#: with several taps would hardly serve its callbacks: the answer of a service then took seconds.
MAX_TAKE = 0.005


def taken(subscription, raw=False):
    """Yield the messages that wait in a subscription's queue; serialised ones if `raw`.

    It ends after `MAX_TAKE`; the next call continues with the rest.
    """
    handle, kind = subscription.handle, subscription.msg_type
    end = time.monotonic() + MAX_TAKE
    with handle:
        while (found := handle.take_message(kind, raw)) is not None:
            yield found[0]
            if time.monotonic() > end:
                return


class Tap:
    """Collects the messages of a topic in order.

    `poll` empties the middleware's queue. Waking an executor for each message would take a processor core from
    the loop that is observed.

    Parameters
    ----------
    node : rclpy.node.Node
    kind : type
        Of the messages.
    topic : str
    raw : bool
        Keep the messages serialised, as bytes.

    Attributes
    ----------
    messages : list
    """

    def __init__(self, node, kind, topic, raw=False):
        self.kind, self.messages, self._raw = kind, [], raw
        self._subscription = node.create_subscription(
            kind, topic, lambda message: None, DEEP, raw=raw, callback_group=Unserved()
        )

    def poll(self):
        """Take what has arrived since the last call."""
        self.messages.extend(taken(self._subscription, self._raw))

    @property
    def newest(self):
        """The last message; None before the first."""
        return self.messages[-1] if self.messages else None

    def close(self, node):
        """Unsubscribe."""
        node.destroy_subscription(self._subscription)

    def publishers(self):
        """Number of publishers of the topic."""
        return self._subscription.get_publisher_count()


class Latest:
    """The newest message of a topic; those in between are dropped, and no publisher waits for this reader.

    Parameters
    ----------
    create : callable
        ``create_subscription`` of a node, or `ArmNode.make_subscription`.
    kind : type
        Of the messages.
    topic : str
    raw : bool
        Leave the messages serialised, as bytes.
    """

    def __init__(self, create, kind, topic, raw=False):
        self._raw = raw
        more = {"raw": True} if raw else {}
        self._subscription = create(
            kind, topic, lambda message: None, LOOKING_ON, callback_group=Unserved(), **more
        )

    def take(self):
        """The newest message since the last call; None if there is none."""
        newest = None
        for newest in taken(self._subscription, self._raw):  # noqa: B007
            pass
        return newest


class Question:
    """A service request that is sent again until an answer arrives.

    A service that is slow serves each request that was sent, for instance resets twice. So the answer is that of the
    last one; it is awaited until the next request would be due, and an earlier answer is taken if it does not come.

    Parameters
    ----------
    client : rclpy.client.Client
    request : object
    then : callable, optional
        Called with the answer.
    again : float
        Time after which the request is sent again [s].

    Attributes
    ----------
    answer : object
        None before it arrives.
    """

    def __init__(self, client, request, then=None, again=3.0):
        self._client, self._request, self._then = client, request, then
        self._futures, self._every, self._again = [], again, 0.0
        self.answer = None

    def poll(self):
        """Send the request if it is due; return whether the answer has arrived."""
        if self.answer is not None:
            return True
        due = time.monotonic() > self._again
        done = [future for future in self._futures if future.done()]
        if done and (due or done[-1] is self._futures[-1]):
            self.answer = done[-1].result()
            for future in self._futures:
                self._client.remove_pending_request(future)
            if self._then is not None:
                self._then(self.answer)
        elif not done and due and self._client.service_is_ready():
            self._again = time.monotonic() + self._every
            self._futures.append(self._client.call_async(self._request))
        return self.answer is not None


class Session:
    """A node of this process with its executor and context, for a program that works with running nodes.

    Parameters
    ----------
    name : str
        Of the node.
    namespace : str
        Of the node, and so of the topics and services with relative names.
    domain : int, optional
        ROS_DOMAIN_ID; the environment's if not given.
    args : sequence of str
        ROS arguments.
    processes : Processes, optional
        Watched while waiting: ``check()`` raises a `FlexarmError` for a process that has died, ``tails()`` is the
        end of each log.
    patience : float
        Default timeout of a wait [s].
    period : float
        Time between two checks of the taps and of the awaited condition [s].

    Attributes
    ----------
    ask_again : float
        Time after which a request without an answer is sent again [s]: a server that has not discovered the client
        yet drops its answer.
    """

    ask_again = 3.0

    def __init__(
        self,
        name,
        *,
        namespace="",
        domain=None,
        args=(),
        processes=None,
        patience=60.0,
        period=0.01,
    ):
        self.patience, self.period, self._processes = patience, period, processes
        self.context = rclpy.Context()
        rclpy.init(context=self.context, args=list(args), domain_id=domain)
        self.node = Node(
            name,
            context=self.context,
            namespace=namespace,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self._taps, self._clients, self._publishers, self._questions = {}, {}, {}, []

    # Waiting ---------------------------------------------------------------------------------

    def wait_for(self, what, condition, patience=None, hint=""):
        """Serve callbacks, taps and requests until `condition` holds; return its value.

        Parameters
        ----------
        what : str
            What is awaited, for the error.
        condition : callable
        patience : float, optional
            [s]
        hint : str
            What the user can do if it does not happen.

        Raises
        ------
        WaitError
            After `patience`, with the end of the watched processes' logs.
        FlexarmError
            At once, if a watched process has died.
        """
        patience = self.patience if patience is None else patience
        if value := self.serve(patience, condition):
            return value
        tails = "" if self._processes is None else self._processes.tails()
        hint = "\n".join(text for text in (hint, tails) if text)
        raise WaitError(f"waited {patience:g} s in vain for {what}", hint=hint)

    def serve(self, seconds, until=lambda: False):
        """Serve for `seconds`, or until a condition holds; return the condition's value.

        Raises
        ------
        FlexarmError
            If a watched process has died, unless the condition waits for its end.
        """
        end = time.monotonic() + seconds
        while True:
            self.poll()
            if value := until():
                return value
            if self._processes is not None:
                try:
                    self._processes.check()
                except FlexarmError:
                    self.poll()
                    if value := until():
                        return value
                    raise
            left = end - time.monotonic()
            if left <= 0.0:
                return value
            self.executor.spin_once(timeout_sec=min(self.period, left))

    def poll(self):
        """Take what has arrived on the taps, and handle requests; callbacks are not served."""
        for tap in self._taps.values():
            tap.poll()
        # The callback of an answer may ask the next question.
        for question in list(self._questions):
            if question.poll():
                self._questions.remove(question)

    # Topics ----------------------------------------------------------------------------------

    def tap(self, kind, topic, raw=False):
        """The `Tap` of a topic; one for each topic."""
        if topic not in self._taps:
            self._taps[topic] = Tap(self.node, kind, topic, raw)
        return self._taps[topic]

    def untap(self, topic):
        """Stop collecting a topic."""
        self._taps.pop(topic).close(self.node)

    @property
    def taps(self):
        """All taps, by topic."""
        return self._taps

    def publisher(self, kind, topic, readers=0, profile=qos.COMMAND):
        """The publisher of a topic, once `readers` subscriptions have discovered it.

        `kind` is the type of the messages; the default profile is reliable and volatile, like that of ``ros2 topic
        pub``.
        """
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(kind, topic, profile)
        publisher = self._publishers[topic]
        if readers:
            count = publisher.get_subscription_count
            self.wait_for(f"{readers} readers of {topic}", lambda: count() >= readers)
        return publisher

    # Services --------------------------------------------------------------------------------

    def ask(self, kind, service, /, then=None, **request):
        """Send a request of a `kind` to a `service` without waiting; return its `Question`.

        While serving, ``then(answer)`` is called.
        """
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, service)
        question = Question(self._clients[service], kind.Request(**request), then, self.ask_again)
        self._questions.append(question)
        question.poll()
        return question

    def call(self, kind, service, /, **request):
        """Send a request of a `kind` to a `service` and wait for its answer."""
        question = self.ask(kind, service, **request)
        try:
            self.wait_for(f"an answer of the service {service}", question.poll)
        finally:
            if question in self._questions:
                self._questions.remove(question)
        return question.answer

    # End -------------------------------------------------------------------------------------

    def close(self):
        """Leave the graph."""
        with ending.bounded():
            self.executor.shutdown()
            self.node.destroy_node()
            rclpy.try_shutdown(context=self.context)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def parameter_messages(values):
    """The messages that set parameters; `values` is a mapping of name to value."""
    return [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]


def plain(value):
    """Python's value of a `ParameterValue`, arrays as lists."""
    found = parameter_value_to_python(value)
    return found.tolist() if hasattr(found, "tolist") else found
