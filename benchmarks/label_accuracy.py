"""How true the labels are: simulate a site, ingest its logs, and compare every segment with the true metre.

    python benchmarks/label_accuracy.py                      # hills12: twelve hilly minutes, every sensor fault on
    python benchmarks/label_accuracy.py --scenario demo --seed 1
    python benchmarks/label_accuracy.py --exact-gnss         # white noise of the fixes, and an antenna where the log states it
    python benchmarks/label_accuracy.py --recipe pipelines/husky-paper.toml

Nothing of this is self-consistent: the truth comes from the simulator, which shares no formula with the pipeline but
rotations. tests/end_to_end/test_whole_pipeline.py holds the same figures under limits.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyproj

from tcpipe import ingest
from tcpipe.formats.recipe_toml import load_recipe
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.geometry.rotation import rpy_from_quat, wrap_to_pi
from tcpipe.simulation import Truth, compute_true_cost, find_scenario, read_truth, simulate
from tcpipe.simulation.sensors import EXACT_GNSS
from tcpipe.store import Store
from tcpipe.tables.columns import to_floats, to_integers

LABELS = {"energy_joule": "J", "power_watt": "W", "velocity_mps": "m/s", "duration_s": "s"}


def figures(run: StoredRun, truth: Truth) -> Iterator[tuple[str, str]]:
    """Yield what each figure is called, and the figure."""
    segments, track = run.segments(), run.track().table
    start_ns = to_integers(segments, "start_ns")
    true = compute_true_cost(truth, start_ns)
    for label, unit in LABELS.items():
        error = to_floats(segments, label) - getattr(true, label)
        std = to_floats(segments, _std_name(label))
        share = np.abs(error).sum() / np.abs(getattr(true, label)).sum()
        within = [np.mean(np.abs(error) <= k * std) for k in (1, 2)]
        bias = error.sum() / np.abs(getattr(true, label)).sum()
        claimed = f"claimed deviation {std.mean():.3g} {unit}: {within[0]:.0%} of the errors within one, {within[1]:.0%} within two"
        yield f"{label}: sum |error| / sum |truth|", f"{share:.2%} (bias {bias:+.2%}); {claimed}"
    yield from describe_net_labels(segments, truth)
    there = truth.at(start_ns)
    lon, lat = to_floats(segments, "start_lon_deg"), to_floats(segments, "start_lat_deg")
    _, _, apart_m = pyproj.Geod(ellps="WGS84").inv(lon, lat, there.lon_deg, there.lat_deg)
    yield "start point, RMS", f"{100 * _rms(apart_m):.2f} cm"
    kept = track["dropped_by"].to_numpy() == 0
    along = truth.at(to_integers(track, "stamp_ns"))
    speed = to_floats(track, "forward_velocity_mps") - along.forward_velocity_mps
    yaw = wrap_to_pi(to_floats(track, "yaw_rad") - rpy_from_quat(along.quat_xyzw)[:, 2])
    yield "forward velocity of the kept track, RMS", f"{_rms(speed[kept]):.4f} m/s"
    yield "yaw of the kept track, RMS", f"{np.degrees(_rms(yaw[kept])):.2f} deg"
    yield "chords, largest departure from 1 m", f"{1e3 * np.abs(to_floats(segments, 'chord_m') - 1).max():.6f} mm"
    energy = run.manifest.info.report.facts.label.energy_joule
    driven_m = sum(run.manifest.distance_by_reason_m.values())
    yield "energy of the whole run", f"{energy / truth.energy_joule[-1] - 1:+.3%} of {truth.energy_joule[-1]:.0f} J"
    yield "odometer", f"{driven_m / truth.distance_m[-1] - 1:+.3%} of {truth.distance_m[-1]:.1f} m"


def describe_net_labels(segments: pa.Table, truth: Truth) -> Iterator[tuple[str, str]]:
    """Yield the same net of idle power; the truth's standing power is that of steps in which nothing moves."""
    still = (truth.wheel_velocity_mps == 0.0) & (np.abs(truth.angular_velocity_radps).max(axis=1) < 1e-6)
    standing = float(np.median(truth.power_watt[still]))
    true = compute_true_cost(truth, to_integers(segments, "start_ns"))
    told, std = to_floats(segments, "idle_power_watt"), to_floats(segments, "idle_power_std_watt")
    yield "idle power", f"{told[0]:.2f} W, claimed deviation {std[0]:.2f} W; truth {standing:.2f} W"
    wanted = true.energy_joule - standing * true.duration_s
    error = to_floats(segments, "net_energy_joule") - wanted
    std = to_floats(segments, "net_energy_std_joule")
    within = [np.mean(np.abs(error) <= k * std) for k in (1, 2)]
    share, bias = np.abs(error).sum() / np.abs(wanted).sum(), error.sum() / np.abs(wanted).sum()
    claimed = (
        f"claimed deviation {std.mean():.3g} J: {within[0]:.0%} of the errors within one, {within[1]:.0%} within two"
    )
    yield "net_energy_joule: sum |error| / sum |truth|", f"{share:.2%} (bias {bias:+.2%}); {claimed}"


def _std_name(label: str) -> str:
    quantity, unit = label.rsplit("_", 1)
    return f"{quantity}_std_{unit}"


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(error))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenario", default="hills12")
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--recipe", type=Path)
    parser.add_argument(
        "--exact-gnss", action="store_true", help="fixes err as white noise, the stated antenna does not"
    )
    given = parser.parse_args()
    scenario = find_scenario(given.scenario)
    if given.exact_gnss:
        drives = (replace(of, sensors=replace(of.sensors, gnss=EXACT_GNSS)) for of in scenario.drives)
        scenario = replace(scenario, drives=tuple(drives))
    with tempfile.TemporaryDirectory() as directory:
        site = simulate(Path(directory) / "site", scenario=scenario, seed=given.seed)
        recipe = load_recipe(given.recipe)
        summary = ingest(site.logs, store=Path(directory) / "store", recipe=recipe)
        if summary.exit_code:
            sys.exit("\n".join(problem for result in summary.results for problem in result.problems))
        for run, truth_path in zip(Store(summary.store).runs(), site.truths, strict=True):
            print(f"{truth_path.stem}: {run.segments().num_rows} segments, estimator {recipe.fuse.estimator}")
            for name, value in figures(run, read_truth(truth_path)):
                print(f"  {name:<45} {value}")


if __name__ == "__main__":
    main()
