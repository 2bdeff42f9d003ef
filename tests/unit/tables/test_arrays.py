"""Arrow columns and numpy arrays against pyarrow's own conversions."""

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from tcpipe.tables.columns import (
    make_lines,
    make_points,
    make_text_column,
    number_column,
    select_rows,
    to_numbers,
    to_texts,
)

KINDS = ("int8", "uint8", "int16", "uint32", "int64", "uint64", "float32", "float64", "bool")


@given(st.sampled_from(KINDS), st.lists(st.integers(0, 100)), st.integers(0, 3))
def test_numbers_there_and_back(kind, values, first):
    array = np.array(values).astype(kind)
    column = number_column(array)
    assert column.equals(pa.array(array))
    found = to_numbers(column.slice(min(first, len(array))))
    assert found.dtype == array.dtype
    np.testing.assert_array_equal(found, array[first:])
    np.testing.assert_array_equal(to_numbers(pa.chunked_array([column, column])), np.tile(array, 2))


@pytest.mark.parametrize("kind", [pa.float32(), pa.float64(), pa.int16(), pa.bool_()])
@pytest.mark.parametrize("rows", [slice(0, None), slice(2, 5), slice(9, None)])
def test_null_is_nan(kind, rows):
    column = pa.array([None, 1, 0, None, 1, None, None, 1, 1, None, 0], pa.int8()).cast(kind)[rows]
    found = to_numbers(column)
    assert found.dtype == (np.float32 if kind == pa.float32() else np.float64)
    np.testing.assert_array_equal(found, [np.nan if value is None else float(value) for value in column.to_pylist()])


def test_nan_is_null_where_asked():
    values = np.array([np.nan, 1.0, np.nan, 2.0] * 5, ">f4")
    assert number_column(values, nan_is_null=True).equals(pa.array(values.astype("f4"), from_pandas=True))
    assert number_column(values).null_count == 0


@given(st.lists(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"))), st.integers(0, 3))
def test_texts_there_and_back(values, first):
    column = make_text_column(values)
    column.validate(full=True)
    assert column.equals(pa.array(values, pa.string()))
    assert to_texts(column.slice(min(first, len(values)))).tolist() == values[first:]
    assert to_texts(pa.chunked_array([column, column])).tolist() == values * 2


def test_rows_where():
    table = pa.table({"clock_epoch": [0, 1, 0], "rail": ["a", "b", "b"]})
    assert select_rows(table, "clock_epoch", 0).to_pylist() == [table.to_pylist()[row] for row in (0, 2)]
    assert select_rows(table, "rail", "b").to_pylist() == [table.to_pylist()[row] for row in (1, 2)]
    assert select_rows(table, "rail", "c").num_rows == 0


def test_pandas_stays_where_it_is():
    pytest.importorskip("pandas")
    program = """
import sys
import numpy as np, pyarrow as pa
from tcpipe.tables.columns import *
column = number_column(np.array([1.0, np.nan]), nan_is_null=True)
table = pa.Table.from_arrays([column, make_text_column(["a", "b"])], names=["x", "y"])
to_numbers(table["x"]), to_texts(table["y"]), select_rows(table, "y", "b")
assert "pandas" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


NAN = float("nan")


def test_shapely_reads_lines_and_points_to_the_last_bit():
    start, end = np.array([[15.43, 47.07], [-0.1, -33.3]]), np.array([[15.4300131, 47.07], [1 / 3, -33.30001]])
    lines = make_lines(start, end)
    assert lines.type == pa.binary()
    for row, line in enumerate(shapely.from_wkb(lines.to_pylist())):
        assert line.geom_type == "LineString"
        assert list(line.coords) == [tuple(start[row]), tuple(end[row])]
    points = shapely.from_wkb(make_points(start).to_pylist())
    assert [(point.x, point.y) for point in points] == [tuple(row) for row in start]


def test_what_is_not_known_is_null_and_moves_no_other_row():
    known, nowhere = [1.0, 2.0], [NAN, NAN]
    lines = make_lines(np.array([nowhere, known, known]), np.array([known, [3.0, 4.0], [NAN, 4.0]]))
    lines.validate(full=True)
    assert [row is None for row in lines.to_pylist()] == [True, False, True]
    assert shapely.from_wkb(lines[1].as_py()).wkt == "LINESTRING (1 2, 3 4)"
    points = make_points(np.array([known, nowhere]))
    points.validate(full=True)
    assert (shapely.from_wkb(points[0].as_py()).wkt, points[1].as_py()) == ("POINT (1 2)", None)
    for empty in (make_lines(np.empty((0, 2)), np.empty((0, 2))), make_points(np.empty((0, 2)))):
        assert len(empty) == 0


def test_a_line_over_the_date_line_does_not_go_round_the_earth():
    (line,) = shapely.from_wkb(make_lines(np.array([[179.99999, -16.8]]), np.array([[-179.99999, -16.8]])).to_pylist())
    assert line.length < 1e-4
