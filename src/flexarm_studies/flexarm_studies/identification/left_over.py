# SPDX-License-Identifier: Apache-2.0
"""What could still be explained of the strains that a model leaves: by the joints' motion, by currents, by gauges.

``python -m flexarm_studies.identification.left_over exp1.csv tudor --mapping tudor --gauge eps31 --fit 14:60 --score
60:80 --band 8:21`` fits what belongs to the recording, while the arm's parameters are held. It regresses the residual
of a gauge, in a band of frequencies, on sets of signals at many lags (`ridge`). This linear model is as large as the
fitted part allows. If even this explains nothing, then no linear model of that input can explain the residual, nor can
a model that is linear for each side of the gears' play.
"""

import argparse
import sys

import numpy as np
from scipy.signal import butter, sosfiltfilt

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError

from ..commands.options import span
from ..recordings import mapping as mappings
from ..recordings.motion import CORNER
from . import recording as recordings
from . import ridge, scores
from .prescribed import MotionPredictor
from .strain_fit import Options
from .strain_study import Study, study

#: The arm's parameters, as patterns of `Options.hold`.
HOLD = ("joints*", "links*", "payload*", "gauges*gain", "gauges*position", "* offset")
#: Length of past and future that the regressions use [s]; for the other gauges, both have the third length [s].
PAST, FUTURE, NEAR = 0.6, 0.2, 0.1


def signals(run, predicted, motion, gauge):
    """Sets of signals: a dict of name to columns (s, c), seconds of the future and seconds of the past.

    Parameters
    ----------
    run : Recording
    predicted : ndarray, shape (s, g)
        Strains of the model [-].
    motion : tuple of ndarray, shape (s, n)
        Position, velocity, acceleration of the joints.
    gauge : int
        Index of the explained gauge.
    """
    static, rigid = scores.regressors(*motion)
    inertial = rigid[:, static.shape[1] :]
    side = np.tanh(predicted / np.maximum(predicted.std(axis=0), 1e-300))
    of_side = [s[:, None] * motion[2] for s in side.T]
    sets = {
        "joint accelerations, past": (motion[2], 0.0, PAST),
        "all terms of the joints' motion, past and to come": (inertial, FUTURE, PAST),
        "the same, and accelerations by the side of the play": (
            np.hstack([inertial, *of_side, side]), FUTURE, PAST,
        ),
    }  # fmt: skip
    if run.current is not None:
        sets["motor currents, past"] = (run.current, 0.0, FUTURE)
    others = np.delete(scores.filled(run.strain), gauge, axis=1)
    return sets | {"the other gauges": (others, NEAR, NEAR)}


def explained(columns, error, period, fitted, scored, band, lags):
    """How much a set of signals explains of the residuals in a band.

    Parameters
    ----------
    columns : ndarray, shape (s, c)
    error : ndarray, shape (s,)
        Measured minus predicted strain [-].
    period : float
        [s]
    fitted, scored : slice
        Samples.
    band : tuple of float
        [Hz]
    lags : tuple of float
        Seconds of the future, and seconds of the past.

    Returns
    -------
    blocks, later : float
        Explained fraction of the sum of squares in blocks of the fitted part to which the regression was not fitted,
        and in the scored part [-].
    coefficients : int
    """
    passes = butter(scores.ORDER, band, "bandpass", fs=1.0 / period, output="sos")
    fast = sosfiltfilt(passes, np.column_stack([columns, error]), axis=0)
    columns, error = fast[:, :-1], fast[:, -1:]
    columns = columns / np.maximum(columns[fitted].std(axis=0), 1e-300)
    X = ridge.lagged(columns, -round(lags[0] / period), round(lags[1] / period))
    found, left = ridge.chosen(X[fitted], error[fitted], np.ones(1))
    rest = error[scored, 0] - X[scored] @ found
    return 1.0 - left, 1.0 - float(np.sum(rest**2) / np.sum(error[scored] ** 2)), X.shape[1]


def spread(error, period, band):
    """Fractions of the variance of residuals (s,) below, in and above a band [Hz]."""
    power = np.abs(np.fft.rfft(error - error.mean())) ** 2
    frequency = np.fft.rfftfreq(len(error), period)
    below, above = frequency < band[0], frequency > band[1]
    return tuple(float(power[k].sum() / power.sum()) for k in (below, ~(below | above), above))


def lines(arm, whole, gauge, fit, score, band):
    """Lines of the table, as Markdown; see `main` for the arguments."""
    if gauge not in arm.gauge_names:
        raise FlexarmError(
            "is no gauge of this arm", field="--gauge", value=gauge, limit=", ".join(arm.gauge_names)
        )  # fmt: skip
    place = arm.gauge_names.index(gauge)
    _, _, (run, predicted) = study(arm, whole, Study(fit, score), Options(hold=HOLD, starts=1))
    rows = [round((t - run.start) / run.period) for t in (*fit, *score)]
    fitted, scored = slice(max(rows[0], 0), rows[1]), slice(rows[2], rows[3])
    error = scores.filled(run.strain - predicted)[:, place]
    predictor = MotionPredictor(arm, run, CORNER)
    motion = predictor.position, predictor.velocity, predictor.acceleration
    yield (
        f"| what is left of {gauge} from {band[0]:g} to {band[1]:g} Hz is explained by | coefficients |"
        " in blocks not fitted [%] | in the scored part [%] |"
    )
    yield "| --- | --- | --- | --- |"
    for name, (columns, ahead, past) in signals(run, predicted, motion, place).items():
        blocks, later, size = explained(
            columns, error, run.period, fitted, scored, band, (ahead, past)
        )
        yield f"| {name} | {size} | {100.0 * blocks:.1f} | {100.0 * later:.1f} |"
    below, inside, above = spread(error[scored], run.period, band)
    left = np.var(error[scored]) / np.nanvar(run.strain[scored, place])
    yield (
        f"\nOf the residual's variance in the scored part {100.0 * below:.0f} % lie below the band,"
        f" {100.0 * inside:.0f} % in it, {100.0 * above:.0f} % above. The model explains {100.0 * (1.0 - left):.2f} %;"
        f" without errors below the band it would explain {100.0 * (1.0 - left * (1.0 - below)):.2f} %."
    )


def main(words=None):
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording")
    parser.add_argument("arm")
    mappings.add_option(parser)
    parser.add_argument("--gauge", required=True)
    for option in ("--fit", "--score"):
        parser.add_argument(option, required=True, metavar="FROM:TO", help="[s]")
    parser.add_argument("--band", required=True, metavar="FROM:TO", help="[Hz]")
    options = parser.parse_args(words)
    try:
        arm = arm_file.load(options.arm)
        whole = recordings.read_csv(options.recording, arm, mappings.of_options(options))
        spans = [span(getattr(options, k), f"--{k}") for k in ("fit", "score", "band")]
        for line in lines(arm, whole, options.gauge, *spans):
            print(line, flush=True)
    except FlexarmError as error:
        sys.exit(f"left_over: {error}")


if __name__ == "__main__":
    main()
