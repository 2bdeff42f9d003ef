"""The shipped recipes parse and say what their comments claim; schedulers call what there is."""

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import polars as pl
import pytest

import tcpipe
from tcpipe.cli import cli
from tcpipe.formats.logs.log_joining import AnyLog, open_logs
from tcpipe.formats.logs.table_log import open_tables
from tcpipe.formats.recipe_toml import ingest_key, load_profiles, load_recipe
from tcpipe.logs.topics import Topic
from tcpipe.recipe import Recipe
from tcpipe.stages.read import decide_roles, find_read_config

PIPELINES = Path(__file__).parents[2] / "pipelines"
VI, SIDES = ("voltage", "current"), ("left", "right")


def played(recipe: Recipe, log: AnyLog) -> set[str]:
    """The roles that are played, all that the recipe says settled."""
    found = decide_roles(
        find_read_config(recipe, log.topics), log.topics.values(), recipe.robot, known=load_profiles(recipe)
    )
    assert found.problems == ()
    return set(found.roles)


def test_husky_is_the_default_written_out() -> None:
    husky = load_recipe(PIPELINES / "husky.toml")
    assert husky.robot == "husky"
    assert ingest_key(husky) == ingest_key(Recipe())
    assert (husky.sample, husky.split) == (Recipe().sample, Recipe().split)


def test_husky_paper_is_the_paper() -> None:
    paper = load_recipe(PIPELINES / "husky-paper.toml")
    assert paper.fuse.estimator == "ukf"
    assert (paper.label.velocity, paper.label.integration) == ("fused", "right_endpoint")
    assert paper.split.holdout == "sample"
    assert (paper.sample.patch_m, paper.sample.patch_px, paper.segment.chord_m) == (1.0, 40, 1.0)


def test_fomo_and_drive_map_the_columns_that_their_publishers_write(tmp_path: Path) -> None:
    fomo, drive = (load_recipe(PIPELINES / f"{name}.toml") for name in ("fomo", "drive"))
    names = {
        "odom.csv": "t,px,py,pz,qx,qy,qz,qw,tlx,tly,tlz,tax,tay,taz,tax,tay,taz",  # fomo-sdk, odom.rs
        "metadata/cmd_velocity.csv": "timestamp,lx,ly,lz,ax,ay,az",
        **{f"metadata/{what}_{side}.csv": "timestamp,value" for what in VI for side in SIDES},
    }
    (tmp_path / "metadata").mkdir()
    for file, head in names.items():
        rows = "".join(f"{1760456485000000 + k * 100000}{',0.5' * 13}\n" for k in range(20))
        (tmp_path / file).write_text(f"{head}\n{rows}")
    (tmp_path / "gt.txt").write_text(
        "".join(f"{1760456485 + k / 10} 255855.3 5242729.3 643.6 0 0 0 1\n" for k in range(20))
    )
    assert played(fomo, open_tables(tmp_path, fomo.tables)) == {"pose", "wheel_odometry", "command", "power"}
    logged = ["cmd_vel_x", "cmd_vel_omega", *(f"icp_pos_{axis}" for axis in "xyz"), *(f"imu_{axis}" for axis in "xyz")]
    logged += [f"imu_acceleration_{axis}" for axis in "xyz"] + [f"{side}_wheel_{what}" for what in VI for side in SIDES]
    times = [str(1721335359000000000 + k * 50_000_000) for k in range(20)]
    frame = pl.DataFrame({"ros_time": times} | {name: ["0.5"] * 20 for name in logged})
    for file in ("icp", "frame"):
        frame.write_parquet(tmp_path / f"{file}.parquet")
    assert played(drive, open_tables(tmp_path, drive.tables)) == {"pose", "imu", "command", "power"}


def test_rellis_plays_its_roles_by_the_topics_of_its_readme() -> None:
    recipe = load_recipe(PIPELINES / "rellis-3d.toml")
    sensors = {
        "/imu/data": "Imu", "/imu/data_raw": "Imu", "/os1_cloud_node/imu": "Imu", "/vectornav/IMU": "Imu", "/vectornav/GPS": "NavSatFix",
    }  # fmt: skip
    kinds = {name: f"sensor_msgs/msg/{kind}" for name, kind in sensors.items()}
    odometry = ("/odometry/filtered", "/vectornav/Odom", "/warthog_velocity_controller/odom")
    kinds |= dict.fromkeys(odometry, "nav_msgs/msg/Odometry")
    kinds |= {f"/{side}_drive/status/battery_{what}": "std_msgs/msg/Float64" for what in VI for side in SIDES}
    kinds |= {
        "/mcu/status": "warthog_msgs/msg/Status",
        "/warthog_velocity_controller/cmd_vel": "geometry_msgs/msg/Twist",
    }
    topics = [Topic(name, kind, 600, 0, 60_000_000_000, "ros1", "") for name, kind in kinds.items()]
    found = decide_roles(recipe.read, topics, recipe.robot, known=load_profiles(recipe))
    assert found.problems == ()
    assert set(found.roles) == {"gnss", "imu", "wheel_odometry", "command", "power"}
    assert len(found.roles["power"].topics) == 4


def test_schedulers_call_commands_and_options_that_exist() -> None:
    """Their own parsers read them in addition (systemd-analyze verify, crontab -n, bash -n), where those are."""
    checks = {
        "nightly.sh": ["bash", "-n"],
        "slurm/night.sbatch": ["bash", "-n"],
        "slurm/cluster.sbatch": ["bash", "-n"],
        "crontab": ["crontab", "-n"],
        "systemd/tcpipe-night.timer": ["systemd-analyze", "calendar"],
    }
    seen = 0
    for path in (PIPELINES / name for name in checks):
        for call in re.findall(r"\b(?:tcpipe|run) (ingest|build-dataset|status)\b([^;|>&\n]*)", path.read_text()):
            options = {option for of in cli.commands[call[0]].params for option in of.opts}
            given = set(re.findall(r"--[a-z-]+", call[1]))
            assert given <= options, (path, call)
            assert call[0] != "ingest" or "--existing-store" in given, path
            seen += 1
    assert seen >= 5
    for name, checker in checks.items():
        if shutil.which(checker[0]):
            what = "*-*-* 02:15:00" if checker[1] == "calendar" else PIPELINES / name
            assert subprocess.run([*checker, what], capture_output=True, check=False).returncode == 0
    assert "OnCalendar=*-*-* 02:15:00\n" in (PIPELINES / "systemd/tcpipe-night.timer").read_text()


def test_the_dagster_definitions_import_only_the_public_api() -> None:
    tree = ast.parse((PIPELINES / "dagster/definitions.py").read_text())
    modules = {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    modules |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {name for name in modules if name.partition(".")[0] not in sys.stdlib_module_names} == {"dagster", "tcpipe"}
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "tcpipe"
    }
    assert used <= set(tcpipe.__all__)


def test_fau_and_borealtc_map_the_columns_that_are_published(tmp_path: Path) -> None:
    fau, borealtc = (load_recipe(PIPELINES / f"{name}.toml") for name in ("fau", "borealtc"))
    fixes, seconds = (fau.tables[name] for name in ("gnss", "imu"))
    for table, head, row in (
        (fixes, "timestamp (ns),latitude (deg),longitude (deg),alt_msl (m),fix_quality", "26.37,-80.1,2.6,4"),
        (seconds, ",".join(("timestamp (ns)", "Power (w)", *seconds.columns.values())), "53.4" + ",0.1" * 10),
    ):
        path = tmp_path / table.file
        path.parent.mkdir(parents=True)
        rows = (f"{1763501392569776384 + k * 10**8},{row}\n" for k in range(30))
        path.write_text(f"{head}\n{''.join(rows)}", encoding="utf-8")
    assert played(fau, open_tables(tmp_path, fau.tables)) == {"gnss", "imu", "power"}
    (tmp_path / "imu_03.csv").write_text(
        "time,wx,wy,wz,ax,ay,az\n" + "".join(f"{k / 100},0,0,0,0,0,9.8\n" for k in range(99))
    )
    (tmp_path / "pro_03.csv").write_text(
        "time,curL,curR,velL,velR\n" + "".join(f"{k / 6.5},4,5,1,1.5\n" for k in range(20))
    )
    with open_logs([tmp_path / "pro_03.csv"], tables=borealtc.tables) as log:
        assert played(borealtc, log) == {"imu", "wheel_odometry", "power"}
        wheels = log.tables(["/wheel_odometry"])["/wheel_odometry"]
    assert wheels["twist.twist.linear.x"][0].as_py() == 1.25
    assert wheels["twist.twist.angular.z"][0].as_py() == pytest.approx(0.5 / 0.85)


def test_enav_plays_its_roles_by_the_topics_of_its_loader() -> None:
    recipe = load_recipe(PIPELINES / "enav.toml")
    kinds = {
        "/gps": "sensor_msgs/msg/NavSatFix",
        "/imu": "sensor_msgs/msg/Imu",
        "/husky_velocity_estimate": "nav_msgs/msg/Odometry",
        "/husky_commanded_velocity": "geometry_msgs/msg/Twist",
        "/status": "husky_msgs/msg/HuskyStatus",
        "/joint_states": "sensor_msgs/msg/JointState",
        "/global_odometry_utm": "nav_msgs/msg/Odometry",
        "/relative_sun_orientation": "geometry_msgs/msg/PoseStamped",
        "/global_sun_orientation": "geometry_msgs/msg/PoseStamped",
    }
    topics = [Topic(name, kind, 600, 0, 60_000_000_000, "ros1", "") for name, kind in kinds.items()]
    found = decide_roles(recipe.read, topics, recipe.robot, known=load_profiles(recipe))
    assert found.problems == ()
    assert {role: of.topics for role, of in found.roles.items()} == {
        "gnss": ("/gps",),
        "imu": ("/imu",),
        "wheel_odometry": ("/husky_velocity_estimate",),
        "command": ("/husky_commanded_velocity",),
        "power": ("/status",),
    }
