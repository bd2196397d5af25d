# SPDX-License-Identifier: Apache-2.0
"""The control path's own loop: everything else of a node is still served, and looked for at little cost."""

import os
import threading
from itertools import count

import pytest
import rclpy
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from flexarm_ros import qos, session, spin


@pytest.fixture
def context(domain):
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    made = rclpy.Context()
    rclpy.init(context=made, domain_id=domain)
    yield made
    rclpy.try_shutdown(context=made)
    made.destroy()


class Path(Node):
    """A node whose control path is the topic `path`."""

    def __init__(self, context):
        super().__init__("path", context=context, start_parameter_services=False)
        self.taken, self.others = [], []
        self.publisher = self.create_publisher(String, "path", qos.CONTROL_PATH)
        mine = self.create_subscription(String, "path", self.taken.append, qos.CONTROL_PATH)
        self.control_path = spin.ControlPath(mine)


@pytest.fixture
def node(context):
    made = Path(context)
    yield made
    made.destroy_node()


def others(node):
    """The node's `Others`, with an executor that has served what there was at first."""
    executor = spin._Executor(context=node.context)
    executor.add_node(node)
    found = spin.Others([node], executor, node.control_path)
    while found.waits(node):
        executor.spin_once(timeout_sec=0.0)
    return found, executor


def soon(condition, work=lambda: None):
    """Wait for a condition, doing some work meanwhile; rather long on a busy machine."""
    pause = threading.Event()
    for _ in range(2000):
        if condition():
            return True
        work()
        pause.wait(0.01)
    return False


def test_without_anything_to_serve_the_executor_looks_once_in_a_while(node):
    found, executor = others(node)
    turns = [found.waiting() for _ in range(3 * spin.EVERY)]
    assert sum(turns) == 3
    executor.shutdown()


def test_messages_of_the_control_path_are_not_for_the_executor(node):
    found, executor = others(node)
    assert soon(lambda: node.publisher.get_subscription_count() == 1)
    node.publisher.publish(String(data="a"))
    handle = node.control_path.subscription.handle
    arrived = []
    assert soon(
        lambda: (
            arrived or arrived.append(handle.take_message(String, False)) or arrived[-1:] != [None]
        )
    )
    assert not found.waits(node)
    executor.shutdown()


@pytest.mark.parametrize("kind", ["message", "request", "answer", "timer", "event", "task"])
def test_whatever_comes_is_found_and_served(node, kind):
    found, executor = others(node)
    served = []
    if kind == "message":
        publisher = node.create_publisher(String, "other", qos.COMMAND)
        node.create_subscription(String, "other", served.append, qos.COMMAND)
        assert soon(lambda: publisher.get_subscription_count() == 1)
        publisher.publish(String(data="a"))
    elif kind in ("request", "answer"):
        node.create_service(Trigger, "ask", lambda _, answer: served.append(1) or answer)
        client = node.create_client(Trigger, "ask")
        assert soon(client.service_is_ready)
        client.call_async(Trigger.Request()).add_done_callback(served.append)
    elif kind == "timer":
        node.create_timer(0.001, lambda: served.append(1))
    elif kind == "event":
        events, take = qos.Mismatches(node).callbacks(True, False)
        best_effort = session.LOOKING_ON
        take(node.create_publisher(String, "apart", best_effort, event_callbacks=events))
        node.get_logger = lambda: type("Log", (), {"warning": staticmethod(served.append)})
        node.create_subscription(String, "apart", served.append, qos.COMMAND)
    else:
        thread = threading.Thread(target=executor.create_task, args=(served.append, 1))
        thread.start()
        thread.join()

    wanted = 2 if kind == "answer" else 1  # the request, then its answer

    def work():
        if found._executor.has_tasks or found.waits(node):
            executor.spin_once(timeout_sec=0.0)

    assert soon(lambda: len(served) >= wanted, work)
    executor.shutdown()


def test_timers_are_served_without_the_executor(node):
    found, executor = others(node)
    served, slow = [], []
    first = node.create_timer(0.001, lambda: served.append(1) or node.destroy_timer(first))
    node.create_timer(100.0, lambda: slow.append(1))
    assert soon(lambda: served, found.serve_timers)
    found.serve_timers()
    assert served == [1]  # destroyed by its own callback
    assert slow == []

    async def later():
        served.append(2)

    node.create_timer(0.001, later)
    assert soon(lambda: found.waits(node), found.serve_timers)  # a coroutine is for the executor
    assert soon(lambda: 2 in served, lambda: executor.spin_once(timeout_sec=0.0))
    executor.shutdown()


def test_a_subscription_that_is_not_to_be_served_is_not_looked_at(node):
    tap = session.Tap(node, String, "tapped")
    publisher = node.create_publisher(String, "tapped", session.DEEP)
    found, executor = others(node)
    assert soon(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(String(data="a"))
    assert soon(lambda: tap.poll() or tap.messages)
    publisher.publish(String(data="b"))
    assert not any(found.waits(node) for _ in range(50))
    executor.shutdown()


def test_a_task_that_waits_is_not_done(node):
    executor = spin._Executor(context=node.context)
    goal, quick = Future(), executor.create_task(lambda: None)

    async def execute():
        await goal

    executor.create_task(execute)
    while not quick.done():
        executor.spin_once(timeout_sec=0.0)
    assert executor.has_tasks
    goal.set_result(None)
    for _ in range(10):
        executor.spin_once(timeout_sec=0.0)
    assert not executor.has_tasks
    executor.create_task(execute).cancel()
    assert not executor.has_tasks
    executor.shutdown()


def test_messages_and_services_are_served_side_by_side_until_the_end(node):
    stopped, numbers = [], count()

    def take(message):
        node.taken.append(message.data)
        node.publisher.publish(String(data=str(next(numbers))))

    def answer(_, response):
        response.success = True
        stopped.append(True)
        return response

    node.control_path.subscription.callback = take
    node.create_service(Trigger, "end", answer)
    node.create_timer(0.05, lambda: node.publisher.publish(String(data="go")))
    client = node.create_client(Trigger, "end")
    node.create_timer(0.05, lambda: len(node.taken) > 200 and client.call_async(Trigger.Request()))
    spin.spin([node], stopped)
    assert len(node.taken) > 200
