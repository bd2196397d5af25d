# SPDX-License-Identifier: Apache-2.0
"""The session beside nodes: what it collects and calls, and that no wait outlives a process it needs."""

import contextlib
import itertools
import os
import time
from types import SimpleNamespace

import numpy as np
import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from std_msgs.msg import String

from flexarm_dynamics.errors import FlexarmError
from flexarm_ros import session as session_of
from flexarm_ros.session import Latest, Session, WaitError, parameter_messages, plain


class Processes:
    """Processes that are alive, or dead with these last words."""

    last_words = ""

    def check(self):
        if self.last_words:
            raise FlexarmError(f"observer ended with code 1:\n{self.last_words}")

    def tails(self):
        return "--- observer\nwaiting for a state"


@pytest.fixture
def session(domain):
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    with Session("test", domain=domain, processes=Processes(), patience=20.0) as session:
        yield session


def test_a_wait_returns_the_conditions_value_and_names_what_did_not_come(session):
    assert session.wait_for("three", lambda: 3) == 3
    with pytest.raises(WaitError) as error:
        session.wait_for("a state", lambda: None, 0.02, hint="start the driver")
    assert error.value.problem == "waited 0.02 s in vain for a state"
    assert error.value.hint == "start the driver\n--- observer\nwaiting for a state"


def test_a_wait_fails_at_once_when_a_watched_process_has_died(session):
    session._processes.last_words = "no such arm"
    began = time.monotonic()
    with pytest.raises(FlexarmError, match="observer ended with code 1:\nno such arm"):
        session.wait_for("a state", lambda: False)
    assert time.monotonic() - began < 5.0


def test_a_death_that_is_waited_for_ends_the_wait(session):
    calls = []

    def ends_between_two_looks():
        calls.append(session._processes.last_words)
        session._processes.last_words = "done"
        return calls[-1]

    assert session.wait_for("its end", ends_between_two_looks) == "done"


class Flood(contextlib.nullcontext):
    """A subscription, and its handle, with a message whenever one is taken."""

    count, msg_type = 0, String

    @property
    def handle(self):
        return self

    def take_message(self, kind, raw):
        self.count += 1
        assert self.count < 10**6, "never ends"
        return kind(), {}


def test_messages_that_arrive_as_fast_as_they_are_read_do_not_hold_the_session(monkeypatch):
    monkeypatch.setattr(session_of, "MAX_TAKE", 0.01)
    flood = Flood()
    assert len(list(session_of.taken(flood))) == flood.count > 0


def test_callbacks_are_served_while_messages_flood_every_tap(session, monkeypatch):
    clock, served = itertools.count(), []
    monkeypatch.setattr(session_of, "time", SimpleNamespace(monotonic=lambda: 1e-4 * next(clock)))
    monkeypatch.setattr(session.executor, "spin_once", lambda **_: served.append(next(clock)))
    floods = [SimpleNamespace(poll=lambda: list(session_of.taken(Flood()))) for _ in range(5)]
    monkeypatch.setattr(session, "_taps", dict(enumerate(floods)))
    session.serve(1.0)
    assert np.diff(served).max() < 0.03 / 1e-4


def test_taps_collect_in_order_and_latest_keeps_the_newest(session):
    tap, raw = session.tap(String, "words"), session.tap(String, "raw_words", raw=True)
    assert session.tap(String, "words") is tap
    latest = Latest(session.node.create_subscription, String, "words")
    words = [session.publisher(String, topic) for topic in ("words", "raw_words")]
    session.wait_for("discovery", lambda: words[0].get_subscription_count() == 2)
    session.wait_for("discovery", raw.publishers)
    for k in range(5):
        for publisher in words:
            publisher.publish(String(data=str(k)))
    session.wait_for("all", lambda: len(tap.messages) == len(raw.messages) == 5)
    assert [m.data for m in tap.messages] == list("01234")
    assert deserialize_message(raw.newest, String).data == "4"
    assert latest.take().data == "4"
    assert latest.take() is None
    session.untap("words")
    assert list(session.taps) == ["raw_words"]


def test_a_service_is_called_and_asked_without_waiting(session):
    answers = []

    def answer(request, response):
        response.values = [m.value for m in parameter_messages({n: 2.5 for n in request.names})]
        return response

    session.node.create_service(GetParameters, "get", answer)
    assert plain(session.call(GetParameters, "get", names=["a"]).values[0]) == 2.5
    question = session.ask(GetParameters, "get", then=answers.append, names=["a", "b"])
    session.wait_for("the answer", lambda: answers)
    assert question.answer is answers[0]
    assert len(answers[0].values) == 2
    assert not session._questions


def test_a_service_that_is_not_there_is_named(session):
    session.patience = 0.05
    with pytest.raises(WaitError, match="an answer of the service nothing"):
        session.call(GetParameters, "nothing")


@pytest.mark.parametrize(
    ("answered", "answer"),
    [
        ([(0.5, 0)], 0),
        ([(3.5, 0), (4.0, 1)], 1),  # the service was slow: it serves both requests
        ([(4.0, 1)], 1),  # the first answer was lost
        ([(3.5, 0)], 0),  # the service ended after the first
    ],
)
def test_the_answer_of_a_service_is_that_of_the_last_request(monkeypatch, answered, answer):
    now, futures, given = [0.1], [], []
    monkeypatch.setattr(session_of, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def send(request):
        futures.append(Future())
        return futures[-1]

    client = SimpleNamespace(
        service_is_ready=lambda: True, call_async=send, remove_pending_request=futures.remove
    )
    question = session_of.Question(client, None, given.append, again=3.0)
    sent = []
    for now[0] in np.arange(0.1, 20.0, 0.1).tolist():
        if question.poll():
            break
        sent = list(futures)
        for at, k in answered:
            if now[0] > at and not futures[k].done():
                futures[k].set_result(k)
    assert question.answer == answer and given == [answer]
    assert not futures and len(sent) == 1 + (answered[-1][0] > 3.0)
