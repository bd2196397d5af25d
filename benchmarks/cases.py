# SPDX-License-Identifier: Apache-2.0
"""The reference cases, and arms made of their links."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model

from .peers import hubs

DATA = Path(__file__).resolve().parents[1] / "tests" / "data"
#: Cases of this folder, whose trajectories `truth` made.
OWN_DATA = Path(__file__).resolve().parent / "data"

#: Largest tip error with which a code takes part [m]. Models of first order have an error of 0.13 mm
#: and 23 um in the first two cases, and of 3.7 mm in the third one.
TARGETS = {
    "one_link_pulse": 5e-4,
    "two_link_torque_x0p1": 5e-5,
    "two_link_torque": 1e-4,
    "three_link_torque": 5e-5,
    "spatial_torque": 5e-5,
}

#: Cases beyond those of ``parameters.json``, of the same kind.
MORE = {
    "three_link_torque": {
        "L": 0.8, "rhoA": 0.2, "EI": 8.0, "Jh1": 0.05, "Jh2": 0.05, "Jh3": 0.03, "Mm": 0.4, "Mp": 0.15, "Jp": 0.0,
        "tau1": "1.0*sin(2*pi*0.5*t)", "tau2": "0.5*sin(2*pi*0.7*t)", "tau3": "0.2*sin(2*pi*0.9*t)",
    },
    "spatial_torque": {
        "L": 1.0, "rhoA": 0.3, "EI": 60.0, "GJ": 45.0, "polar": 5e-5, "Mh": 0.1, "Jh1": 0.05, "Jh2": 0.01, "Mm": 0.5,
        "Jm": 2e-3, "Mp": 0.3, "Jp": 1e-3, "tau1": "1.5*sin(2*pi*0.5*t)", "tau2": "0.5*sin(2*pi*0.7*t)",
    },
}  # fmt: skip

#: Duration of every case [s].
DURATION = 4.0


@cache
def parameters(case):
    """A case's entry of ``parameters.json``, or of `MORE`."""
    if case in MORE:
        return MORE[case]
    return json.loads((DATA / "parameters.json").read_text(encoding="utf-8"))[case]


@cache
def reference(case):
    """The reference trajectory, dict of str to ndarray."""
    folder = OWN_DATA if case in MORE else DATA
    table = np.genfromtxt(folder / f"{case}.csv", delimiter=",", names=True)
    return {name: table[name] for name in table.dtype.names}


def chain(p, links=None, modes=2, foreshortening=False):
    """The project's model of a case's arm, a `Chain`; `p` is the case's entry of ``parameters.json``.

    For another number of `links`, the last link is repeated or left out. `modes` is the number of modes of each link.
    """
    if "GJ" in p:
        return _tubes(p, modes, foreshortening)
    inertias = hubs(p)
    count = len(inertias) if links is None else links
    inertias = (inertias + inertias[-1:] * count)[:count]
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
                for i, hub in enumerate(inertias)
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


def _tubes(p, modes, foreshortening):
    """As `chain`, for the spatial arm."""
    bends = {"modes": modes, "shape": "loaded"}
    hubs_of = [p["Jh1"], p["Jh2"]]
    joints = [
        {"name": "yaw", "axis": [0, 0, 1]},
        {"name": "pitch", "axis": [0, 1, 0], "motor_mass": p["Mm"], "housing_inertia": p["Jm"]},
    ]
    links = [
        {
            "name": f"link{i + 1}",
            "length": p["L"],
            "mass_per_length": p["rhoA"],
            "polar_inertia_per_length": p["polar"],
            "EI_y": p["EI"],
            "EI_z": p["EI"],
            "GJ": p["GJ"],
            "bodies": [{"position": 0.0, "mass": p["Mh"], "inertia": inertia}],
            "flexible": {"y": bends, "z": bends, "twist": {"modes": 1, "shape": "loaded"}},
        }
        for i, inertia in enumerate(hubs_of)
    ]
    text = yaml.safe_dump(
        {
            "name": "tubes",
            "units": "si",
            "foreshortening": foreshortening,
            "joints": joints,
            "links": links,
            "payload": {"mass": p["Mp"], "inertia": p["Jp"]},
        }
    )
    return model.build(arm_file.parse(text))
