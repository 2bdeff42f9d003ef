"""The job of `pipelines/crontab`, night after night: what it mails, and what the dataset contains in the morning.

Cron mails what the job prints. Each ``tcpipe`` of the job is done in this process.
"""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from installed_command import run_script, tcpipe

import tcpipe as package
from tcpipe.pipeline.maps import add_map
from tcpipe.simulation import Faults, SimulatedSite, make_tiny, simulate

PIPELINES = Path(__file__).resolve().parents[2] / "pipelines"
SILENT = ("", 0)
AGE_S = 3600.0
"""Age of a log: the job leaves logs alone that may still be written."""


@pytest.fixture(scope="module")
def sites(tmp_path_factory: pytest.TempPathFactory) -> list[SimulatedSite]:
    """Three drives over one small world."""
    here = tmp_path_factory.mktemp("sites")
    seconds = {seed: make_tiny(Faults.every(), seconds=28.0 + 2 * seed) for seed in (1, 2, 3)}
    return [simulate(here / str(seed), scenario=scenario, seed=seed) for seed, scenario in seconds.items()]


class Crontab:
    """The job of `pipelines/crontab` on another directory."""

    def __init__(self, data: Path, programs: Path) -> None:
        """Copy the job's program, so that it runs one process at a time."""
        self.data, self.recordings, self.programs = data, data / "recordings", programs
        self.recordings.mkdir(parents=True)
        programs.mkdir()
        program = (PIPELINES / "nightly.sh").read_text()
        assert "--jobs 4" in program
        self.add_program("nightly.sh", program.replace("--jobs 4", "--jobs 1"))
        lines = [line for line in (PIPELINES / "crontab").read_text().splitlines() if line and line[0] != "#"]
        given = dict(line.split("=", 1) for line in lines if line.partition("=")[0].isidentifier())
        (job,) = [line for line in lines if not line.partition("=")[0].isidentifier()]
        self.job = job.split(maxsplit=5)[5].replace("/data", str(data))
        self.environment = {name: value.replace("/data", str(data)) for name, value in given.items()}
        self.environment |= {"HOME": str(data.parent), "PATH": f"{programs}:/usr/bin:/bin"}

    @property
    def samples(self) -> int:
        """Number of samples in the dataset."""
        card = self.data / "dataset" / "dataset.json"
        return int(json.loads(card.read_text())["samples"]) if card.exists() else 0

    def add_program(self, name: str, text: str) -> Path:
        """Put a program before all others of its name."""
        path = self.programs / name
        path.write_text(text)
        path.chmod(0o755)
        return path

    def add_log(self, name: str, content: bytes) -> None:
        """Write a log that nobody writes any more."""
        path = self.recordings / name
        path.write_bytes(content)
        os.utime(path, (time.time() - AGE_S,) * 2)

    def run(self) -> tuple[str, int]:
        """Run a night; return the mail and the exit code."""
        printed = run_script(f'{self.job}; echo "ended with $?"', cwd=self.data.parent, env=self.environment)
        mail, _, code = printed.rpartition("ended with ")
        return mail, int(code)

    def run_by_hand(self, *arguments: str) -> None:
        """Run a command as the user does in the morning."""
        done = tcpipe(*arguments, cwd=self.data, env=self.environment)
        assert done.returncode == 0, done.stderr


@contextmanager
def full_disk() -> Iterator[None]:
    """Limit the size of files that this process writes, which stands for a disk with little room."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (16_384, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


HANGING_INGEST = f"""#!{sys.executable}
import os, sys, time
from pathlib import Path

sys.path.insert(0, {str(Path(package.__file__).parents[1])!r})
from tcpipe.formats.recipe_toml import ingest_key, load_recipe
from tcpipe.pipeline.calls import INGEST, record_call
from tcpipe.pipeline.ingest import CallOptions
from tcpipe.store import open_store

options = CallOptions(recipe=ingest_key(load_recipe(Path("tcpipe.toml"))))
with record_call(open_store(os.environ["TCPIPE_STORE"]), INGEST, [str(Path("recordings").absolute())], options):
    print("reading third.mcap", flush=True)
    time.sleep(3600)
"""


def lack_the_store(crontab: Crontab, sites: list[SimulatedSite]) -> None:
    """The disk with the store is not mounted: no store is made in its place."""
    (crontab.data / "tcpipe.toml").write_text('[split]\nholdout = "sample"\n')
    crontab.add_log("first.mcap", sites[0].logs[0].read_bytes())
    mail, exit_code = crontab.run()
    assert mail.startswith(f"tcpipe: {crontab.data}/store: there is no store here (--existing-store)")
    assert "tcpipe ingest recordings --existing-store" in mail
    assert (exit_code, (crontab.data / "store").exists()) == (1, False)
    layers = {layer: sites[0].rasters[layer] for layer in ("height", "terrain", "classes")}
    add_map("site", **layers, store=crontab.data / "store")


def bring_a_new_log(crontab: Crontab, _: list[SimulatedSite]) -> None:
    assert crontab.run() == SILENT
    assert crontab.samples > 0


def bring_a_damaged_log(crontab: Crontab, sites: list[SimulatedSite]) -> None:
    """It is named, and what can be read of it is used."""
    before = crontab.samples
    crontab.add_log("second.mcap", sites[1].logs[0].read_bytes()[:500_000])
    mail, _ = crontab.run()
    assert "tcpipe ingest recordings --existing-store --jobs 1 --min-age 10m --quiet: exit code 3\n" in mail
    assert "second.mcap: the file ends inside a chunk or record" in mail
    assert "tcpipe status: exit code 3\n" in mail
    assert "tcpipe build-dataset" not in mail
    assert crontab.samples > before
    crontab.run_by_hand("acknowledge", "recordings/second.mcap")


def fill_the_disk(crontab: Crontab, sites: list[SimulatedSite]) -> None:
    """Each command that fails is named with its reason; the next night ingests the log."""
    before = crontab.samples
    crontab.add_log("third.mcap", sites[2].logs[0].read_bytes())
    with full_disk():
        mail, exit_code = crontab.run()
    assert "tcpipe ingest recordings" in mail
    assert "third.mcap: " in mail
    assert "File too large" in mail
    assert "tcpipe status: exit code 3\nto do now: correct the cause, then tcpipe ingest (1 log): " in mail
    assert exit_code == 1
    (crontab.recordings / "first.mcap").unlink()  # archived: its run is complete
    assert crontab.run() == SILENT
    assert crontab.samples > before
    assert not [*crontab.data.rglob(".tmp-*")]


def hang(crontab: Crontab, _: list[SimulatedSite]) -> None:
    """The next night does not start beside one that hangs, and shows what that one printed and which call runs."""
    complete = crontab.samples
    ingest = crontab.add_program("tcpipe", HANGING_INGEST)
    with subprocess.Popen(
        ["sh", "-c", crontab.job], cwd=crontab.data, env=crontab.environment, start_new_session=True
    ) as hanging:
        while "reading" not in "".join(path.read_text() for path in crontab.data.glob("night/ingest.txt")):
            time.sleep(0.05)
        ingest.unlink()
        mail, exit_code = crontab.run()
        os.killpg(hanging.pid, signal.SIGKILL)
    lock = crontab.data / "night" / "lock"
    subprocess.run(["flock", "--timeout", "20", lock, "true"], check=True)  # until all are gone
    assert "An earlier night still runs. It has printed:\nreading third.mcap\n" in mail
    assert "\nrunning: ingest of " in mail
    assert exit_code == 1
    assert crontab.run() == SILENT
    assert crontab.samples == complete


@pytest.mark.skipif(shutil.which("flock") is None, reason="flock is not installed")
def test_nights(tmp_path: Path, sites: list[SimulatedSite]) -> None:
    crontab = Crontab(tmp_path / "data", tmp_path / "bin")
    for night in (lack_the_store, bring_a_new_log, bring_a_damaged_log, fill_the_disk, hang):
        night(crontab, sites)
