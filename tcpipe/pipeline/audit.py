"""Judge the uncertainty of a run by sensors that are withheld from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from tcpipe.errors import StoreError, UsageError, clean_lines
from tcpipe.formats.logs.log_joining import open_single_log
from tcpipe.formats.object_storage import format_path, is_url
from tcpipe.formats.recipe_toml import load_profiles
from tcpipe.fusion.withheld import WithheldScore, score_comparisons
from tcpipe.progress import step
from tcpipe.recipe import FuseConfig, Recipe
from tcpipe.stages.fuse_inputs import name_pose
from tcpipe.stages.read import find_read_config, read_run
from tcpipe.stages.withheld import compare_withheld
from tcpipe.store import is_store, run_at
from tcpipe.tables.levels import Streams

_HEADER = (
    "withheld", "window", "chord", "windows", "values", "error", "95 %", "σ", "≤ 1σ", "≤ 2σ", "line", "95 %", "",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Audit:
    """How well a run's track predicts what was withheld from it."""

    run: str
    robot: str
    scores: tuple[WithheldScore, ...]
    skipped: tuple[str, ...]
    """What could not be withheld, and why."""
    length_ratios: Mapping[str, float]
    """Without fixes: length of the track over the distance of each odometry, by role."""

    def __str__(self) -> str:
        """Return it as a table, in metres."""
        lines = [f"{self.run}: robot {self.robot}"]
        if self.scores:
            lines += [
                "m: median and 95 % of the errors, their median σ; shares inside 1σ and 2σ; errors of a straight line between the ends",
                "",
            ]
            rows = [_HEADER, *map(_make_row, self.scores)]
            widths = [max(len(row[k]) for row in rows) for k in range(len(_HEADER))]
            lines += [
                "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
            ]
        lines += [f"track / {role}: {ratio:.4f} of its distance" for role, ratio in self.length_ratios.items()]
        lines += [f"not audited: {line}" for line in self.skipped]
        return clean_lines(lines)


def _make_row(score: WithheldScore) -> tuple[str, ...]:
    line = (score.straight_median_m, score.straight_p95_m)
    return (
        score.role,
        f"{score.window_s:.0f} s",
        "" if score.chord_s is None else f"{score.chord_s:.0f} s",
        *(str(count) for count in (score.windows, score.compared)),
        *(f"{value:.3f}" for value in (score.median_error_m, score.p95_error_m, score.median_std_m)),
        *(f"{share:.0%}" for share in (score.within_1_sigma, score.within_2_sigma)),
        *("" if value is None else f"{value:.3f}" for value in line),
        score.calibration,
    )


def audit(
    run: Path | str, *, recipe: Recipe, robot: str | None = None, message_definitions: Path | None = None
) -> Audit:
    """Withhold fixes, wheels and camera in windows, fuse the rest, and score the track by what was withheld.

    Raises `UsageError`: the run is too short, or has no sensor beside the one that would be withheld; `LogError`, `RecipeError`,
    `StoreError`, `FusionError`: it cannot be read or fused.

    Parameters
    ----------
    run : a log, or ``STORE/runs/RUN``, which is fused as its own recipe says.
    recipe, robot, message_definitions : how a log is read and fused, as `tcpipe.pipeline.ingest.ingest` takes them.
    """
    name = format_path(run)
    streams, config = read_audited(run, recipe, robot=robot, message_definitions=message_definitions)
    found = compare_withheld(streams, config, run_id=name)
    skipped = tuple(f"{name_pose(role, streams)}, {reason}" for role, reason in found.skipped)
    if not found.comparisons and not found.length_ratios:
        raise UsageError(f"{name}: nothing can be withheld and compared", *skipped)
    scores = (score_comparisons([each]) for each in found.comparisons)
    named = tuple(replace(score, role=name_pose(score.role, streams)) for score in scores)
    return Audit(name, streams.robot, named, skipped, found.length_ratios)


def read_audited(
    run: Path | str, recipe: Recipe, *, robot: str | None = None, message_definitions: Path | None = None
) -> tuple[Streams, FuseConfig]:
    """Return the streams of a log or of a run of a store, and how these are fused; parameters and errors as for `audit`."""
    stored = _read_stored(run)
    if stored is not None:
        return stored
    path = run if is_url(run) else Path(run)
    step("reading")
    with open_single_log(path, message_definitions=message_definitions, tables=recipe.tables) as log:
        read = find_read_config(recipe, log.topics)
        return read_run(log, read, robot=robot or recipe.robot, known=load_profiles(recipe)), recipe.fuse


def _read_stored(run: Path | str) -> tuple[Streams, FuseConfig] | None:
    """Return the streams of a run of a store, and how it was fused; None for any other path."""
    if is_store(run):
        raise UsageError(f"{run}: is a store; give one of its runs, {run}/runs/RUN")
    found = run_at(run)
    if found is None:
        return None
    store, runs = found
    if len(runs) > 1:
        names = ", ".join(of.recipe_id for of in runs)
        raise UsageError(f"{run}: was ingested under several recipes; give one of them: {run}/… {names}")
    streams = store.read_streams(runs[0].run_id, key=runs[0].streams_key)
    if streams is None:
        raise StoreError(f"{run}: its streams are gone or were read otherwise; audit its log, or ingest it again")
    return streams, runs[0].manifest.recipe.fuse
