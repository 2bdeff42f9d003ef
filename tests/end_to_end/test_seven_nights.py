"""The crontab as cron runs it, over seven nights: what it mails, and what the dataset contains in the morning.

Each night runs the job of `pipelines/crontab` in a process of its own, with the environment that cron gives it and a clock that is days
ahead. Cron mails what the job prints.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, tzinfo
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from installed_command import COMMAND, HANGS_S, tcpipe

import tcpipe as package
from tcpipe.pipeline.maps import add_map
from tcpipe.simulation import Faults, make_tiny, messages, simulate

ROOT = Path(__file__).resolve().parents[2]
PIPELINES = ROOT / "pipelines"
_DAY_S = 86_400
_DISK_BYTES, _ROOM_BYTES = 64 << 20, 128 << 10

CLOCK = """# Python imports this module when it starts: tcpipe sees a clock that is ahead.
import datetime
import importlib.machinery
import os
import time

_AHEAD_NS = int(os.environ["CLOCK_AHEAD_S"]) * 10**9
_time_ns, _exec_module = time.time_ns, importlib.machinery.SourceFileLoader.exec_module
time.time_ns = lambda: _time_ns() + _AHEAD_NS
time.time = lambda: time.time_ns() / 1e9


class _Later(datetime.datetime):
    @classmethod
    def now(cls, tz=None):
        return cls.fromtimestamp(time.time(), tz)


def _replace_clock(loader, module):
    _exec_module(loader, module)
    if module.__name__.startswith("tcpipe.") and vars(module).get("datetime") is datetime.datetime:
        module.datetime = _Later  # compiled modules need the real one


importlib.machinery.SourceFileLoader.exec_module = _replace_clock
"""


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Three logs of a Husky, one of a Jackal, and the rasters of their site."""
    here = tmp_path_factory.mktemp("drives")
    found = dict[str, Path]()
    for seed, name in enumerate(("first", "second", "third", "jackal"), 1):
        topics = {
            role: topic.replace("a200", "j100" if name == "jackal" else "a200")
            for role, topic in messages.TOPICS["ros2"].items()
        }
        scenario = make_tiny(Faults.every(), seconds=28.0 + 2 * seed)
        with patch.dict(messages.TOPICS, ros2=topics):
            site = simulate(here / name, scenario=scenario, seed=seed)
        found = {name: site.logs[0], **site.rasters, **found}
    return found


@pytest.fixture
def data(tmp_path: Path) -> Iterator[Path]:
    """The directory of the job: a small file system where this user may mount one."""
    place = tmp_path / "data"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={_DISK_BYTES}", "tmpfs", place]
    is_mounted = os.geteuid() == 0 and subprocess.run(mount, capture_output=True, check=False).returncode == 0
    yield place
    if is_mounted:
        subprocess.run(["umount", "--lazy", place], check=True)


@contextmanager
def full_disk(data: Path) -> Iterator[str]:
    """Fill the disk but for a few documents; without a disk of its own, yield a limit on file size for the job."""
    if not data.is_mount():
        yield "ulimit -f 16; "
        return
    filler = data / "filler"
    filler.write_bytes(bytes(shutil.disk_usage(data).free - _ROOM_BYTES))
    yield ""
    filler.unlink()


@contextmanager
def advance_clock(ahead_s: int) -> Iterator[None]:
    """Show tcpipe in this process a clock that is ahead, as `CLOCK` does in others."""
    real_ns = time.time_ns

    class Later(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> "Later":
            return cls.fromtimestamp(real_ns() / 1e9 + ahead_s, tz)

    with (
        patch("time.time_ns", lambda: real_ns() + ahead_s * 10**9),
        patch("time.time", lambda: real_ns() / 1e9 + ahead_s),
        patch("tcpipe.pipeline.calls.datetime", Later),
    ):
        yield


class Crontab:
    """The job of `pipelines/crontab` on another directory, night after night."""

    def __init__(self, data: Path, tmp_path: Path) -> None:
        """Copy the job's program, so that it can be changed as a user changes it."""
        self.data, self.recordings = data, data / "recordings"
        self.recordings.mkdir()
        self._bin = tmp_path / "bin"
        self._bin.mkdir()
        shutil.copy(PIPELINES / "nightly.sh", self._bin)
        self.change_program("--jobs 4", "--jobs 1")
        (tmp_path / "clock").mkdir()
        (tmp_path / "clock" / "sitecustomize.py").write_text(CLOCK)
        lines = [line for line in (PIPELINES / "crontab").read_text().splitlines() if line and line[0] != "#"]
        given = dict(line.split("=", 1) for line in lines if line.partition("=")[0].isidentifier())
        (job,) = [line for line in lines if not line.partition("=")[0].isidentifier()]
        self._job = job.split(maxsplit=5)[5].replace("/data", str(data))
        self._environment = {
            **{name: value.replace("/data", str(data)) for name, value in given.items()},
            "HOME": str(tmp_path),
            "PATH": f"{self._bin}:{COMMAND.parent}:/usr/bin:/bin",
            "PYTHONPATH": f"{tmp_path / 'clock'}:{Path(package.__file__).parents[1]}",
        }
        self._night = 0

    @property
    def samples(self) -> int:
        """Number of samples in the dataset."""
        card = self.data / "dataset" / "dataset.json"
        return int(json.loads(card.read_text())["samples"]) if card.exists() else 0

    def start(self, before: str = "") -> subprocess.Popen[str]:
        """Begin a night, a day after the one before."""
        self._night += 1
        return subprocess.Popen(
            ["sh", "-c", f"{before}{self._job}"],
            cwd=self._environment["HOME"],
            env=self._environment | {"CLOCK_AHEAD_S": str(self._night * _DAY_S)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def run(self, before: str = "") -> tuple[str, int]:
        """Run a whole night; return the mail and the exit code."""
        with self.start(before) as job:
            mail = job.communicate(timeout=HANGS_S)[0]
        return mail, job.returncode

    def run_by_hand(self, *arguments: str, exit_code: int = 0) -> str:
        """Run a command as the user does in the morning, in this process; return what it printed on stdout."""
        environment = {name: value for name, value in self._environment.items() if name != "PYTHONPATH"}
        with advance_clock(self._night * _DAY_S + _DAY_S // 4):
            done = tcpipe(*arguments, cwd=self.data, env=environment)
        assert done.returncode == exit_code, done.stderr
        return done.stdout

    def read_latest_call(self, command: str) -> dict[str, Any]:
        """Return the record of the latest call of a command."""
        history = json.loads(self.run_by_hand("status", "--json", exit_code=3))["history"]
        return next(call for call in history if call["command"] == command)

    def change_program(self, old: str, new: str) -> None:
        """Edit nightly.sh."""
        path = self._bin / "nightly.sh"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    def add_program(self, name: str, text: str) -> Path:
        """Put a program before all others of its name."""
        path = self._bin / name
        path.write_text(text)
        path.chmod(0o755)
        return path


@pytest.fixture
def crontab(data: Path, tmp_path: Path) -> Crontab:
    return Crontab(data, tmp_path)


SLEEPER = """
import os
import time
from pathlib import Path

from tcpipe.formats.recipe_toml import ingest_key, load_recipe
from tcpipe.pipeline.calls import INGEST, record_call
from tcpipe.pipeline.ingest import CallOptions
from tcpipe.store import open_store

options = CallOptions(recipe=ingest_key(load_recipe(Path("tcpipe.toml"))))
with record_call(open_store(os.environ["TCPIPE_STORE"]), INGEST, [str(Path("recordings").absolute())], options):
    print("reading third.mcap", flush=True)
    time.sleep(3600)
"""
"""A call of ingest that hangs."""
Drives = dict[str, Path]
SILENT = ("", 0)


def lack_the_store(crontab: Crontab, drives: Drives) -> None:
    """The disk with the store is not mounted: no store is made in its place."""
    (crontab.data / "tcpipe.toml").write_text('[split]\nholdout = "sample"\n')
    shutil.copy(drives["first"], crontab.recordings / "first.mcap")
    mail, exit_code = crontab.run()
    assert mail.startswith(f"tcpipe: {crontab.data}/store: there is no store here (--existing-store)")
    assert "tcpipe ingest recordings --existing-store" in mail
    assert (exit_code, (crontab.data / "store").exists()) == (1, False)
    layers = {layer: drives[layer] for layer in ("height", "terrain", "classes")}
    add_map("site", **layers, store=crontab.data / "store")


def bring_a_new_log(crontab: Crontab, _: Drives) -> None:
    assert crontab.run() == SILENT
    assert crontab.samples > 0


def bring_a_damaged_log(crontab: Crontab, drives: Drives) -> None:
    """It is named, and what can be read of it is used."""
    before = crontab.samples
    (crontab.recordings / "second.mcap").write_bytes(drives["second"].read_bytes()[:500_000])
    mail, _ = crontab.run()
    assert "tcpipe ingest recordings --existing-store --jobs 1 --min-age 10m --quiet: exit code 3\n" in mail
    assert "second.mcap: the file ends inside a chunk or record" in mail
    assert "tcpipe status: exit code 3\n" in mail
    assert "tcpipe build-dataset" not in mail
    assert crontab.samples > before
    crontab.run_by_hand("acknowledge", "recordings/second.mcap")


def bring_a_second_robot(crontab: Crontab, drives: Drives) -> None:
    """The dataset stays as it is until the job names a robot."""
    before = crontab.samples
    shutil.copy(drives["jackal"], crontab.recordings / "jackal.mcap")
    mail, _ = crontab.run()
    assert "tcpipe build-dataset dataset --jobs 1 --quiet: exit code 1\n" in mail
    assert "runs of 2 robots (husky, jackal); name one with --robot" in mail
    assert ("tcpipe ingest" in mail, crontab.samples) == (False, before)
    assert "tcpipe status: exit code 3\n" in mail
    assert crontab.run_by_hand("status", exit_code=3).startswith(f"to do now: {crontab.data}/dataset: the last call")
    crontab.run_by_hand("acknowledge", "dataset")
    assert crontab.run_by_hand("status").startswith("nothing to do")
    crontab.change_program("build-dataset dataset", "build-dataset dataset --robot husky")


def change_the_recipe(crontab: Crontab, _: Drives) -> None:
    """The runs are made again; the dataset is not replaced before somebody asks for it."""
    before = crontab.samples
    with (crontab.data / "tcpipe.toml").open("a") as recipe:
        recipe.write("[mask]\nrequire_full_speed = false\n")
    mail, _ = crontab.run()
    assert "tcpipe build-dataset dataset --robot husky --jobs 1 --quiet: exit code 2\n" in mail
    assert "recipe mask.require_full_speed: yes in the dataset, no now" in mail
    assert ("tcpipe ingest" in mail, crontab.samples) == (False, before)
    assert "tcpipe status: exit code 3\n" in mail
    assert crontab.read_latest_call("build-dataset")["exit_code"] == 2
    assert crontab.run_by_hand("status", exit_code=3).startswith(f"to do now: {crontab.data}/dataset: the last call")
    crontab.run_by_hand("build-dataset", "dataset", "--robot", "husky", "--force")
    assert crontab.run_by_hand("status").startswith("nothing to do")


def fill_the_disk(crontab: Crontab, drives: Drives) -> None:
    """Each command that fails is named with its reason, though the disk has no room for what it prints."""
    shutil.copy(drives["third"], crontab.recordings / "third.mcap")
    with full_disk(crontab.data) as limit:
        mail, exit_code = crontab.run(limit)
    assert "tcpipe ingest recordings" in mail
    assert "third.mcap: " in mail
    reason = "No space left on device" if crontab.data.is_mount() else "File too large"
    assert reason in mail
    assert "tcpipe status: exit code 3\nto do now: correct the cause, then tcpipe ingest (1 log): " in mail
    assert exit_code == 1
    call = crontab.read_latest_call("ingest")
    assert (call["exit_code"], reason in call["message"]) == (3, True)


def archive_a_log(crontab: Crontab, _: Drives) -> None:
    """The log of a complete run is no longer there; the third log, for which there was no room, is ingested."""
    before = crontab.samples
    (crontab.recordings / "first.mcap").unlink()
    assert crontab.run() == SILENT
    assert crontab.samples > before
    assert not [*crontab.data.rglob(".tmp-*")]


def hang(crontab: Crontab, _: Drives) -> None:
    """The next night does not start beside one that hangs, and shows what that one printed and which call runs.

    The night after is as any other.
    """
    complete = crontab.samples
    sleeper = crontab.add_program("tcpipe", f"#!{sys.executable}\n{SLEEPER}")
    with crontab.start() as hanging:
        while "reading" not in "".join(path.read_text() for path in crontab.data.glob("night/ingest.txt")):
            time.sleep(0.05)
        sleeper.unlink()
        mail, exit_code = crontab.run()
        os.killpg(hanging.pid, signal.SIGKILL)
    subprocess.run(
        ["flock", "--timeout", "20", crontab.data / "night" / "lock", "true"], check=True
    )  # until all are gone
    assert "An earlier night still runs. It has printed:\nreading third.mcap\n" in mail
    assert "\nrunning: ingest of " in mail
    assert exit_code == 1
    assert crontab.run() == SILENT
    assert crontab.samples == complete


def test_seven_nights(crontab: Crontab, drives: Drives) -> None:
    for night in (
        lack_the_store,
        bring_a_new_log,
        bring_a_damaged_log,
        bring_a_second_robot,
        change_the_recipe,
        fill_the_disk,
        archive_a_log,
        hang,
    ):
        night(crontab, drives)
