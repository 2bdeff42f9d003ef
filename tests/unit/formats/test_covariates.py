"""Tables of covariates: stamps in any unit, rows joined by time, and what cannot be joined refused or counted."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from tcpipe.errors import DatasetError
from tcpipe.formats.covariates import read_covariates
from tcpipe.tables.findings import Subject

HOURS = [datetime(2025, 10, 14, 11, tzinfo=UTC) + timedelta(minutes=10 * k) for k in range(3)]
NS = [int(hour.timestamp()) * 10**9 for hour in HOURS]
SPAN = ("2025-10-14T11:00:00Z", "2025-10-14T11:20:00Z")


def table(tmp_path, text, name="weather.csv", **how):
    path = tmp_path / name
    path.write_text(text)
    return read_covariates(path, **how)


def line(tmp_path, text, **how):
    with pytest.raises(DatasetError) as caught:
        table(tmp_path, text, **how)
    assert len(caught.value.problems) == 1
    return caught.value.problems[0]


@pytest.mark.parametrize(
    ("name", "of"),
    [
        ("time", lambda hour: hour.isoformat()),
        ("time", lambda hour: hour.strftime("%Y-%m-%d %H:%M:%S")),
        ("time", lambda hour: hour.astimezone().isoformat()),
        ("Timestamp", lambda hour: hour.strftime("%Y-%m-%dT%H:%M:%SZ")),
        ("stamp_ns", lambda hour: int(hour.timestamp()) * 10**9),
        ("time_us", lambda hour: int(hour.timestamp()) * 10**6),
        ("time", lambda hour: int(hour.timestamp()) * 1000),
        ("time", lambda hour: f"{hour.timestamp():.3f}"),
        ("date", lambda hour: int(hour.timestamp())),
    ],
)
def test_stamps_in_every_unit_are_the_same_times(tmp_path, name, of):
    rows = "".join(f"{of(hour)},{k}\n" for k, hour in enumerate(HOURS))
    found = table(tmp_path, f"{name},temp_c\n{rows}")
    assert (found.span, found.rows["temp_c"].to_list()) == (SPAN, [0.0, 1.0, 2.0])


def test_each_stamp_takes_the_last_row_before_it_that_is_not_too_old(tmp_path):
    rows = "".join(f"{ns},{k},{word}\n" for k, (ns, word) in enumerate(zip(NS, ("wet", "", "dry"), strict=True)))
    found = table(tmp_path, f"stamp_ns,temp_c,ground\n{rows}")
    second = 10**9
    stamps = np.array([NS[0] + 700 * second, NS[0] - 1, NS[0], NS[2] + 900 * second, NS[2] + 901 * second])
    joined, reached = found.join(stamps, max_age_s=900.0)
    by_hand = []
    for stamp in stamps.tolist():  # without any join
        rows_before = [k for k, ns in enumerate(NS) if 0 <= stamp - ns <= 900 * second]
        by_hand.append(float(rows_before[-1]) if rows_before else None)
    assert joined["weather_temp_c"].to_pylist() == by_hand == [1.0, None, 0.0, 2.0, None]
    assert joined["weather_ground"].to_pylist() == [None, None, "wet", "dry", None]
    assert reached.tolist() == [True, False, True, True, False]


def test_parquet_is_as_csv(tmp_path):
    pl.DataFrame({"time": HOURS[::-1], "wet": [True, False, True], "snow_m": [0.1, float("nan"), 0.3]}).write_parquet(
        tmp_path / "ground.parquet"
    )
    found = read_covariates(tmp_path / "ground.parquet")
    assert found.span == SPAN
    assert found.rows["snow_m"].to_list() == [0.3, None, 0.1]
    assert found.rows["wet"].to_list() == ["true", "false", "true"]


def test_numbers_among_which_is_a_word_are_text_and_said_to_be(tmp_path):
    found = table(tmp_path, f"stamp_ns,temp_c\n{NS[0]},3.5\n{NS[1]},4\n{NS[2]},frozen\n")
    assert found.rows["temp_c"].to_list() == ["3.5", "4", "frozen"]
    (finding,) = found.findings
    assert (finding.code, finding.subject) == ("column-is-text", Subject("column", "weather_temp_c"))
    assert finding.numbers == {"odd_count": 1, "value_count": 3}
    assert finding.names["example"] == "frozen"


def test_rows_without_a_stamp_are_left_out_and_counted(tmp_path):
    found = table(tmp_path, f"stamp_ns,temp_c\n{NS[0]},3.5\n,4\n{NS[0]},3.5\n")
    assert found.rows.height == 1  # a repeated row says nothing else
    (finding,) = found.findings
    assert (finding.code, finding.subject) == ("covariates-without-time", Subject("file", "weather.csv"))
    assert (finding.names, finding.numbers) == ({"column": "stamp_ns"}, {"row_count": 1})


@pytest.mark.parametrize(
    ("text", "how", "said"),
    [
        ("when,temp_c\n1,2\n", {}, "no column is called as one of time; name it (recipe key covariates.time_column)"),
        ("time,date,temp_c\n1,2,3\n", {}, "2 columns tell the time (time, date)"),
        (
            "time,temp_c\n1,2\n",
            {"time_column": "when"},
            "no column 'when' (recipe key covariates.time_column); there are time",
        ),
        (
            "time,temp_c\n17,2\n",
            {},
            "time: its stamps do not count from 1970; set their unit, one of ns, us, ms, s (recipe key covariates.time_unit)",
        ),
        ("time,temp_c\nnoon,2\n", {}, "time: it contains neither numbers nor dates"),
        ("time,temp_c\n", {}, "0 rows of 1 columns"),
        ("time\n2025-01-01\n", {}, "1 rows of 0 columns besides time"),
        ("", {}, "not a readable table"),
        (f"stamp_ns,temp_c\n{NS[0]},3\n{NS[0]},4\n", {}, "rows of 2025-10-14T11:00:00Z differ"),
    ],
)
def test_what_cannot_be_joined_is_one_line(tmp_path, text, how, said):
    assert said in line(tmp_path, text, **how)


def test_a_simulated_clock_wants_its_unit(tmp_path):
    found = table(tmp_path, "time,temp_c\n17,2\n18,3\n", time_unit="s")
    assert found.span == ("1970-01-01T00:00:17Z", "1970-01-01T00:00:18Z")
