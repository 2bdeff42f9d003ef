"""What can be predicted of real drives where there is no map: time and energy of a metre from slope, turn and commanded speed alone.

    python benchmarks/real_data.py DRIVE=LOG[,RECIPE] [DRIVE=LOG[,RECIPE] ...]

Logs are ingested; the class of the ground is not known. Fitted are the mean, physics (`cost/physics.py`; the speed by a line over the
slope, of the commanded speed where there is one), and boosted trees on the same numbers. Held out are, in turn, fifths of the drive
and, between two drives, the whole other drive. 90 % intervals, NLL and CRPS come from a second cross-fit inside what
is fitted on, so that nothing held out has told them. The floor is what the labels' own deviations make of a perfect prediction. Beside the
real ones stands a simulated drive of as many metres as the longest (labels, no logs: benchmarks/path_coverage.py), of which the class is
not told either.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from path_coverage import END_STD_M, drive

from tcpipe import ingest
from tcpipe.cost.physics import ALL, FitSamples, fit_physics
from tcpipe.cost.prediction_errors import fit_bias_correction, fit_errors
from tcpipe.formats.recipe_toml import load_recipe
from tcpipe.learning.metrics import (
    LEAST,
    LEAST_VELOCITY_MPS,
    Errors,
    Spread,
    compute_costs,
    compute_errors,
    label_floor,
)
from tcpipe.learning.table_model import grow
from tcpipe.simulation import find_scenario
from tcpipe.store import Store
from tcpipe.tables.columns import to_floats

Floats = NDArray[np.float64]

FOLDS = 5
QUANTITIES = {"T": "duration", "E": "energy"}


@dataclass(frozen=True)
class Metre:
    """Labelled metres of a drive, in order, shape (N,) each."""

    power: Floats
    velocity: Floats
    rise: Floats
    turn_radpm: Floats
    command: Floats
    """Commanded speed [m/s]; 1 where none is known."""
    duration_std: Floats
    energy_std: Floats
    start_ns: NDArray[np.int64]

    def take(self, rows: NDArray[np.bool_]) -> Metre:
        """Return some of them."""
        return Metre(*(getattr(self, of.name)[rows] for of in fields(self)))


def recorded(log: str, recipe: str | None) -> Metre:
    """Return the labelled segments of a log."""
    with tempfile.TemporaryDirectory() as directory:
        ingest([Path(log)], store=Path(directory) / "store", recipe=load_recipe(Path(recipe) if recipe else None))
        found = Store(Path(directory) / "store").runs()[0].segments().sort_by("start_ns")
    command = to_floats(found, "commanded_velocity_mps")
    velocity = to_floats(found, "velocity_mps")
    metres = Metre(
        to_floats(found, "power_watt"), velocity,
        (to_floats(found, "end_z_m") - to_floats(found, "start_z_m")) / to_floats(found, "chord_m"),
        to_floats(found, "turn_rate_radps") / velocity, np.where(np.isfinite(command), command, 1.0),
        to_floats(found, "duration_std_s"), to_floats(found, "energy_std_joule"), to_floats(found, "start_ns").astype(np.int64),
    )  # fmt: skip
    return metres.take(np.isfinite(metres.power + metres.velocity + metres.rise + metres.turn_radpm))


def simulated(metres: int) -> Metre:
    """Return a simulated drive on all classes, of which none is told."""
    site = find_scenario("paper")
    made = drive(site.world, site.drives[0].robot, np.random.default_rng(0), metres=metres + 10.0, run="simulated")
    still = np.zeros(len(made.block))
    time = 1.0 / made.velocity_mps
    std = np.sqrt(2.0) * END_STD_M * time
    return Metre(
        made.power_watt, made.velocity_mps, np.tan(made.features[:, 0]), still, still + 1.0, std, std * made.power_watt, made.start_ns
    ).take(np.arange(len(still)) < metres)  # fmt: skip


Predictor = Callable[[Metre], Floats]
"""Power and velocity, shape (N, 2)."""


def by_mean(of: Metre) -> Predictor:
    energy, time = float((of.power / of.velocity).mean()), float((1.0 / of.velocity).mean())
    return lambda there: np.tile([energy / time, 1.0 / time], (len(there.power), 1))


def by_physics(of: Metre) -> Predictor:
    rate = np.polyfit(of.rise, of.velocity / of.command, 1)

    def metres_of(there: Metre, velocity: Floats) -> FitSamples:
        return FitSamples(there.power, velocity, there.rise, there.turn_radpm * velocity, np.full(len(velocity), ALL))

    found = fit_physics(metres_of(of, of.velocity))
    assert found is not None, "fewer than 20 segments"

    def predict(there: Metre) -> Floats:
        velocity = np.maximum(there.command * np.polyval(rate, there.rise), LEAST_VELOCITY_MPS)
        return np.column_stack([found.power_watt(metres_of(there, velocity)), velocity])

    return predict


def by_trees(of: Metre) -> Predictor:
    def features(there: Metre) -> Floats:
        return np.column_stack([there.rise, there.turn_radpm, there.command])

    labels = np.column_stack([of.power, of.velocity])
    forest, _ = grow(features(of), labels, np.ones_like(labels), _folds(len(labels)))
    return lambda there: np.maximum(forest.predict(features(there)), [-np.inf, LEAST_VELOCITY_MPS])


MODELS = {"mean": by_mean, "physics": by_physics, "boosted trees": by_trees}


def _folds(count: int) -> NDArray[np.int64]:
    return np.arange(count) * FOLDS // count


@dataclass(frozen=True)
class Told:
    """What a predictor says of held-out metres, centred, and what it states of its errors."""

    said: dict[str, Floats]
    spread: dict[str, Spread]


def told(fit: Callable[[Metre], Predictor], known: Metre, there: Metre) -> Told:
    """Fit to some metres and predict others; what errors are like is told by folds of the first."""
    folds, held = _folds(len(known.power)), np.empty((len(known.power), 2))
    for fold in np.unique(folds):
        held[folds == fold] = fit(known.take(folds != fold))(known.take(folds == fold))
    residuals = {
        "run_id": np.zeros(len(held), np.int64), "start_ns": known.start_ns, "terrain_class": np.zeros(len(held)),
        "power_watt": known.power, "velocity_mps": known.velocity,
        "power_predicted_watt": held[:, 0], "velocity_predicted_mps": held[:, 1],
    }  # fmt: skip
    nowhere, found = np.zeros(len(there.power), np.int64), fit_errors(residuals)
    assert found is not None, "fewer than 20 segments"
    said = compute_costs(*fit_bias_correction(residuals).apply(*fit(known)(there).T, nowhere), 1.0)
    spread = {
        name: Spread(found[of].compute_std(said[name], nowhere), *found[of].compute_intervals(said[name], nowhere))
        for name, of in QUANTITIES.items()
    }
    return Told({name: said[name] for name in QUANTITIES}, spread)


def by_blocks(fit: Callable[[Metre], Predictor], of: Metre) -> Told:
    """Return what is said of each fifth of a drive by the others."""
    folds = _folds(len(of.power))
    parts = [
        (np.flatnonzero(folds == fold), told(fit, of.take(folds != fold), of.take(folds == fold)))
        for fold in range(FOLDS)
    ]
    back = np.argsort(np.concatenate([rows for rows, _ in parts]))

    def whole(what: Callable[[Told], Floats]) -> Floats:
        return np.concatenate([what(part) for _, part in parts])[back]

    return Told(
        {name: whole(lambda part, name=name: part.said[name]) for name in QUANTITIES},
        {
            name: Spread(
                *(whole(lambda part, n=name, a=end.name: getattr(part.spread[n], a)) for end in fields(Spread))
            )
            for name in QUANTITIES
        },
    )


UNITS = {"T": ("s", 3), "E": ("J", 0)}


def lines(name: str, held_out: str, model: str, of: Metre, found: Told) -> Iterator[str]:
    """Yield the table's rows of a drive and a model."""
    measured = {"T": 1.0 / of.velocity, "E": of.power / of.velocity}
    for quantity in UNITS:
        found_errors = compute_errors(found.said[quantity], measured[quantity], LEAST[quantity], found.spread[quantity])
        yield _row(name, held_out, model, found_errors, quantity)


def _row(name: str, held_out: str, model: str, of: Errors, quantity: str) -> str:
    unit, digits = UNITS[quantity]
    mape = "–" if of.mape_percent is None else f"{of.mape_percent:.1f} ({of.mape_count} of {of.count})"
    scores = (
        ["–"] * 3 if of.nll is None else [f"{of.held_percent:.0f}", f"{of.nll:.2f}", f"{of.crps:.{digits}f} {unit}"]
    )
    return "| " + " | ".join([name, held_out, model, quantity, f"{of.rmse:.{digits}f} {unit}", mape, *scores]) + " |"


def floor_lines(name: str, of: Metre) -> Iterator[str]:
    """Yield the rows of what the labels' own deviations make of a perfect prediction."""
    measured, std = {"T": 1.0 / of.velocity, "E": of.power / of.velocity}, {"T": of.duration_std, "E": of.energy_std}
    found = label_floor(std, measured, np.zeros(len(of.power), np.int64), {0: "unknown"})
    for quantity in UNITS:
        yield _row(name, "–", "floor: labels alone", found[quantity]["all"], quantity)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drives", nargs="+", metavar="DRIVE=LOG[,RECIPE]")
    drives = {}
    for entry in parser.parse_args().drives:
        name, _, place = entry.partition("=")
        log, _, recipe = place.partition(",")
        drives[name] = recorded(log, recipe or None)
    drives["simulated"] = simulated(max(len(of.power) for of in drives.values()))
    print(
        "| drive | held out | model | of | RMSE | MAPE [%] (labels) | held by 90 % [%] | NLL [nat] | CRPS |\n"
        + "|---" * 9
        + "|"
    )
    for name, of in drives.items():
        named = f"{name}, {len(of.power)} m"
        print(*floor_lines(named, of), sep="\n")
        for model, fit in MODELS.items():
            print(*lines(named, "blocks", model, of, by_blocks(fit, of)), sep="\n", flush=True)
    real = [name for name in drives if name != "simulated"]
    for name in real:
        for other in real:
            if other != name:
                for model, fit in MODELS.items():
                    print(
                        *lines(
                            f"{name}, {len(drives[name].power)} m",
                            f"all: by {other}",
                            model,
                            drives[name],
                            told(fit, drives[other], drives[name]),
                        ),
                        sep="\n",
                    )


if __name__ == "__main__":
    main()
