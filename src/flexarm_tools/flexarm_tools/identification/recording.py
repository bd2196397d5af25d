# SPDX-License-Identifier: Apache-2.0
"""Reads a recorded motion: a bag or a CSV file."""

from pathlib import Path

from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.shown import listed
from flexarm_studies.identification.recording import from_tables, read_csv


def of_contents(contents, arm):
    """The `Recording` in a bag's `contents`.

    Raises
    ------
    FlexarmError
        When there are no usable states, or gauges of another arm.
    """
    unknown = contents.unknown.get("gauge_names")
    if unknown:
        limit = listed(arm.gauge_names)
        raise FlexarmError("are not this arm's", field="gauge_names", value=unknown, limit=limit)
    tables = contents.tables
    return from_tables(tables.get("arm_state"), tables.get("joint_torque"), arm)


def read(path, arm, namespace=""):
    """A `Recording` of a bag or a CSV file, by what `path` is.

    Parameters
    ----------
    path : str or Path
    arm : Arm
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
    if not path.is_dir() and path.suffix not in (".mcap", ".db3"):
        return read_csv(path, arm)
    from ..recording import bag

    (contents,) = bag.read(path, arm, namespace)
    return of_contents(contents, arm)
