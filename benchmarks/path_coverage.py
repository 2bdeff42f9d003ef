"""How often 90 % intervals hold what further drives measure: metres, and paths of 10, 30 and 100 m; and models adapted to another payload.

    python benchmarks/path_coverage.py [--train 6] [--metres 220] [--further 8] [--kind boosting] [--payload 0] [--seed
    0] [--models 3]

Drives wander over the small site of `tcpipe demo` with the paper's robot. All of it is the product's way: logs are
simulated, ingested, built into a dataset, a model is trained on the first drives; the further ones, in a store of their
own, are predicted on the map as `tcpipe evaluate --drive` does; all of it for --models seeds. Paths follow one another
along a drive. Coverage is of the measured labels, over all drives, with its 95 % interval (binomial, clustered by
drive: `tcpipe.cost.coverage`); 90 is to be inside. With --payload the further drives carry so many kg more. The line of
budgets is of two consecutive paths of a drive together. The second table predicts the rest of each further drive of the
last seed after its first metres adapt the model.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from adapted_drives import compare_adaptations

from tcpipe.cost.adaptation import MeasuredRun, Metres, predict
from tcpipe.cost.coverage import measure_coverage
from tcpipe.cost.prediction_errors import COVERAGE, NORMAL_HALF_WIDTH, QuantityErrors
from tcpipe.learning.fitting import FitConfig
from tcpipe.learning.models import Model, load_model
from tcpipe.learning.training import train
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.maps import add_map
from tcpipe.planning.drives import collect_runs
from tcpipe.planning.path_files import RISK, choose_map
from tcpipe.recipe import Recipe
from tcpipe.simulation import SimulatedSite, find_scenario, simulate
from tcpipe.store import open_store

LENGTHS = (1, 10, 30, 100)
KNOWN_M = (0.0, 10.0, 50.0, 100.0)


def simulate_drives(place: Path, count: int, metres: float, *, seed: int, payload_kg: float = 0.0) -> SimulatedSite:
    """Simulate drives over the small site."""
    site = find_scenario("paper_quick")
    robot = site.drives[0].robot
    robot = replace(robot, mass_kg=robot.mass_kg + payload_kg)
    drives = tuple(
        replace(spec, name=f"drive_{number:02d}", plan=replace(spec.plan, length_m=metres), robot=robot)
        for number in range(count)
        for spec in [site.drives[number % len(site.drives)]]
    )
    return simulate(place, scenario=replace(site, drives=drives), seed=seed)


def make_store(place: Path, site: SimulatedSite, layers: Mapping[str, Path] | None = None) -> Path:
    """Ingest the logs of a site and add its map, with further layers."""
    store = place / "store"
    done = ingest(site.logs, store=store, recipe=replace(Recipe(), robot="husky"))
    assert done.exit_code == 0, "\n".join(problem for result in done.results for problem in result.problems)
    add_map("site", store=store, layer=layers or {}, **site.rasters)
    return store


def measure(here: Path, seed: int, *, given: argparse.Namespace) -> tuple[Model, list[MeasuredRun]]:
    """Return a model of some drives, and further drives as it predicts and they measured them."""
    site = simulate_drives(here / "train" / "site", given.train, given.metres, seed=seed)
    store = make_store(here / "train", site)
    build_dataset(here / "dataset", store=store, recipe=replace(Recipe(), robot="husky"))
    train(here / "dataset", here / "model", config=FitConfig(model=given.kind))
    model = load_model(here / "model")
    further = simulate_drives(
        here / "further" / "site", given.further, given.metres, payload_kg=given.payload, seed=seed + 1000
    )
    store = make_store(here / "further", further)
    source, opened = choose_map(store, None), open_store(store)
    return model, collect_runs(model, source, opened, [run.run_id for run in opened.runs()])


Found = list[tuple[dict[str, QuantityErrors], MeasuredRun]]
"""Further drives, each with the errors of the model that predicts it."""


def list_paths(found: Found, quantity: str, length: int) -> Iterator[tuple[str, QuantityErrors, Metres]]:
    """Yield consecutive paths of a length along each drive, with its name and the model's errors."""
    for errors, run in found:
        metres = run.metres[quantity]
        at = np.arange(len(metres.predicted))
        for first in range(0, len(at) - length + 1, length):
            yield run.name, errors[quantity], metres.take((at >= first) & (at < first + length))


def format_coverage(quantity: str, length: int, found: Found) -> str:
    """Return how many paths of a length are inside their interval, how wide that is, and the rms of errors over their σ."""
    inside, names, widths, scores = [], [], [], []
    for name, errors, path in list_paths(found, quantity, length):
        said = predict(errors, path)
        low, high = (float(said.low[0]), float(said.high[0])) if length == 1 else said.total.interval
        inside.append(low <= float(path.measured.sum()) <= high)
        names.append(name)
        widths.append((high - low) / 2.0 / float(np.abs(path.predicted).sum()))
        scores.append(float((path.measured - path.predicted).sum()) * 2.0 * NORMAL_HALF_WIDTH / (high - low))
    if not inside:
        return f"{quantity:8} {length:4d} m: no drive is as long"
    share = measure_coverage(np.array(inside), np.array(names))
    verdict = "undecided"
    if share.low is not None:
        verdict = "90 is inside" if share.low <= COVERAGE <= (share.high or 0.0) else "90 is NOT inside"
    width = 100.0 * float(np.median(widths))
    rms = float(np.sqrt(np.mean(np.square(scores))))
    return f"{quantity:8} {length:4d} m: {share} of {share.samples}: {verdict}; ± {width:.1f} %, rms z {rms:.2f}"


def format_budget(found: Found, length: int = 30) -> str:
    """Return for how many pairs of paths of a drive a budget suffices that `plan-path --budget` calls enough at 95 % for both together."""
    is_enough, names = [], []
    for name, errors, path in list_paths(found, "energy", 2 * length):
        at = np.arange(2 * length)
        sums = [predict(errors, path.take(way)).total for way in (at < length, at >= length)]
        is_enough.append(float(path.measured.sum()) <= (sums[0] + sums[1]).compute_quantile(RISK))
        names.append(name)
    if not is_enough:
        return f"budget 2 x {length} m: no drive is as long"
    share = measure_coverage(np.array(is_enough), np.array(names))
    return f"budget 2 x {length} m: enough for {share} of {share.samples}, at least {RISK:.0%} wanted"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", type=int, default=6)
    parser.add_argument("--metres", type=float, default=220.0)
    parser.add_argument("--further", type=int, default=8)
    parser.add_argument("--kind", default="boosting")
    parser.add_argument("--payload", type=float, default=0.0, metavar="KG")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--models", type=int, default=3)
    given = parser.parse_args()
    found: Found = []
    for seed in range(given.seed, given.seed + given.models):
        with tempfile.TemporaryDirectory() as name:
            model, runs = measure(Path(name), seed, given=given)
        errors = model.errors
        assert errors is not None, "too few samples to train on"
        found += [(errors, replace(run, name=f"{seed}-{run.name}")) for run in runs]
        metres = np.mean([run.metres["energy"].length_m.sum() for run in runs])
        fitted = model.card.training.samples["fitted"]
        print(f"seed {seed}: {fitted} samples of {given.train} drives; {len(runs)} further ones, {metres:.0f} m each")
    for quantity in ("duration", "energy"):
        for length in LENGTHS:
            print(format_coverage(quantity, length, found))
    print(format_budget(found))
    known_m = [metres for metres in KNOWN_M if metres <= given.metres / 3.0]
    both = {quantity: errors[quantity] for quantity in ("energy", "duration")}
    print(*compare_adaptations(both, runs, known_m), sep="\n")


if __name__ == "__main__":
    main()
