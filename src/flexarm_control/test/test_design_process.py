# SPDX-License-Identifier: Apache-2.0
"""Designs that come from another process are those made here."""

import os
import pickle
import signal
from dataclasses import dataclass
from threading import Thread
from types import SimpleNamespace

import numpy as np
import pytest

from flexarm_control.composite import design_process
from flexarm_control.composite.design import design
from flexarm_control.composite.design_process import AwayError, DesignProcess
from flexarm_control.composite.designer import Designer
from flexarm_dynamics import processes
from flexarm_dynamics.errors import DesignError, ParameterError

FAST, CORRECTED = {"type": "lqr"}, {"type": "corrected"}


def torques(control, n, m):
    """A few samples about a reference that moves."""
    out, rng = [], np.random.default_rng(2)
    for k in range(5):
        state = np.array([np.full(n, 0.1 + 1e-3 * k), np.full(n, 0.2), np.full(n, -0.3)])
        reference = SimpleNamespace(
            position=state[0],
            velocity=state[1],
            acceleration=state[2],
            path=None,
            stamp_ns=10**9 + 10**6 * k,
            near=lambda _, s=state: s.copy(),
        )
        draw = [1e-3 * rng.standard_normal(size) for size in (n, n, m, m)]
        q, qd = state[0] + draw[0], state[1] + draw[1]
        out.append(control.step(q, qd, *draw[2:], reference, 1e-3 if k else 0.0).copy())
    return np.array(out)


@pytest.mark.parametrize(
    ("slow", "kind"),
    [("linear_model_following", "none"), ("model_following", "model"), ("sliding_mode", "preview")],
)
def test_a_control_that_has_travelled_gives_the_same_torque(arm_r, slow, kind):
    made = design(arm_r, {"type": slow}, FAST, CORRECTED, {"feedforward": kind})
    data = design_process.dumps(made, arm_r.arm)
    expected = torques(made, 1, arm_r.n_modes)
    travelled = design_process.loads(data, arm_r)
    assert travelled.model is arm_r
    np.testing.assert_array_equal(torques(travelled, 1, arm_r.n_modes), expected)
    assert np.ptp(expected) > 0.0


@pytest.mark.parametrize("level", ["file", "stiffening", "finite_slope"])
def test_a_feedforward_that_knows_more_than_the_file_travels_too(two_link, level):
    laws = {"type": "joint_pid", "stiffness": [0.01], "damping": [0.01]}, {"type": "none"}
    settings = {"feedforward": "preview", "stability_margin": -1000.0}
    settings |= {"feedforward_modes": 3, "feedforward_level": level}
    made = design(two_link, *laws, {"type": "reference"}, settings)
    assert made.feedforward.model.n_modes == 6
    data = design_process.dumps(made, two_link.arm)
    travelled = design_process.loads(data, two_link)
    known = travelled.feedforward.model.arm
    assert known.foreshortening == (level != "file")
    assert known.finite_slope == (level == "finite_slope")
    np.testing.assert_array_equal(torques(travelled, 2, 4), torques(made, 2, 4))
    again = design_process.loads(data, two_link)
    assert again.feedforward.model is travelled.feedforward.model  # it takes a second to make


@dataclass
class Part:
    """Of a preparation."""

    left: tuple
    note: str = ""


def test_what_is_not_ready_when_the_motion_begins_is_left_out_and_named(arm_r):
    answers = [Part(("moving", "plan")), TimeoutError()]

    class Late(Designer):
        def _in_process(self, function, *arguments, waits=None):
            answer = answers.pop(0)
            if isinstance(answer, Exception):
                raise answer
            return answer

    late = Late(arm_r, pytest.fail, process=False)
    found = late.prepare(None, None, None, waits=lambda: False)
    assert not found.left
    assert found.note == "the motion begins before it is ready: moving, plan"
    answers[:] = [TimeoutError()]
    with pytest.raises(DesignError, match="begins before its regulators are ready"):
        late.prepare(None, None, None, waits=lambda: False)


def pid(model):
    return os.getpid()


def read(model, path):
    """The line that someone writes there; until then it takes."""
    with open(path) as pipe:
        return pipe.readline()


def scheduled(model):
    return os.sched_getscheduler(0), os.nice(0)


def test_it_leaves_the_cpus_of_the_control_path(monkeypatch):
    asked = []
    for name in ("sched_setaffinity", "sched_setscheduler", "nice"):

        def record(*values, name=name):
            asked.append((name, values[-1]))
            if name == "sched_setaffinity":
                raise OSError

        monkeypatch.setattr(os, name, record)
    processes.step_back(5)
    assert [name for name, _ in asked] == ["sched_setscheduler", "nice"]
    processes.step_back(5, {3})  # what the system refuses is left at that
    assert ("sched_setaffinity", {3}) in asked and asked[-1] == ("nice", 5)


def test_a_model_of_another_arm_is_not_sent(arm_r, arm_p3):
    with pytest.raises(pickle.PicklingError, match="another arm, P3"):
        design_process.dumps([arm_p3], arm_r.arm)


@pytest.mark.slow
def test_the_process_has_a_low_priority_designs_refuses_and_comes_again_when_it_has_died(
    arm_r, tmp_path
):
    worker, pipe = DesignProcess(arm_r, niceness=3), tmp_path / "pipe"
    os.mkfifo(pipe)
    held = os.fdopen(os.open(pipe, os.O_RDWR), "w", buffering=1)
    try:
        assert worker.call(scheduled) == (os.SCHED_BATCH, os.nice(0) + 3)
        slow, settings = {"type": "linear_model_following"}, {"feedforward": "model"}
        made = worker.call(design, slow, FAST, CORRECTED, settings)
        here = design(arm_r, slow, FAST, CORRECTED, settings)
        m = arm_r.n_modes
        np.testing.assert_allclose(torques(made, 1, m), torques(here, 1, m), rtol=1e-12)
        with pytest.raises(ParameterError, match=r"slow\.kp"):
            worker.call(design, slow | {"kp": [-1.0]}, FAST, CORRECTED, settings)
        (number,) = worker._pool._processes
        os.kill(number, signal.SIGKILL)
        with pytest.raises(AwayError, match="has died"):
            worker.call(design, slow, FAST, CORRECTED, settings)
        assert worker.call(design, slow, FAST).feedforward is None
        asked = []

        def waits():
            asked.append(1)
            assert len(asked) < 4, "it was asked and did not care"
            return len(asked) < 3

        with pytest.raises(TimeoutError, match="not wanted any more"):
            worker.call(read, pipe, waits=waits)
        assert len(asked) == 3
        held.write("now\n")
        # What no thread waits for is done before the next.
        assert worker.call(pid, waits=lambda: True) in worker._pool._processes
    finally:
        held.write("a failed test must not leave it reading\n")
        worker.close()
        held.close()


@pytest.mark.slow
def test_a_process_that_was_started_outlives_the_thread_that_designs(arm_r):
    designer = Designer(arm_r, lambda text: pytest.fail(text))
    try:
        designer.start()
        pids = []
        for _ in range(2):
            thread = Thread(target=lambda: pids.append(designer._process.call(pid)))
            thread.start()
            thread.join()
        assert pids[0] == pids[1] != os.getpid()
    finally:
        designer.close()


def test_a_law_of_many_links_travels(two_link):
    given = {"type": "model_following", "kp": [2.25], "kv": [3.0]}
    fast = {"type": "lqr", "alpha": 2.0, "q": [0.0] * 4 + [0.001] * 4, "configuration": [0.8, 0.8]}
    made = design(two_link, given, fast, CORRECTED | {"order": 1})
    travelled = design_process.loads(design_process.dumps(made, two_link.arm), two_link)
    np.testing.assert_array_equal(torques(travelled, 2, 4), torques(made, 2, 4))
