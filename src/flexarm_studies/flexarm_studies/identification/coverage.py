# SPDX-License-Identifier: Apache-2.0
"""How often the intervals cover the truth, and how wide they are, for simulated arms drawn at random.

``python -m flexarm_studies.identification.coverage --arms 100`` draws arms around `nominal`, shakes and measures each
one with noise and encoder counts, identifies it from the nominal arm's file, and prints a table.
"""

import argparse
import json
import time
from dataclasses import replace

import numpy as np

from flexarm_control.motions.excitation_torque import ExcitationTorque
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Friction
from flexarm_dynamics.models import model
from flexarm_sim.plant import Plant
from flexarm_sim.sensors import Sensors

from .derived import derived
from .fit import identify
from .quantities import changed, quantities
from .recording import Recording

#: Largest relative deviation of each parameter from the nominal one [-].
SPREAD = 0.3
#: Rms noise of the gauges [strain], and counts of the encoder.
NOISE, COUNTS = 0.5e-6, 4096
#: The excitation: a sweep over both modes, then some seconds without torque.
SETTINGS = {"kind": "sweep", "amplitude": 6.0, "duration": 4.0, "rest": 2.0}
SETTINGS |= {"frequency_low": 0.3, "frequency_high": 20.0}


def nominal(counts=COUNTS, noise=NOISE):
    """The arm whose file is the start of the fit: one_link with friction, an encoder, and gauges with noise."""
    arm = arm_file.load("one_link")
    joint = replace(arm.joints[0], friction=Friction(0.2, 0.1, 0.01), encoder_counts=counts)
    payload = replace(
        arm.payload, inertia=tuple(tuple(10.0 * x for x in r) for r in arm.payload.inertia)
    )
    gauges = tuple(replace(g, noise=noise) for g in arm.gauges)
    # The closed form of this arm has the same equations and is faster.
    return replace(arm, joints=(joint,), gauges=gauges, payload=payload, model="one_link")


def drawn(arm, random, recording=None):
    """An arm with all parameters drawn within `SPREAD`, and biases within 50 microstrain."""
    found = quantities(arm, recording or _still(arm))
    values = [
        50e-6 * random.uniform(-1, 1)
        if q.kind == "bias"
        else q.get(arm) * random.uniform(1.0 - SPREAD, 1.0 + SPREAD)
        for q in found
    ]
    return changed(arm, found, values)


def _still(arm):
    n = len(arm.joints)
    return Recording(1e-3, np.zeros((3, n)), np.zeros((3, n)), np.zeros((3, len(arm.gauges))))


def measured(arm, settings=SETTINGS, rate=250.0, seed=0, drive=None):
    """A `Recording` of a simulated arm's encoder and gauges during an excitation with these `settings`.

    The excitation is planned for `drive`, an arm; for the arm itself if none is given.
    """
    built = model.build(arm)
    plant = Plant(built, 1.0 / rate)
    plant.reset(np.zeros(built.n_joints))
    sensors = Sensors(built, True, seed, 1.0 / rate)
    shake = ExcitationTorque(built if drive is None else model.build(drive), settings)
    samples = int(shake.duration * rate) + 1
    n, g = built.n_joints, len(arm.gauges)
    q, e, u = np.zeros((samples, n)), np.zeros((samples, g)), np.zeros((samples, n))
    for k in range(samples):
        if k:
            u[k] = shake.torque((k - 1) / rate)
            plant.advance(u[k])
        sensors.position(plant.q, q[k])
        sensors.strain(plant.delta, e[k])
    return Recording(1.0 / rate, q, u, e)


def run(arms, seed=0, rate=250.0, settings=SETTINGS, progress=None):
    """Identify this number of `arms`, excited with these `settings`; return a row per parameter and derived value.

    A row has the number of intervals that covered the truth, the relative widths, the errors in half-widths, and how
    often the parameter was left out.
    """
    given, table = nominal(), {}
    for k in range(arms):
        random = np.random.default_rng([seed, k])
        truth = drawn(given, random)
        recording = measured(truth, settings, rate, seed=int(random.integers(2**31)), drive=given)
        found = identify(given, recording)
        for name, value, width, true in _compared(found, truth):
            row = table.setdefault(name, {"covered": 0, "widths": [], "errors": [], "left_out": 0})
            if np.isnan(width):
                row["left_out"] += 1
                continue
            row["covered"] += bool(abs(value - true) <= width)
            row["widths"].append(width / abs(true))
            row["errors"].append((value - true) / width)
        if progress:
            progress(k + 1, table)
    return table


def _compared(found, truth):
    for quantity, value, width in zip(
        found.quantities, found.values, found.half_widths, strict=True
    ):
        yield quantity.name, value, width, quantity.get(truth)
    own = {d.name: d.value for d in derived(truth, found.initial[: len(truth.joints)])}
    for d in derived(found.arm, found.initial[: len(truth.joints)], found):
        yield d.name, d.value, d.half_width, own[d.name]


def text(table, arms):
    """Lines of the table."""
    yield f"{'parameter':44}{'covered':>9}{'left out':>10}{'median half-width [%]':>23}"
    for name, row in table.items():
        width = 100.0 * np.median(row["widths"]) if row["widths"] else float("nan")
        yield f"{name:44}{row['covered']:>9}{row['left_out']:>10}{width:23.3g}"
    yield f"{arms} arms"


def main(argv=None):
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arms", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate", type=float, default=250.0, help="samples per second [Hz]")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(argv)
    begin = time.perf_counter()
    table = run(options.arms, options.seed, options.rate)
    if options.json:
        print(json.dumps(table))
    else:
        print("\n".join(text(table, options.arms)))
        print(f"{(time.perf_counter() - begin) / options.arms:.2f} s for each")


if __name__ == "__main__":
    main()
