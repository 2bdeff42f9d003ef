"""A package reads a file format of its own by an entry point: `tests/reader_package` is one, installed but for pip."""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from installed_command import tcpipe
from package_source import PACKAGE

from tcpipe import ingest, read_log
from tcpipe.errors import LogError
from tcpipe.formats.logs import table_folders
from tcpipe.formats.logs.log_file import find_logs
from tcpipe.pipeline.export import export
from tcpipe.store import Store

READER = Path(__file__).parents[1] / "reader_package"
LATITUDE_DEG, LONGITUDE_DEG, METRES_OF_DEGREE = -43.5, 172.5, 80_830.0


def write_drive(path: Path) -> Path:
    """Write 10 s of standing and 40 s eastward at 1 m/s, 100 W in motion."""
    noise, lines = np.random.default_rng(0), []
    for tick in range(1000):
        time = tick * 0.05
        moves = time >= 10.0
        place = {"kind": "gps", "lat": LATITUDE_DEG, "height": 30.0 + 0.02 * noise.standard_normal()}
        place["lon"] = LONGITUDE_DEG + (max(time - 10.0, 0.0) + 0.01 * noise.standard_normal()) / METRES_OF_DEGREE
        lines.append({"kind": "wheels", "speed": 1.0 * moves, "turn": 0.001 * noise.standard_normal()})
        lines += [place, {"kind": "battery", "volt": 25.0, "amp": -0.4 - 3.6 * moves}] if tick % 4 == 0 else []
        for line in lines[-3:]:
            line.setdefault("time", 1.7e9 + time)
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    return path


@pytest.fixture
def installed(monkeypatch):
    """Put the package where Python finds it, and search again."""
    monkeypatch.syspath_prepend(str(READER))
    table_folders._list_readers.cache_clear()
    yield
    table_folders._list_readers.cache_clear()


@pytest.fixture
def install(monkeypatch, tmp_path, installed):
    """Return a function that installs a package whose reader of ``.mine`` has the given code, and returns such a file."""

    def add(code: str, package: str = "broken-lines") -> Path:
        module = package.replace("-", "_")
        about = tmp_path / package / f"{module}-1.0.dist-info"
        about.mkdir(parents=True)
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(f"[tcpipe.logs]\nmine = {module}:read\n")
        (tmp_path / package / f"{module}.py").write_text(code)
        monkeypatch.syspath_prepend(str(tmp_path / package))
        monkeypatch.delitem(sys.modules, module, raising=False)
        table_folders._list_readers.cache_clear()
        (tmp_path / "a.mine").touch()
        return tmp_path / "a.mine"

    return add


def test_a_log_of_another_package_becomes_segments(tmp_path, installed):
    folder = tmp_path / "logs"
    folder.mkdir()
    log = write_drive(folder / "monday.rover")
    (folder / "notes.md").write_text("no log")
    with read_log(log) as opened:
        assert {topic.name: topic.message_count for topic in opened.topics.values()} == {
            "/gps": 250,
            "/battery": 250,
            "/wheels/odom": 1000,
        }
        fixes = opened.tables(["/gps"])["/gps"]
    assert fixes["log_time_ns"][4].as_py() == 1_700_000_000_800_000_000
    assert fixes["header.frame_id"].to_pylist() == ["gps_link"] * 250

    with read_log(log.as_uri()) as copied:
        assert copied.tables(["/gps"])["/gps"].equals(fixes)

    (result,) = ingest([folder], store=tmp_path / "store").results
    assert (result.status, result.problems) == ("done", ())
    (run,) = Store(tmp_path / "store").runs()
    assert run.run_id.startswith("monday-")
    segments = run.segments()
    assert 35 <= segments.num_rows <= 40
    assert np.median(segments["energy_joule"]) == pytest.approx(100.0, rel=0.05)

    made = export(log, tmp_path / "out", topics=["/battery"])
    assert [(topic.topic, topic.messages) for topic in made.topics] == [("/battery", 250)]
    assert export(log, tmp_path / "out", topics=["/battery"]).status == "unchanged"


def test_the_command_finds_the_package_by_the_path_of_python(tmp_path):
    log = write_drive(tmp_path / "monday.rover")
    path = os.pathsep.join((str(PACKAGE.parent), str(READER)))
    found = json.loads(tcpipe("inspect", log, "--json", cwd=tmp_path, env={"PYTHONPATH": path}).stdout)
    assert found["container"] == "rover"
    assert {topic["role"] for topic in found["topics"]} == {"gnss", "power", "wheel_odometry"}


def test_without_the_package_the_file_is_no_log(tmp_path):
    table_folders._list_readers.cache_clear()
    done = tcpipe("inspect", write_drive(tmp_path / "monday.rover"), cwd=tmp_path)
    assert done.returncode != 0
    assert "monday.rover: not a log: it is" in done.stderr


GOOD_TOPIC = "'/a', 'std_msgs/msg/Float64', [1, 2]"


@pytest.mark.parametrize(
    ("code", "cause"),
    [
        ("import no_such_library", "ModuleNotFoundError: No module named 'no_such_library'"),
        ("READ = 1", "AttributeError: module 'broken_lines' has no attribute 'read'"),
        ("def read(path): raise OSError('two' + chr(10) + 'lines')", r"OSError: two\nlines"),
        ("def read(path): return None", "TypeError: 'NoneType' object is not iterable"),
        ("def read(path): yield '/a', 'T', [1.5], dict", "ValueError: topic /a: expected rising stamps [ns] as int64"),
        ("def read(path): yield '/a', 'T', [2, 1], dict", "got int64 of shape (2,)"),
        ("def read(path): yield '/a', 'T', [], dict", "got float64 of shape (0,)"),
        (
            f"def read(path): yield {GOOD_TOPIC}, lambda: {{'data': [1.0]}}",
            "ArrowInvalid: Column 4 named data expected",
        ),
        (f"def read(path): yield {GOOD_TOPIC}, lambda: 1 / 0", "ZeroDivisionError: division by zero"),
    ],
)
def test_an_error_of_a_reader_names_its_package_and_entry_point(install, code, cause):
    log = install(code)
    with pytest.raises(LogError) as caught, read_log(log) as opened:
        opened.tables(list(opened.topics))
    (line,) = caught.value.problems
    assert line.startswith(f"{log}: cannot be read by package broken-lines, entry point mine = broken_lines:read: "), (
        line
    )
    assert cause in line
    assert line.endswith("; correct or uninstall that package")


def test_a_reader_may_say_itself_what_is_wrong(install):
    log = install("from tcpipe.errors import LogError\ndef read(path): raise LogError(f'{path}: no header')")
    with pytest.raises(LogError, match=r"a\.mine: no header$"):
        read_log(log)


def test_two_packages_for_one_suffix_are_named(install):
    install("def read(path): return ()")
    log = install("def read(path): return ()", "other-lines")
    with pytest.raises(LogError, match="several packages read such a file: broken-lines, other-lines; uninstall all"):
        read_log(log)


def test_packages_are_searched_only_for_suffixes_that_tcpipe_does_not_read(tmp_path):
    table_folders._list_readers.cache_clear()
    for name in ("a.mcap", "b.BAG", "c.db3", "d.csv", "e.ulg"):
        (tmp_path / name).touch()
    assert len(find_logs(tmp_path)) == 4
    assert table_folders._list_readers.cache_info().misses == 0
    (tmp_path / "f.other").touch()
    assert len(find_logs(tmp_path)) == 4
    assert table_folders._list_readers.cache_info().misses == 1
