"""Measure how well slope, turn and speed alone predict time and energy of a metre of real drives without a map.

    python benchmarks/real_data.py DRIVE=LOG[,RECIPE] [DRIVE=LOG[,RECIPE] ...]
    python benchmarks/real_data.py --classes STORE

Logs are ingested; the class of the ground is not known. Fitted are the mean of the other metres, their mean power at
the speed, physics (`cost/physics.py`; the speed by a line over the slope, of the commanded speed), and boosted trees on
slope, turn and commanded speed. Without a commanded speed the speed of the track is used: E is then that of a metre
whose speed is known, and T is not predicted; E and T without the speed are printed as well. Each fifth of the drive is
held out in turn and, between two drives, the whole other drive. The mean of the held-out block itself, which no model
knows, is printed for comparison. R² is one less the squared errors over those of the mean of all metres. 90 %
intervals, NLL and CRPS come from a second cross-fit inside the fitted part, so that they do not depend on held-out
data. The floor is the error of a perfect prediction, given the standard deviations of the labels.

Between two drives a second table shows physics and trees of the other drive after the first K metres of this one adapt
them (`tcpipe.cost.adaptation`), on the metres after the largest K, beside the mean of these K metres.

``--classes`` prints the energy per metre of a store's runs by the class of their ground, which is the first word of
their names. Runs are the unit: the mean over runs, the standard deviation between them, and the error of the mean of
the other runs of a class as a prediction of a run, compared with the mean of all other runs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from itertools import permutations
from pathlib import Path

import lightgbm
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from adapted_drives import compare_adaptations

from tcpipe import ingest
from tcpipe.cost.adaptation import MeasuredRun, Metres
from tcpipe.cost.physics import ALL, FitSamples, fit_physics
from tcpipe.cost.prediction_errors import QuantityErrors, fit_bias_correction, fit_errors
from tcpipe.formats.recipe_toml import load_recipe
from tcpipe.learning.metrics import (
    LEAST,
    LEAST_VELOCITY_MPS,
    Errors,
    Spread,
    compute_costs,
    compute_errors,
    compute_label_floor,
)
from tcpipe.learning.table_model import grow
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
    """Commanded speed [m/s]; where none is known that of the track, or 1 of a simulated drive."""
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
        to_floats(found, "mean_abs_yaw_rate_radps") / velocity, np.where(np.isfinite(command), command, velocity),
        to_floats(found, "duration_std_s"), to_floats(found, "energy_std_joule"), to_floats(found, "start_ns").astype(np.int64),
    )  # fmt: skip
    return metres.take(np.isfinite(metres.power + metres.velocity + metres.rise + metres.turn_radpm))


def forget_speed(of: Metre) -> Metre | None:
    """Return metres whose command is the track's own speed without it; None where one was commanded."""
    is_known = not np.array_equal(of.command, of.velocity)
    return None if is_known else replace(of, command=np.ones_like(of.command))


Predictor = Callable[[Metre], Floats]
"""Power and velocity, shape (N, 2)."""


def by_mean(of: Metre) -> Predictor:
    energy, time = float((of.power / of.velocity).mean()), float((1.0 / of.velocity).mean())
    return lambda there: np.tile([energy / time, 1.0 / time], (len(there.power), 1))


def by_mean_power(of: Metre) -> Predictor:
    power, share = float(of.power.mean()), float((of.velocity / of.command).mean())
    return lambda there: np.column_stack([np.full(len(there.power), power), share * there.command])


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
    texts, _, _ = grow(features(of), labels, _folds(len(labels)))
    trees = [lightgbm.Booster(model_str=text) for text in texts]

    def predict(there: Metre) -> Floats:
        outputs = np.column_stack([tree.predict(features(there)) for tree in trees])
        return np.maximum(outputs, [-np.inf, LEAST_VELOCITY_MPS])

    return predict


MODELS = {"mean": by_mean, "mean power": by_mean_power, "physics": by_physics, "boosted trees": by_trees}


def _folds(count: int) -> NDArray[np.int64]:
    return np.arange(count) * FOLDS // count


@dataclass(frozen=True)
class Told:
    """Centred predictions of held-out metres, and the stated errors."""

    said: dict[str, Floats]
    spread: dict[str, Spread]


def told(fit: Callable[[Metre], Predictor], known: Metre, there: Metre) -> Told:
    """Fit to some metres and predict others; folds of the first give the distribution of errors."""
    said, found = centred(fit, known, there)
    nowhere = np.zeros(len(there.power), np.int64)
    spread = {
        name: Spread(found[of].compute_std(said[name], nowhere), *found[of].compute_intervals(said[name], nowhere))
        for name, of in QUANTITIES.items()
    }
    return Told({name: said[name] for name in QUANTITIES}, spread)


def centred(
    fit: Callable[[Metre], Predictor], known: Metre, there: Metre
) -> tuple[dict[str, Floats], dict[str, QuantityErrors]]:
    """Return what a fit to some metres says of others, and what it states of its errors by folds of the first."""
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
    return compute_costs(*fit_bias_correction(residuals).apply(*fit(known)(there).T, nowhere), 1.0), found


ADAPTED_M = (0, 5, 10, 20, 50, 100)


def adapted_lines(name: str, other: str, known: Metre, there: Metre) -> Iterator[str]:
    """Yield E of a drive's rest by models of another, after its first metres adapt them."""
    known_m = [metres for metres in ADAPTED_M if 2 * metres <= len(there.power)]
    ones = np.ones_like(there.power)
    for model in ("physics", "boosted trees"):
        said, errors = centred(MODELS[model], known, there)
        metres = Metres(
            said["E"], there.power / there.velocity, np.zeros(len(ones), np.int64), np.cumsum(ones) - 1.0, ones, said["T"],
            there.rise, there.turn_radpm,
        )  # fmt: skip
        runs = [MeasuredRun(name, {"energy": metres})]
        for of in compare_adaptations({"energy": errors["energy"]}, runs, known_m):
            r2 = 1.0 - of.rmse**2 / float(np.var(metres.measured[-of.samples :]))
            yield (
                f"| {name} by {other} | {model} | {of.metres:g} | {of.samples} | {of.rmse:.0f} J | {r2:.2f} "
                f"| {of.coverage_percent:.0f} | {of.total_error_percent:.0f} | {'yes' if of.totals_inside else 'no'} |"
            )


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
    for quantity, measured in _measured(of).items():
        spread = found.spread.get(quantity)
        errors = compute_errors(found.said[quantity], measured, LEAST[quantity], spread)
        yield _row((name, held_out, model), errors, quantity, float(np.std(measured)))


def _measured(of: Metre) -> dict[str, Floats]:
    """Return T and E of metres; no T where the speed is taken as known."""
    energy = {"E": of.power / of.velocity}
    return energy if np.array_equal(of.command, of.velocity) else {"T": 1.0 / of.velocity} | energy


def own_mean(of: Metre) -> Told:
    """Return the mean of each block, of itself."""
    folds = _folds(len(of.power))
    return Told(
        {
            name: np.array([value[folds == fold].mean() for fold in range(FOLDS)])[folds]
            for name, value in _measured(of).items()
        },
        {},
    )


def _row(names: tuple[str, ...], of: Errors, quantity: str, scatter: float) -> str:
    unit, digits = UNITS[quantity]
    assert of.rmse is not None, "no labels"
    mape = "–" if of.mape_percent is None else f"{of.mape_percent:.1f} ({of.mape_count} of {of.count})"
    scores = (
        ["–"] * 3 if of.nll is None else [f"{of.coverage_percent:.0f}", f"{of.nll:.2f}", f"{of.crps:.{digits}f} {unit}"]
    )
    r2 = f"{1.0 - (of.rmse / scatter) ** 2:.2f}"
    return "| " + " | ".join([*names, quantity, f"{of.rmse:.{digits}f} {unit}", r2, mape, *scores]) + " |"


def floor_lines(name: str, of: Metre) -> Iterator[str]:
    """Yield the rows of what the labels' own deviations make of a perfect prediction."""
    measured, std = _measured(of), {"T": of.duration_std, "E": of.energy_std}
    found = compute_label_floor(
        {name: std[name] for name in measured}, measured, np.zeros(len(of.power), np.int64), {0: "unknown"}
    )
    for quantity in measured:
        yield _row(
            (name, "–", "floor: labels alone"), found[quantity]["all"], quantity, float(np.std(measured[quantity]))
        )


LEAST_METRES = 3
"""Fewest metres of a run whose mean counts [1]."""


def class_lines(store: Path) -> Iterator[str]:
    """Yield the energy per metre by the class of the ground, and how well the class predicts it."""
    runs: dict[str, list[Floats]] = {}
    for run in Store(store).runs():
        found = run.segments()
        means = [float(np.nanmean(to_floats(found, of))) for of in MEANS if found.num_rows >= LEAST_METRES]
        if np.isfinite(means).all() and means:
            runs.setdefault(run.run_id.split("_imu")[0], []).append(np.array([found.num_rows, *means]))
    yield (
        "| class | runs | metres | E, mean of runs ± between runs [J/m] | speed [m/s] | turning [rad/s] |\n"
        + "|---" * 6
        + "|"
    )
    for name, rows in sorted(runs.items()):
        metres, energy, speed, turning = np.array(rows).T
        between = f" ± {energy.std(ddof=1):.0f}" if len(rows) > 1 else ""
        yield (
            f"| {name} | {len(rows)} | {metres.sum():.0f} | {energy.mean():.0f}{between} | {speed.mean():.2f} | {turning.mean():.2f} |"
        )
    known = np.array([(at, *row[1:]) for at, rows in enumerate(runs.values()) if len(rows) > 1 for row in rows])
    classes, energy, speed = known[:, 0, None] == np.unique(known[:, 0]), known[:, 1], known[:, [2]]
    ones = np.ones_like(speed)
    for name, columns in {
        "mean": ones, "class": classes, "speed": np.hstack([ones, 1.0 / speed]), "class and speed": np.hstack([classes, 1.0 / speed])
    }.items():  # fmt: skip
        error = _leave_one_out(columns.astype(np.float64), energy)
        r2 = 1.0 - np.mean(error**2) / np.var(energy)
        yield f"E of a run by the others, {name}: RMSE {np.sqrt(np.mean(error**2)):.0f} J/m, R² {r2:.2f} ({len(energy)} runs)"


MEANS = ("energy_joule", "velocity_mps", "mean_abs_yaw_rate_radps")


def _leave_one_out(columns: Floats, values: Floats) -> Floats:
    """Return the error of each value by least squares on the others."""
    hat = columns @ np.linalg.pinv(columns)
    return np.asarray((values - hat @ values) / (1.0 - np.diag(hat)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drives", nargs="*", metavar="DRIVE=LOG[,RECIPE]")
    parser.add_argument("--classes", type=Path, metavar="STORE")
    given = parser.parse_args()
    if given.classes:
        print(*class_lines(given.classes), sep="\n")
        return
    drives = {}
    for entry in given.drives:
        name, _, place = entry.partition("=")
        log, _, recipe = place.partition(",")
        drives[name] = recorded(log, recipe or None)
    real = list(drives)
    drives |= {f"{name}, speed unknown": of for name in real if (of := forget_speed(drives[name])) is not None}
    print(
        "| drive | held out | model | of | RMSE | R² | MAPE [%] (labels) | held by 90 % [%] | NLL [nat] | CRPS |\n"
        + "|---" * 10
        + "|"
    )
    for name, of in drives.items():
        named = f"{name}, {len(of.power)} m"
        print(*floor_lines(named, of), sep="\n")
        print(*lines(named, "blocks", "mean of the block itself", of, own_mean(of)), sep="\n")
        for model, fit in MODELS.items():
            print(*lines(named, "blocks", model, of, by_blocks(fit, of)), sep="\n", flush=True)
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
    print(
        "\n| E of the rest of a drive | model | known [m] | rest [m] | RMSE | R² | held by 90 % [%] | sum off by [%] | held |\n"
        + "|---" * 9
        + "|"
    )
    for name, other in permutations(real, 2):
        print(*adapted_lines(name, other, drives[other], drives[name]), sep="\n", flush=True)


if __name__ == "__main__":
    main()
