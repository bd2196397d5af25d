# SPDX-License-Identifier: Apache-2.0
"""Percentiles by nearest rank, of the newest values; gaps in uint32 numbers."""

import math
import tracemalloc

import numpy as np
import pytest

from flexarm_ros.statistics import Gaps, Latency, Percentiles


@pytest.mark.parametrize("count", [1, 2, 7, 99, 100, 101, 256])
def test_percentiles_are_the_nearest_rank_of_numpys(count):
    values = np.random.default_rng(count).lognormal(size=count)
    window = Percentiles(256)
    for value in values:
        window.add(value)
    expected = np.percentile(values, [50, 99, 100], method="inverted_cdf")
    assert window.take(50, 99) == tuple(expected)


def test_only_the_newest_values_count_but_the_largest_of_all():
    window = Percentiles(10)
    for value in [1000.0, *([5.0] * 20), *range(1, 11)]:
        window.add(value)
    assert window.count == 31
    assert window.take(10, 50, 100) == (1.0, 5.0, 10.0, 1000.0)


def test_taking_begins_anew_and_nothing_is_nan():
    window = Percentiles(8)
    assert all(map(math.isnan, window.take(50)))
    window.add(3.0)
    window.add(math.nan)
    assert window.take(50) == (3.0, 3.0)
    assert all(map(math.isnan, window.take(50, 99)))
    window.add(-2.0)
    assert window.take(50) == (-2.0, -2.0)


def test_adding_keeps_no_memory():
    window, gaps = Percentiles(64), Gaps()

    def feed(start):
        for i in range(start, start + 1000):
            window.add(0.5)
            gaps.add(7, i)

    feed(0)
    tracemalloc.start()
    feed(1000)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 2000  # a thousand values would be 8000 bytes


def test_latency_is_text_in_milliseconds():
    latency = Latency("latency")
    for time in (0.001, 0.002, 0.0255):
        latency.add(time)
    assert latency.values() == {
        "latency p50 [ms]": "2.000",
        "latency p99 [ms]": "25.500",
        "latency max [ms]": "25.500",
    }
    assert set(latency.values().values()) == {"-"}


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ([5, 6, 7], 0),
        ([0, 3], 2),
        ([0, 3, 3, 3, 4], 2),
        ([0, 3, 1, 2, 4], 2),  # late ones were counted as lost, and stay so
        ([2**32 - 2, 2**32 - 1, 0, 1], 0),
        ([2**32 - 2, 2], 3),
        ([7, 2**31, 2**31 + 2, 8, 10], 2),  # another count
    ],
)
def test_gaps_in_the_numbers_are_lost_samples(numbers, lost):
    gaps = Gaps()
    for number in numbers:
        gaps.add(1, number)
    assert gaps.lost == lost


def test_a_new_session_is_no_gap_and_a_second_asks_only_for_its_own():
    gaps = Gaps()
    gaps.add(1, 0)
    gaps.add(1, 5)
    gaps.add(2, 900)
    gaps.add(2, 902)
    assert (gaps.take(), gaps.take(), gaps.lost) == (5, 0, 5)
    gaps.add(2, 904)
    assert (gaps.take(), gaps.lost) == (1, 6)
