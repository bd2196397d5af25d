# SPDX-License-Identifier: Apache-2.0
"""Reads a recorded motion: a bag or a CSV file."""

from pathlib import Path
from types import SimpleNamespace

from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.shown import listed
from flexarm_studies.identification.recording import from_tables, read_csv
from flexarm_studies.recordings import mapping as mappings


def of_contents(contents, arm=None):
    """The `Recording` in a bag's `contents`; without an `arm`, with the names that the bag has.

    Raises
    ------
    FlexarmError
        When there are no usable states, or gauges of another arm.
    """
    unknown = contents.unknown.get("gauge_names")
    if unknown and arm is not None:
        limit = listed(arm.gauge_names)
        raise FlexarmError("are not this arm's", field="gauge_names", value=unknown, limit=limit)
    tables = contents.tables
    if arm is None:
        arm = SimpleNamespace(**contents.names)
    return from_tables(tables.get("arm_state"), tables.get("joint_torque"), arm)


def read(path, arm=None, namespace="", mapping=None):
    """A `Recording` of a bag or a CSV file, by what `path` is.

    Parameters
    ----------
    path : str or Path
    arm : Arm, optional
        Whose names and order are wanted; those of the recording if not given.
    namespace : str
        Of the topics in a bag.
    mapping : str or Path, optional
        What the columns of a CSV file are: a shipped name or a path, see `recordings.mapping`.

    Raises
    ------
    FlexarmError
        For a file that can't be read, and for a bag without `arm_state`.
    """
    path = Path(path)
    if not path.exists():
        raise FlexarmError("no such file or bag", field=str(path))
    if not is_bag(path):
        return read_csv(path, arm, mappings.load(mapping) if mapping else None)
    if mapping:
        problem, hint = "is of no use for a bag", "its messages have names and units"
        raise FlexarmError(problem, field="--mapping", value=str(mapping), hint=hint)
    from ..recording import bag

    (contents,) = bag.read(path, arm, namespace)
    return of_contents(contents, arm)


def is_bag(path):
    """Whether a path is a bag, and not a CSV file."""
    return Path(path).is_dir() or Path(path).suffix in (".mcap", ".db3")


def add_mapping(parser):
    """The option ``--mapping`` of commands that read recordings."""
    parser.add_argument(
        "--mapping",
        metavar="M",
        help="what the columns of a CSV file are: a mapping file, by path or shipped name (tudor); not given: "
        "the names in its first line (t, <joint>_position, <gauge>_strain, …)",
    )
