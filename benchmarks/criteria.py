# SPDX-License-Identifier: Apache-2.0
"""What the figures have to be."""

import numpy as np

from .compare import OWN
from .timing import paired


def _fastest_peer(result):
    """Ratio of the fastest peer's time to this project's, and its name; None if no peer was timed."""
    codes = result["codes"]
    timed = [
        (c["ratio"], name) for name, c in codes.items() if c["kind"] == "peer" and "ratio" in c
    ]
    return min(timed, default=(None, "no peer"))


def check(summary):
    """Criteria with their measured values, for a `summary` as `__main__` writes it.

    Each has ``text``, ``value``, ``limit``, ``least`` (True: the value must not be below the limit; False: not above
    it) and ``met``, which is None if two cores were not available for a throughput measurement.
    """
    found = []

    def criterion(text, value, limit, least, none_is=False):
        met = none_is
        if value is not None:
            met = bool(value >= limit if least else value <= limit)
        found.append({"text": text, "value": value, "limit": limit, "least": least, "met": met})

    for case, result in summary["cases"].items():
        error = result["codes"][OWN]["tip_error"]
        criterion(f"{case}: tip error [um]", 1e6 * error, 1e6 * result["target"], False)
    for links, case, times_faster in (
        ("one link", "one_link_pulse", 5.0),
        ("two links", "two_link_torque_x0p1", 3.0),
        ("two links that stiffen", "two_link_torque", 10.0),
        ("three links that stiffen", "three_link_torque", 10.0),
        ("two tubes in space that stiffen", "spatial_torque", 5.0),
    ):
        ratio, name = _fastest_peer(summary["cases"][case])
        criterion(f"{links}: times faster than {name}", ratio, times_faster, True)
    for name, hand in (("one link", 2.0), ("two links", 1.5), ("one link that stiffens", 1.5)):
        worst = max(entry["ratio"] for entry in summary["same_step"][name])
        criterion(f"{name}: time over hand-written loops, same step", worst, hand, False)
    turns = {e["links"]: np.array(e["turns"]["loops"]) for e in summary["stiffening"]}
    most = max(turns)
    text = f"{most} links that stiffen over 1, general code"
    criterion(text, paired(turns[most], turns[1]), 1.5 * most, False)
    general = {entry["links"]: entry["loops"] for entry in summary["links"]}
    most = max(general)
    criterion(f"{most} links over 1, general code", general[most] / general[1], 1.5 * most, False)
    two = [entry for entry in summary["throughput"]["cores"] if entry["cores"] == 2]
    text, least = "2 cores over 1, batch throughput", 1.6
    if two and two[0]["available"] < least:
        text += f" ({two[0]['available']:.2f} cores were to be had)"
        two = []
    criterion(text, two[0]["speedup"] if two else None, least, True, none_is=None)
    return found
