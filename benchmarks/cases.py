# SPDX-License-Identifier: Apache-2.0
"""The reference cases, and arms made of their links."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model

DATA = Path(__file__).resolve().parents[1] / "tests" / "data"

#: What the tip may be off by, for a code to take part [m]. Models of first order are off by 0.13 mm
#: and 23 um in the first two cases, by 3.7 mm in the last one.
TARGETS = {"one_link_pulse": 5e-4, "two_link_torque_x0p1": 5e-5, "two_link_torque": 1e-4}

#: Length of every case [s].
DURATION = 4.0


@cache
def parameters(case):
    """A case's entry of ``parameters.json``."""
    return json.loads((DATA / "parameters.json").read_text(encoding="utf-8"))[case]


@cache
def reference(case):
    """The reference trajectory, dict of str to ndarray."""
    table = np.genfromtxt(DATA / f"{case}.csv", delimiter=",", names=True)
    return {name: table[name] for name in table.dtype.names}


def chain(p, links=None, modes=2, foreshortening=False):
    """The project's model of a case's arm, a `Chain`; `p` is the case's entry of ``parameters.json``.

    With another number of `links` the last one is repeated, or left out; each has so many `modes`.
    """
    hubs = [p["Jh"]] if "Jh" in p else [p["Jh1"], p["Jh2"]]
    count = len(hubs) if links is None else links
    hubs = (hubs + hubs[-1:] * count)[:count]
    text = yaml.safe_dump(
        {
            "name": "benchmark",
            "units": "si",
            "foreshortening": foreshortening,
            "joints": [
                {
                    "name": f"joint{i + 1}",
                    "axis": [0, 0, 1],
                    "hub_inertia": hub,
                    "motor_mass": p["Mm"] if i else 0.0,
                }
                for i, hub in enumerate(hubs)
            ],
            "links": [
                {
                    "name": f"link{i + 1}",
                    "length": p["L"],
                    "mass_per_length": p["rhoA"],
                    "EI_y": p["EI"],
                    "flexible": {"y": {"modes": modes, "shape": "loaded"}},
                }
                for i in range(count)
            ],
            "payload": {"mass": p["Mp"], "inertia": [0, 0, p["Jp"], 0, 0, 0]},
        }
    )
    return model.build(arm_file.parse(text))
