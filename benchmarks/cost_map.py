"""Throughput of `tcpipe cost-map` as a ratio to the bare forward pass of the same network on the same number of ready patches.

    python benchmarks/cost_map.py [SIDE_M] [WIDTH]

A site of SIDE_M x SIDE_M (default 16: some 3,500 patches), three layers at 0.05 m, in a store; ResNet-18 with random
weights (WIDTH filters in its first stage; 64 is the paper's). The cost map is the whole of it: opening, decoding,
sampling, judging, predicting, GeoTIFFs, Nav2 maps, checksums. Rounds alternate in one process. The ratio of the clock
is what a user waits; that of CPU time does not depend on what else runs. Also: how much of the time sampling and
judging take without the network.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from made_models import made_model
from map_worlds import World

from tcpipe.formats.maps.building import build_map
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.learning.model_card import TrainingRange
from tcpipe.learning.models import Model, load_model
from tcpipe.planning.cost_grid import make_survey
from tcpipe.planning.cost_map import make_cost_map

ROUNDS = 5
WANTED = 0.9


def timed(run: Callable[[], object]) -> tuple[float, float]:
    """Return seconds of clock and of CPU time."""
    clock, cpu = time.perf_counter(), time.process_time()
    run()
    return time.perf_counter() - clock, time.process_time() - cpu


def prepared(directory: Path, side_m: float, width: int) -> tuple[MapFile, Model]:
    """Return a map and a model that has seen all of it."""
    layers = World("EPSG:32633", 500_000.0, 5_200_000.0, side_m).write(directory, 0.05)
    build_map(directory / "site.zarr", name="site", **layers)
    ranges = {"slope_rad": (-1.5, 1.5), "cross_slope_rad": (-1.5, 1.5), "relief_m": (0.0, 9.0)}
    seen = TrainingRange(dict.fromkeys((4, 5, 6, 7), 100), (4, 5, 6, 7), ranges)
    made_model(directory / "model", training_range=seen, width=width)
    return open_map(directory / "site.zarr"), load_model(directory / "model")


def main() -> None:
    side_m = float(sys.argv[1]) if len(sys.argv) > 1 else 16.0
    width = int(sys.argv[2]) if len(sys.argv) > 2 else 64
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        source, model = prepared(directory, side_m, width)
        costs = make_cost_map(model, source, directory / "warm", cell_size_m=1.0).card.cells
        survey = make_survey(model, source, 1.0)
        survey.predict(np.ones_like(survey.predicted))
        patches = int(np.count_nonzero(np.isfinite(survey.costs.velocity_mps)))
        together = model.card.layout.batch_rows
        ready = np.random.default_rng(0).random((together, 40, 40, 3)).astype(np.float32)

        def forward() -> None:
            for first in range(0, patches, together):
                model.predict(ready[: min(together, patches - first)])

        spent = []
        for number in range(ROUNDS):
            mapped = timed(lambda n=number: make_cost_map(model, source, directory / f"map{n}", cell_size_m=1.0))
            spent.append((mapped, timed(forward)))
    print(f"{costs.with_cost} cells with a cost, {patches} predictions, ResNet-18 of width {width}")
    for at, kind in enumerate(("clock", "CPU time")):
        ratio = median(forward[at] / mapped[at] for mapped, forward in spent)
        rate = patches / median(mapped[at] for mapped, _ in spent)
        print(f"{kind:9s} {rate:7.0f} patches/s   {ratio:.2f} x the bare forward pass (goal at least {WANTED})")


if __name__ == "__main__":
    main()
