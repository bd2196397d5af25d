# SPDX-License-Identifier: Apache-2.0
"""Determines what the columns of a CSV file are, from a mapping file or from the names in the file's first line.

A mapping file (YAML; ``config/recordings/tudor.yaml`` is a commented one)::

    columns:
    - {column: 1, quantity: time, unit: s}
    - {column: 2, quantity: position, joint: shoulder, unit: deg, sign: -1}
    - {column: strain_a, quantity: strain, gauge: eps1, unit: microstrain}
    held:
    - {joint: base, position: 0.0, unit: rad}

A column is given by its number, from 1, or by its name in the first line; columns that are not listed are ignored. A
value in SI is the cell times the unit, times ``factor`` and ``sign`` (1 where not given). ``rate`` [Hz] replaces a
column of time. ``delimiter``, ``decimal`` and ``header`` are needed only if the file does not make them clear.

Without a mapping file the first line has the names: ``t``, ``<joint>_position``, ``<gauge>_strain`` and so on, in SI.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from flexarm_dynamics.arm.arm_file import arms_directories
from flexarm_dynamics.arm.entries import Section, read_yaml
from flexarm_dynamics.errors import ArmFileError

from ..tables import TableError

ANGLE = {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180.0, "turn": 2.0 * np.pi}
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
#: Quantity to the kind of thing it belongs to, and its units, each with the factor to SI.
QUANTITIES = {
    "time": ("", TIME),
    "position": ("joint", ANGLE),
    "velocity": ("joint", {f"{u}/s": f for u, f in ANGLE.items()} | {"rpm": np.pi / 30.0}),
    "acceleration": ("joint", {f"{u}/s^2": f for u, f in ANGLE.items()}),
    "torque": ("joint", {"N m": 1.0, "mN m": 1e-3}),
    "current": ("joint", {"A": 1.0, "mA": 1e-3}),
    "linear_acceleration": ("imu", {"m/s^2": 1.0, "g": 9.80665}),
    "angular_velocity": ("imu", {f"{u}/s": f for u, f in ANGLE.items()} | {"rpm": np.pi / 30.0}),
    "strain": ("gauge", {"strain": 1.0, "millistrain": 1e-3, "microstrain": 1e-6}),
    "amplitude": ("mode", {"m": 1.0, "mm": 1e-3, "um": 1e-6, "rad": 1.0, "mrad": 1e-3}),
}
#: Kinds of things to which a quantity may belong.
KINDS = ("joint", "gauge", "mode", "imu")
DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}


@dataclass(frozen=True)
class Column:
    """One column of a file.

    Attributes
    ----------
    at : int or str
        Its number, from 1, or its name in the first line.
    quantity : str
        One of `QUANTITIES`.
    of : str
        Joint, gauge, mode, or axis of an IMU; empty for the time.
    factor : float
        Factor from the cell to SI, including the sign.
    """

    at: int | str
    quantity: str
    of: str = ""
    factor: float = 1.0

    @property
    def name(self):
        """Its name in messages."""
        return f"{self.quantity} of {self.of}" if self.of else self.quantity


@dataclass(frozen=True)
class Mapping:
    """What the columns of a file are.

    Attributes
    ----------
    columns : tuple of Column
    held : dict
        Joint that is not recorded, because it stands still, to its angle [rad].
    rate : float or None
        Rows per second if no column is the time [Hz].
    header : bool or None
        Whether the first line has names; None: it has names if a cell of it is not a number.
    delimiter : str or None
        Between cells; None: found in the first line.
    decimal : str
        ``.`` or ``,`` within numbers.
    """

    columns: tuple
    held: dict = field(default_factory=dict)
    rate: float | None = None
    header: bool | None = None
    delimiter: str | None = None
    decimal: str = "."

    def names(self, kind):
        """Names of all things of a `kind` (of `KINDS`), in the file's order, held joints last."""
        found = [c.of for c in self.columns if QUANTITIES[c.quantity][0] == kind]
        return tuple(dict.fromkeys([*found, *(self.held if kind == "joint" else ())]))


def directory():
    """Folder of the shipped mapping files."""
    return arms_directories()[0].parent / "recordings"


def load(name):
    """Read a mapping file, by its path or shipped `name`.

    Raises
    ------
    TableError
        Naming the file, the entry by its path, the value and what is wanted.
    """
    path = next(
        (p for p in (Path(name).expanduser(), directory() / f"{name}.yaml") if p.is_file()), None
    )
    if path is None:
        shipped = ", ".join(sorted(p.stem for p in directory().glob("*.yaml")))
        problem = "is neither a file nor a shipped mapping"
        raise TableError(problem, field="--mapping", value=str(name), limit=shipped)
    try:
        return parse(path.read_text(encoding="utf-8"), path.name)
    except (OSError, UnicodeDecodeError) as error:
        raise TableError(f"can't be read: {error}", field=str(path)) from None


def parse(text, where="mapping"):
    """A `Mapping` from the text of a file that messages call `where`; errors as in `load`."""
    try:
        return _mapping(Section(read_yaml(text, where), "", "si"))
    except ArmFileError as error:
        again = TableError(error.problem, value=error.value, limit=error.limit, hint=error.hint)
        again.field = error.field if error.field.startswith(where) else f"{where}: {error.field}"
        raise again from None


def _mapping(top):
    columns, given = [], set()
    for entry in top.sections("columns", required=True):
        column = _column(entry)
        if (column.quantity, column.of) in given:
            raise entry.error("quantity", f"{column.name} has a column already")
        given.add((column.quantity, column.of))
        columns.append(column)
    held = dict(_held(entry, given) for entry in top.sections("held"))
    rate = top.number("rate", positive=True) if top.has("rate") else None
    if rate is not None and ("time", "") in given:
        raise top.error("rate", "is given beside a column of time", hint="leave one of them out")
    if rate is None and ("time", "") not in given:
        hint = "give the rows per second [Hz], or a column whose quantity is time"
        raise top.error("rate", "missing", hint=hint)
    mapping = Mapping(
        tuple(columns),
        held,
        rate,
        top.flag("header") if top.has("header") else None,
        DELIMITERS[top.text("delimiter", choices=DELIMITERS)] if top.has("delimiter") else None,
        top.text("decimal", ".", (".", ",")),
    )
    top.done()
    for name in mapping.names("joint"):
        if ("position", name) not in given and name not in held:
            hint = "give its column, or its angle under held if the joint stands still"
            raise top.error("columns", f"position of {name} is missing", hint=hint)
    return mapping


def _column(entry):
    at = entry.raw("column", required=True)
    if isinstance(at, bool) or not isinstance(at, (int, str)) or at == "":
        raise entry.error("column", "is neither a number, from 1, nor a name", value=at)
    if isinstance(at, int):
        entry.integer("column", low=1, high=100_000)
    quantity = entry.text("quantity", choices=QUANTITIES)
    kind, units = QUANTITIES[quantity]
    factor = units[entry.text("unit", choices=units)]
    factor *= entry.number("factor", default=1.0) * _sign(entry)
    if factor == 0.0:
        raise entry.error("factor", "makes every value zero", value=0.0)
    of = _named(entry, kind) if kind else ""
    entry.done()
    return Column(at, quantity, of, factor)


def _held(entry, given):
    joint = _named(entry, "joint")
    angle = ANGLE[entry.text("unit", "rad", ANGLE)] * entry.number("position")
    if ("position", joint) in given:
        raise entry.error(
            "joint", f"{joint} has a column of positions", hint="leave one of them out"
        )
    entry.done()
    return joint, angle


def _named(entry, kind):
    name = entry.text(kind)
    if not name.strip():
        raise entry.error(kind, "empty", hint=f"write the {kind}'s name in the arm file")
    return name


def _sign(entry):
    sign = entry.number("sign", default=1.0)
    if sign not in (1.0, -1.0):
        raise entry.error("sign", "is no sign", value=sign, limit="1 or -1")
    return sign


def _parts(title):
    """Name and quantity of a column, from its title; both are empty if the quantity is unknown."""
    for quantity in sorted(QUANTITIES, key=len, reverse=True):
        if title.endswith(f"_{quantity}"):
            return title[: -len(quantity) - 1], quantity
    return "", ""


def names_in(arm, kind):
    """Names of all things of a `kind` in an arm; None without an `arm`, and for kinds that arm files do not have."""
    return getattr(arm, f"{kind}_names", None)


def by_names(header, arm=None):
    """The `Mapping` of a file whose first line has names, see the module.

    Parameters
    ----------
    header : sequence of str
    arm : Arm, optional
        Only its joints, gauges and modes are wanted; others are ignored.
    """
    wanted = {kind: names_in(arm, kind) for kind in KINDS}
    columns = [Column("t", "time")]
    for title in header:
        of, quantity = _parts(title)
        kind = QUANTITIES.get(quantity, ("",))[0]
        if of and kind and (wanted[kind] is None or of in wanted[kind]):
            columns.append(Column(title, quantity, of))
    return Mapping(tuple(dict.fromkeys(columns)), header=True)


def add_option(parser):
    """Give a command's `parser` the option ``--mapping``."""
    parser.add_argument(
        "--mapping",
        metavar="M",
        help="what the columns of a CSV file are: a mapping file, by path or shipped name (tudor); not given: "
        "the names in its first line (t, <joint>_position, <gauge>_strain, ...)",
    )


def of_options(options):
    """The `Mapping` of ``--mapping``; None without this option."""
    return None if options.mapping is None else load(options.mapping)
