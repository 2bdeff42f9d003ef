"""Rows of tables and arrays in mapped files."""

import numpy as np
import pyarrow as pa
import pytest

from tcpipe.formats.parquet import map_table, move_rows_to_file, take_rows, write_pieces


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Return a table of five pieces, one of them empty."""
    path = tmp_path_factory.mktemp("mapped") / "rows.arrow"
    names = [f"segment {number}" for number in range(60)]
    whole = pa.table({"name": names, "value": pa.array([None, *range(59)], pa.int64())})
    write_pieces(
        path, whole.schema, [whole.slice(first, count) for first, count in ((0, 7), (7, 0), (7, 30), (37, 23))]
    )
    return map_table(path)


@pytest.mark.parametrize("count", [0, 1, 200])
def test_rows_of_several_pieces_come_in_the_order_that_was_asked_for(table, count):
    rows = np.random.default_rng(count).integers(0, table.num_rows, count)
    assert take_rows(table, rows).equals(table.take(pa.array(rows)))
    assert take_rows(table.slice(0, 0), rows[:0]).equals(table.slice(0, 0))


def test_rows_of_an_array_are_moved_into_a_file(tmp_path):
    array = np.arange(24.0).reshape(6, 2, 2)
    moved = move_rows_to_file(array, np.array([4, 1, 1]), tmp_path)
    np.testing.assert_array_equal(moved, array[[4, 1, 1]])
    assert move_rows_to_file(array, np.empty(0, np.int64), tmp_path).shape == (0, 2, 2)
