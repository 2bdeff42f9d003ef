"""Every program of this directory runs once at its smallest size: ``make test-benchmarks``. It ends well and prints its figures.

The figures themselves say nothing at this size. A program that is not in `SMALLEST` fails the test.
"""

import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import pytest
from object_gateway import gateway  # noqa: F401  a fixture

from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.maps import add_map
from tcpipe.simulation import simulate
from tcpipe.simulation.scenarios import find_scenario

HERE = Path(__file__).parent
PROGRAMS = sorted(
    path.stem for path in HERE.glob("*.py") if re.search(r"^if __name__ == ", path.read_text(), re.MULTILINE)
)
LONGEST_S = 600


@dataclass(frozen=True)
class Smallest:
    """The arguments of a program's smallest size, and what its output holds.

    ``{out}`` is a new directory, ``{log}`` a simulated log of some minutes, ``{dataset}`` a dataset of it, ``{bucket}``
    a bucket's URL.
    """

    arguments: str
    figures: str
    """A regular expression."""
    package: str = ""
    """Without which it cannot run."""


NUMBER = r"\d+(?:\.\d+)?"
SMALLEST = {
    "autopilots": Smallest("--minutes 2", rf"pymavlink {NUMBER} s: {NUMBER} of its time", package="pyulog"),
    "buckets": Smallest("ingest {bucket} {out} 1", rf"wall .*: {NUMBER} x; CPU .*: {NUMBER} x"),
    "build_dataset": Smallest("{out} 300", rf"floors: .*: {NUMBER} x"),
    "campaign": Smallest("--out {out} --cells ^GNSS,.wheels.10.Hz:.clean --quick", r"w \d.* E \d"),
    "cost_map": Smallest("4 16", rf"{NUMBER} x the bare forward pass", package="torch"),
    "densities": Smallest(
        "--seeds 701 --length 60 --only 'white 1.5 cm, no camera'", rf"white 1.5 cm +no camera +{NUMBER}"
    ),
    "error_budget": Smallest("", rf"averaged, 20 Hz \| {NUMBER} %"),
    "faults": Smallest("kills --only 'a file over another' --times 1", r"together +[1-9]"),
    "few_samples": Smallest("{dataset} --counts 60 --kinds physics", rf"60 physics +test +: E +{NUMBER} ± {NUMBER} J"),
    "first_minute": Smallest("{out} tiny", rf"\| {NUMBER} ± {NUMBER} segments an hour \|"),
    "fuse": Smallest(
        "--hours 0.01 --paired-seconds 5",
        rf"forward filter by filterpy +{NUMBER} us/event[\s\S]*peak memory {NUMBER} MB",
    ),
    "fusion_worlds": Smallest(
        "--kinds '^step of fixes 0.20' --seeds 1 --length 40 --out {out}/a.json",
        rf"step of fixes 0.20 m +[1-9]\d* +{NUMBER}",
    ),
    "fusion_accuracy": Smallest("--drives 1 --only 'GNSS alone'", rf"GNSS alone +{NUMBER}"),
    "honesty": Smallest(
        "--cells '^GNSS, wheels: clean' --seeds 1 --length 60 --out {out}/a.json",
        rf"GNSS, wheels: clean +\d+( +\d+/\d+){{5}} +{NUMBER}",
    ),
    "label_accuracy": Smallest("--scenario tiny", rf"odometer +[+-]?{NUMBER}%"),
    "load_dataset": Smallest("{out} 300", rf"epoch from disk, zstd: {NUMBER} x memmap"),
    "many_runs": Smallest("{out} 3", rf"build-dataset, cold +{NUMBER} s wall"),
    "nav2_path": Smallest("40 1", rf"straight lines on the Nav2 map: -?{NUMBER} % more energy"),
    "path_coverage": Smallest("--train 2 --metres 60 --further 1 --models 1", rf"energy +1 m: +{NUMBER} %"),
    "peers": Smallest(
        "--seeds 1 --length 40 --outage 10 --only white", rf"white +pyins( +{NUMBER}){{3}}", package="pyins"
    ),
    "physics": Smallest("--metres 100", rf"C_rr grass +{NUMBER} ± +{NUMBER}"),
    "plan_path": Smallest("120 1", rf"peak memory: {NUMBER} x that of the full search"),
    "read_logs": Smallest("--minutes 0.05", rf"{NUMBER} of {NUMBER} figures met"),
    "real_data": Smallest("drive={log}", rf"drive, .*blocks .* {NUMBER} J"),
    "sample_patches": Smallest("50", rf"nearest gather +{NUMBER} us a patch +{NUMBER} x"),
    "scale": Smallest("hours {out} 3 1 tiny", rf"the last half against the first: {NUMBER} x"),
    "start_up": Smallest("--quick --turns 1", rf"ingest +{NUMBER} s +{NUMBER} x the floor"),
    "table_digests": Smallest("write {out}/made {out}/digests.json --quick", r"3 runs and 1 datasets .*: \d+ tables"),
    "table_model": Smallest("200", rf"{NUMBER} s for trees[\s\S]*\d predictions/s"),
    "tables": Smallest("0.01", rf"CPU: {NUMBER} times"),
    "train_step": Smallest("{dataset} 16", rf"throughput {NUMBER} x", package="torch"),
    "withheld": Smallest("--log {log}", rf"gnss 10 s +1 +\d+ +{NUMBER} +{NUMBER}"),
    "yield_of_logs": Smallest("{log}", rf"mcap( +{NUMBER}){{7}}\n"),
}
"""By the name of the program."""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Return a site with a log of 190 m."""
    spec = find_scenario("paper_quick")
    return simulate(tmp_path_factory.mktemp("benchmarks") / "site", scenario=replace(spec, drives=spec.drives[:1]))


@pytest.fixture(scope="module")
def log(site):
    """Return the log of the site."""
    return site.logs[0]


@pytest.fixture(scope="module")
def dataset(site, tmp_path_factory):
    """Return a dataset of the log."""
    here = tmp_path_factory.mktemp("dataset")
    assert ingest(site.logs, store=here / "store").exit_code == 0
    add_map("site", store=here / "store", **site.rasters)
    build_dataset(here / "dataset", store=here / "store", split=site.region)
    return here / "dataset"


def test_every_program_has_a_smallest_size():
    assert sorted(SMALLEST) == PROGRAMS, "add the arguments of the program's smallest size to SMALLEST"


@pytest.mark.parametrize("program", SMALLEST)
def test_it_runs_and_prints_its_figures(program, tmp_path, request):
    case = SMALLEST[program]
    if case.package and find_spec(case.package) is None:
        pytest.skip(f"{case.package} is not installed")
    values, environment = {"out": tmp_path / "out"}, os.environ | {"OMP_NUM_THREADS": "1"}
    values["out"].mkdir()
    for name in ("log", "dataset"):
        if f"{{{name}}}" in case.arguments:
            values[name] = request.getfixturevalue(name)
    if "{bucket}" in case.arguments:
        environment |= request.getfixturevalue("gateway")
        values["bucket"] = "s3://tests"
    arguments = [word.format(**values) for word in shlex.split(case.arguments)]
    done = subprocess.run(
        [sys.executable, HERE / f"{program}.py", *arguments],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=LONGEST_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(case.figures, done.stdout), done.stdout
    assert not re.search(r"\b(nan|inf)\b", done.stdout), done.stdout
    assert "Warning" not in done.stderr, done.stderr
