"""The installed command in the hands of someone who trusts nothing: bad input, signals, races, odd names, full disks."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import rasterio
from installed_command import COMMAND, HANGS_S, plain_lines, run_script, tcpipe, told
from stored_files import map_path, only_run, tables

from tcpipe.formats.logs.writing import write_mcap
from tcpipe.simulation import Faults, SimulatedSite, make_tiny, simulate
from tcpipe.simulation.scenarios import RasterSpec
from tcpipe.simulation.site_files import simulate_messages
from tcpipe.store import Store

_SECONDS = (32.0, 17.0, 17.0)


@pytest.fixture(scope="session")
def sites(tmp_path_factory: pytest.TempPathFactory) -> list[SimulatedSite]:
    """Three short drives over one small world; the first is long enough for some segments."""
    here = tmp_path_factory.mktemp("sites")
    first, *others = (make_tiny(Faults(), seconds=seconds) for seconds in _SECONDS)
    coarse = [replace(scenario, rasters=RasterSpec(1.0, 1.0, 1.0)) for scenario in others]
    return [simulate(here / str(seed), scenario=each, seed=seed) for seed, each in enumerate((first, *coarse))]


@pytest.fixture(scope="session")
def log(sites: list[SimulatedSite]) -> Path:
    return sites[0].logs[0]


@pytest.fixture(scope="session")
def logs(sites: list[SimulatedSite], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The drives' logs in one folder, under names of their own."""
    folder = tmp_path_factory.mktemp("logs")
    paths = [folder / f"run{number}.mcap" for number in range(len(sites))]
    for path, site in zip(paths, sites, strict=True):
        shutil.copy(site.logs[0], path)
    return paths


@pytest.fixture(scope="session")
def store(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with one run; tests read it only."""
    here = tmp_path_factory.mktemp("store")
    _run("ingest", log, "--tag", "weather=dry", cwd=here)
    return here / "tcpipe-store"


def _run(*arguments: str | Path, cwd: Path, env: Mapping[str, str] | None = None) -> str:
    done = tcpipe(*arguments, cwd=cwd, env=env)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _start(*arguments: str | Path, cwd: Path, env: Mapping[str, str] | None = None) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [COMMAND, *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, **(env or {})},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def _files(directory: Path) -> set[str]:
    return {path.relative_to(directory).as_posix() for path in directory.rglob("*") if path.is_file()}


def _list_payload(directory: Path) -> set[str]:
    """The files that are no documents on calls and logs."""
    return {name for name in _files(directory) if not name.startswith(("tcpipe-store/calls/", "tcpipe-store/seen/"))}


def _written(directory: Path) -> dict[Path, int]:
    """When each file was written, but for the history, which has every call."""
    files = (path for path in directory.rglob("*") if path.is_file() and path.parent.name != "calls")
    return {path: path.stat().st_mtime_ns for path in files}


# --- bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said", "code"),
    [
        (["ingest"], "Missing argument", 2),
        (["ingest", "LOG", "--nosuch"], "No such option", 2),
        (["nosuch"], "No such command", 2),
        (["ingest", "LOG", "--store", ""], "is a variable not set?", 2),
        (["ingest", "LOG", "--tag", "=wet"], "expected KEY=VALUE", 2),
        (["ingest", "LOG", "--robot", "nosuch"], "robot 'nosuch' is not known", 2),
        (["ingest", "LOG", "--store", "LOG"], "is a file, expected a directory", 2),
        (["inspect", "nosuch"], "there is no such file", 2),
        (["inspect", "/dev/null"], "a pipe or a device", 1),
        (["export", "LOG", "out", "--topics", "/nosuch"], "topic /nosuch is not in this log", 1),
        (["export", "LOG", "LOG/below"], "is a file, expected a directory", 2),
        (["simulate", "out", "--scenario", "nosuch"], "scenario 'nosuch' is unknown", 2),
        (["simulate", ".."], "is no site of scenario demo", 2),
        (["add-map", "m", "--height", "LOG"], "not a raster", 1),
    ],
)
def test_what_cannot_be_done_is_one_line_and_an_exit_code(
    arguments: list[str], said: str, code: int, log: Path, tmp_path: Path
) -> None:
    arguments = [argument.replace("LOG", str(log)) for argument in arguments]
    here = tmp_path / "here"
    here.mkdir()
    as_json = arguments[0] in ("ingest", "inspect", "add-map", "simulate")
    done = tcpipe(*arguments, *(["--json"] if as_json else []), cwd=here)
    assert said in plain_lines(done, code, most=1)
    if as_json:
        answer = json.loads(done.stdout)
        assert answer["exit_code"] == code
        assert said in answer["problems"][0]
    assert not any(path.is_file() for path in here.rglob("*"))


def test_a_raster_without_crs_and_a_map_that_is_there(sites: list[SimulatedSite], tmp_path: Path) -> None:
    with rasterio.open(sites[0].rasters["height"]) as raster:
        profile, data = raster.profile, raster.read()
    profile.pop("crs")
    with rasterio.open(tmp_path / "nocrs.tif", "w", **profile) as raster:
        raster.write(data)
    assert "has no CRS" in plain_lines(tcpipe("add-map", "m", "--height", "nocrs.tif", cwd=tmp_path), 1, most=1)
    add = ["add-map", "m", "--height", "nocrs.tif", "--crs", "EPSG:32633"]
    _run(*add, cwd=tmp_path)
    before = _list_payload(tmp_path)
    assert "nothing to do" in _run(*add, cwd=tmp_path)
    assert _list_payload(tmp_path) == before


# --- what is printed ------------------------------------------------------------------------------------------------


def test_json_is_an_object_a_log_and_one_of_all_and_quiet_says_only_what_is_news(
    logs: list[Path], tmp_path: Path
) -> None:
    damaged, junk = tmp_path / "cut.mcap", tmp_path / "junk.bag"
    damaged.write_bytes(logs[1].read_bytes()[:-200_000])
    junk.write_bytes(b"junk" * 100)
    statuses = ["damaged", "failed", "done"], ["unchanged", "failed", "unchanged"]
    for status, code in zip(statuses, (3, 0), strict=True):
        done = tcpipe("ingest", damaged, junk, logs[2], "--json", "--quiet", cwd=tmp_path)
        assert done.returncode == code
        of_all = told(done)
        assert [result["status"] for result in of_all["results"]] == status
        assert (of_all["exit_code"], of_all["recipe"]) == (code, "built-in defaults")
        assert of_all["results"][0]["run"]["damage"]
        assert "junk.bag" in of_all["results"][1]["problems"][0]
        assert [result["known"] for result in of_all["results"]] == [code == 0, code == 0, False]
        lines = done.stderr.splitlines()
        assert [line.startswith(f"tcpipe: {junk}: not a log") for line in lines] == [True] * (code == 3)


def test_quiet_prints_no_line_for_an_unchanged_log(log: Path, store: Path, tmp_path: Path) -> None:
    shutil.copytree(store, tmp_path / "tcpipe-store")
    assert "unchanged " in _run("ingest", log, cwd=tmp_path)
    lines = _run("ingest", log, "--quiet", cwd=tmp_path).splitlines()
    assert [line.split(":")[0] for line in lines] == ["recipe", "nothing to do"]


def test_nobody_listening_is_no_reason_to_stop(logs: list[Path], tmp_path: Path) -> None:
    """The work is complete with standard error closed, and with an unread pipe."""
    closed = f"{COMMAND} ingest {logs[1]} --store closed 2>&-"
    subprocess.run(["bash", "-c", closed], cwd=tmp_path, check=False, stdout=subprocess.DEVNULL)
    run_script(f"tcpipe ingest {logs[1]} --store unread 2>&1 | head -c1", cwd=tmp_path, env=dict(os.environ))
    assert [len(tables(tmp_path / name)) for name in ("closed", "unread")] == [1, 1]
    full = subprocess.run(
        ["bash", "-c", f"{COMMAND} inspect {logs[1]} --json >/dev/full"], check=False, stderr=-1, text=True
    )
    assert full.returncode == 1
    assert full.stderr == "tcpipe: No space left on device\n"


def test_it_is_a_module_too(tmp_path: Path) -> None:
    said = [
        subprocess.run([*command, "--version"], cwd=tmp_path, capture_output=True, check=True).stdout
        for command in ([sys.executable, "-m", "tcpipe"], [COMMAND])
    ]
    assert said[0] == said[1] == tcpipe("--version", cwd=tmp_path).stdout.encode() != b""


# --- names, twins and parts -----------------------------------------------------------------------------------------


def test_one_recording_is_one_run_under_any_name(log: Path, tmp_path: Path) -> None:
    names = [b"a\xff.mcap", "日本 'q\".mcap".encode(), b"new\nline.mcap", b"UPPER.MCAP"]
    (tmp_path / "logs" / "below").mkdir(parents=True)
    for name in names:
        shutil.copy(log, os.fsencode(tmp_path / "logs" / "below") + b"/" + name)
    (tmp_path / "logs" / "link.mcap").symlink_to(log)
    (tmp_path / "logs" / "loop").symlink_to(tmp_path / "logs")
    (tmp_path / "logs" / "dangling.mcap").symlink_to(tmp_path / "nowhere.mcap")
    done = tcpipe("ingest", "logs", log, log, "--json", cwd=tmp_path)
    results = told(done)["results"]
    assert Counter(result["status"] for result in results) == {"done": 1, "unchanged": 4, "failed": 1}
    assert {result["run"]["run_id"] for result in results if result["status"] != "failed"} == {
        results[0]["run"]["run_id"]
    }
    assert sum(result["same_as"] is not None for result in results) == 4
    assert f"dangling.mcap: is a link to {tmp_path / 'nowhere.mcap'}, which is not there" in done.stderr
    assert done.returncode == 3
    again = tcpipe("ingest", "logs/below", cwd=tmp_path)
    assert again.returncode == 0
    assert "nothing to do: 4 of 4 logs" in again.stdout
    assert "new\\nline.mcap is a duplicate of" in again.stdout
    assert len(Store(tmp_path / "tcpipe-store").runs()) == 1


def test_power_logged_apart_is_one_drive(store: Path, tmp_path: Path) -> None:
    drive, power = tmp_path / "drive.mcap", tmp_path / "power.mcap"
    _, messages = simulate_messages(make_tiny(Faults(), seconds=_SECONDS[0]), seed=0)
    write_mcap(drive, [stream for stream in messages if "power" not in stream.topic])
    write_mcap(power, [stream for stream in messages if "power" in stream.topic])
    for paths in itertools.permutations((drive, power)):
        _run("ingest", *paths, "--as-one", "--store", "joined", cwd=tmp_path)
    found = [
        only_run(place).segments().drop_columns(["segment_id", "run_id"]) for place in (store, tmp_path / "joined")
    ]
    assert found[0].num_rows > 0
    assert found[0].equals(found[1])
    assert len(Store(tmp_path / "joined").runs()) == 1
    shutil.copy(drive, tmp_path / "twin.mcap")
    twice = tcpipe("ingest", drive, tmp_path / "twin.mcap", "--as-one", cwd=tmp_path)
    assert "the same recording as" in plain_lines(twice, 1, most=1)


# --- where things are found and kept --------------------------------------------------------------------------------


def test_recipe_and_store_of_the_environment_rule(logs: list[Path], tmp_path: Path) -> None:
    for name, chord_m in (("tcpipe.toml", 2.0), ("other.toml", 1.5)):
        (tmp_path / name).write_text(f"[segment]\nchord_m = {chord_m}\n")
    env = {"TCPIPE_RECIPE": str(tmp_path / "other.toml"), "TCPIPE_STORE": str(tmp_path / "elsewhere")}
    assert f"recipe: {tmp_path / 'other.toml'}" in _run("ingest", logs[1], "--quiet", cwd=tmp_path, env=env)
    assert only_run(tmp_path / "elsewhere").manifest.recipe.segment.chord_m == 1.5
    assert not (tmp_path / "tcpipe-store").exists()


def test_tags_are_kept_and_changed_without_doing_the_work_again(log: Path, store: Path, tmp_path: Path) -> None:
    shutil.copytree(store, tmp_path / "tcpipe-store")
    (segments,) = tables(tmp_path / "tcpipe-store")
    made = segments.stat().st_mtime_ns
    _run("ingest", log, "--tag", "driver=x", cwd=tmp_path)
    assert "nothing to do" in _run("ingest", log, cwd=tmp_path)
    assert segments.stat().st_mtime_ns == made
    run = only_run(tmp_path / "tcpipe-store")
    assert run.manifest.tags == run.facts.tags == {"weather": "dry", "driver": "x"}


# --- looking at what is there ---------------------------------------------------------------------------------------


def test_everything_can_be_inspected_and_a_second_call_of_anything_does_nothing(
    sites: list[SimulatedSite], store: Path, tmp_path: Path
) -> None:
    shutil.copytree(store, tmp_path / "tcpipe-store")
    site = sites[0]
    commands = [
        ["init"],
        ["add-map", "site", *(str(x) for name in ("height", "ortho") for x in (f"--{name}", site.rasters[name]))],
        ["build-dataset", "--holdout", "sample"],
        ["report", "tcpipe-store", "--no-runs"],
        ["report", "tcpipe-store"],
        ["simulate", "site", "--scenario", "tiny", "--quiet"],
    ]
    for command in commands:
        _run(*command, "--seed", "3", cwd=tmp_path) if command[0] == "simulate" else _run(*command, cwd=tmp_path)
    before = _written(tmp_path)
    for command in commands:
        seed = ["--seed", "3"] if command[0] == "simulate" else []
        assert "nothing to do" in _run(*command, *seed, cwd=tmp_path), command
    assert _written(tmp_path) == before
    run = only_run(tmp_path / "tcpipe-store")
    expected = {
        "tcpipe-store": run.run_id,
        str(map_path(tmp_path / "tcpipe-store", "site")): "EPSG:32633",
        "dataset": run.run_id,
        run.run_id: "weather=dry",
        run.name: "m kept",
        "site": "wheel_odometry",
    }
    for path, said in expected.items():
        assert said in _run("inspect", path, cwd=tmp_path)


def test_a_damaged_log_can_be_looked_at(log: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(log.read_bytes()[:-200_000])
    (tmp_path / "junk.bag").write_bytes(b"junk" * 100)
    assert tcpipe("inspect", "cut.mcap", "--full", cwd=tmp_path).returncode == 3
    both = tcpipe("inspect", ".", cwd=tmp_path)
    assert both.returncode == 3
    assert "not a log" in both.stdout
    exported = tcpipe("export", "cut.mcap", "out", "--topics", "/a200_0000/platform/odom", cwd=tmp_path)
    assert exported.returncode == 3
    assert "damage: cut.mcap" in exported.stderr
    assert pq.read_metadata(tmp_path / "out" / "a200_0000_platform_odom.parquet").num_rows > 100


# --- signals and other processes ------------------------------------------------------------------------------------


def _processes_of(group: int) -> list[str]:
    listed = subprocess.run(["ps", "-eo", "pgid=,stat=,args="], capture_output=True, text=True, check=True).stdout
    rows = [line.split(None, 2) for line in listed.splitlines()]
    return [row[2] for row in rows if int(row[0]) == group and not row[1].startswith("Z")]


def _wait_until_fusing(running: subprocess.Popen[str]) -> None:
    assert running.stderr is not None
    for line in running.stderr:
        if "fusing" in line:
            return


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_batch_that_is_ended_goes_on_where_it_was(number: signal.Signals, logs: list[Path], tmp_path: Path) -> None:
    running = _start("ingest", *logs[1:], "--jobs", "2", cwd=tmp_path)
    _wait_until_fusing(running)
    running.send_signal(number)
    _, told = running.communicate(timeout=HANGS_S)
    if number != signal.SIGKILL:
        assert running.returncode == 128 + number
        assert "no output is incomplete" in told
        assert "Traceback" not in told
    end = time.monotonic() + 20
    while _processes_of(running.pid):
        assert time.monotonic() < end, _processes_of(running.pid)
        time.sleep(0.05)
    _run("ingest", *logs[1:], cwd=tmp_path)  # which also removes what a worker had begun
    assert len(tables(tmp_path / "tcpipe-store")) == len(logs[1:])
    assert not list(tmp_path.rglob(".tmp-*"))
