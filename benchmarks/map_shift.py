"""Shifts of a map against several runs: each run alone, and shared by all runs of the site, on random sites.

    python benchmarks/map_shift.py [--sites 20] [--first-seed 1000]

The map is off by 0.3 to 3 m, tilted by 1.5 %, noisy (3 cm a pixel of 0.5 m, and 2 cm over metres); heights of tracks drift by 2 cm.
A shift is applied where it and a track of 2 cm (DRMS) are known to 10 cm together, as `sample.align` does. "inside": of both axes' errors
inside two standard deviations. "mean": every run takes the mean of the applicable shifts, with their scatter.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from map_worlds import ArrayMap

from tcpipe.terrain.registration import Registration, register_tracks, share_shift, thin_tracks
from tcpipe.terrain.target_grid import MapGrid

Floats = NDArray[np.float64]
SIDE_M, PIXEL_M, STEP_M, MARGIN_M = 160.0, 0.5, 0.04, 10.0
TRACK_STD_M, MOST_STD_M, MOST_MISFIT_M = 0.02, 0.1, 0.3
SITES = {
    "6 runs of 30 to 240 m anywhere": {"relief_m": 0.2, "runs": 6},
    "12 runs of 30 to 240 m anywhere": {"relief_m": 0.2, "runs": 12},
    "8 runs of 240 m in one lane": {"relief_m": 0.2, "runs": 8, "lane": True, "lengths_m": (240,)},
    "the same, gentler ground": {"relief_m": 0.15, "runs": 8, "lane": True, "lengths_m": (240,)},
    "the same, map off by 6 cm": {"relief_m": 0.25, "runs": 8, "lane": True, "lengths_m": (240,), "warp_m": 0.06},
    "8 runs, tilt 3 %": {"relief_m": 0.25, "runs": 8, "tilt": 0.03},
    "10 runs, fixes off by 6 cm, 2 stated": {"relief_m": 0.2, "runs": 10, "bias_m": 0.04},
    "8 runs of 120 or 240 m, one off by 0.5 m": {"relief_m": 0.25, "runs": 8, "other_m": 0.5, "lengths_m": (120, 240)},
}


class Waves:
    """A sum of random waves over x and y, of unit variance for each length."""

    def __init__(self, rng: np.random.Generator, lengths_m: tuple[float, ...], count: int = 20) -> None:
        self.k = rng.normal(0.0, 1.0, (len(lengths_m), count, 2)) / np.array(lengths_m)[:, None, None]
        self.phase = rng.uniform(0.0, 2.0 * np.pi, (len(lengths_m), count))

    def at(self, x: Floats, y: Floats, std_m: tuple[float, ...]) -> Floats:
        """Return the sum, with a standard deviation for each length."""
        heights = np.zeros(np.shape(x))
        for k, phase, std in zip(self.k, self.phase, std_m, strict=True):
            for (u, v), p in zip(k, phase, strict=True):
                heights += std * np.sqrt(2.0 / len(k)) * np.sin(u * x + v * y + p)
        return heights


def drift(rng: np.random.Generator, count: int, over: int) -> Floats:
    """Return noise of unit variance that is alike over so many points."""
    return np.convolve(rng.normal(0.0, 1.0, count + over), np.ones(over) / np.sqrt(over), "valid")[:count]


def drive(rng: np.random.Generator, length_m: float) -> Floats:
    """Return a winding path that stays on the site."""
    count = int(length_m / STEP_M)
    course = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(0.003 * drift(rng, count, 200))
    xy = rng.uniform(30.0, SIDE_M - 30.0, 2) + np.cumsum(STEP_M * np.stack([np.cos(course), np.sin(course)], 1), axis=0)
    width_m = SIDE_M - 2.0 * MARGIN_M
    return np.asarray(MARGIN_M + np.abs((xy - MARGIN_M) % (2.0 * width_m) - width_m))


def make_site(
    seed: int,
    relief_m: float,
    runs: int,
    *,
    lane: bool = False,
    lengths_m: tuple[float, ...] = (30, 60, 120, 240),
    tilt: float = 0.015,
    warp_m: float = 0.02,
    bias_m: float = 0.01,
    other_m: float = 0.0,
) -> tuple[ArrayMap, list[tuple[Floats, Floats, Floats]]]:
    """Return a map, and positions, heights and true shift of each run."""
    rng = np.random.default_rng([seed, 77])
    ground, warp, count = Waves(rng, (3.0, 15.0)), Waves(rng, (8.0,)), int(SIDE_M / PIXEL_M)
    std_m = (relief_m, 6.0 * relief_m)
    grid = MapGrid("EPSG:32633", 0.0, SIDE_M, PIXEL_M, count, count)
    x, y = np.moveaxis(grid.xy_from_px(np.stack(np.meshgrid(*2 * [np.arange(float(count))]), -1)), -1, 0)
    angle, towards = rng.uniform(0.0, 2.0 * np.pi, 2)
    height = ground.at(x, y, std_m) + warp.at(x, y, (warp_m,)) + rng.normal(0.0, 0.03, x.shape)
    height += tilt * (np.cos(angle) * x + np.sin(angle) * y)
    source = ArrayMap(grid, {"height": height.astype(np.float32)}, tile_px=256, height_reference_m=600.0)
    shift_m = rng.uniform(0.3, 3.0) * np.array([np.cos(towards), np.sin(towards)])
    first, found = drive(rng, max(lengths_m)), []
    for number in range(runs):
        length_m = rng.choice(lengths_m)
        xy = first[: int(length_m / STEP_M)] + rng.normal(0.0, 0.15, 2) if lane else drive(rng, length_m)
        own_m = shift_m + rng.normal(0.0, bias_m, 2) + (other_m, 0.0) * np.array(number == runs - 1)
        z = 646.0 + ground.at(*(xy + own_m).T, std_m) + 0.02 * drift(rng, len(xy), 400)
        found.append((xy, z, own_m))
    return source, found


def is_applied(found: Registration) -> bool:
    """Return whether ``sample.align`` would apply a shift that fits the map's ground."""
    return bool(np.hypot(found.position_std_m, TRACK_STD_M) <= MOST_STD_M)


def measure_site(
    source: ArrayMap, runs: list[tuple[Floats, Floats, Floats]]
) -> dict[str, list[tuple[Floats, Floats, int]]]:
    """Return error and standard deviation of both axes [m] of the applied shifts, and their points, by method; and runs that differ."""
    fits = [
        (found, run)
        for run in runs
        if (found := register_tracks(source, [run[:2]])) and not found.at_reach and found.shape_misfit_m < MOST_MISFIT_M
    ]
    rows: dict[str, list[tuple[Floats, Floats, int]]] = {"alone": [], "mean": [], "shared": [], "differ": []}
    if len(fits) < 2:
        return rows
    alone = [found for found, _ in fits]
    together = register_tracks(source, [thin_tracks([run[:2]])[0] for _, run in fits])
    shared = share_shift(alone, together, np.full(len(fits), TRACK_STD_M))
    applied = np.array([of.shift_xy_m for of in alone if is_applied(of)])
    for (own, (xy, _, true_m)), given in zip(fits, shared, strict=True):
        taken = given.registration
        taken = own if taken is None or own.position_std_m <= taken.position_std_m else taken
        for method, of in (("alone", own), ("shared", taken)):
            if is_applied(of):
                rows[method].append((of.shift_xy_m - true_m, of.axis_std_m, len(xy)))
        if len(applied) > 1:
            rows["mean"].append((applied.mean(axis=0) - true_m, applied.std(axis=0, ddof=1), len(xy)))
        if np.isfinite(given.difference_m):
            rows["differ"].append((own.shift_xy_m - true_m, own.axis_std_m, len(xy)))
    return rows


def main() -> None:
    """Print a row for each kind of site and method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sites", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1000)
    asked = parser.parse_args()
    for name, how in SITES.items():
        pooled: dict[str, list[tuple[Floats, Floats, int]]] = {}
        points = 0
        for seed in range(asked.first_seed, asked.first_seed + asked.sites):
            source, runs = make_site(seed, **how)  # type: ignore[arg-type]
            points += sum(len(xy) for xy, _, _ in runs)
            for method, rows in measure_site(source, runs).items():
                pooled.setdefault(method, []).extend(rows)
        print(f"{name}: {len(pooled.pop('differ'))} of {asked.sites * len(runs)} runs are said to differ")
        for method, rows in pooled.items():
            if not rows:
                print(f"  {method:7} none applied")
                continue
            error_m, std_m, lengths = (np.array(column) for column in zip(*rows, strict=True))
            share, inside = lengths.sum() / points, (np.abs(error_m) < 2.0 * std_m).mean()
            rms_m = np.sqrt((error_m**2).sum(axis=1).mean())
            print(
                f"  {method:7} {share:4.0%} of path applied, {inside:4.0%} inside, rms {100 * rms_m:.1f} cm", flush=True
            )


if __name__ == "__main__":
    main()
