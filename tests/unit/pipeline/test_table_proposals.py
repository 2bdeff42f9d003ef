"""Recipe proposed for a folder of tables: names and values decide together; open questions are comments."""

import numpy as np
import polars as pl
import pytest
from table_loggers import Drive, write_spanish

from tcpipe.errors import UsageError
from tcpipe.formats.logs.log_joining import open_single_log
from tcpipe.formats.logs.table_folders import find_table_logs
from tcpipe.formats.recipe_toml import parse_recipe, parse_toml
from tcpipe.pipeline.proposals import propose_recipe

ROWS = 60
UTC_S = 1_763_501_392.0


def write(path, **columns):
    path.parent.mkdir(parents=True, exist_ok=True)
    names = [name.replace("__", " ") for name in columns]
    values = [np.broadcast_to(of, ROWS).tolist() for of in columns.values()]
    lines = [",".join(names), *(",".join(map(str, row)) for row in zip(*values, strict=True))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def proposed(folder):
    """The recipe as it is written, and with every comment of a line removed and places measured."""
    text = propose_recipe(folder).toml()
    bare = "\n".join(
        line.removeprefix("# ") if " = " in line or line.startswith("# [") else line for line in text.splitlines()
    )
    measured = bare.replace("?", "0.1")
    return parse_toml(text), parse_recipe(parse_toml(measured), where="every comment removed"), text


SECONDS = np.arange(ROWS) / 10
WALL_NS = ((UTC_S + SECONDS) * 1e9).astype(np.int64)
FIXES = {"latitude__(deg)": 26.372 + 1e-6 * np.arange(ROWS), "longitude__(deg)": -80.1 + 1e-6 * np.arange(ROWS)}
INERTIAL = {**dict.fromkeys(("wx", "wy"), 0.01), "wz": 0.1, "ax": 0.2, "ay": -0.1, "az": 9.8}


def test_stamps_since_1970_go_before_those_from_the_start_and_texts_cut_to_seconds(tmp_path):
    text = np.array([f"2025-11-18 21:29:{52 + int(second)}" for second in SECONDS])
    write(
        tmp_path / "a" / "gps.csv",
        **{"timestamp__(sec)": SECONDS, "timestring": text, "timestamp__(ns)": WALL_NS},
        **FIXES,
        alt_msl=2.6,
    )
    write(tmp_path / "b" / "power.csv", timestring=text, stamp_ns=WALL_NS, **{"Power__(w)": 50 + SECONDS})
    values, recipe, _ = proposed(tmp_path)
    assert values["tables"]["gnss"]["stamp"] == "timestamp (ns)"
    assert values["tables"]["gnss"]["columns"]["altitude"] == "alt_msl"
    assert values["tables"]["power"] == {
        "file": "b/power.csv",
        "stamp": "stamp_ns",
        "columns": {"power": "`Power (w)`"},
    }
    topics = open_single_log(tmp_path, message_definitions=None, tables=recipe.tables).topics
    assert {name: topic.message_count for name, topic in topics.items()} == {"/gnss": ROWS, "/power": ROWS}


def test_numbered_files_are_runs_and_both_sides_are_one_robot(tmp_path):
    for number in ("00", "01"):
        write(tmp_path / f"imu_{number}.csv", time=SECONDS, **INERTIAL)
        write(tmp_path / f"pro_{number}.csv", time=SECONDS, curL=2.0 + SECONDS, curR=3.0 + SECONDS, velL=0.2, velR=0.3)
    values, recipe, text = proposed(tmp_path)
    tables = values["tables"]
    assert {name: of["file"] for name, of in tables.items()} == {
        "imu": "imu_*.csv",
        "wheel_odometry": "pro_*.csv",
        "power": "pro_*.csv",
    }
    assert {of["stamp_unit"] for of in tables.values()} == {"s"}
    assert tables["wheel_odometry"]["columns"] == {"linear_x": "(velL + velR) / 2"}
    assert tables["power"]["columns"] == {"current": "curL + curR"}
    assert recipe.tables["wheel_odometry"].columns["angular_z"] == "(velR - velL) / 1 / 0.5"
    assert recipe.tables["power"].nominal_voltage_volt == 24.0
    assert text.count("\n# columns.angular_z") == text.count("\n# nominal_voltage_volt") == 1


@pytest.mark.parametrize(
    ("latitude", "expected"), [(4704.1, "is no"), (0.82, "radians"), (470_612_345.0, ""), (47.06, "")]
)
def test_latitudes_that_are_no_degrees_are_for_a_person(tmp_path, latitude, expected):
    longitude = latitude / 3
    rows = np.arange(ROWS)
    write(
        tmp_path / "gps.csv",
        time=SECONDS + UTC_S,
        lat=np.round(latitude + rows) if latitude > 1e6 else latitude + 1e-6 * rows,
        lon=np.round(longitude + rows) if latitude > 1e6 else longitude + 1e-6 * rows,
    )
    values, recipe, text = proposed(tmp_path)
    assert ("tables" in values) is not bool(expected)
    if latitude > 1e6:
        assert recipe.tables["gnss"].columns["latitude"] == "lat * 1e-7"
    assert all(word in text.lower() for word in expected.replace("is no", "no degrees").split(" ") if expected)


def test_a_speed_and_a_place_beside_fixes_are_computed_from_them(tmp_path):
    write(tmp_path / "gps.csv", time=SECONDS + UTC_S, **FIXES, speed=0.5, x=SECONDS, y=SECONDS)
    assert set(proposed(tmp_path)[0]["tables"]) == {"gnss"}


def test_a_folder_without_known_names_says_so(tmp_path):
    write(tmp_path / "notes.csv", week=SECONDS, done=1.0)
    with pytest.raises(UsageError, match="no table with stamps and columns of known names"):
        propose_recipe(tmp_path)


@pytest.mark.parametrize("columns", [{**FIXES, "volt": 24.0, "amp": 2.0}, {"volt": 24 + 1e-3 * SECONDS, "amp": 2.0}])
def test_what_a_role_measures_is_no_stamp(tmp_path, columns):
    write(tmp_path / "drive.csv", **columns)
    with pytest.raises(UsageError, match=r"drive\.csv, not used: no stamps; columns"):
        propose_recipe(tmp_path)


def test_a_file_that_is_no_table_is_named_beside_the_others(tmp_path):
    write(tmp_path / "gps.csv", time=SECONDS + UTC_S, **FIXES)
    (tmp_path / "broken.parquet").write_bytes(b"no parquet")
    assert "broken.parquet: it cannot be read as a table" in propose_recipe(tmp_path).toml()


def test_what_tcpipe_wrote_is_no_table(tmp_path):
    write(tmp_path / "samples.csv", time=SECONDS + UTC_S, **FIXES)
    (tmp_path / "dataset.json").write_text("{}")
    with pytest.raises(UsageError, match="tcpipe wrote this"):
        propose_recipe(tmp_path)


def test_tables_of_two_drives_are_not_mixed(tmp_path):
    write(tmp_path / "gps.csv", time=np.arange(ROWS) + UTC_S, **FIXES)
    write(
        tmp_path / "other" / "log.csv",
        time=np.arange(ROWS) + UTC_S + 9e5,
        battery_voltage=24.0 + SECONDS,
        battery_current=2.0 + SECONDS,
    )
    values, _, text = proposed(tmp_path)
    assert set(values["tables"]) == {"gnss"}
    assert "no time in common" in text


def test_one_table_of_odd_names_is_fixes_wheels_and_power(tmp_path):
    table = {"Timestamp_us": WALL_NS // 1000, "GPS__Lat": 26.37 + 1e-6 * np.arange(ROWS), "GPS__Lng": -80.1}
    table |= {"Alt__MSL__(ft)": 10.0, "Fix__Quality": 4, "spd_L__(km/h)": 3.9, "spd_R__(km/h)": 4.1, "SoC__%": 80}
    write(tmp_path / "log.csv", **table, **{"U_bat__[V]": 25.1, "I_bat__[A]": 2.0 + SECONDS})
    values, recipe, _ = proposed(tmp_path)
    tables = values["tables"]
    assert tables["gnss"]["columns"] == {
        "latitude": "GPS Lat", "longitude": "GPS Lng", "altitude": "Alt MSL (ft)", "quality": "Fix Quality"
    }  # fmt: skip
    assert tables["wheel_odometry"]["columns"] == {"linear_x": "(`spd_L (km/h)` + `spd_R (km/h)`) / 2"}
    assert tables["wheel_odometry"]["units"] == {"linear_x": "km/h"}
    assert tables["power"]["columns"] == {"voltage": "`U_bat [V]`", "current": "`I_bat [A]`"}
    log = open_single_log(tmp_path, message_definitions=None, tables=recipe.tables)
    read = log.tables(["/gnss", "/wheel_odometry"])
    assert read["/gnss"]["altitude"][0].as_py() == pytest.approx(3.048)
    assert read["/wheel_odometry"]["twist.twist.linear.x"][0].as_py() == pytest.approx(4.0 / 3.6)
    assert read["/wheel_odometry"]["twist.twist.angular.z"][0].as_py() == pytest.approx(0.2 / 3.6 / 0.5)


def test_what_is_not_recognised_is_named_under_its_role_with_three_values(tmp_path):
    table = {"millis": 1000 + 100 * np.arange(ROWS), "lat": 47.0 + 1e-6 * SECONDS, "lon": 15.0}
    table |= {"ax[g]": 0.0, "ay[g]": 0.1, "az[g]": 1.0, "rot__pitch": SECONDS, "rot__yaw": 0.2}
    write(tmp_path / "log.csv", **table)
    values, _, text = proposed(tmp_path / "log.csv")
    assert set(values["tables"]) == {"gnss"}
    (imu,) = (line for line in text.splitlines() if "imu is not recognised" in line)
    for word in ("ax[g] (0, 0, 0)", "az[g] (1, 1, 1)", "rot pitch (0, 0.1, 0.2)", "rot yaw"):
        assert word in imu
    assert '# columns.linear_acceleration_x = "ax[g]"' in text
    assert '# columns.angular_velocity_x = "column?"' in text


@pytest.mark.parametrize(
    "drives", [("drive1",), ("drive1", "drive2"), ("north", "south"), ("2025-07-09_14-03-12", "2025-07-10_09-00-00")]
)
def test_files_of_one_drive_share_the_first_part_of_their_names(tmp_path, drives):
    for number, drive in enumerate(drives):
        start_s = UTC_S + 1e5 * number
        write(tmp_path / f"{drive}_gps.csv", time=SECONDS + start_s, **FIXES)
        write(tmp_path / f"{drive}_imu.csv", time=SECONDS + start_s, **INERTIAL)
        write(tmp_path / f"{drive}_power.csv", time=SECONDS + start_s, voltage=24.0 + SECONDS, current=2.0 + SECONDS)
    values, recipe, text = proposed(tmp_path)
    names = {name: of["file"].partition("*")[2] for name, of in values["tables"].items()}
    assert {name: file.partition("_")[2].rpartition("_")[2] or file for name, file in names.items()} == {
        "gnss": "gps.csv",
        "imu": "imu.csv",
        "power": "power.csv",
    }
    assert "no time in common" not in text
    assert len(find_table_logs(tmp_path, recipe.tables)) == len(drives)
    log = open_single_log(tmp_path / f"{drives[0]}_imu.csv", tables=recipe.tables)
    assert set(log.topics) == {"/gnss", "/imu", "/power"}


@pytest.mark.parametrize("noise_mps", [0.0, 1.0, 2.0, 3.0])
def test_the_first_minute_shows_a_unit_or_contradicts_a_table(tmp_path, noise_mps):
    write_spanish(Drive(), tmp_path)
    table = pl.read_parquet(tmp_path / "viaje.parquet")
    noise = noise_mps * np.abs(np.sin(np.arange(len(table)) / 40.0))
    wheels = pl.Series(noise) if noise_mps else pl.col("velocidad_rueda") * 3.6
    table.with_columns(velocidad_rueda=wheels).write_parquet(tmp_path / "viaje.parquet")
    values, _, text = proposed(tmp_path)
    if noise_mps:
        assert set(values["tables"]) == {"gnss", "imu", "power"}
        assert '# file = "viaje.parquet"  # in the first minute: gnss: ' in text
    else:
        assert values["tables"]["wheel_odometry"]["units"] == {"linear_x": "km/h"}
        assert "in the first minute: wheel_odometry: drives 3.59" in text


def test_what_ingest_would_reject_is_a_comment(tmp_path):
    write(tmp_path / "gps.csv", time=SECONDS + UTC_S, **FIXES)
    write(tmp_path / "power.csv", time=SECONDS + UTC_S, **{"voltage__[%]": 24.0 + SECONDS, "current": 2.0 + SECONDS})
    values, _, _ = proposed(tmp_path)
    open_single_log(tmp_path, tables=parse_recipe(values, where="as written").tables)


@pytest.mark.parametrize("robot_s", [UTC_S, 100.0])
def test_tables_on_another_clock_are_aligned_by_speed_and_turns(tmp_path, robot_s):
    """The fixes have GPS time, 18 s ahead; the computer's other tables have UTC or count from its start."""
    t = np.arange(0.0, 240.0, 0.1)
    rng = np.random.default_rng(4)
    hold = np.repeat(rng.uniform(0.0, 1.3, 60), 40), np.repeat(rng.normal(0.0, 0.3, 80), 30)
    speed, turn = (np.convolve(each, np.ones(15) / 15, "same") for each in hold)
    place = np.cumsum(speed * np.exp(1j * np.cumsum(turn) * 0.1)) * 0.1
    fixes = {
        "latitude": 47.0 + place.imag / 111_195.0,
        "longitude": 15.0 + place.real / (111_195.0 * np.cos(np.radians(47.0))),
    }
    tables = {"gps": {"time": t + UTC_S + 18.0, **fixes, "altitude": 400.0 + 0 * t}}
    tables["odom"] = {"time": t + robot_s, "linear_x": speed, "angular_z": turn}
    tables["power"] = {"time": t + robot_s, "voltage": 24.0 + 0.01 * speed, "current": 1.0 + 4.0 * speed}
    for name, columns in tables.items():
        pl.DataFrame(columns).write_csv(tmp_path / f"{name}.csv")
    values, _, _ = proposed(tmp_path)
    offset_s = {name: of.get("offset_s", 0.0) for name, of in values["tables"].items()}
    assert offset_s["wheel_odometry"] + robot_s - (offset_s["gnss"] + UTC_S + 18.0) == pytest.approx(0.0, abs=0.05)
    assert offset_s["power"] == offset_s["wheel_odometry"]
