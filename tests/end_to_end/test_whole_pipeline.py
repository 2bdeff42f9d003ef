"""From simulated logs and rasters to a dataset through the installed command, held against the simulation's truth."""

import json
import subprocess
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyproj
import pytest
from installed_command import tcpipe
from page_reading import data_of
from scipy.interpolate import CubicHermiteSpline

import tcpipe as package
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.geometry.rotation import rpy_from_quat, wrap_to_pi
from tcpipe.simulation import Truth, compute_true_cost, read_truth
from tcpipe.store import Store

DRAWS_DATASET_PAGES = True

Demo = tuple[Path, subprocess.CompletedProcess[str]]
"""Where ``tcpipe demo`` put all it made, and what it said."""

Drives = list[tuple[StoredRun, Truth]]
"""Runs, each with the truth of its drive."""


def _run(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    done = tcpipe(*arguments, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    """Output of ``tcpipe demo``: two drives over a small site with all sensor faults, their store and dataset; read only."""
    here = tmp_path_factory.mktemp("demo")
    return here / "here", _run("demo", "here", cwd=here)


@pytest.fixture(scope="module")
def drives(demo: Demo) -> Drives:
    """The runs of the demo, each with the truth of its drive."""
    runs = Store(demo[0] / "store").runs()
    truths = sorted((demo[0] / "site" / "truth").iterdir())
    found = [(run, read_truth(path)) for path in truths for run in runs if run.run_id.startswith(path.stem)]
    assert len(found) == len(runs) == 2
    return found


def _labels(drives: Drives, column: str) -> np.ndarray:
    """Return a column of the segments of both runs."""
    return np.concatenate([_column(run.segments(), column) for run, _ in drives])


def _true_labels(drives: Drives, name: str) -> np.ndarray:
    true = (compute_true_cost(truth, _column(run.segments(), "start_ns")) for run, truth in drives)
    return np.concatenate([getattr(of, name) for of in true])


def _column(table, name):
    return table.column(name).to_numpy(zero_copy_only=False)


def _share(estimate, truth):
    return np.abs(estimate - truth).sum() / np.abs(truth).sum()


def test_labels_are_those_of_the_true_metre(drives: Drives) -> None:
    for name, limit in (("energy_joule", 0.006), ("velocity_mps", 0.005), ("duration_s", 0.005)):
        assert _share(_labels(drives, name), _true_labels(drives, name)) <= limit, name


def test_segments_begin_where_the_robot_was(drives: Drives) -> None:
    for run, truth in drives:
        segments = run.segments()
        at = truth.at(_column(segments, "start_ns"))
        lon, lat = _column(segments, "start_lon_deg"), _column(segments, "start_lat_deg")
        _, _, error_m = pyproj.Geod(ellps="WGS84").inv(lon, lat, at.lon_deg, at.lat_deg)
        assert np.sqrt(np.mean(error_m**2)) <= 0.03


def test_chords_are_one_metre_on_the_ellipsoid_too(drives: Drives) -> None:
    ends = [_labels(drives, f"{end}_{axis}_deg") for end in ("start", "end") for axis in ("lon", "lat")]
    _, _, length_m = pyproj.Geod(ellps="WGS84").inv(*ends)
    assert np.abs(_labels(drives, "chord_m") - 1.0).max() <= 1e-6
    assert np.abs(length_m - 1.0).max() <= 1e-3


def test_the_kept_track_knows_its_speed_and_yaw(drives: Drives) -> None:
    for run, truth in drives:
        track = run.track().table
        at = truth.at(_column(track, "stamp_ns"))
        kept = _column(track, "dropped_by") == 0
        speed = (_column(track, "forward_velocity_mps") - at.forward_velocity_mps)[kept]
        yaw = wrap_to_pi(_column(track, "yaw_rad") - rpy_from_quat(at.quat_xyzw)[:, 2])[kept]
        assert np.sqrt(np.mean(speed**2)) <= 0.03
        assert np.degrees(np.sqrt(np.mean(yaw**2))) <= 1.0


def test_whole_run_energy_and_odometer(drives: Drives) -> None:
    for run, truth in drives:
        facts = run.manifest.info.report.facts
        assert facts.label.energy_joule == pytest.approx(truth.energy_joule[-1], rel=0.005)
        assert sum(run.manifest.distance_by_reason_m.values()) == pytest.approx(truth.distance_m[-1], rel=0.005)


def test_every_metre_is_in_the_ledger_of_the_run_and_of_the_dataset(demo: Demo, drives: Drives) -> None:
    total_m = 0.0
    for run, _ in drives:
        distance_by_reason_m = run.manifest.distance_by_reason_m
        assert sum(distance_by_reason_m.values()) == pytest.approx(_measure_by_spline(run.track().table), rel=1e-3)
        assert distance_by_reason_m["kept"] == pytest.approx(_column(run.segments(), "arc_length_m").sum(), rel=1e-9)
        total_m += sum(distance_by_reason_m.values())
    card = json.loads((demo[0] / "dataset" / "dataset.json").read_text())
    assert sum(card["distance_by_reason_m"].values()) == pytest.approx(total_m, rel=1e-3)


def _measure_by_spline(track: pa.Table) -> float:
    """Return the length of a spline of SciPy through the track's rows [m]."""
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
    return float(sum(metres))


def test_labels_know_their_own_error(drives: Drives) -> None:
    for quantity, unit in (("duration", "s"), ("velocity", "mps"), ("power", "watt"), ("energy", "joule")):
        error = _labels(drives, f"{quantity}_{unit}") - _true_labels(drives, f"{quantity}_{unit}")
        # Without the error that the run has in common: this power sensor has none.
        total, common = (_labels(drives, f"{quantity}_{part}_{unit}") for part in ("std", "common_std"))
        normalized = np.abs(error) / np.sqrt(total**2 - common**2)
        assert 0.60 <= np.mean(normalized < 1) <= 0.85, quantity
        assert 0.92 <= np.mean(normalized < 2) <= 0.995, quantity


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
