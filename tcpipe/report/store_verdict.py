"""What the page of a store says first, in plain words; and which of its figures have changed over the nights."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tcpipe.cost.held_out import PHYSICS_UNITS
from tcpipe.motion.remedies import StoreLoss
from tcpipe.report.page import Verdict
from tcpipe.report.store_runs import StoredRun, StoreFacts

_NOISY = 0.05
_LITTLE_USED = 0.3
_FEWEST, _LATEST, _MOST_LATEST = 12, 0.25, 20
"""So many runs tell a change; the latest of them are so large a share, or so many."""
_BEYOND, _WORTH = 3.0, 0.05
"""A change is that many robust standard deviations of the runs before, and that share of their median."""


@dataclass(frozen=True, slots=True)
class Shift:
    """The latest values of a series lie elsewhere than those before: both medians, and how many there are of each."""

    before: float
    after: float
    earlier: int
    latest: int


def shift_of(values: Sequence[float]) -> Shift | None:
    """Return by how much a series has changed in its latest quarter, at most 20 values; None where scatter or length tell no change.

    The medians differ by more than three robust standard deviations (1.4826 times the median absolute deviation) of the values before.
    """
    if len(values) < _FEWEST:
        return None
    count = min(int(len(values) * _LATEST), _MOST_LATEST)
    earlier, latest = np.array(values[:-count], float), np.array(values[-count:], float)
    before, after = float(np.median(earlier)), float(np.median(latest))
    scatter = 1.4826 * float(np.median(np.abs(earlier - before)))
    changed = abs(after - before) > max(_BEYOND * scatter, _WORTH * abs(before))
    return Shift(before, after, len(earlier), count) if changed else None


def store_verdict(store: StoreFacts, runs: Sequence[StoredRun], losses: Sequence[StoreLoss]) -> list[Verdict]:
    """Return the sentences."""
    current = [run for run in runs if run.is_current]
    if not current:
        failed = f"; {_many(len(store.failed), 'log')} gave none, and why stands below" if store.failed else ""
        return [
            Verdict("doubtful", f"No run can be used{failed}."),
            Verdict("do", "'tcpipe ingest LOG' adds runs; 'tcpipe preflight LOG' says beforehand what a log lacks."),
        ]
    return [*_good(current), *_thin(store, current), *_doubtful(store, runs, current), *_to_do(store, current, losses)]


def _good(runs: Sequence[StoredRun]) -> Iterator[Verdict]:
    facts = [run.facts for run in runs if run.facts]
    driven_m, kept_m = sum(of.driven_m for of in facts), sum(of.kept_m for of in facts)
    segments, robots = sum(of.segments for of in facts), len({of.robot for of in facts})
    if segments:
        said = f"{_many(len(runs), 'run')} of {_many(robots, 'robot')}: {_many(segments, 'segment')}"
        yield Verdict("good", f"{said}, {100 * kept_m / max(driven_m, 1e-9):.0f} % of {driven_m / 1000:.1f} km driven.")
    floors = [run.floor for run in runs if run.floor is not None]
    if floors and (middle := float(np.median(floors))) < _NOISY:
        yield Verdict(
            "good",
            f"Labels are sharp: the noise floor of E is {100 * middle:.1f} % (median of {_many(len(floors), 'run')}).",
        )


def _thin(store: StoreFacts, runs: Sequence[StoredRun]) -> Iterator[Verdict]:
    bare = sum(not (run.facts and run.facts.segments) for run in runs)
    if bare:
        yield Verdict("thin", f"{_many(bare, 'run')} without a segment.")
    if unpowered := sum(bool(run.facts and run.facts.segments) and run.floor is None for run in runs):
        yield Verdict(
            "thin",
            f"{_many(unpowered, 'run')} of which no noise floor of E is known: without power they tell v and T alone.",
        )
    if little := sum(run.used_share < _LITTLE_USED for run in runs if run.used_share is not None):
        yield Verdict(
            "thin", f"{_many(little, 'run')} of which less than {100 * _LITTLE_USED:.0f} % of the metres are used."
        )
    if any(of.there for of in store.datasets) and (unused := sum(not run.datasets for run in runs)):
        yield Verdict("thin", f"{_many(unused, 'run')} in no dataset that is known here.")


def _doubtful(store: StoreFacts, runs: Sequence[StoredRun], current: Sequence[StoredRun]) -> Iterator[Verdict]:
    bad = sum(run.facts is None for run in runs)
    if bad:
        yield Verdict("doubtful", f"{_many(bad, 'run')} not as written, or of another data model (listed below).")
    if damaged := sum(run.state == "damaged" for run in current):
        yield Verdict("doubtful", f"{_many(damaged, 'run')} of a damaged log.")
    if empty := sum(run.state == "empty" for run in current):
        yield Verdict("doubtful", f"{_many(empty, 'run')} without a segment though the robot drove.")
    if failed := sum(of.state != "accepted" for of in store.failed):
        yield Verdict("doubtful", f"{_many(failed, 'log')} gave no run (listed below).")
    floors = [run.floor for run in current if run.floor is not None]
    if floors and (middle := float(np.median(floors))) >= _NOISY:
        yield Verdict(
            "doubtful",
            f"Labels are noisy: the noise floor of E is {100 * middle:.1f} % (median of {_many(len(floors), 'run')}).",
        )
    for text in changes(current):
        yield Verdict("doubtful", text)


def changes(runs: Iterable[StoredRun]) -> Iterator[str]:
    """Yield what has changed over the nights, robot by robot."""
    series = dict[tuple[str, str, str], list[float]]()
    for run in sorted((run for run in runs if run.begin_ns), key=lambda run: run.begin_ns):
        for name, unit, value in _measures(run):
            series.setdefault((run.facts.robot if run.facts else "", name, unit), []).append(value)
    for (robot, name, unit), values in series.items():
        if found := shift_of(values):
            yield (
                f"{name} of {robot} has changed: {found.before:.3g} {unit} over {found.earlier} runs, "
                f"{found.after:.3g} {unit} over the latest {found.latest}."
            )


def _measures(run: StoredRun) -> Iterator[tuple[str, str, float]]:
    """Yield name, unit and value of what should stay as it is."""
    if run.facts is None:
        return
    if run.used_share is not None:
        yield "The share of metres used", "%", 100.0 * run.used_share
    if run.floor is not None:
        yield "The noise floor of E", "%", 100.0 * run.floor
    if run.facts.standing_watt is not None:
        yield "Standing power", PHYSICS_UNITS["standing"], run.facts.standing_watt
    for term, (value, std) in run.facts.physics.items():
        if not term.startswith("standing") and abs(value) > _BEYOND * std:
            yield f"Physics' {term}", PHYSICS_UNITS.get(term.partition(" ")[0], ""), value


def _to_do(store: StoreFacts, runs: Sequence[StoredRun], losses: Sequence[StoreLoss]) -> Iterator[Verdict]:
    worth = next((loss for loss in losses if not loss.remedy.startswith("nothing")), None)
    if worth is not None:
        reason = worth.reason.replace("_", " ")
        yield Verdict(
            "do", f"Most is to be won of {reason}, {worth.metres:.0f} m ({100 * worth.share:.0f} %): {worth.remedy}."
        )
    if any(of.state != "accepted" for of in store.failed) or any(run.state in ("damaged", "empty") for run in runs):
        yield Verdict(
            "do", "Look at what failed, is damaged or empty; 'tcpipe accept' sets aside what cannot be mended."
        )
    if not any(of.there for of in store.datasets):
        yield Verdict("do", "Build a dataset: 'tcpipe build-dataset'.")


def _many(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
