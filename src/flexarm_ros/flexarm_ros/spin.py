# SPDX-License-Identifier: Apache-2.0
"""Spins nodes whose control path is one subscription, without rebuilding a wait set of everything per message.

rclpy's executor gathers every service, timer and event of a node anew for each message. For a lifecycle node that costs
more than the control law. Here the control path waits for its own subscription alone. The executor serves the rest
(parameters, services, timers, trajectories) every `HOUSEKEEPING` seconds, if there is anything to serve: `Others` finds
that out in a sixth of the executor's time. It uses the same part of rclpy as ``rclpy.wait_for_message``: a wait set.
"""

import inspect
import time
from collections import deque

from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.waitable import NumberOfEntities

#: Services, timers and slow topics are served at least this often [s].
HOUSEKEEPING = 0.02
#: How many of them are served in one turn for each node; the search for each costs about 0.2 ms.
AT_ONCE = 2
#: After this many turns the executor itself searches.
EVERY = 25


class ControlPath:
    """The control path of a node.

    Parameters
    ----------
    subscription : rclpy.subscription.Subscription
        The executor calls its callback as well, if it comes first.
    period : float, optional
        Time between two calls of `on_period`, in seconds of the steady clock.
    on_period : callable, optional
        Called once in each period. A period that was missed completely is left out, not made up for.

    Attributes
    ----------
    lost : int
        Periods that passed without a callback.
    """

    def __init__(self, subscription, period=None, on_period=None):
        self.subscription = subscription
        self.period, self.on_period = period, on_period
        self.lost = 0


class _Executor(SingleThreadedExecutor):
    """rclpy's executor, which also knows whether it was given tasks that are not done."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self._given = deque()

    def create_task(self, callback, *args, **kwargs):
        """As in rclpy; from any thread."""
        task = super().create_task(callback, *args, **kwargs)
        self._given.append(task)
        return task

    @property
    def has_tasks(self):
        """Whether a task is not done."""
        given = self._given
        while given and (given[0].done() or given[0].cancelled()):
            given.popleft()
        return bool(given)


class Others:
    """What the executor serves beside the control path.

    Parameters
    ----------
    nodes : sequence of Node
    executor : _Executor
    path : ControlPath
    """

    def __init__(self, nodes, executor, path):
        self._nodes, self._executor, self._path = nodes, executor, path
        self._turn = 0

    def waiting(self):
        """Whether there is something to serve; also true every `EVERY` turns, for what this check may miss."""
        self._turn = (self._turn + 1) % EVERY
        if self._turn == 0 or self._executor.has_tasks:
            return True
        return any(self.waits(node) for node in self._nodes)

    def serve_timers(self):
        """Call the timers that are ready: the executor would take 0.1 ms for each."""
        for node in self._nodes:
            for timer in list(node.timers):
                if self._is_ready(timer) and not inspect.iscoroutinefunction(timer.callback):
                    with timer.handle:
                        timer.handle.call_timer()
                    timer.callback()

    @staticmethod
    def _is_ready(timer):
        try:
            return timer.is_ready() and timer.callback_group.can_execute(timer)
        except InvalidHandle:  # destroyed by the callback of another one
            return False

    def waits(self, node):
        """Whether a timer, message, request, answer or event of a `node` waits, except those of the control path."""
        if any(timer.is_ready() for timer in node.timers):
            return True
        subscriptions = [
            s
            for s in node.subscriptions
            if s is not self._path.subscription and s.callback_group.can_execute(s)
        ]
        clients, services, waitables = list(node.clients), list(node.services), list(node.waitables)
        count = NumberOfEntities(
            len(subscriptions), len(list(node.guards)), 0, len(clients), len(services)
        )
        for waitable in waitables:
            count += waitable.get_num_entities()
        found = rclpy_implementation.WaitSet(
            count.num_subscriptions, count.num_guard_conditions, count.num_timers, count.num_clients,
            count.num_services, count.num_events, node.context.handle,
        )  # fmt: skip
        found.clear_entities()
        for subscription in subscriptions:
            found.add_subscription(subscription.handle)
        for client in clients:
            found.add_client(client.handle)
        for service in services:
            found.add_service(service.handle)
        for guard in node.guards:
            found.add_guard_condition(guard.handle)
        for waitable in waitables:
            waitable.add_to_wait_set(found)
        found.wait(0)
        kinds = ("subscription", "client", "service", "guard_condition")
        return any(found.get_ready_entities(kind) for kind in kinds) or any(
            waitable.is_ready(found) for waitable in waitables
        )


def spin(nodes, stopped):
    """Serve nodes until `stopped` holds something.

    Parameters
    ----------
    nodes : sequence of ArmNode
        At most one of them with a `control_path` while it is active, None otherwise; they share the executor.
    stopped : list
        Filled by a signal handler.
    """
    context = nodes[0].context
    executor = _Executor(context=context)
    for node in nodes:
        executor.add_node(node)
    try:
        while not stopped and context.ok():
            node = next((n for n in nodes if n.control_path is not None), None)
            if node is None:
                executor.spin_once(timeout_sec=0.1)
            else:
                _spin_control_path(node, node.control_path, executor, nodes, stopped)
    finally:
        executor.shutdown()


def _spin_control_path(node, path, executor, nodes, stopped):
    handle, kind = path.subscription.handle, path.subscription.msg_type
    callback, raw = path.subscription.callback, path.subscription.raw
    waiting = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)
    clock = time.monotonic
    others, rest = clock(), Others(nodes, executor, path)
    due = clock() + path.period if path.period else None
    while node.control_path is path and not stopped:
        now = clock()
        if now >= others:
            rest.serve_timers()
            if node.control_path is not path:
                return
            if rest.waiting():
                for _ in range(AT_ONCE * len(nodes)):
                    executor.spin_once(timeout_sec=0.0)
            if node.control_path is not path or not node.context.ok():
                return
            now = clock()
            others = now + HOUSEKEEPING
        if due is not None and now >= due:
            path.on_period()
            # On the grid of whole periods: a short period follows a late one, and a period missed completely is lost.
            due += path.period
            missed = int((clock() - due) / path.period)
            if missed > 0:
                path.lost += missed
                due += missed * path.period
        until = others if due is None else min(others, due)
        with handle:
            taken = handle.take_message(kind, raw)
            if taken is None:
                waiting.clear_entities()
                waiting.add_subscription(handle)
                waiting.wait(max(0, int((until - clock()) * 1e9)))
                taken = handle.take_message(kind, raw)
        if taken is not None:
            callback(taken[0])
