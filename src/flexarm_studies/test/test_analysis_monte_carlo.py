# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo of ``flexarm analyze``: the same samples however they are computed, results kept, resumed, refused."""

import builtins
import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.analysis import monte_carlo as mc
from flexarm_studies.analysis import report
from flexarm_studies.loop.scenario import Scenario, parameters
from flexarm_studies.workers import through

SHORT = Scenario(
    "R", parameters("paper_composite"), trajectory="quintic:to=0.01,duration=0.1", window=0.05
)
COUNT = 4


@pytest.fixture(scope="module")
def spec():
    return mc.specification(SHORT, 7)


@pytest.fixture(scope="module")
def results(spec):
    """By one worker: this process."""
    return mc.run(spec, COUNT, workers=1)


def test_samples_differ_are_in_their_ranges_and_are_their_number_s_own(spec):
    drawn = [mc.draw(spec, n) for n in range(50)]
    for name, (low, high) in mc.RANGES.items():
        values = [d[name] for d in drawn]
        assert low <= min(values) < max(values) <= high
        assert len(set(values)) == 50
    assert mc.draw(spec, 3) == drawn[3]
    assert mc.draw(replace(spec, seed=8), 3) != drawn[3]


@pytest.mark.long
@pytest.mark.slow
def test_one_and_two_workers_and_threads_give_the_same(spec, results):
    assert mc.run(spec, COUNT, workers=2) == results
    with ThreadPoolExecutor(1) as executor:
        found = dict(through(executor, mc.sample, [(spec, 2), (spec, 1)]))
    assert [found[1], found[0]] == results[1:3]


def test_a_run_that_was_cut_off_goes_on_and_more_samples_may_follow(
    spec, results, tmp_path, monkeypatch
):
    path = tmp_path / mc.FILE
    assert mc.run(spec, 3, tmp_path, workers=1) == results[:3]
    whole = path.read_bytes()
    lines = whole.splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:2]) + lines[2][:20])
    ran, sample = [], mc.sample
    monkeypatch.setattr(mc, "sample", lambda s, n: (ran.append(n), sample(s, n))[1])
    assert mc.run(spec, 3, tmp_path, workers=1) == results[:3]
    assert ran == [1, 2]
    assert path.read_bytes() == whole
    ran.clear()
    assert mc.run(spec, COUNT, tmp_path, workers=1) == results
    assert ran == [3]


def test_results_that_are_there_survive_an_interruption(spec, results, tmp_path, monkeypatch):
    sample = mc.sample

    def interrupted(s, n):
        if n == 1:
            raise KeyboardInterrupt
        return sample(s, n)

    monkeypatch.setattr(mc, "sample", interrupted)
    with pytest.raises(KeyboardInterrupt):
        mc.run(spec, COUNT, tmp_path, workers=1)
    rows = [json.loads(line) for line in (tmp_path / mc.FILE).read_text().splitlines()]
    assert rows[1:] == results[:1]


@pytest.mark.parametrize(
    ("other", "problem"),
    [
        (lambda s: replace(s, seed=8), "seed differ"),
        (lambda s: replace(s, ranges=s.ranges | {"delay": [0.0, 0.1]}), "ranges differ"),
        (lambda s: replace(s, files={"R": "0"}), "files differ"),
    ],
)
def test_results_of_another_specification_are_not_mixed(spec, tmp_path, other, problem):
    mc.Store(tmp_path / mc.FILE, spec).close()
    with pytest.raises(FlexarmError, match=problem):
        mc.run(other(spec), 1, tmp_path)


@pytest.mark.parametrize("content", ["not ours\n", '{"a": 1}\n', "[1]\n", "no line at all"])
def test_a_file_that_is_none_of_ours_is_left_alone(spec, tmp_path, content):
    path = tmp_path / mc.FILE
    path.write_text(content)
    with pytest.raises(FlexarmError, match=mc.FILE):
        mc.run(spec, 1, tmp_path)
    assert path.read_text() == content


def test_a_refused_run_is_a_lost_one(spec):
    bad = replace(spec, scenario=spec.scenario | {"trajectory": "quintic:to=1e9"})
    found = mc.sample(bad, 0)["metrics"]
    assert found["lost"]
    assert found["reason"]


def test_summary_counts_and_orders(results):
    lost = {"sample": 4, "metrics": results[0]["metrics"] | {"lost": True, "reason": "gone"}}
    found = mc.summary([*results, lost])
    assert found["samples"] == 5
    assert found["lost"] == 1
    low, high = found["lost_share_95"]
    assert low < 0.2 < high
    assert (low, high) == pytest.approx((0.0362, 0.6245), abs=1e-4)  # Wilson, 1 of 5
    peak = found["quantiles"]["peak_joint_error_rad"]
    values = [r["metrics"]["peak_joint_error_rad"] for r in results]
    assert peak["0.5"] == pytest.approx(np.median(values))
    assert peak["max"] == max(values)
    text = "\n".join(report._monte_carlo(found | {"residual_window_s": [1.0, 3.0]}))
    assert "1 of 5 (95 % interval of the fraction 0.0362 to 0.624)" in text
    assert "residual: 1 to 3 s after the motion" in text


def test_numbers_of_samples_and_workers_are_checked(spec):
    for count, workers, field in ((0, None, "--monte-carlo"), (1, 0, "--workers")):
        with pytest.raises(FlexarmError) as refused:
            mc.run(spec, count, workers=workers)
        assert (refused.value.field, refused.value.value) == (field, 0)


def test_without_dask_the_error_tells_what_to_install(spec, monkeypatch):
    real = builtins.__import__

    def without(name, *rest):
        if name.split(".")[0] == "distributed":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(FlexarmError, match=r"--scheduler.*pip install distributed"):
        mc.run(spec, 1, scheduler="tcp://127.0.0.1:1")


@pytest.mark.long
def test_two_dask_worker_processes_give_the_same(spec, results):
    distributed = pytest.importorskip("distributed")
    own = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with distributed.LocalCluster(**own) as cluster:
        with distributed.Client(cluster) as client:
            pids = set(client.run(os.getpid).values())
        assert len(pids) == 2 and os.getpid() not in pids
        assert mc.run(spec, COUNT, scheduler=cluster.scheduler_address) == results
