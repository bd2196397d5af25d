# SPDX-License-Identifier: Apache-2.0
"""Records the states of a running arm, and the torques that answer them."""

from flexarm_dynamics.errors import FlexarmError

#: Timeout for the first state, and for the torques that answer the last one [s].
PATIENCE = 10.0
#: Longest recording [s].
MAX_SECONDS = 3600.0
#: What a user can do if no state arrives.
START_DRIVER = "start the driver (or simulator)"


def record(arm, seconds, namespace=""):
    """Make a `Recording` of a running arm over `seconds`, by the stamps.

    Raises
    ------
    FlexarmError
        If no states arrive, or if they stop.
    """
    from flexarm_ros.session import Session

    from ..recording import bag
    from ..recording.recorder import Recorder, raw_stamp_ns
    from .recording import of_contents

    if not 0.0 < seconds < MAX_SECONDS:
        raise FlexarmError(
            "is out of range", field="--live", value=seconds, limit=f"0 to {MAX_SECONDS:g} s"
        )
    with Session("identify", namespace=namespace) as session:
        recorder = Recorder(session, ("arm_state", "joint_torque"))
        states = recorder.raw["arm_state"]
        session.wait_for("arm_state", lambda: states, PATIENCE, START_DRIVER)
        end = raw_stamp_ns(states[0]) + 1e9 * seconds
        session.wait_for(
            f"{seconds:g} s of arm_state",
            lambda: raw_stamp_ns(states[-1]) >= end,
            PATIENCE + 5.0 * seconds,
        )
    return of_contents(bag.from_messages(recorder.raw, arm), arm)
