# SPDX-License-Identifier: Apache-2.0
"""Spins nodes whose control path is one subscription, without rebuilding a wait set of everything per message.

rclpy's executor gathers every service, timer and event of a node anew for each message: for a lifecycle node
that costs more than the control law. Here the control path waits on its own subscription alone, and the
executor serves the rest (parameters, services, timers, trajectories) at least every `HOUSEKEEPING` seconds.
It takes what ``rclpy.wait_for_message`` takes of rclpy: a wait set with one subscription.
"""

import time

from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation

#: Services, timers and slow topics are served at least this often [s].
HOUSEKEEPING = 0.02
#: How many of them are served in one turn for each node; looking for each costs about 0.2 ms.
AT_ONCE = 2


class ControlPath:
    """The control path of a node.

    Parameters
    ----------
    subscription : rclpy.subscription.Subscription
        Its callback is called by the executor as well, whichever comes first.
    period : float, optional
        A callback in real time is wanted every so many seconds (steady clock).
    on_period : callable, optional
        That callback. A period that was missed whole is not made up for.

    Attributes
    ----------
    lost : int
        Periods that passed without a callback.
    """

    def __init__(self, subscription, period=None, on_period=None):
        self.subscription = subscription
        self.period, self.on_period = period, on_period
        self.lost = 0


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
    executor = SingleThreadedExecutor(context=context)
    for node in nodes:
        executor.add_node(node)
    try:
        while not stopped and context.ok():
            node = next((n for n in nodes if n.control_path is not None), None)
            if node is None:
                executor.spin_once(timeout_sec=0.1)
            else:
                _spin_control_path(node, node.control_path, executor, AT_ONCE * len(nodes), stopped)
    finally:
        executor.shutdown()


def _spin_control_path(node, path, executor, at_once, stopped):
    handle, kind = path.subscription.handle, path.subscription.msg_type
    callback, raw = path.subscription.callback, path.subscription.raw
    waiting = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)
    clock = time.monotonic
    others = clock()
    due = clock() + path.period if path.period else None
    while node.control_path is path and not stopped:
        now = clock()
        if now >= others:
            for _ in range(at_once):
                executor.spin_once(timeout_sec=0.0)
            if node.control_path is not path or not node.context.ok():
                return
            now = clock()
            others = now + HOUSEKEEPING
        if due is not None and now >= due:
            path.on_period()
            # On the grid of whole periods: a late one is followed by a short one, one missed whole is lost.
            due += path.period
            missed = int((clock() - due) / path.period)
            if missed > 0:
                path.lost += missed
                due += missed * path.period
        until = others if due is None else min(others, due)
        waiting.clear_entities()
        with handle:
            waiting.add_subscription(handle)
            waiting.wait(max(0, int((until - clock()) * 1e9)))
            taken = handle.take_message(kind, raw)
        if taken is not None:
            callback(taken[0])
