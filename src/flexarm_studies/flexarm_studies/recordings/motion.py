# SPDX-License-Identifier: Apache-2.0
"""Makes the joint motion of a recording a smooth function of time, with consistent angle, speed and acceleration."""

import numpy as np

from flexarm_dynamics.errors import FlexarmError

from ..tables import Motion

#: Corner of the low pass of the measured angles [Hz]: joints hardly move faster, and encoders' steps are noise above.
CORNER = 20.0
#: A corner above this fraction of the rate does not smooth anything [-].
PASSES_ALL = 0.4


def motion_of(recording, corner=CORNER):
    """The measured joint motion, without phase: a low pass forwards and backwards, then a spline of degree five.

    Speed and acceleration are the spline's derivatives, so all three belong to one motion. Recorded speeds and
    accelerations are not used, because each of them is filtered in a different way.

    Parameters
    ----------
    recording : Recording
    corner : float
        Corner of the low pass, a Butterworth filter of order two that is passed twice [Hz].

    Returns
    -------
    Motion
        A function of the time as the recording counts it.

    Raises
    ------
    FlexarmError
        For a corner that is not above 0.
    """
    position = np.ascontiguousarray(low_passed(recording, corner))
    return Motion(recording.start + recording.time, position, "the recording")


def low_passed(recording, corner=CORNER):
    """The measured joint angles without the part above a `corner` [Hz], without phase, shape (s, n) [rad].

    The filter is a Butterworth filter of order two, passed forwards and backwards. `recording` is a `Recording`.

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
