"""From simulated logs and rasters to a dataset through the installed command, held against the simulation's truth."""

import json
import subprocess
from hashlib import sha256
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyproj
import pytest
from installed_command import tcpipe
from page_reading import data_of
from scipy.interpolate import CubicHermiteSpline

import tcpipe as package
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.geometry.rotation import rpy_from_quat, wrap_to_pi
from tcpipe.simulation import SimulatedSite, compute_true_cost, find_scenario, read_truth, simulate
from tcpipe.store import Store
from tcpipe.tables.bits import DropReason

DRAWS_DATASET_PAGES = True

Demo = tuple[Path, subprocess.CompletedProcess[str]]
"""Where ``tcpipe demo`` put all it made, and what it said."""


def _run(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    done = tcpipe(*arguments, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSite:
    """A 12-minute hilly drive, RTK sigma 1.5 cm, all sensor faults on."""
    return simulate(tmp_path_factory.mktemp("hills") / "site", scenario="hills12", seed=11)


@pytest.fixture(scope="module")
def work(site: SimulatedSite) -> Path:
    """Everything a user does with it, with the installed command."""
    here = site.directory.parent
    _run("ingest", *site.logs, "--quiet", cwd=here)
    rasters = site.rasters
    layers = [item for name in ("height", "ortho", "terrain", "classes") for item in (f"--{name}", rasters[name])]
    _run("add-map", "site", *layers, "--quiet", cwd=here)
    _run("build-dataset", "--split", site.region, "--quiet", cwd=here)
    return here


@pytest.fixture(scope="module")
def run(work: Path) -> RunDirectory:
    (found,) = Store(work / "tcpipe-store").runs()
    return found


def _column(table, name):
    return table.column(name).to_numpy(zero_copy_only=False)


def _share(estimate, truth):
    return np.abs(estimate - truth).sum() / np.abs(truth).sum()


def test_labels_are_those_of_the_true_metre(site: SimulatedSite, run: RunDirectory) -> None:
    segments = run.segments()
    truth = compute_true_cost(read_truth(site.truths[0]), _column(segments, "start_ns"))
    assert _share(_column(segments, "energy_joule"), truth.energy_joule) <= 0.006
    assert _share(_column(segments, "velocity_mps"), truth.velocity_mps) <= 0.005
    assert _share(_column(segments, "duration_s"), truth.duration_s) <= 0.005


def test_segments_begin_where_the_robot_was(site: SimulatedSite, run: RunDirectory) -> None:
    segments = run.segments()
    truth = read_truth(site.truths[0]).at(_column(segments, "start_ns"))
    lon, lat = _column(segments, "start_lon_deg"), _column(segments, "start_lat_deg")
    _, _, error_m = pyproj.Geod(ellps="WGS84").inv(lon, lat, truth.lon_deg, truth.lat_deg)
    assert np.sqrt(np.mean(error_m**2)) <= 0.03


def test_chords_are_one_metre_on_the_ellipsoid_too(run: RunDirectory) -> None:
    segments = run.segments()
    ends = [_column(segments, f"{end}_{axis}_deg") for end in ("start", "end") for axis in ("lon", "lat")]
    _, _, length_m = pyproj.Geod(ellps="WGS84").inv(*ends)
    assert np.abs(_column(segments, "chord_m") - 1.0).max() <= 1e-6
    assert np.abs(length_m - 1.0).max() <= 1e-3


def test_the_kept_track_knows_its_speed_and_yaw(site: SimulatedSite, run: RunDirectory) -> None:
    track = run.track().table
    truth = read_truth(site.truths[0]).at(_column(track, "stamp_ns"))
    kept = _column(track, "dropped_by") == 0
    speed = (_column(track, "forward_velocity_mps") - truth.forward_velocity_mps)[kept]
    yaw = wrap_to_pi(_column(track, "yaw_rad") - rpy_from_quat(truth.quat_xyzw)[:, 2])[kept]
    assert np.sqrt(np.mean(speed**2)) <= 0.03
    assert np.degrees(np.sqrt(np.mean(yaw**2))) <= 1.0


def test_whole_run_energy_and_odometer(site: SimulatedSite, run: RunDirectory) -> None:
    truth = read_truth(site.truths[0])
    facts = run.manifest.info.report.facts
    assert facts.label.energy_joule == pytest.approx(truth.energy_joule[-1], rel=0.005)
    assert sum(run.manifest.distance_by_reason_m.values()) == pytest.approx(truth.distance_m[-1], rel=0.005)


def test_every_metre_is_in_the_ledger_of_the_run_and_of_the_dataset(work: Path, run: RunDirectory) -> None:
    """The odometer here is a spline of SciPy through the track's rows."""
    track, distance_by_reason_m = run.track().table, run.manifest.distance_by_reason_m
    seconds = (_column(track, "stamp_ns") - _column(track, "stamp_ns")[0]) * 1e-9
    pieces = np.split(np.arange(len(seconds)), np.flatnonzero(np.diff(seconds) > 0.075) + 1)
    metres = [
        np.hypot(*(float(_column(track, f"{axis}_m")[b[0]] - _column(track, f"{axis}_m")[a[-1]]) for axis in "xy"))
        for a, b in pairwise(pieces)
    ]
    for rows in pieces:
        fine = np.linspace(seconds[rows[0]], seconds[rows[-1]], 10 * len(rows))
        x, y = (
            CubicHermiteSpline(
                seconds[rows], _column(track, f"{axis}_m")[rows], _column(track, f"{name}_velocity_mps")[rows]
            )(fine)
            for axis, name in (("x", "east"), ("y", "north"))
        )
        metres.append(np.hypot(np.diff(x), np.diff(y)).sum())
    assert sum(distance_by_reason_m.values()) == pytest.approx(sum(metres), rel=1e-3)
    assert distance_by_reason_m["kept"] == pytest.approx(_column(run.segments(), "arc_length_m").sum(), rel=1e-9)
    card = json.loads((work / "dataset" / "dataset.json").read_text())
    assert sum(card["distance_by_reason_m"].values()) == pytest.approx(sum(distance_by_reason_m.values()), rel=1e-3)


def test_labels_know_their_own_error(site: SimulatedSite, run: RunDirectory) -> None:
    segments = run.segments()
    truth = compute_true_cost(read_truth(site.truths[0]), _column(segments, "start_ns"))
    for quantity, unit in (("duration", "s"), ("velocity", "mps"), ("power", "watt"), ("energy", "joule")):
        error = _column(segments, f"{quantity}_{unit}") - getattr(truth, f"{quantity}_{unit}")
        # Without the error that the run has in common: this power sensor has none.
        total, common = (_column(segments, f"{quantity}_{part}_{unit}") for part in ("std", "common_std"))
        normalized = np.abs(error) / np.sqrt(total**2 - common**2)
        assert 0.60 <= np.mean(normalized < 1) <= 0.80, quantity
        assert 0.92 <= np.mean(normalized < 2) <= 0.995, quantity


def test_steadily_driven_metres_become_segments(site: SimulatedSite, run: RunDirectory) -> None:
    """Steady by the truth: full command for 2 s, forward, not turning hard."""
    truth = read_truth(site.truths[0])
    full = truth.command_velocity_mps >= 0.95
    settled = np.convolve(full, np.ones(400), "full")[: len(full)] >= 400  # 2 s at 200 Hz
    radius_m = np.abs(truth.forward_velocity_mps) / np.maximum(np.abs(truth.angular_velocity_radps[:, 2]), 1e-9)
    steady = settled & (truth.wheel_velocity_mps > 0.2) & (truth.forward_velocity_mps > 0.3) & (radius_m > 1.5)
    steady_m = np.diff(truth.distance_m, prepend=0.0)[steady].sum()
    assert run.manifest.distance_by_reason_m["kept"] >= 0.90 * steady_m


def test_patches_show_the_world_at_their_own_pixel_centres(site: SimulatedSite, work: Path) -> None:
    world = find_scenario("hills12").world
    data = package.open_dataset(work / "dataset")
    card = json.loads((work / "dataset" / "dataset.json").read_text())
    classes = {entry["id"]: entry["name"] for entry in card["classes"]}
    checked = wrong = 0
    to_map = pyproj.Transformer.from_crs("EPSG:4326", card["maps"][0]["crs"], always_xy=True)
    for split in ("train", "test", "unseen"):
        samples, patches = data[split].samples, data[split].patches
        start = np.column_stack(to_map.transform(_column(samples, "start_lon_deg"), _column(samples, "start_lat_deg")))
        end = np.column_stack(to_map.transform(_column(samples, "end_lon_deg"), _column(samples, "end_lat_deg")))
        offset = (np.arange(40) + 0.5) / 40
        for row in range(0, len(patches), 7):
            along = end[row] - start[row]
            left = np.array([-along[1], along[0]])
            xy = start[row] + offset[None, :, None] * along + (0.5 - offset)[:, None, None] * left
            height = world.height_m(xy[..., 0], xy[..., 1])
            got = patches[row, ..., 2] + _column(samples, "height_min_m")[row]
            unclipped = patches[row, ..., 2] < 1.0
            assert np.abs(got - height)[unclipped].max() <= 0.002
            ids = np.rint(patches[row, ..., 1] * (len(classes) - 1)).astype(int) + 1
            truth = world.terrain_class(xy[..., 0], xy[..., 1])
            wrong += int((ids != truth).sum())
            checked += truth.size
    assert checked > 50_000
    assert wrong <= 0.005 * checked


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    """What ``tcpipe demo`` made: two drives over a small site, their store and dataset; tests read it only."""
    here = tmp_path_factory.mktemp("demo")
    return here / "here", _run("demo", "here", cwd=here)


def _demo_logs(demo_directory: Path) -> list[Path]:
    return sorted((demo_directory / "site" / "logs").iterdir())


def _hashes(directory: Path, pattern: str) -> dict[str, str]:
    return {
        str(path.relative_to(directory)): sha256(path.read_bytes()).hexdigest()
        for path in sorted(directory.rglob(pattern))
        if path.is_file()
    }


def test_two_runs_and_any_number_of_workers_give_the_same_bytes(demo: Demo, tmp_path: Path) -> None:
    """What the demo made alone is made again through single commands, by two workers."""
    here, _ = demo
    site, jobs = here / "site", ("--jobs", "2", "--quiet")
    _run("ingest", *_demo_logs(here), *jobs, cwd=tmp_path)
    assert (
        _hashes(tmp_path / "tcpipe-store" / "runs", "*.parquet") == _hashes(here / "store" / "runs", "*.parquet") != {}
    )
    rasters = {"height": "height.tif", "ortho": "ortho.tif", "terrain": "terrain.tif", "classes": "classes.csv"}
    layers = [item for name, file in rasters.items() for item in (f"--{name}", site / "maps" / file)]
    _run("add-map", "site", *layers, "--ortho-bands", "rgb", "--quiet", cwd=tmp_path)
    _run("build-dataset", "--split", site / "region.geojson", *jobs, cwd=tmp_path)
    alone, by_two = _hashes(here / "dataset", "*"), _hashes(tmp_path / "dataset", "*")
    assert alone.pop("report.html") != by_two.pop("report.html")  # the demo's leads to its runs, which lie beside it
    assert alone == by_two != {}


def test_no_dropped_row_inside_a_segment(run: RunDirectory) -> None:
    track, segments = run.track().table, run.segments()
    stamps, dropped = _column(track, "stamp_ns"), _column(track, "dropped_by")
    count = np.concatenate([[0], np.cumsum(dropped != 0)])
    first = np.searchsorted(stamps, _column(segments, "start_ns"), side="left")
    last = np.searchsorted(stamps, _column(segments, "end_ns"), side="right")
    assert (count[last] - count[first]).max() == 0
    assert {int(bit) for bit in DropReason} >= set(np.unique(dropped & -dropped).tolist()) - {0}


def test_demo_runs_everything_and_says_what_to_open(demo: Demo) -> None:
    here, done = demo
    for name in ("site", "store", "dataset", "dataset/report.html"):
        assert (here / name).exists()
        assert name in done.stdout
    sheets = data_of((here / "dataset/report.html").read_text(encoding="utf-8"))["patches"]
    assert [layer["name"] for layer in sheets["layers"]] == ["ortho", "terrain", "height"]  # the first in colour
    train = package.open_dataset(here / "dataset")["train"]
    assert train.patches.shape[1:] == (40, 40, 3)
    assert train.labels.shape == (len(train), 2)
    assert "nothing to do" in _run("demo", "here", "--seed", "1", "--quiet", cwd=here.parent).stdout
