"""What a layer of the user's own is worth: RMSE of E and T on drives that were not fitted, with it, with noise, and without.

    python benchmarks/own_layers.py OUT [--drives 12] [--bands 8] [--kinds boosting]

The small simulated site has a rolling resistance that no raster shows. `informed` has bands that are mixtures of it and of two fields that
cost nothing; `noise` has as many random bands. Both are rasters of 0.5 m, added with ``add-map --layer``; whole drives are held out.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from path_coverage import make_store, simulate_drives

from tcpipe.dataset import open_dataset
from tcpipe.dataset.extra_features import read_extra_features
from tcpipe.formats.maps.geotiff import write_geotiff
from tcpipe.learning.fitting import FitConfig
from tcpipe.learning.metrics import compute_costs
from tcpipe.learning.models import load_model
from tcpipe.learning.training import train
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe
from tcpipe.simulation import find_scenario
from tcpipe.simulation.world import World, draw_waves, sum_waves
from tcpipe.terrain.target_grid import MapGrid

PIXEL_M = 0.5
_METRES = 190.0
"""Of a drive."""

PAPER = ("ortho", "terrain", "height")


def make_bands(world: World, count: int, rng: np.random.Generator) -> dict[str, NDArray[np.float32]]:
    """Return the bands of both layers, north up, shape (count, rows, columns)."""
    site = world.site
    u = (np.arange(round(site.width_m / PIXEL_M)) + 0.5)[None, :] * PIXEL_M
    v = (site.height_m - (np.arange(round(site.height_m / PIXEL_M)) + 0.5) * PIXEL_M)[:, None]
    idle = (draw_waves(seed, count=10, total=1.0, wavelength_m=(1.5, 15.0)) for seed in (901, 902))
    fields = np.stack([sum_waves(waves, u, v) for waves in (world.resistance, *idle)])
    fields /= fields.std(axis=(1, 2), keepdims=True)
    mixed = np.tensordot(rng.normal(size=(count, 3)), fields, 1)
    noise = rng.normal(size=mixed.shape)
    return {"informed": (mixed + 0.1 * noise).astype(np.float32), "noise": noise.astype(np.float32)}


def build(out: Path, drives: int, bands: int) -> Path:
    """Return a dataset of the simulated drives, with both layers."""
    site = simulate_drives(out / "site", drives, _METRES, seed=0)
    made = find_scenario("paper_quick").world
    world = made.site
    rasters = {}
    for name, values in make_bands(made, bands, np.random.default_rng(7)).items():
        rasters[name] = out / f"{name}.tif"
        corner = world.west_m, world.south_m + world.height_m
        grid = MapGrid(f"EPSG:{world.epsg}", *corner, PIXEL_M, *values.shape[1:])
        write_geotiff(
            rasters[name], lambda first, last, of=values: of[:, first:last], grid, dtype="float32", bands=bands
        )
    recipe = replace(Recipe(), robot="husky", split=replace(Recipe().split, holdout="run", test_fraction=0.34))
    store = make_store(out, site, rasters)
    print(str(build_dataset(out / "dataset", store=store, recipe=recipe)).splitlines()[0])
    return out / "dataset"


def measure(dataset: Path, out: Path, kind: str, more: tuple[str, ...]) -> str:
    """Train with some layers and return the errors on the held-out drives."""
    data = open_dataset(dataset)
    fold = int(data["train"].column("fold").min())
    config = FitConfig(
        model=kind, layers=(*PAPER, *more), fold=fold, epochs=40, patience=8, learning_rate=1e-3, width=16
    )
    train(dataset, out, config=config)
    model, held = load_model(out), data["test"]
    said = model.predict(held.with_layout(model.card.layout).patches, read_extra_features(held)).mean
    told, true = (compute_costs(*outputs.astype(float).T, 1.0) for outputs in (said, held.labels))
    energy, time = (float(np.sqrt(np.mean((told[name] - true[name]) ** 2))) for name in ("E", "T"))
    return (
        f"E {energy:6.2f} J, T {time:.4f} s on {len(held)} samples of {len(set(held.column('run_id')))} held-out drives"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--drives", type=int, default=12)
    parser.add_argument("--bands", type=int, default=8)
    parser.add_argument("--kinds", nargs="*", default=["boosting"])
    told = parser.parse_args()
    dataset = build(told.out, told.drives, told.bands)
    for kind in told.kinds:
        for more in ((), ("informed",), ("noise",)):
            name = "+".join(("paper", *more))
            print(f"{kind:9} {name:15}: {measure(dataset, told.out / f'{kind}-{name}', kind, more)}", flush=True)


if __name__ == "__main__":
    main()
