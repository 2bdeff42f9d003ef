"""Geometry columns, read by shapely."""

import numpy as np
import pyarrow as pa
import shapely

from tcpipe.tables.arrays import make_lines, make_points

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
