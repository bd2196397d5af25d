# SPDX-License-Identifier: Apache-2.0
"""``flexarm observers``: shows the errors of each observer's rates, by noise, sample rate and delay.

The arm is simulated once per rate. A collocated PD law on the true state makes the joints follow steps of the
reference, which excite the modes. Every observer receives the same samples: joint positions and strains, with the given
noise and counts, and the torque, but no joint velocity. Errors are rms over the run after its first tenth, in percent
of the rms of the estimated state. With a delay, the estimate is compared with the state after the delay, once with
prediction and once without.
"""

from dataclasses import replace

import numpy as np

from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import OBSERVERS, observe
from flexarm_dynamics import registry
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_sim.plant import Plant
from flexarm_sim.sensors import Sensors

from .. import markdown
from ..progress import Progress
from .options import add_arm_arguments, in_range, numbers, show

#: Observers that receive the true rates have no error.
LEFT_OUT = ("true_rates",)
#: Steps of the reference: size [rad] and time between them [s].
STEP, EVERY = 0.2, 0.4
#: Frequency of the PD law as a fraction of the lowest bending frequency, its maximum [rad/s], and damping ratio.
FREQUENCY_RATIO, MAX_FREQUENCY, DAMPING = 0.4, 20.0, 0.5
#: Maximum fraction of a joint's speed that its damping removes in one period.
MAX_DAMPED = 0.3
MIN_SAMPLES, MAX_SAMPLES = 10, 1_000_000
COLUMNS = (
    "observer", "rate [Hz]", "noise", "delay [ms]", "predicted", "mode 1 [%]", "all modes [%]", "joints [%]"
)  # fmt: skip


def add_arguments(parser):
    """Arguments of ``observers``."""
    parser.description = (
        "Simulates an arm in motion, and compares the estimates of all observers from its samples."
    )
    parser.epilog = "example: flexarm observers R --rates 1000,250 --delays 0,0.01"
    add_arm_arguments(parser, "rows as JSON")
    parser.add_argument("--rates", default="1000,250", help="samples per second (1000,250)")
    parser.add_argument(
        "--strain-noise", type=float, default=5e-7, help="noise of every gauge, rms strain (5e-7)"
    )
    parser.add_argument("--counts", type=int, default=4096, help="encoder counts per turn (4096)")
    parser.add_argument("--delays", default="0,0.01", help="delays of the torque [s] (0,0.01)")
    parser.add_argument("--observers", help="names, separated by commas (all but true_rates)")
    parser.add_argument("--duration", type=float, default=2.0, help="simulated time [s] (2)")
    parser.add_argument("--seed", type=int, default=0, help="of reference and noise (0)")


def observers(options):
    """Print the table."""
    rows = table(
        options.arm,
        [in_range("--rates", v, 1.0, 20000.0) for v in numbers("--rates", options.rates)],
        {"none": (0.0, 0), "given": (options.strain_noise, options.counts)},
        [in_range("--delays", v, 0.0, 0.1) for v in numbers("--delays", options.delays)],
        options.observers.split(",") if options.observers else None,
        options.duration,
        options.seed,
        Progress(),
    )
    show(options, rows, markdown.table(COLUMNS, (row.values() for row in rows)), indent=1)


def table(arm, rates, noises, delays, names=None, duration=2.0, seed=0, progress=None):
    """Errors of the observers' rates: a list of rows, dicts with the keys `COLUMNS`.

    Parameters
    ----------
    arm : str
        Arm file: shipped name or path.
    rates, delays : sequence of float
        [Hz], [s]
    noises : mapping of str to (float, int)
        Strain noise [rms strain] and encoder counts [per turn; 0: not rounded], by a name for the table.
    names : sequence of str, optional
        Observers; all installed ones except `LEFT_OUT` if not given.
    duration : float
        [s]
    seed : int
    progress : Progress, optional
    """
    known = arm_file.load(arm)
    if names is None:
        names = [n for n in registry.names(OBSERVERS) if n not in LEFT_OUT]
    rows = []
    for rate in rates:
        in_range(
            f"samples of {duration:g} s at {rate:g} Hz", rate * duration, MIN_SAMPLES, MAX_SAMPLES
        )
        if progress is not None:
            progress.step(f"{known.name} at {rate:g} Hz")
        truth, torques = motion(model.build(known), rate, duration, seed)
        for label, (strain, counts) in noises.items():
            sensed = model.build(_with_noise(known, strain, counts))
            for i, name in enumerate(names):
                for delay, predicted in _cases(delays):
                    values = {"delay": delay if predicted else 0.0}
                    found = estimates(
                        sensed, observe(sensed, name, values), truth, torques, rate, seed
                    )
                    errors = _errors(found, truth, delay * rate, sensed)
                    head = (name, rate, label, 1e3 * delay, predicted)
                    rows.append(dict(zip(COLUMNS, (*head, *errors), strict=True)))
                if progress is not None:
                    done = list(noises).index(label) * len(names) + i + 1
                    progress.fraction(done / (len(noises) * len(names)))
    if progress is not None:
        progress.done()
    return rows


def _cases(delays):
    """Pairs of a delay and whether the observer predicts it; a delay of 0 is not predicted."""
    return [(d, p) for d in delays for p in ((False, True) if d else (False,))]


def motion(arm, rate, duration, seed=0):
    """States and torques of the arm, along steps of its reference.

    Returns
    -------
    states : ndarray, shape (k, N)
        (q, delta, qd, delta_d) at the samples.
    torques : ndarray, shape (k, n)
        Applied in the period that ends at the sample [N m].
    """
    n, m = arm.n_joints, arm.n_modes
    plant, random = Plant(arm, 1.0 / rate, "dop853"), np.random.default_rng(seed)
    lowest = arm.frequencies()[0] if m else MAX_FREQUENCY
    w = min(FREQUENCY_RATIO * lowest, MAX_FREQUENCY)
    terms = arm.terms(np.zeros(n), np.zeros(n))
    stiff = w**2 * np.diag(terms.M)[:n]
    # At first a joint turns only the small inertia that is rigidly connected to it: more damping, held over a period,
    # would be unstable.
    limit = MAX_DAMPED * rate / np.abs(terms.partition()[0]).sum(axis=1)
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


def estimates(arm, core, states, torques, rate, seed=0):
    """Estimates (q, delta, qd, delta_d), shape (k, N), that an observer makes of a motion.

    `arm` has the gauges and encoders, `core` is the `ArmObserver`, `states` and `torques` are those of `motion`.
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


def _errors(found, truth, late, arm):
    """Rms errors of the rates of the first mode, of all modes and of the joints, in percent of their own rms."""
    n, m = arm.n_joints, arm.n_modes
    times = np.arange(len(truth)) + late
    kept = (times <= len(truth) - 1) & (np.arange(len(truth)) >= len(truth) // 10)
    wanted = np.stack([np.interp(times[kept], np.arange(len(truth)), x) for x in truth.T], axis=1)
    wrong = np.square(found[kept] - wanted).mean(axis=0)
    size = np.square(wanted).mean(axis=0)
    joints, modes = slice(n + m, 2 * n + m), slice(2 * n + m, 2 * (n + m))
    first = slice(2 * n + m, 2 * n + m + 1)
    groups = (first, modes, joints) if m else (slice(0, 0), slice(0, 0), joints)
    return [_percent(wrong[g].sum(), size[g].sum()) for g in groups]


def _percent(wrong, size):
    return float(100.0 * np.sqrt(wrong / size)) if size > 0.0 else float("nan")
