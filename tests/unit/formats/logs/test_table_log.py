"""A folder of tables is read like the bag it was made from; what its mapping names in vain is said, all at once."""

import numpy as np
import polars as pl
import pytest
from simulated_streams import log_of

from tcpipe.errors import LogError, UsageError
from tcpipe.formats.finding_lines import describe_finding
from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.log_joining import open_logs
from tcpipe.formats.logs.table_log import open_tables
from tcpipe.formats.recipe_toml import load_shipped_profiles, parse_toml
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.proposals import propose_recipe
from tcpipe.recipe import Recipe, TableMapping
from tcpipe.recipe.checking import from_values
from tcpipe.simulation.scenarios import make_tiny
from tcpipe.stages.read import find_read_config, read_run
from tcpipe.tables.columns import to_floats, to_integers

START_NS = 1_760_456_485 * 10**9


def folder_with(tmp_path, **tables):
    folder = tmp_path / "session"
    folder.mkdir(exist_ok=True)
    for name, text in tables.items():
        (folder / f"{name}.csv").write_text(text)
    return folder


def odometry(count=50, unit=10**6, start=START_NS, text="t,v,w\n"):
    return text + "".join(f"{(start + k * 20_000_000) // (10**9 // unit)},{0.5 + k % 2},0.1\n" for k in range(count))


SAME = {
    "gnss": TableMapping(
        "gnss.csv",
        stamp="time",
        columns={"latitude": "lat_deg", "longitude": "lon_deg", "altitude": "alt_m", "status": "fix_status"}
        | {f"{axis}_std": axis for axis in ("east", "north", "up")},
    ),
    "imu": TableMapping(
        "imu.parquet",
        columns={f"angular_velocity_{axis}": f"angular_velocity_{axis}_radps" for axis in "xyz"}
        | {f"linear_acceleration_{axis}": f"linear_acceleration_{axis}_mps2" for axis in "xyz"},
    ),
    "wheel_odometry": TableMapping(
        "wheels.tsv", columns={"linear_x": "velocity_x_mps", "angular_z": "angular_velocity_z_radps"}
    ),
    "power": TableMapping("power.csv", columns={"voltage": "voltage_volt", "current": "current_amp"}),
}
WHEELS = TableMapping("odom.csv", columns={"linear_x": "v", "angular_z": "w"})


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    scenario = make_tiny(seconds=20.0)
    return log_of(scenario, scenario.drives[0], tmp_path_factory.mktemp("site"))


def test_what_a_bag_holds_is_the_same_as_tables(bag, tmp_path):
    with open_log(bag) as log:
        wanted = read_run(log, Recipe().read, robot=None, known=load_shipped_profiles())
    folder = tmp_path / "drive"
    folder.mkdir()
    for role, name in (
        ("gnss", "gnss.csv"),
        ("imu", "imu.parquet"),
        ("wheel_odometry", "wheels.tsv"),
        ("power", "power.csv"),
    ):
        table = wanted.tables[role]
        frame = pl.DataFrame({n: table[n].to_pylist() for n in table.column_names if n != "rail"})
        if role == "gnss":
            frame = frame.with_columns(
                pl.col("east_var_m2").sqrt().alias("east"),
                pl.col("north_var_m2").sqrt().alias("north"),
                pl.col("up_var_m2").sqrt().alias("up"),
                pl.from_epoch("stamp_ns", time_unit="ns").alias("time"),
            )
        if name.endswith("parquet"):
            frame.write_parquet(folder / name)
        else:
            separator = "\t" if name.endswith("tsv") else ","
            frame.write_csv(folder / name, separator=separator, datetime_format="%Y-%m-%dT%H:%M:%S%.9f")
    recipe = Recipe(tables=SAME)
    with open_logs([folder], tables=recipe.tables) as log:
        assert log.findings == []
        found = read_run(log, find_read_config(recipe, log.topics), robot=None, known=load_shipped_profiles())
    for role in ("gnss", "imu", "wheel_odometry", "power"):
        assert (
            to_integers(found.tables[role], "stamp_ns").tolist()
            == to_integers(wanted.tables[role], "stamp_ns").tolist()
        )
    for role, names in (
        ("gnss", ("lon_deg", "lat_deg", "alt_m", "east_var_m2", "up_var_m2")),
        ("imu", ("angular_velocity_z_radps", "linear_acceleration_x_mps2")),
        ("wheel_odometry", ("velocity_x_mps", "angular_velocity_z_radps")),
        ("power", ("voltage_volt", "current_amp")),
    ):
        for name in names:
            np.testing.assert_allclose(
                to_floats(found.tables[role], name), to_floats(wanted.tables[role], name), rtol=1e-12
            )


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


def test_inspect_proposes_what_the_columns_are_called_and_it_can_be_read(tmp_path):
    def rows(cells):
        return "".join(f"17604564{85 + k // 10}.{k % 10},{cells.format(k=k % 10)}\n" for k in range(50))

    folder = folder_with(
        tmp_path,
        odom=odometry(text="time,vx,yaw_rate\n"),
        cmd_vel=odometry(text="stamp,linear.x,angular.z\n"),
        imu="t,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z\n" + rows("0.{k},0.1{k},0.2{k},0.1{k},0.2,9.8{k}"),
        fixes="t,Latitude (deg),Longitude (deg),height\n" + rows("47.{k},15.{k},40{k}"),
        voltage_left="timestamp,value\n" + rows("48.{k}"),
        current_left="timestamp,value\n" + rows("4.{k}"),
        notes="a,b,c\n1,2,3\n",
    )  # fmt: skip
    found = inspect(folder, recipe=Recipe())
    assert found.kind == "tables"
    assert "notes.csv, not used" in found.recipe
    assert found.recipe == propose_recipe(folder).toml()
    alone = inspect(folder / "fixes.csv", recipe=Recipe())
    assert alone.recipe == propose_recipe(folder / "fixes.csv").toml()
    recipe = from_values(Recipe, parse_toml(found.recipe), where="proposed")
    assert {table.role or name for name, table in recipe.tables.items()} == {
        "gnss",
        "imu",
        "wheel_odometry",
        "command",
        "power",
    }
    read = inspect(folder, recipe=recipe)
    assert read.kind == "log"
    assert {topic.name: topic.role for topic in read.topics} == {
        "/gnss": "gnss",
        "/imu": "imu",
        "/wheel_odometry": "wheel_odometry",
        "/command": "command",
        "/voltage_left": "power",
        "/current_left": "power",
    }


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
    assert "nor is one of the files that the recipe's tables name: fixes.csv" in caught.value.problems[1]
    recipe = Recipe(tables={"wheel_odometry": WHEELS, "imu": TableMapping("odom.csv")})
    (failed,) = ingest([tmp_path], store=tmp_path / "store", recipe=recipe).results
    assert (failed.status, failed.log) == ("failed", str(folder))
    assert "tables.imu.columns: imu needs angular_velocity_x" in failed.problems[0]
    recipe = Recipe(tables={"wheel_odometry": WHEELS})
    (done,) = ingest([tmp_path], store=tmp_path / "store", recipe=recipe).results
    assert (done.status, done.run.run_id[:8]) == ("done", "session-")
    (again,) = ingest([folder], store=tmp_path / "store", recipe=recipe).results
    assert (again.status, again.run.run_id) == ("unchanged", done.run.run_id)
