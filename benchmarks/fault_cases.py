"""The writing commands on the smallest inputs that make each of them do all it does, and the protocol below them."""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fault_children import INPUTS, command
from fault_services import BUCKET

import tcpipe
from tcpipe.formats.atomic import clear_beside, write_atomic_directory, write_text

Run = Callable[[], object]

STORE = ("--store", "store")
LAYERS = tuple(word for name in ("height", "ortho", "terrain") for word in (f"--{name}", f"{INPUTS}/{name}.tif"))
LOG, CUT = f"{INPUTS}/logs/tiny.mcap", f"{INPUTS}/cut.mcap"
MODEL, DATASET = f"{INPUTS}/model", f"{INPUTS}/dataset"
FROM, TO = "15.434471784,47.069643821", "15.434788601,47.069732605"


@dataclass(frozen=True)
class Case:
    """One call, the calls before it, and the inputs that it needs: ``log``, ``world`` (rasters and a store), ``model``, ``old`` store.

    It writes to its directory or below ``url``; with ``cluster`` a Dask cluster does the work. Steps are those of its
    ``workers`` if it has workers that can be killed, each a process that `fault_workers` watches.
    """

    name: str
    run: Run
    before: tuple[Run, ...] = ()
    wants: frozenset[str] = frozenset()
    url: str = ""
    extra_features: Run | None = None
    """Second call of a pair that runs at the same time; None: the same call."""
    has_workers: bool = False

    @property
    def steps_in(self) -> str:
        """Return where steps are counted: ``workers``, ``bucket`` or ``disk``."""
        return "workers" if self.has_workers else "bucket" if self.url else "disk"


def _as_command(run: Run) -> Run:
    """Return a call by the command line, which reports errors and signals."""

    def called() -> None:
        from click import Command

        from tcpipe.cli import cli

        cli.commands = {"write": Command("write", callback=run)}  # in a process of its own
        command("write")()

    return called


def _file(name: str, text: str) -> Run:
    """Return a command that writes a file by the protocol alone, or finds the same there."""

    def write() -> None:
        place = Path(name)
        clear_beside(place)
        if not place.is_file() or place.read_text() != text:
            write_text(place, text)

    return _as_command(write)


def _directory(name: str, **files: str) -> Run:
    """Return a command that writes a directory by the protocol alone, or finds the same there."""

    def write() -> None:
        place = Path(name)
        clear_beside(place)
        if not place.is_dir() or {path.name: path.read_text() for path in place.iterdir()} != files:
            with write_atomic_directory(place) as half:
                for file, content in files.items():
                    write_text(half / file, content)

    return _as_command(write)


def _have_store() -> None:
    """Copy the store of the inputs, which calls write into."""
    shutil.copytree(f"{INPUTS}/store", "store")


_RUN = command("ingest", LOG, "--quiet")
_BUILD = ("build-dataset", *STORE, "--split", f"{INPUTS}/region.geojson", "--quiet")
_MAP = ("add-map", "site", *LAYERS, "--quiet")
_LOG, _WORLD, _MODEL = (frozenset({name}) for name in ("log", "world", "model"))
_CLUSTER = frozenset({"cluster"})

URL = f"s3://{BUCKET}/a case"
"""Where cases in a bucket write."""
_THERE = ("--store", f"{URL}/tcpipe-store", "--quiet")
_RUN_THERE = command("ingest", LOG, *_THERE)
_OTHER_THERE = command("ingest", LOG, "--recipe", f"{INPUTS}/other.toml", *_THERE)
_PRUNE_THERE = ("prune", "--store", f"{URL}/tcpipe-store")
_BUILD_THERE = command("build-dataset", f"{URL}/dataset", *_BUILD[1:])
_FORCED_THERE = command("build-dataset", f"{URL}/dataset", *_BUILD[1:], "--seed", "5", "--force")
_OTHER_RUN = command("ingest", LOG, "--recipe", f"{INPUTS}/other.toml", "-q")
_ARRAY_TASK, _OTHER_TASK = (command("ingest", f"{INPUTS}/logs", *_THERE, "--shard", f"{n}/2") for n in (1, 2))


CASES = (
    Case("a file", _file("one", "1")),
    Case("a file over another", _file("one", "1"), (_file("one", "0"),)),
    Case("a directory", _directory("dataset", one="1")),
    Case("a directory over another", _directory("dataset", one="1", two="2"), (_directory("dataset", one="0"),)),
    Case("init", command("init")),
    Case("simulate", command("simulate", "site", "--scenario", "tiny"), wants=_LOG),
    Case("export", command("export", LOG, "table"), wants=_LOG),
    Case("ingest", _RUN, wants=_LOG),
    Case("ingest --force", command("ingest", LOG, "--force", "--quiet"), (_RUN,), _LOG),
    Case("ingest by another recipe", command("ingest", LOG, "--recipe", f"{INPUTS}/other.toml", "-q"), (_RUN,), _LOG),
    Case("ingest beside build-dataset", _RUN, (_have_store,), wants=_LOG | _WORLD, extra_features=command(*_BUILD)),
    Case("ingest beside prune", _OTHER_RUN, (_RUN,), _LOG, extra_features=command("prune")),
    Case("prune", command("prune"), (_OTHER_RUN, _RUN), _LOG),
    Case("ingest into a bucket", _RUN_THERE, wants=_LOG, url=URL),
    Case("ingest --force there", command("ingest", LOG, "--force", *_THERE), (_RUN_THERE,), _LOG, URL),
    Case("ingest there beside prune", _OTHER_THERE, (_RUN_THERE,), _LOG, URL, command(*_PRUNE_THERE)),
    Case("add-map there", command(*_MAP[:-1], *_THERE), wants=_WORLD, url=URL),
    Case("build-dataset there", _BUILD_THERE, (_have_store,), _WORLD, url=URL),
    Case("build-dataset --force there", _FORCED_THERE, (_have_store, _BUILD_THERE), _WORLD, URL),
    Case("prune there", command(*_PRUNE_THERE), (_OTHER_THERE, _RUN_THERE), _LOG, URL),
    Case("ingest --shard 1/2 there", _ARRAY_TASK, wants=_LOG, url=URL, extra_features=_OTHER_TASK),
    Case("ingest on a cluster", _RUN_THERE, wants=_LOG | _CLUSTER, url=URL),
    Case("ingest on Dask workers", _RUN_THERE, wants=_LOG | _CLUSTER, url=URL, has_workers=True),
    Case("ingest --tag", command("ingest", LOG, "--tag", "load=12", "--quiet"), (_RUN,), _LOG),
    Case("ingest --jobs 2", command("ingest", f"{INPUTS}/logs", "--jobs", "2", "--quiet"), wants=_LOG),
    Case("acknowledge", command("acknowledge", CUT), (command("ingest", CUT, "--quiet"),), _LOG),
    Case("report", command("report", "tcpipe-store"), (_RUN,), _LOG),
    Case("add-map", command(*_MAP), wants=_WORLD),
    Case("add-map --force", command(*_MAP, "--force"), (command("add-map", "site", *LAYERS[:2], "-q"),), _WORLD),
    Case("build-dataset", command(*_BUILD), (_have_store,), wants=_WORLD),
    Case(
        "build-dataset over another",
        command(*_BUILD, "--force"),
        (_have_store, command(*_BUILD, "--seed", "5")),
        _WORLD,
    ),
    Case("build-dataset --format parquet", command(*_BUILD, "--format", "parquet"), (_have_store,), wants=_WORLD),
    Case("build-dataset --jobs 2", command(*_BUILD, "--jobs", "2"), (_have_store,), wants=_WORLD),
    Case("train", command("train", DATASET, "--epochs", "2", "--width", "16", "-q"), wants=_MODEL),
    Case("evaluate", command("evaluate", MODEL, DATASET, "--no-baselines", "--noise-draws", "1", "-q"), wants=_MODEL),
    Case(
        "cost-map",
        command("cost-map", MODEL, "costs", "--cell-size", "4", *STORE, "--quiet"),
        before=(_have_store,),
        wants=_MODEL,
    ),
    Case(
        "predict-path",
        command(
            "predict-path", MODEL, "--path", f"{INPUTS}/path.geojson", "--out", "path-segments.csv", *STORE, "--quiet"
        ),
        before=(_have_store,),
        wants=_MODEL,
    ),
    Case(
        "plan-path",
        command("plan-path", MODEL, "--from", FROM, "--to", TO, "--cell-size", "2", *STORE, "-q"),
        before=(_have_store,),
        wants=_MODEL,
    ),
)


def make_inputs(place: Path, wanted: set[str]) -> None:
    """Write the inputs that cases want, and warm what children share: modules, and compiled kernels."""
    place.mkdir(parents=True)
    (place.parent / "tmp").mkdir()
    learning = () if "model" in wanted else ("tcpipe.learning", "tcpipe.dataset.torch")
    for module in walk_packages(tcpipe.__path__, "tcpipe.") if wanted else ():
        if not module.name.startswith(("tcpipe.__main__", *learning)):
            import_module(module.name)
    if "log" in wanted:
        _make_logs(place)
    if wanted & {"world", "model"}:
        _make_world(place)
    if "model" in wanted:
        _make_model(place)


def _make_logs(place: Path) -> None:
    from tcpipe import ingest
    from tcpipe.simulation import simulate

    (place / "logs").mkdir()
    for seed, name in ((3, "tiny"), (4, "second")):
        site = simulate(place / "simulated", scenario="tiny", seed=seed)
        shutil.copyfile(site.logs[0], place / "logs" / f"{name}.mcap")
        shutil.rmtree(place / "simulated")
    (place / "cut.mcap").write_bytes((place / "logs" / "tiny.mcap").read_bytes()[:-100_000])
    (place / "other.toml").write_text("[mask]\nmax_acceleration_mps2 = 0.31\n")
    ingest([place / "logs" / "tiny.mcap"], store=place / "warm")
    shutil.rmtree(place / "warm")


def _make_world(place: Path) -> None:
    from synthetic_store import WORLD, box, region_file, small_store

    from tcpipe import build_dataset

    WORLD.write(place, 0.1)
    region_file(place / "region.geojson", box(-18, -18, 6, 18))
    small_store(place)
    build_dataset(place / "dataset", store=place / "store", split=place / "region.geojson")


def _make_model(place: Path) -> None:
    from made_models import CARD, made_model

    from tcpipe.learning.fitting import FitConfig
    from tcpipe.learning.model_card import TrainingRange

    ranges = {"slope_rad": (-0.5, 0.5), "cross_slope_rad": (-0.5, 0.5), "relief_m": (0.0, 1.0)}
    config = FitConfig(epochs=1, width=16)
    training = replace(CARD.training, config=config, samples={"fitted": 100, "held out": 20})
    made_model(
        place / "model",
        training_range=TrainingRange(CARD.training_range.class_counts | {5: 10}, (4, 5, 6, 7), ranges),
        training=training,
    )
    ends = [[float(value) for value in end.split(",")] for end in (FROM, TO)]
    (place / "path.geojson").write_text(json.dumps({"type": "LineString", "coordinates": ends}))
