"""How often 90 % intervals hold what further drives measure: metres, and paths of 10, 30 and 100 m; and models adapted to another payload.

    python benchmarks/path_coverage.py [--train 10] [--metres 300] [--further 24] [--kind boosting] [--payload 0] [--seed 0]

Drives wander over the small site of `tcpipe demo` with the paper's robot. All of it is the product's way: logs are simulated, ingested,
built into a dataset, a model is trained on the first drives; the further ones, in a store of their own, are predicted on the map as
`tcpipe evaluate --drive` does. Paths follow one another along a drive. Coverage is of the measured labels, over all drives, with its 95 %
interval (binomial, clustered by drive: `tcpipe.cost.coverage`); 90 is to be inside. With --payload the further drives carry so many kg
more. The line of budgets is of paths there and back: two consecutive parts of a drive. The second table predicts the rest of each
further drive after its first metres adapt the model, beside the mean of these metres.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from tcpipe.cost.adaptation import Run, compare_adaptations, format_adaptations
from tcpipe.cost.coverage import measure_coverage
from tcpipe.cost.prediction_errors import COVERAGE, Errors, fit_errors
from tcpipe.learning.fitting import FitConfig
from tcpipe.learning.models import Model, load_model
from tcpipe.learning.training import train
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.maps import add_map
from tcpipe.planning.drives import collect_run
from tcpipe.planning.path_files import RISK, choose_map
from tcpipe.recipe import Recipe
from tcpipe.simulation import SimulatedSite, find_scenario, simulate
from tcpipe.store import open_store

LENGTHS = (1, 10, 30, 100)
KNOWN_M = (0.0, 10.0, 50.0, 100.0)


def drive(place: Path, count: int, metres: float, *, payload_kg: float, seed: int) -> SimulatedSite:
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


def store_of(place: Path, site: SimulatedSite) -> Path:
    """Ingest the logs of a site and add its map."""
    store = place / "store"
    done = ingest(site.logs, store=store, recipe=replace(Recipe(), robot="husky"))
    assert done.exit_code == 0, "\n".join(problem for result in done.results for problem in result.problems)
    add_map("site", store=store, **site.rasters)
    return store


def measure(here: Path, *, given: argparse.Namespace) -> tuple[Model, list[Run]]:
    """Return a model of some drives, and further drives as it predicts and they measured them."""
    site = drive(here / "train" / "site", given.train, given.metres, payload_kg=0.0, seed=given.seed)
    store = store_of(here / "train", site)
    build_dataset(here / "dataset", store=store, recipe=replace(Recipe(), robot="husky"))
    train(here / "dataset", here / "model", config=FitConfig(model=given.kind))
    model = load_model(here / "model")
    further = drive(
        here / "further" / "site", given.further, given.metres, payload_kg=given.payload, seed=given.seed + 1000
    )
    store = store_of(here / "further", further)
    source = choose_map(store, None)
    return model, [collect_run(model, source, run) for run in open_store(store).runs()]


def coverage_line(quantity: str, length: int, errors: Errors, runs: list[Run]) -> str:
    """Return how many paths of a length are inside their interval, and how wide that is."""
    inside, names, widths = [], [], []
    for run in runs:
        of = run.metres[quantity]
        for first in range(0, len(of.predicted) - length + 1, length):
            rows = slice(first, first + length)
            said, class_id, measured = of.predicted[rows], of.class_id[rows], float(of.measured[rows].sum())
            alone, total = errors.compute_intervals(said, class_id), errors.compute_sum(said, class_id)
            low, high = (float(end[0]) for end in alone) if length == 1 else total.interval
            inside.append(low <= measured <= high)
            names.append(run.name)
            widths.append((high - low) / 2.0 / float(np.abs(said).sum()))
    if not inside:
        return f"{quantity:8} {length:4d} m: no drive is as long"
    found = measure_coverage(np.array(inside), np.array(names))
    verdict = (
        "undecided"
        if found.low is None
        else "90 is inside"
        if found.low <= COVERAGE <= (found.high or 0.0)
        else "90 is NOT inside"
    )
    return (
        f"{quantity:8} {length:4d} m: {found} of {found.samples}: {verdict}; ± {100.0 * float(np.median(widths)):.1f} %"
    )


def budget_line(errors: Errors, runs: list[Run], length: int = 30) -> str:
    """Return for how many ways there and back of a drive a budget suffices that `plan-path --budget --return` calls enough at 95 %."""
    is_enough, names = [], []
    for run in runs:
        of = run.metres["energy"]
        for first in range(0, len(of.predicted) - 2 * length + 1, 2 * length):
            there, back = slice(first, first + length), slice(first + length, first + 2 * length)
            sums = [errors.compute_sum(of.predicted[way], of.class_id[way]) for way in (there, back)]
            budget = (sums[0] + sums[1]).compute_quantile(RISK)
            is_enough.append(float(of.measured[first : first + 2 * length].sum()) <= budget)
            names.append(run.name)
    if not is_enough:
        return f"budget 2 x {length} m: no drive is as long"
    found = measure_coverage(np.array(is_enough), np.array(names))
    return f"budget 2 x {length} m: enough for {found} of {found.samples}, at least {RISK:.0%} wanted"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", type=int, default=10)
    parser.add_argument("--metres", type=float, default=300.0)
    parser.add_argument("--further", type=int, default=24)
    parser.add_argument("--kind", default="boosting")
    parser.add_argument("--payload", type=float, default=0.0, metavar="KG")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        model, runs = measure(Path(name), given=given)
    errors = fit_errors(model.residuals)
    assert errors is not None, "too few samples to train on"
    metres = np.mean([run.metres["energy"].length_m.sum() for run in runs])
    print(
        f"{model.card.training.samples['fitted']} samples of {given.train} drives; {len(runs)} further ones, {metres:.0f} m each"
    )
    for quantity in ("duration", "energy"):
        for length in LENGTHS:
            print(coverage_line(quantity, length, errors[quantity], runs))
    print(budget_line(errors["energy"], runs))
    both = {quantity: errors[quantity] for quantity in ("energy", "duration")}
    known_m = [metres for metres in KNOWN_M if metres <= given.metres / 3.0]
    print(*format_adaptations(list(compare_adaptations(both, runs, known_m))), sep="\n")


if __name__ == "__main__":
    main()
