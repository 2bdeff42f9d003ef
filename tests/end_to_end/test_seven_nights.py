"""The crontab as cron runs it, over seven nights: what it mails, and what the dataset contains in the morning.

Each night runs the job of `pipelines/crontab` in a process of its own, with the environment that cron gives it and a clock that is days
ahead. Cron mails what the job prints.
"""

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import pytest
from installed_command import COMMAND, HANGS_S

import tcpipe
from tcpipe.pipeline.maps import add_map
from tcpipe.simulation import Faults, make_tiny, messages, simulate

ROOT = Path(__file__).resolve().parents[2]
PIPELINES = ROOT / "pipelines"
_DAY_S = 86_400
_DISK_BYTES = 64 << 20

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
    """Fill the disk; yield what a job has to begin with where only a limit on the size of files can stand in for that."""
    if not data.is_mount():
        yield "ulimit -f 16; "
        return
    filler = data / "filler"
    filler.write_bytes(bytes(shutil.disk_usage(data).free))
    yield ""
    filler.unlink()


@dataclass(frozen=True)
class Morning:
    """What a night left."""

    mail: str
    exit_code: int
    samples: int


class Crontab:
    """The job of `pipelines/crontab` on another directory, night after night."""

    def __init__(self, data: Path, tmp_path: Path) -> None:
        """Copy the job's program, so that it can be changed as a user changes it."""
        self._data, self._bin = data, tmp_path / "bin"
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
            "PYTHONPATH": f"{tmp_path / 'clock'}:{Path(tcpipe.__file__).parents[1]}",
        }
        self._night = 0

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

    def run(self, before: str = "") -> Morning:
        """Run a whole night."""
        with self.start(before) as job:
            mail = job.communicate(timeout=HANGS_S)[0]
        card = self._data / "dataset" / "dataset.json"
        return Morning(mail, job.returncode, json.loads(card.read_text())["samples"] if card.exists() else 0)

    def by_hand(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a command as the user does in the morning, who works in the directory."""
        environment = self._environment | {"CLOCK_AHEAD_S": str(self._night * _DAY_S + _DAY_S // 4)}
        return subprocess.run(
            [COMMAND, *arguments], cwd=self._data, env=environment, capture_output=True, text=True, check=False
        )

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


SILENT = ("", 0)


def test_seven_nights(crontab: Crontab, data: Path, drives: dict[str, Path]) -> None:
    recordings = data / "recordings"
    recordings.mkdir()
    (data / "tcpipe.toml").write_text('[split]\nholdout = "sample"\n')

    # No store: the disk with it is not mounted. Nothing is made in its place.
    shutil.copy(drives["first"], recordings / "first.mcap")
    morning = crontab.run()
    assert "tcpipe ingest recordings --existing-store" in morning.mail
    assert f"{data}/store" in morning.mail
    assert (morning.exit_code, (data / "store").exists()) == (1, False)
    add_map("site", **{layer: drives[layer] for layer in ("height", "terrain", "classes")}, store=data / "store")

    # 1. A new log.
    morning = crontab.run()
    assert (morning.mail, morning.exit_code) == SILENT
    first = morning.samples
    assert first > 0

    # 2. A damaged log: it is named, what can be read is used, and it is named again until somebody acknowledges it.
    (recordings / "second.mcap").write_bytes(drives["second"].read_bytes()[:500_000])
    morning = crontab.run()
    assert "tcpipe ingest recordings --existing-store --jobs 1 --min-age 10m --quiet: exit code 3\n" in morning.mail
    assert "second.mcap: the file ends inside a chunk or record" in morning.mail
    assert "tcpipe build-dataset" not in morning.mail
    assert "tcpipe status: exit code 3\n" in morning.mail
    assert morning.samples > first
    crontab.by_hand("acknowledge", "recordings/second.mcap").check_returncode()

    # 3. A second robot: the dataset stays as it is, and every night says so until the job names a robot.
    before = morning.samples
    shutil.copy(drives["jackal"], recordings / "jackal.mcap")
    morning = crontab.run()
    assert "tcpipe build-dataset dataset --jobs 1 --quiet: exit code 1\n" in morning.mail
    assert "runs of 2 robots (husky, jackal); name one with --robot" in morning.mail
    assert (morning.samples, "tcpipe ingest" in morning.mail) == (before, False)
    # Status of outputs: "tcpipe status: exit code 3" in the mail, and `crontab.by_hand("status").returncode == 3`.
    crontab.change_program("build-dataset dataset", "build-dataset dataset --robot husky")

    # 4. The recipe changes: its runs are made, the dataset is not replaced before somebody asks for it.
    (data / "tcpipe.toml").write_text('[split]\nholdout = "sample"\n[mask]\nrequire_full_speed = false\n')
    morning = crontab.run()
    assert "tcpipe build-dataset dataset --robot husky --jobs 1 --quiet: exit code 2\n" in morning.mail
    assert "recipe mask.require_full_speed: yes in the dataset, no now" in morning.mail
    assert (morning.samples, "tcpipe ingest" in morning.mail) == (before, False)
    # Status of outputs: "tcpipe status: exit code 3" in the mail, and `crontab.by_hand("status").returncode == 3`.
    crontab.by_hand("build-dataset", "dataset", "--robot", "husky", "--force").check_returncode()

    # 5. A full disk: each command that failed says so; the next night completes the work.
    shutil.copy(drives["third"], recordings / "third.mcap")
    with full_disk(data) as limit:
        morning = crontab.run(limit)
    assert "tcpipe ingest recordings" in morning.mail
    assert "third.mcap: " in morning.mail
    assert ("No space left on device" if data.is_mount() else "File too large") in morning.mail
    assert morning.exit_code == 1

    # 6. The log of a complete run is archived. The third log, which had no room, is ingested now.
    (recordings / "first.mcap").unlink()
    morning = crontab.run()
    assert (morning.mail, morning.exit_code) == SILENT
    assert morning.samples > before
    assert not [*data.rglob(".tmp-*")]

    # 7. A night that hangs: the next one does not start beside it, and shows what it printed.
    hung = crontab.add_program("tcpipe", "#!/bin/sh\necho reading third.mcap\nexec sleep 3600\n")
    with crontab.start() as sleeping:
        while "reading" not in "".join(path.read_text() for path in (data / "night").glob("ingest.txt")):
            time.sleep(0.05)
        hung.unlink()
        complete, morning = morning.samples, crontab.run()
        assert "An earlier night still runs. It has printed:\nreading third.mcap\n" in morning.mail
        assert (morning.exit_code, morning.samples) == (1, complete)
        os.killpg(sleeping.pid, signal.SIGKILL)
    morning = crontab.run()
    assert (morning.mail, morning.exit_code, morning.samples) == (*SILENT, complete)
