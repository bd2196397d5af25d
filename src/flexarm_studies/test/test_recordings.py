# SPDX-License-Identifier: Apache-2.0
"""Recordings in CSV files: mapping files, cells, and what is refused with row, column and value."""

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.identification import recording
from flexarm_studies.recordings import mapping as mappings
from flexarm_studies.tables import TableError

COLUMNS = [
    {"column": 1, "quantity": "time", "unit": "ms"},
    {"column": 3, "quantity": "position", "joint": "joint1", "unit": "deg", "sign": -1},
    {"column": 2, "quantity": "strain", "gauge": "root", "unit": "microstrain"},
    {"column": 4, "quantity": "current", "joint": "joint1", "unit": "mA", "factor": 2.0},
]


def mapped(columns=None, **more):
    return mappings.parse(yaml.safe_dump({"columns": columns or COLUMNS, **more}), "m.yaml")


def rows(count=30):
    k = np.arange(count)
    return np.column_stack([10.0 * k, 100.0 + k, 90.0 - k, 500.0 - k])


def written(path, table, header="", delimiter=","):
    np.savetxt(path, table, "%.17g", delimiter, header=header, comments="")
    return path


def test_columns_by_number_become_si_with_unit_factor_and_sign(tmp_path):
    held = [{"joint": "base", "position": 180.0, "unit": "deg"}]
    found = recording.read_csv(written(tmp_path / "a.csv", rows()), None, mapped(held=held))
    k = np.arange(30)
    assert found.period == pytest.approx(0.01) and found.held == ("base",)
    assert (found.joint_names, found.gauge_names) == (("joint1", "base"), ("root",))
    np.testing.assert_allclose(found.position[:, 0], -np.radians(90.0 - k), atol=1e-12)
    np.testing.assert_allclose(found.position[:, 1], np.pi)
    np.testing.assert_allclose(found.strain[:, 0], 1e-6 * (100.0 + k))
    np.testing.assert_allclose(found.current[:, 0], 2e-3 * (500.0 - k))
    assert np.isnan(found.torque).all() and found.velocity is None
    with pytest.raises(FlexarmError, match="joint_torque: is unknown"):
        found.need_torque()


@pytest.mark.parametrize("delimiter", [";", "\t", " ", ","])
def test_delimiters_headers_and_comments_are_found(tmp_path, delimiter):
    path = written(tmp_path / "a.csv", rows(), delimiter.join("abcd"), delimiter)
    path.write_text("# measured on a Monday\n" + path.read_text())
    named = [c | {"column": "abcd"[c["column"] - 1]} for c in COLUMNS]
    by_name = recording.read_csv(path, None, mapped(named))
    by_number = recording.read_csv(path, None, mapped())
    np.testing.assert_array_equal(by_name.position, by_number.position)
    assert len(by_name.position) == 30


def test_a_decimal_comma_and_a_rate_in_place_of_times(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("".join(f"{k},5;2,25\n" for k in range(25)))
    columns = [
        {"column": 1, "quantity": "position", "joint": "j", "unit": "mrad"},
        {"column": 2, "quantity": "torque", "joint": "j", "unit": "N m"},
    ]
    found = recording.read_csv(path, None, mapped(columns, rate=200.0, decimal=","))
    np.testing.assert_allclose(found.position[:, 0], 1e-3 * (np.arange(25) + 0.5))
    np.testing.assert_allclose(found.torque, 2.25)
    assert found.period == pytest.approx(0.005)


def test_without_a_mapping_the_first_line_names_the_columns(tmp_path):
    path = written(
        tmp_path / "a.csv", rows() * [0.001, 1, 1, 1], "t,root_strain,a_position,a_velocity"
    )
    found = recording.read_csv(path)
    assert (found.joint_names, found.gauge_names) == (("a",), ("root",))
    np.testing.assert_array_equal(found.velocity[:, 0], 500.0 - np.arange(30))


def test_a_part_is_cut_out_by_the_times_of_the_source(tmp_path):
    table = rows(200)
    table[:, 0] += 14_000.0
    whole = recording.read_csv(written(tmp_path / "a.csv", table), None, mapped())
    part = whole.between(14.5, 15.0)
    assert (part.start, len(part.position)) == (pytest.approx(14.5), 51)
    np.testing.assert_array_equal(part.current, whole.current[50:101])
    with pytest.raises(FlexarmError, match=r"part 20:30 of the recording.*it is from 14 to 16 s"):
        whole.between(20.0, 30.0)


def test_gaps_are_left_out_and_noted(tmp_path):
    table = np.delete(rows(200), slice(40, 70), axis=0)
    found = recording.read_csv(written(tmp_path / "a.csv", table), None, mapped())
    assert len(found.position) == 130 and found.start == pytest.approx(0.7)
    assert found.stamps.size == 170 and "40 of 170 samples left out" in found.notes[0]


REFUSED_CELLS = {
    (5, 2, "x"): r"a\.csv:6: column 3, position of joint1: 'x' is not a number; correct it",
    (
        5,
        2,
        "",
    ): r"a\.csv:6: column 3, position of joint1: nan is not finite; correct it, or leave the row",
    (7, 1, "inf"): r"a\.csv:8: column 2, strain of root: inf is not finite",
    (9, 0, "20"): r"a\.csv:10: time \[s\]: 0\.02 comes after 0\.08; times must ascend",
    (9, 3, None): r"a\.csv:10: column 4, current of joint1: is missing; the row has 3 cells",
}


@pytest.mark.parametrize("cell", REFUSED_CELLS)
def test_a_cell_that_is_no_value_is_named_by_row_and_column(tmp_path, cell):
    table = [[f"{x:g}" for x in row] for row in rows()]
    row, column, text = cell
    if text is None:
        del table[row][column:]
    else:
        table[row][column] = text
    path = tmp_path / "a.csv"
    path.write_text("\n".join(map(",".join, table)))
    with pytest.raises(TableError, match=REFUSED_CELLS[cell]):
        recording.read_csv(path, None, mapped())


def test_a_gauge_may_miss_values(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("\n".join(f"{10 * k},,{k},1" for k in range(25)))
    assert np.isnan(recording.read_csv(path, None, mapped()).strain).all()


REFUSED_MAPPINGS = {
    "columns: [{column: 1, quantity: speed}]": r"m\.yaml: columns\[0\]\.quantity: 'speed' is not one of",
    "columns: [{column: 0, quantity: time, unit: s}]": r"columns\[0\]\.column: 0 is out of range",
    "columns: [{column: 1, quantity: time, unit: h}]": r"columns\[0\]\.unit: 'h' is not one of .* \(s, ms",
    "columns: [{column: 1, quantity: time, unit: s, sign: 2}]": r"\.sign: 2\.0 is no sign \(1 or -1\)",
    "columns: [{column: 1, quantity: strain, unit: strain}]": r"columns\[0\]\.gauge: missing",
    "columns: [{column: 1, quantity: position, joint: a, unit: rad}]": r"rate: missing; give the rows per second",
    "rate: 1.0\ncolumns: [{column: 1, quantity: time, unit: s}]": "rate: is given beside a column of time",
    "rate: 1.0\ncolumns: [{column: 1, quantity: torque, joint: a, unit: N m}]": "position of a is missing",
    "rate: 1.0\ncolumns: []\nheld: [{joint: a}]": r"held\[0\]\.position: missing",
    "rate: 1.0\ncolumns: []\ndelimeter: comma": "delimeter: no such field .*did you mean 'delimiter'",
    "columns: {": "m.yaml line 1: not YAML",
}  # fmt: skip


@pytest.mark.parametrize("text", REFUSED_MAPPINGS)
def test_a_mapping_that_says_nothing_clear_is_refused(text):
    with pytest.raises(TableError, match=REFUSED_MAPPINGS[text]):
        mappings.parse(text, "m.yaml")


def test_columns_and_names_that_are_not_there_are_refused(tmp_path):
    path = written(tmp_path / "a.csv", rows())
    beyond = [COLUMNS[0], COLUMNS[1] | {"column": 9}]
    with pytest.raises(
        TableError, match=r"column of position of joint1: 9 is no column .* \(it has 4\)"
    ):
        recording.read_csv(path, None, mapped(beyond))
    named = [COLUMNS[0], COLUMNS[1] | {"column": "angle"}]
    with pytest.raises(TableError, match=r"'angle' is not in the first line \(it has no names\)"):
        recording.read_csv(path, None, mapped(named))
    other = [*COLUMNS[:2], COLUMNS[2] | {"gauge": "other"}]
    with pytest.raises(TableError, match="gauge: 'other' is no gauge of"):
        recording.read_csv(path, arm_file.load("one_link"), mapped(other))
    with pytest.raises(TableError, match="position of joint2: is not in the mapping"):
        recording.read_csv(path, arm_file.load("two_link"), mapped(COLUMNS[:2]))
    with pytest.raises(
        TableError, match=r"'none' is neither a file nor a shipped mapping \(tudor\)"
    ):
        mappings.load("none")


def test_a_joint_that_stands_still_need_not_be_in_the_arm(tmp_path):
    held = [{"joint": "base", "position": 0.0}]
    path, arm = written(tmp_path / "a.csv", rows()), arm_file.load("one_link")
    found = recording.read_csv(path, arm, mapped(COLUMNS[:2], held=held))
    assert found.joint_names == arm.joint_names and found.position.shape == (30, 1)


CELL = st.one_of(
    st.floats(allow_nan=True).map(repr), st.sampled_from(["", "nan", "1e5", "-0", "x", '"', "1,5", "٣"]),
    st.text(max_size=6),
)  # fmt: skip


@settings(max_examples=150, deadline=None)
@given(st.lists(st.lists(CELL, max_size=6), max_size=40), st.sampled_from([",", ";", "\t", " "]))
def test_whatever_is_in_the_file_it_is_read_or_refused(tmp_path_factory, table, delimiter):
    path = tmp_path_factory.mktemp("any") / "a.csv"
    path.write_text("\n".join(map(delimiter.join, table)), encoding="utf-8", errors="replace")
    for mapping in (None, mapped()):
        try:
            found = recording.read_csv(path, None, mapping)
        except FlexarmError as error:
            assert str(error)
        else:
            assert np.isfinite(found.position).all() and not np.isinf(found.strain).any()


NUMBER = st.floats(-1e6, 1e6)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(NUMBER, NUMBER, NUMBER), min_size=20, max_size=40), st.booleans())
def test_what_was_written_is_read_again(tmp_path_factory, values, comma):
    path = tmp_path_factory.mktemp("again") / "a.csv"
    delimiter, decimal = (";", ",") if comma else (",", ".")
    lines = [[repr(10.0 * k), *map(repr, row)] for k, row in enumerate(values)]
    path.write_text(
        "\n".join(delimiter.join(w.replace(".", decimal) for w in row) for row in lines)
    )
    columns = [c | {"unit": u} for c, u in zip(COLUMNS, ("ms", "rad", "strain", "A"), strict=True)]
    found = recording.read_csv(path, None, mapped(columns, decimal=decimal))
    table = np.array(values)
    np.testing.assert_array_equal(found.strain[:, 0], table[:, 0])
    np.testing.assert_array_equal(found.position[:, 0], -table[:, 1])
    np.testing.assert_array_equal(found.current[:, 0], 2.0 * table[:, 2])


def test_the_real_arms_file_is_read_with_the_shipped_mapping(real_arm):
    found = recording.read_csv(real_arm / "exp1.csv", None, mappings.load("tudor"))
    assert found.joint_names == ("shoulder", "elbow", "base") and found.held == ("base",)
    assert found.gauge_names == ("eps21", "eps22", "eps31", "eps32")
    assert len(found.position) == 8000 and found.period == pytest.approx(0.01)
    np.testing.assert_allclose(found.position[0], [2.4958, -1.1345, 0.0])
    np.testing.assert_allclose(found.strain[0, :2], [-269.25e-6, -113.2e-6])
