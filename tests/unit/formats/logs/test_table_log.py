"""A folder of tables is read like the bag it was made from; what its mapping names in vain is said, all at once."""

import os
from dataclasses import replace

import numpy as np
import pytest

from tcpipe.errors import LogError, UsageError
from tcpipe.formats.finding_lines import describe_finding
from tcpipe.formats.logs.log_joining import open_logs
from tcpipe.formats.logs.table_log import open_tables
from tcpipe.pipeline.ingest import ingest
from tcpipe.recipe import Recipe, TableMapping

START_NS = 1_760_456_485 * 10**9


def folder_with(tmp_path, **tables):
    folder = tmp_path / "session"
    folder.mkdir(exist_ok=True)
    for name, text in tables.items():
        (folder / f"{name}.csv").write_text(text)
    return folder


def odometry(count=50, unit=10**6, start=START_NS, text="t,v,w\n"):
    return text + "".join(f"{(start + k * 20_000_000) // (10**9 // unit)},{0.5 + k % 2},0.1\n" for k in range(count))


WHEELS = TableMapping("odom.csv", columns={"linear_x": "v", "angular_z": "w"})


def test_all_that_a_mapping_names_in_vain_is_said_at_once(tmp_path):
    folder = folder_with(
        tmp_path,
        odom=odometry(),
        imu="t,wx\n1760456485,x\n",
        late=odometry(start=START_NS + 10**12),
        relative=odometry(start=0),
        words="t,v\n1760456485,fast\n1760456486,slow\n",
    )
    mappings = {
        "wheel_odometry": WHEELS,
        "gnss": TableMapping("fixes.csv", columns={"latitude": "lat", "longitude": "lon"}),
        "imu": TableMapping("imu.csv", columns={"angular_velocity_x": "wx"}),
        "cmd": TableMapping("odom.csv", columns={"linear_x": "v"}),
        "command": TableMapping("words.csv", columns={"linear_x": "v"}),
        "pose": TableMapping("odom.csv", columns={"x": "px", "y": "py"}),
        "visual_odometry": TableMapping("relative.csv", columns={"linear_x": "v"}),
        "speed": TableMapping("late.csv", "wheel_odometry", columns={"linear_x": "v"}),
        "notes": TableMapping("notes.docx", "command", columns={"linear_x": "v"}),
    }
    with pytest.raises(LogError) as caught:
        open_tables(folder, mappings)
    said = "\n".join(caught.value.problems)
    assert len(caught.value.problems) == 9
    for words in (
        "tables.gnss.file: there is no fixes.csv here; there are imu.csv, late.csv, odom.csv",
        "tables.imu.columns: imu needs angular_velocity_y",
        "tables.cmd: role is 'cmd'; expected one of gnss",
        "column v of words.csv contains text ('fast' in row 1), expected numbers",
        "tables.pose.columns.x: there is no column px; there are t, v, w (odom.csv)",
        "relative.csv, column t: its stamps",
        "/speed and /wheel_odometry have no time in common (they begin 1000.000 s apart)",
        "notes.docx'; expected a name that ends in .csv",
    ):
        assert words in said


def test_what_cannot_be_read_of_a_row_is_damage_and_rows_are_put_in_order(tmp_path):
    lines = odometry().splitlines()
    lines[3], lines[4], lines[10], lines[20] = lines[4], lines[3], "later,1,1", lines[20].split(",")[0] + ",slow,0.1"
    folder = folder_with(tmp_path, odom="\n".join(lines))
    log = open_tables(folder, {"wheel_odometry": WHEELS})
    assert [describe_finding(finding) for finding in log.findings] == [
        "odom.csv: messages or rows have no valid time (1 messages lost)",
        "odom.csv: not read as numbers: column v, row 20: 'slow' (1 messages lost)",
        "odom.csv: messages are not stored in the order of their time",
    ]
    assert [finding.severity for finding in log.findings] == ["warning", "warning", "note"]
    table = log.tables(["/wheel_odometry"])["/wheel_odometry"]
    stamps = table["log_time_ns"].to_numpy()
    assert len(stamps) == 49
    assert (np.diff(stamps) > 0).all()


def test_a_run_is_known_by_all_tables_of_its_folder_not_by_what_is_mapped(tmp_path):
    folder = folder_with(tmp_path, odom=odometry(), other="t,a\n1,2\n")
    one = open_tables(folder, {"wheel_odometry": WHEELS}).sha256()
    assert open_tables(folder, {"command": TableMapping("odom.csv", columns={"linear_x": "v"})}).sha256() == one
    (folder / "other.csv").write_text("t,a\n1,3\n")
    assert open_tables(folder, {"wheel_odometry": WHEELS}).sha256() != one


def test_a_store_inside_the_folder_of_tables_is_no_part_of_the_log(tmp_path):
    folder = folder_with(tmp_path, odom=odometry())
    recipe = Recipe(tables={"wheel_odometry": WHEELS})
    (beside,) = ingest([folder], store=tmp_path / "store", recipe=recipe).results
    (inside,) = ingest([folder], store=folder / "tcpipe-store", recipe=recipe).results
    assert (inside.status, inside.run.run_id) == (beside.status, beside.run.run_id)
    (again,) = ingest([folder], store=folder / "tcpipe-store", recipe=recipe).results
    assert again.status == "unchanged"


def test_a_folder_of_tables_is_ingested_as_one_log_and_what_is_in_the_way_is_said(tmp_path):
    folder = folder_with(tmp_path, odom=odometry())
    with pytest.raises(UsageError) as caught:
        ingest([folder], store=tmp_path / "store", recipe=Recipe())
    assert "it contains 1 tables (odom.csv, …): 'tcpipe init --from" in caught.value.problems[1]
    wrong = Recipe(tables={"gnss": TableMapping("fixes.csv")})
    with pytest.raises(UsageError) as caught:
        ingest([folder], store=tmp_path / "store", recipe=wrong)
    assert "it contains none of the files that the recipe's tables name: fixes.csv" in caught.value.problems[1]
    recipe = Recipe(tables={"wheel_odometry": WHEELS, "imu": TableMapping("odom.csv")})
    (failed,) = ingest([tmp_path], store=tmp_path / "store", recipe=recipe).results
    assert (failed.status, failed.log) == ("failed", str(folder))
    assert "tables.imu.columns: imu needs angular_velocity_x" in failed.problems[0]
    recipe = Recipe(tables={"wheel_odometry": WHEELS})
    (done,) = ingest([tmp_path], store=tmp_path / "store", recipe=recipe).results
    assert (done.status, done.run.run_id[:8]) == ("done", "session-")
    (again,) = ingest([folder], store=tmp_path / "store", recipe=recipe).results
    assert (again.status, again.run.run_id) == ("unchanged", done.run.run_id)


NOON_NS = 1_752_062_592_000_000_000
"""2025-07-09T12:03:12Z."""


def stamps_of(tmp_path, stamps, mapping):
    """Return the stamps [ns] of a table with a row each 20 ms."""
    (tmp_path / "odom.csv").write_text("stamp,date,utc,v\n" + "".join(f"{row},1.0\n" for row in stamps))
    mapping = replace(mapping, file="odom.csv", stamp="stamp", columns={"linear_x": "v"})
    log = open_tables(tmp_path, {"wheel_odometry": mapping})
    assert not log.findings
    return log.tables(["/wheel_odometry"])["/wheel_odometry"]["log_time_ns"].to_numpy()


SECONDS = 12.0 + np.arange(50) * 0.02
AS_SPECIFIED = NOON_NS + np.arange(50) * 20_000_000


@pytest.mark.parametrize(
    ("form", "zone"),
    [
        ("2025-07-09 14:03:{:06.3f}", "Europe/Vienna"),
        ("2025-07-09T12:03:{:06.3f}", "UTC"),
        ("09.07.2025 14:03:{:06.3f}", "Europe/Vienna"),
        ("13/07/2025 14:03:{:06.3f}", "Europe/Vienna"),
        ("07/13/2025 02:03:{:06.3f} PM", "Europe/Vienna"),
        ("2025-07-09T14:03:{:06.3f}+02:00", ""),
    ],
)
def test_local_times_are_utc_by_the_zone_of_the_recipe_and_never_without(tmp_path, form, zone):
    rows = [f"{form.format(second)},," for second in SECONDS]
    found = stamps_of(tmp_path, rows, TableMapping(stamp_zone=zone))
    later_ns = 4 * 86_400_000_000_000 if "13" in form else 0
    assert found.tolist() == (AS_SPECIFIED + later_ns).tolist()
    if zone:
        with pytest.raises(LogError, match='have no zone; state it, as stamp_zone = "Europe/Vienna" or "UTC"'):
            stamps_of(tmp_path, rows, TableMapping())


def test_days_and_months_that_cannot_be_told_apart_are_asked_for(tmp_path):
    rows = [f"07/09/2025 14:03:{second:06.3f},," for second in SECONDS]
    with pytest.raises(LogError, match="may begin with day or month; state stamp_format"):
        stamps_of(tmp_path, rows, TableMapping(stamp_zone="Europe/Vienna"))
    stated = TableMapping(stamp_zone="Europe/Vienna", stamp_format="%m/%d/%Y %H:%M:%S%.f")
    assert stamps_of(tmp_path, rows, stated)[0] == NOON_NS


@pytest.mark.parametrize(
    ("dated_by", "unit"),
    [("column", "auto"), *((by, unit) for by in ("key", "name", "change") for unit in ("auto", "ms_today"))],
)
def test_times_of_day_get_their_date_from_column_recipe_name_or_change_of_the_file(tmp_path, dated_by, unit):
    of_day = {"auto": "14:03:{:06.3f}", "ms_today": "{:.0f}"}[unit]
    second = SECONDS if unit == "auto" else 50_580_000 + 1000 * SECONDS
    file = "drive_20250709.csv" if dated_by == "name" else "drive.csv"
    mapping = TableMapping(
        file,
        stamp="stamp",
        stamp_unit=unit,
        stamp_zone="Europe/Vienna",
        stamp_date={"column": "date", "key": "2025-07-09"}.get(dated_by, ""),
        columns={"linear_x": "v"},
    )
    rows = "".join(f"{of_day.format(of)},09.07.2025,1.0\n" for of in second)
    (tmp_path / file).write_text(f"stamp,date,v\n{rows}")
    os.utime(tmp_path / file, (NOON_NS / 1e9 + 5 * 3600,) * 2)
    log = open_tables(tmp_path, {"wheel_odometry": mapping})
    assert log.tables(["/wheel_odometry"])["/wheel_odometry"]["log_time_ns"].to_pylist() == AS_SPECIFIED.tolist()
    said = [describe_finding(finding) for finding in log.findings]
    assert ["2025-07-09 by the last change of the file" in line for line in said] == [True] * (dated_by == "change")


def test_a_time_of_day_passes_midnight(tmp_path):
    rows = [f"{(86_399_500 + 20 * k) % 86_400_000},," for k in range(50)]
    mapping = TableMapping(stamp_zone="UTC", stamp_unit="ms_today", stamp_date="2025-07-09")
    assert set(np.diff(stamps_of(tmp_path, rows, mapping))) == {20_000_000}


def test_local_times_go_on_rising_when_summer_time_ends(tmp_path):
    rows = [f"2025-10-26 {hour}:{second // 60:02d}:{second % 60:02d},," for hour, second in (
        *(("02", 3540 + k) for k in range(60)), *(("02", k) for k in range(60))
    )]  # fmt: skip
    found = stamps_of(tmp_path, rows, TableMapping(stamp_zone="Europe/Vienna"))
    assert found[0] == 1_761_440_340_000_000_000  # 2025-10-26T00:59:00Z
    assert set(np.diff(found)) == {1_000_000_000}


def test_times_that_no_clock_of_the_zone_showed_are_an_error(tmp_path):
    rows = [f"2025-03-30 02:30:{second:06.3f},," for second in SECONDS]
    with pytest.raises(LogError, match="no time of it exists in Europe/Vienna, whose clocks skip an hour then"):
        stamps_of(tmp_path, rows, TableMapping(stamp_zone="Europe/Vienna"))


def test_a_counter_is_tied_to_utc_by_whole_seconds_beside_it(tmp_path):
    rows = [f"{5000 + 20 * k},,{NOON_NS // 10**9 + k // 50}" for k in range(200)]
    found = stamps_of(tmp_path, rows, TableMapping(stamp_unit="ms", stamp_utc="utc"))
    assert found.tolist() == (NOON_NS + np.arange(200) * 20_000_000).tolist()


def test_wrong_keys_of_stamps_are_named(tmp_path):
    rows = [f"14:03:{second:06.3f},," for second in SECONDS]
    for mapping, problem in (
        (TableMapping(stamp_zone="Europe/Wien"), "Europe/Wien"),
        (
            TableMapping(stamp_zone="UTC", stamp_date="yesterday"),
            "expected a column of dates of odom.csv, or a date, as 2025-07-09",
        ),
        (TableMapping(stamp_utc="gps"), "stamp_utc: odom.csv has no column gps"),
        (
            TableMapping(stamp_zone="UTC", stamp_format="%Y"),
            "stamp_format is '%Y', and its first text is '14:03:12.000'",
        ),
    ):
        with pytest.raises(LogError, match=problem):
            stamps_of(tmp_path, rows, mapping)


def test_a_table_that_the_recipe_does_not_name_says_which_it_names(tmp_path):
    folder_with(tmp_path, odom=odometry(), other=odometry())
    with pytest.raises(LogError, match=r"the recipe's tables are called odom\.csv"):
        open_logs([tmp_path / "session" / "other.csv"], tables={"wheel_odometry": WHEELS})


def test_rows_without_a_value_of_a_table_are_no_messages(tmp_path):
    rows = "".join(f"{START_NS // 10**6 + 20 * k},{'' if k % 4 else 1.0},0.1\n" for k in range(40))
    folder = folder_with(tmp_path, odom="t,v,w\n" + rows)
    mapping = TableMapping("odom.csv", columns={"linear_x": "v"})
    assert open_tables(folder, {"wheel_odometry": mapping}).topics["/wheel_odometry"].message_count == 10
