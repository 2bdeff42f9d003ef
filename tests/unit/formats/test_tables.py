"""Tables as loggers write them: separators, headers, stamps as text, rows that are short, long or broken."""

from datetime import UTC, datetime

import numpy as np
import polars as pl
import pytest

from tcpipe.errors import LogError
from tcpipe.formats.logs.table_log import read_cells, read_table_header
from tcpipe.formats.logs.table_stamps import read_clock


def ns(*time):
    return round(datetime(*time, tzinfo=UTC).timestamp()) * 1_000_000_000


@pytest.mark.parametrize(
    ("text", "names", "stamps", "values"),
    [
        ("t,a\n1,2.5\n2,3\n", ["t", "a"], [1, 2], [2.5, 3.0]),
        ("t;a\n1,5;2,25\n2,5;3\n", ["t", "a"], [1.5, 2.5], [2.25, 3.0]),  # decimal comma
        ("t\ta\r\n1\t2\r\n2\t\r\n", ["t", "a"], [1, 2], [2.0, np.nan]),
        ("1,2\n2,3\n", ["column_1", "column_2"], [1, 2], [2.0, 3.0]),
        ("# t  a\n 1   2\n2  3  \n", ["t", "a"], [1, 2], [2.0, 3.0]),
        ("t,a,b\n1,2\n2,3,4,5\n3\n", ["t", "a", "b"], [1, 2, 3], [2.0, 3.0, np.nan]),  # rows short and long
    ],
)
def test_a_table_is_told_by_its_first_lines(tmp_path, text, names, stamps, values):
    path = tmp_path / "table.csv"
    path.write_text(text)
    assert read_table_header(path) == names
    found = read_cells(path, stamps=[names[0]], columns=[names[1]])
    assert found.stamps[names[0]].to_list() == stamps
    np.testing.assert_array_equal(found.columns[names[1]], values)
    assert found.texts == {}
    assert read_clock(found.stamps[names[0]]).kind == "counter"


def test_a_tum_trajectory_and_a_solution_of_rtklib(tmp_path):
    tum, pos = tmp_path / "gt.txt", tmp_path / "ppk.pos"
    tum.write_text("1760456485.7 1 2 3 0 0 0 1\n1760456485.8 4 5 6 0 0 0 1\n")
    assert read_table_header(tum) == ["timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw"]
    pos.write_text(
        "% program   : RTKLIB\n%\n%  GPST                 latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)\n"
        "2025/10/14 15:41:25.700   47.1234567890  -71.1   643.6   1  12   0.0100\n"
    )
    assert read_table_header(pos)[:2] == ["GPST", "latitude(deg)"]
    found = read_cells(pos, stamps=["GPST"], columns=["latitude(deg)", "sdn(m)"])
    clock = read_clock(found.stamps["GPST"])
    assert (clock.kind, clock.ns.to_list()) == ("utc", [ns(2025, 10, 14, 15, 41, 25) - 17_300_000_000])
    assert [values.tolist() for values in found.columns.values()] == [[47.123456789], [0.01]]


@pytest.mark.parametrize(
    "text",
    ["2025-10-14 15:41:25.5", "2025-10-14T15:41:25.5", "2025-10-14T15:41:25.5Z", "2025-10-14T17:41:25.500+02:00"],
)
def test_stamps_in_words_are_local_times_unless_they_state_a_zone(tmp_path, text):
    path = tmp_path / "table.csv"
    path.write_text(f"time,a\n{text},1\n{text},2\nnever,3\n")
    clock = read_clock(read_cells(path, stamps=["time"], columns=["a"]).stamps["time"])
    assert clock.kind == ("utc" if text.endswith(("Z", "+02:00")) else "local")
    assert clock.ns.head(2).to_list() == [ns(2025, 10, 14, 15, 41, 25) + 500_000_000] * 2
    assert clock.ns.is_null().to_list() == [False, False, True]


def test_text_among_numbers_is_counted_and_an_open_quote_costs_its_line(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text('t,a\n1,2\n2,fast\n3,\n4,slow\n5,6\n"6,7\n')
    found = read_cells(path, stamps=["t"], columns=["a"])
    np.testing.assert_array_equal(found.columns["a"][:5], [2.0, np.nan, np.nan, np.nan, 6.0])
    assert found.texts == {"a": (2, 2, "fast")}
    assert read_clock(found.stamps["t"]).ns.is_null().to_list() == [False] * 5 + [True]


def test_parquet_with_times_and_text(tmp_path):
    path = tmp_path / "table.parquet"
    times = pl.Series([datetime(2025, 10, 14, tzinfo=UTC)] * 2)
    pl.DataFrame({"time": times, "a": [1, 2], "b": ["3.5", "x"]}).write_parquet(path)
    found = read_cells(path, stamps=["time"], columns=["a", "b"])
    clock = read_clock(found.stamps["time"])
    assert (clock.kind, clock.ns.to_list()) == ("utc", [ns(2025, 10, 14)] * 2)
    assert found.columns["a"].tolist() == [1.0, 2.0]
    assert found.columns["b"][0] == 3.5
    assert found.texts == {"b": (1, 2, "x")}


@pytest.mark.parametrize(
    ("name", "content"), [("a.csv", b""), ("a.parquet", b"no parquet"), ("a.txt", b"# only words\n")]
)
def test_what_is_no_table_is_one_plain_line(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(LogError) as caught:
        read_cells(tmp_path / name, stamps=["t"], columns=["a"])
    (problem,) = caught.value.problems
    assert problem.startswith(str(tmp_path / name))
    assert "\n" not in problem
