# SPDX-License-Identifier: Apache-2.0
"""``flexarm observers``: how well each observer tells the rates of an arm, by noise, rate and delay. No ROS.

The arm is simulated once per rate, its joints led by a collocated PD law on the true state through steps of the
reference, which shake the modes. Every observer hears the same samples: joint positions and strains, with the
noise and counts that are asked for, and the torque, but no joint velocity. Errors are rms over the run after its
first tenth, in percent of what is estimated, itself rms, over the same time. With a delay the estimate is compared
with the state so much later, predicted and not predicted.
"""

import json
from dataclasses import replace

import numpy as np

from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import OBSERVERS, observe
from flexarm_dynamics import registry
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model
from flexarm_sim.plant import Plant
from flexarm_sim.sensors import Sensors

from ..progress import Progress

#: Observers that hear the truth have no error to show.
LEFT_OUT = ("true_rates",)
#: Steps of the reference: size [rad] and time between them [s].
STEP, EVERY = 0.2, 0.4
#: Frequency of the PD law in parts of the lowest bending frequency, at most so much [rad/s]; damping ratio.
SHARE, FASTEST, DAMPING = 0.4, 20.0, 0.5
#: Largest share of a joint's speed that its damping takes in one period.
HELD = 0.3
MOST_SAMPLES = 1_000_000
COLUMNS = (
    "observer", "rate [Hz]", "noise", "delay [ms]", "predicted", "mode 1 [%]", "all modes [%]", "joints [%]"
)  # fmt: skip


def add_arguments(parser):
    """Arguments of ``observers``."""
    parser.description = (
        "Simulates an arm that is shaken, and compares what each observer makes of its samples."
    )
    parser.epilog = "example: flexarm observers R --rates 1000,250 --delays 0,0.01"
    parser.add_argument("arm", metavar="ARM", help="arm file: a shipped name or a path")
    parser.add_argument("--rates", default="1000,250", help="samples per second (1000,250)")
    parser.add_argument(
        "--strain-noise", type=float, default=5e-7, help="noise of every gauge, rms strain (5e-7)"
    )
    parser.add_argument("--counts", type=int, default=4096, help="encoder counts per turn (4096)")
    parser.add_argument("--delays", default="0,0.01", help="delays of the torque [s] (0,0.01)")
    parser.add_argument("--observers", help="names, separated by commas (all but true_rates)")
    parser.add_argument("--duration", type=float, default=2.0, help="simulated time [s] (2)")
    parser.add_argument("--seed", type=int, default=0, help="of reference and noise (0)")
    parser.add_argument("--json", action="store_true", help="rows as JSON")


def observers(options):
    """Print the table."""
    rows = table(
        options.arm,
        _numbers("--rates", options.rates, 1.0, 20000.0),
        {"none": (0.0, 0), "given": (options.strain_noise, options.counts)},
        _numbers("--delays", options.delays, 0.0, 0.1),
        options.observers.split(",") if options.observers else None,
        options.duration,
        options.seed,
        Progress(),
    )
    if options.json:
        print(json.dumps(rows, indent=1))
        return
    print("| " + " | ".join(COLUMNS) + " |")
    print("|" + " --- |" * len(COLUMNS))
    for row in rows:
        print("| " + " | ".join(_word(row[c]) for c in COLUMNS) + " |")


def table(arm, rates, noises, delays, names=None, duration=2.0, seed=0, progress=None):
    """Errors of the observers' rates.

    Parameters
    ----------
    arm : str
        Arm file: shipped name or path.
    rates : sequence of float
        [Hz]
    noises : mapping of str to (float, int)
        Strain noise [rms strain] and encoder counts [per turn; 0: not rounded], by a name for the table.
    delays : sequence of float
        [s]
    names : sequence of str, optional
        Observers; all that are installed but `LEFT_OUT`.
    duration : float
        [s]
    seed : int
    progress : Progress, optional

    Returns
    -------
    list of dict
        A row each, keys `COLUMNS`.

    Raises
    ------
    FlexarmError
    """
    known = arm_file.load(arm)
    if names is None:
        names = [n for n in registry.names(OBSERVERS) if n not in LEFT_OUT]
    rows = []
    for rate in rates:
        if not 10.0 <= rate * duration <= MOST_SAMPLES:
            raise FlexarmError(
                f"{rate:g} Hz for {duration:g} s: from 10 to {MOST_SAMPLES} samples are possible"
            )
        if progress is not None:
            progress.step(f"{known.name} at {rate:g} Hz")
        truth, torques = motion(model.build(known), rate, duration, seed)
        for label, (strain, counts) in noises.items():
            sensed = model.build(_with_noise(known, strain, counts))
            for i, name in enumerate(names):
                for delay, predicted in _cases(delays):
                    values = {"delay": delay if predicted else 0.0}
                    heard = listen(
                        sensed, observe(sensed, name, values), truth, torques, rate, seed
                    )
                    errors = _errors(heard, truth, delay * rate, sensed)
                    head = (name, rate, label, 1e3 * delay, predicted)
                    rows.append(dict(zip(COLUMNS, (*head, *errors), strict=True)))
                if progress is not None:
                    done = list(noises).index(label) * len(names) + i + 1
                    progress.fraction(done / (len(noises) * len(names)))
    if progress is not None:
        progress.done()
    return rows


def _cases(delays):
    """(delay, whether it is predicted across); both where there is one."""
    return [(d, p) for d in delays for p in ((False, True) if d else (False,))]


def motion(arm, rate, duration, seed=0):
    """States and torques of the arm, led through steps.

    Returns
    -------
    states : ndarray, shape (k, N)
        (q, delta, qd, delta_d) at the samples.
    torques : ndarray, shape (k, n)
        Applied in the period that ends at the sample [N m].
    """
    n, m = arm.n_joints, arm.n_modes
    plant, random = Plant(arm, 1.0 / rate, "dop853"), np.random.default_rng(seed)
    lowest = arm.frequencies()[0] if m else FASTEST
    w = min(SHARE * lowest, FASTEST)
    terms = arm.terms(np.zeros(n), np.zeros(n))
    stiff = w**2 * np.diag(terms.M)[:n]
    # At once a joint turns the little that is rigid at it: held over a period, more damping would be unstable.
    limit = HELD * rate / np.abs(terms.partition()[0]).sum(axis=1)
    damp = np.minimum(2.0 * DAMPING / w * stiff, limit)
    torque, reference, states, torques = np.zeros(n), np.zeros(n), [], []
    every = max(1, round(EVERY * rate))
    for k in range(int(duration * rate)):
        states.append(plant.state.copy())
        torques.append(torque)
        if k % every == 0:
            reference = STEP * random.uniform(-1.0, 1.0, n)
        q, qd = plant.state[:n], plant.state[n + m : 2 * n + m]
        weight = arm.terms(q, np.zeros(n)).f1
        torque = weight + stiff * (reference - q) - damp * qd
        plant.advance(torque)
    return np.array(states), np.array(torques)


def _with_noise(arm, strain, counts):
    gauges = tuple(replace(g, noise=strain) for g in arm.gauges)
    joints = tuple(replace(j, encoder_counts=counts) for j in arm.joints)
    return replace(arm, gauges=gauges, joints=joints)


def listen(arm, core, states, torques, rate, seed=0):
    """What an observer makes of the samples of a motion.

    Parameters
    ----------
    arm : ArmModel
        Whose gauges and encoders measure.
    core : ArmObserver
    states, torques : ndarray
        Of `motion`.
    rate : float
        [Hz]
    seed : int
        Of the noise.

    Returns
    -------
    ndarray, shape (k, N)
        (q, delta, qd, delta_d) as passed on.
    """
    n, m, period = arm.n_joints, arm.n_modes, round(1e9 / rate)
    sensors, sample = Sensors(arm, True, seed), ArmSample(n, m, len(arm.arm.gauges))
    strain, out = np.zeros(len(arm.arm.gauges)), []
    for k, (state, torque) in enumerate(zip(states, torques, strict=True)):
        sample.stamp_ns, sample.session, sample.sequence = 10**9 + k * period, 1, k
        sensors.position(state[:n], sample.position)
        sensors.strain(state[n : n + m], strain)
        sample.strain, sample.amplitude = (
            (strain, None) if strain.size else (None, state[n : n + m])
        )
        sample.torque[:], sample.velocity_known = torque, False
        core.step(sample)
        out.append(np.concatenate([core.position, core.amplitude, core.velocity, core.rate]))
    return np.array(out)


def _errors(heard, truth, late, arm):
    """Rms errors of the first mode's rate, of all modes' and of the joints', in percent of their own rms."""
    n, m = arm.n_joints, arm.n_modes
    times = np.arange(len(truth)) + late
    kept = (times <= len(truth) - 1) & (np.arange(len(truth)) >= len(truth) // 10)
    wanted = np.stack([np.interp(times[kept], np.arange(len(truth)), x) for x in truth.T], axis=1)
    wrong = np.square(heard[kept] - wanted).mean(axis=0)
    size = np.square(wanted).mean(axis=0)
    joints, modes = slice(n + m, 2 * n + m), slice(2 * n + m, 2 * (n + m))
    first = slice(2 * n + m, 2 * n + m + 1)
    groups = (first, modes, joints) if m else (slice(0, 0), slice(0, 0), joints)
    return [_percent(wrong[g].sum(), size[g].sum()) for g in groups]


def _percent(wrong, size):
    return float(100.0 * np.sqrt(wrong / size)) if size > 0.0 else float("nan")


def _word(value):
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _numbers(option, text, low, high):
    """Numbers from an option's list."""
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        raise FlexarmError(f"{option} {text}: numbers separated by commas are wanted") from None
    for value in values:
        if not low <= value <= high:
            raise FlexarmError(f"{option} {value:g}: from {low:g} to {high:g} are possible")
    return values
