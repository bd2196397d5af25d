# SPDX-License-Identifier: Apache-2.0
"""Reads a recorded motion: a bag or a CSV file."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.shown import listed
from flexarm_studies.identification.recording import from_tables, read_csv


def of_contents(contents, arm=None):
    """The `Recording` in a bag's `contents`; without an `arm`, it has the names in the bag.

    Raises
    ------
    FlexarmError
        If there are no usable states, or gauges of another arm.
    """
    unknown = contents.unknown.get("gauge_names")
    if unknown and arm is not None:
        limit = listed(arm.gauge_names)
        raise FlexarmError("are not this arm's", field="gauge_names", value=unknown, limit=limit)
    tables = contents.tables
    if arm is None:
        arm = SimpleNamespace(**contents.names)
    return from_tables(tables.get("arm_state"), tables.get("joint_torque"), arm)


def read(path, arm=None, mapping=None, namespace=""):
    """Read a `Recording` from a bag or a CSV file, whichever `path` is.

    Parameters
    ----------
    path : str or Path
    arm : Arm, optional
        Gives the names and their order; if not given, those of the recording are used.
    mapping : Mapping, optional
        What the columns of a CSV file are, see `recordings.mapping`.
    namespace : str
        Of the topics in a bag.

    Raises
    ------
    FlexarmError
        For a file that can't be read, and for a bag without `arm_state`.
    """
    path = Path(path)
    if not path.exists():
        raise FlexarmError("no such file or bag", field=str(path))
    if not is_bag(path):
        return read_csv(path, arm, mapping)
    if mapping is not None:
        problem, hint = "is of no use for a bag", "its messages have names and units"
        raise FlexarmError(problem, field="--mapping", hint=hint)
    from ..recording import bag

    (contents,) = bag.read(path, arm, namespace)
    return of_contents(contents, arm)


def to_contents(recording, path, arm=None):
    """The `Contents` that a bag with the samples of a `recording` would have; `path` is where it came from."""
    from ..recording import bag

    columns = {
        "joint_position": recording.position,
        "joint_velocity": recording.velocity,
        "joint_torque": recording.torque,
        "strain": recording.strain,
        "modal_amplitude": recording.amplitude,
    }
    columns = {name: v for name, v in columns.items() if v is not None and v.shape[1]}
    known = {name for name, values in columns.items() if np.isfinite(values).any()}
    count = len(recording.position)
    stamp = np.rint(1e9 * (recording.start + recording.time)).astype(np.int64)
    session, none = np.zeros(count, np.int64), np.full(count, -1, np.int32)
    state = bag.Table(stamp, session, np.arange(count), columns, known, none)
    names = {
        f"{kind}_names": getattr(recording, f"{kind}_names") for kind in ("joint", "gauge", "mode")
    }
    return bag.Contents(path, "", arm, names, {"arm_state": state}, [], list(recording.notes))


def is_bag(path):
    """Whether a path is a bag, and not a CSV file."""
    return Path(path).is_dir() or Path(path).suffix in (".mcap", ".db3")
