# SPDX-License-Identifier: Apache-2.0
"""The joint motion of a recording as a smooth function of time: angle, speed and acceleration that belong together."""

import numpy as np

from flexarm_dynamics.errors import FlexarmError

from ..tables import Motion

#: Corner of the low pass of the measured angles [Hz]: joints hardly move faster, and encoders' steps are noise above.
CORNER = 20.0
#: A corner above this fraction of the rate smooths nothing [-].
PASSES_ALL = 0.4


def motion_of(recording, corner=CORNER):
    """The measured joint motion, without phase: a low pass forwards and backwards, then a spline of degree five.

    Speed and acceleration are the spline's derivatives, so that all three are of one motion; recorded speeds and
    accelerations, which are filtered each in its own way, are not used.

    Parameters
    ----------
    recording : Recording
    corner : float
        Of the low pass, a Butterworth filter of order two, passed twice [Hz].

    Returns
    -------
    Motion
        Of the time as the recording counts it.

    Raises
    ------
    FlexarmError
        For a corner that is not above 0.
    """
    position = np.ascontiguousarray(low_passed(recording, corner))
    return Motion(recording.start + recording.time, position, "the recording")


def low_passed(recording, corner=CORNER):
    """The measured joint angles without what is above a `corner` [Hz], without phase, shape (s, n) [rad].

    A Butterworth filter of order two, passed forwards and backwards. `recording` is a `Recording`.

    Raises
    ------
    FlexarmError
        For a corner that is not above 0.
    """
    from scipy.signal import butter, sosfiltfilt

    if not corner > 0.0:
        raise FlexarmError("is out of range", field="--smooth", value=corner, limit="above 0 Hz")
    position = recording.position
    if corner < PASSES_ALL / recording.period:
        passes = butter(2, corner, fs=1.0 / recording.period, output="sos")
        position = sosfiltfilt(passes, position, axis=0)
    return position
