"""What changed between two datasets, and by which cause: code, recipe keys, logs, maps, region; with the shift of the labels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.errors import clean_lines
from tcpipe.formats.bucket_directories import fetch_directory
from tcpipe.formats.dataset_card import DatasetCard, Exclusion, MapSource, RunSource
from tcpipe.formats.dataset_files import find_places_in_files, open_patches, read_card, read_samples, sample_columns
from tcpipe.formats.finding_lines import format_findings
from tcpipe.formats.json_files import to_plain
from tcpipe.pipeline.explain import flatten_recipe
from tcpipe.splits.assignment import SPLITS
from tcpipe.tables.columns import to_integers
from tcpipe.tables.findings import Finding, Subject

_LABELS = ("power_watt", "velocity_mps", "duration_s", "energy_joule")
_STDS = ("power_std_watt", "velocity_std_mps", "duration_std_s", "energy_std_joule")
_LABELLED = (*_LABELS, "fused_velocity_mps", *_STDS)
_DRAWN = ("split", "fold")
_SHARED = 0.9
"""So much of their time samples share that are compared."""
_VERSIONS = ("tcpipe_version", "data_model_version")

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Difference:
    """Two datasets held against each other; ``str`` of it is what the command prints."""

    a: str
    b: str
    causes: tuple[str, ...]
    """What the two are made from differently."""
    samples: Mapping[str, int]
    """Samples only in one, in both, and how many of these have other labels, columns beside them, patches, folds."""
    moved: Mapping[str, int]
    """Samples of both by the splits that they moved between, ``train to test`` …."""
    labels: Mapping[str, Mapping[str, float]]
    """For every label: means and deviations over all samples."""
    changes: Mapping[str, Mapping[str, float]]
    """For every label and its σ: median and largest absolute change, over the samples of one run that share most of their time."""
    findings_gone: tuple[Finding, ...]
    """Findings of the first, by code and subject, that the second lacks: its own, its runs' and its maps'."""
    findings_new: tuple[Finding, ...]
    same: bool
    """Whether nothing differs."""

    def __str__(self) -> str:
        """Return causes and effects as plain lines."""
        return clean_lines(_iterate_lines(self))


_CHANGES = ("only in a", "only in b", "other labels", "other columns", "other patches", "other fold")


def diff(a: str | Path, b: str | Path) -> Difference:
    """Compare two datasets; `DatasetError` if either is none."""
    first, second = fetch_directory(a), fetch_directory(b)
    cards = read_card(first), read_card(second)
    there = [sample_columns(directory) for directory in (first, second)]
    shared = [name for name in there[0] if name in there[1]]
    tables = tuple(read_samples(directory, ["sample_id", "split", *_LABELS]) for directory in (first, second))
    at = pc.index_in(tables[0].column("sample_id"), value_set=tables[1].column("sample_id").combine_chunks())
    row = at.to_numpy(zero_copy_only=False)  # of b for each of a, NaN where it is not there
    in_a = np.flatnonzero(np.isfinite(row))
    in_b = row[in_a].astype(np.int64)
    both = ((first, in_a), (second, in_b))
    counts = {
        "only in a": tables[0].num_rows - len(in_a),
        "only in b": tables[1].num_rows - len(in_a),
        "in both": len(in_a),
        "other labels": _count_differing(both, [name for name in shared if name in _LABELLED]),
        "other columns": _count_differing(both, [name for name in shared if name not in (*_LABELLED, *_DRAWN)]),
        "other patches": _count_differing_patches((first, second), cards, tables, in_a, in_b),
        "other fold": _count_differing(both, [name for name in shared if name == "fold"]),
    }
    moved = _count_moved(tables[0].column("split").to_numpy()[in_a], tables[1].column("split").to_numpy()[in_b])
    causes = tuple(_iterate_causes(*cards))
    (ours, theirs) = (_find_all(card) for card in cards)
    gone, new = (
        tuple(runs[key] for key in runs if key not in other) for runs, other in ((ours, theirs), (theirs, ours))
    )
    same = not (causes or moved or gone or new or any(counts[name] for name in _CHANGES))
    return Difference(
        a=str(a),
        b=str(b),
        causes=causes,
        samples=counts,
        moved=moved,
        labels=_compute_shifts(tables),
        changes=_measure_changes((first, second)),
        findings_gone=gone,
        findings_new=new,
        same=same,
    )


def _find_all(card: DatasetCard) -> dict[tuple[str, str, Subject], Finding]:
    """Return every finding of a dataset by its run or map, its code and its subject."""
    every = [("", card.findings), *card.findings_by_run.items(), *card.findings_by_map.items()]
    return {(where, finding.code, finding.subject): finding for where, findings in every for finding in findings}


def _compute_shifts(tables: Sequence[pa.Table]) -> dict[str, dict[str, float]]:
    values = {name: [_read_values(table, name) for table in tables] for name in _LABELS if all(map(len, tables))}
    return {
        name: {
            f"{what}_{end}": float(getattr(samples, what)())
            for end, samples in zip("ab", both, strict=True)
            for what in ("mean", "std")
        }
        for name, both in values.items()
    }


def _read_values(table: pa.Table, name: str) -> NDArray[np.float64]:
    values: NDArray[np.float64] = table.column(name).to_numpy().astype(np.float64)
    return values


def _measure_changes(directories: tuple[Path, Path]) -> dict[str, dict[str, float]]:
    matched = _match_by_time(*(read_samples(directory, ["run_id", "start_ns", "end_ns"]) for directory in directories))
    found = dict[str, dict[str, float]]()
    for name in (*_LABELS, *_STDS):
        ours, theirs = (
            _read_values(read_samples(directory, [name]), name)[rows]
            for directory, rows in zip(directories, matched, strict=True)
        )
        change = np.abs(theirs - ours)
        if len(change := change[np.isfinite(change)]):
            found[name] = {"samples": len(change), "median": float(np.median(change)), "largest": float(change.max())}
    return found


def _match_by_time(a: pa.Table, b: pa.Table) -> tuple[Ints, Ints]:
    """Return the rows of samples of one run that share most of the longer one's time: on another track a run is cut elsewhere."""
    runs = pc.unique(b.column("run_id"))
    run = [pc.index_in(table.column("run_id"), value_set=runs).fill_null(-1).to_numpy() for table in (b, a)]
    begin_b, end_b, begin_a, end_a = (to_integers(table, f"{end}_ns") for table in (b, a) for end in ("start", "end"))
    order = np.lexsort((np.concatenate([begin_b, begin_a + (end_a - begin_a) // 2]), np.concatenate(run)))
    latest = np.maximum.accumulate(np.where(order < len(b), np.arange(len(order)), 0))  # that began before each middle
    of_a = order >= len(b)
    in_a, in_b = order[of_a] - len(b), order[latest[of_a]]
    is_same = (in_b < len(b)) & (run[0][np.minimum(in_b, len(b) - 1)] == run[1][in_a]) if len(b) else in_b < 0
    in_a, in_b = in_a[is_same], in_b[is_same]
    shared_ns = np.minimum(end_a[in_a], end_b[in_b]) - np.maximum(begin_a[in_a], begin_b[in_b])
    longer_ns = np.maximum(end_a[in_a] - begin_a[in_a], end_b[in_b] - begin_b[in_b])
    enough = shared_ns >= _SHARED * longer_ns
    return in_a[enough], in_b[enough]


def _count_differing(both: Sequence[tuple[Path, Ints]], names: Sequence[str]) -> int:
    """Return how many of the given rows of two datasets differ in any of the columns; what is missing in both is the same."""
    other = np.zeros(len(both[0][1]), np.bool_)
    for name in names:  # one at a time: a large dataset has gigabytes of them
        ours, theirs = (read_samples(directory, [name]).column(name).take(pa.array(rows)) for directory, rows in both)
        one_null = pc.xor(pc.is_null(ours), pc.is_null(theirs))
        other |= pc.coalesce(pc.not_equal(ours, theirs), one_null).to_numpy()
    return int(other.sum())


def _count_differing_patches(
    directories: tuple[Path, Path],
    cards: tuple[DatasetCard, DatasetCard],
    tables: Sequence[pa.Table],
    in_a: Ints,
    in_b: Ints,
) -> int:
    """Return how many samples of both have other pixels; all of them where layers or size differ."""
    if set(cards[0].layers) != set(cards[1].layers) or cards[0].patch_px != cards[1].patch_px:
        return len(in_a)
    ours, theirs = (
        _hash_patches(directory, card, table) for directory, card, table in zip(directories, cards, tables, strict=True)
    )
    return int((ours[in_a] != theirs[in_b]).sum())


def _hash_patches(directory: Path, card: DatasetCard, table: pa.Table) -> NDArray[np.int64]:
    """Return a hash of every patch, in the order of the samples: equal pixels, equal hashes."""
    files = open_patches(directory, card)
    found = np.empty(table.num_rows, np.int64)
    for piece in range(len(files.starts) - 1):
        pixels = files.read(piece, files.layers)
        count = len(next(iter(pixels.values())))
        flat = [np.ascontiguousarray(layer).reshape(count, -1).view(np.uint8) for layer in pixels.values()]
        found[files.starts[piece] : files.starts[piece + 1]] = [
            hash(b"".join(part.tobytes() for part in parts)) for parts in zip(*flat, strict=True)
        ]
    places: NDArray[np.int64] = found[find_places_in_files(card, table.column("split").to_numpy())]
    return places


def _count_moved(ours: NDArray[np.object_], theirs: NDArray[np.object_]) -> dict[str, int]:
    moves = {f"{a} to {b}": int(((ours == a) & (theirs == b)).sum()) for a in SPLITS for b in SPLITS if a != b}
    return {name: count for name, count in moves.items() if count}


def _iterate_causes(a: DatasetCard, b: DatasetCard) -> Iterator[str]:
    """Yield a line for everything that the two are made from differently."""
    for name in _VERSIONS:
        was, now = getattr(a, name), getattr(b, name)
        if was != now:
            yield f"code: {name} {was} → {now}"
    ours, theirs = flatten_recipe(a.recipe), flatten_recipe(b.recipe)
    for key in sorted({*ours, *theirs}):
        if ours.get(key) != theirs.get(key):
            yield f"recipe: {key} {_format_value(ours.get(key))} → {_format_value(theirs.get(key))}"
    yield from _run_causes({run.run_id: run for run in a.runs}, {run.run_id: run for run in b.runs})
    yield from _map_causes({entry.name: entry for entry in a.maps}, {entry.name: entry for entry in b.maps})
    if a.split.region != b.split.region:
        yield f"region: {'added' if a.split.region is None else 'removed' if b.split.region is None else 'another one'}"
    if a.split.kept != b.split.kept:
        yield f"kept split: {_format_value(to_plain(a.split.kept))} → {_format_value(to_plain(b.split.kept))}"
    yield from _exclusion_causes(
        {exclusion.name: exclusion for exclusion in a.exclusions},
        {exclusion.name: exclusion for exclusion in b.exclusions},
    )
    if a.format != b.format:
        yield f"format: {a.format} → {b.format}"


def _run_causes(a: Mapping[str, RunSource], b: Mapping[str, RunSource]) -> Iterator[str]:
    for run_id in sorted({*a, *b}):
        if run_id not in a or run_id not in b:
            which, run = ("added", b[run_id]) if run_id not in a else ("removed", a[run_id])
            yield f"log: {which} {', '.join(run.logs)} (run {run_id}, {run.samples} samples)"
        elif a[run_id].segments_sha256 != b[run_id].segments_sha256:
            was, now = a[run_id].recipe_id, b[run_id].recipe_id
            why = f"ingested with recipe {was} → {now}" if was != now else "the same log and recipe, ingested again"
            yield f"log: run {run_id} has other segments: {why}"


def _exclusion_causes(a: Mapping[str, Exclusion], b: Mapping[str, Exclusion]) -> Iterator[str]:
    for name in sorted({*a, *b}):
        if name not in a or name not in b:
            which, exclusion = ("added", b[name]) if name not in a else ("removed", a[name])
            yield f"exclusion: {which} {name} ({exclusion.samples} samples): {exclusion.reason}"
        elif (was := a[name]) != (now := b[name]):
            yield f"exclusion: {name} is another list: {was.samples} → {now.samples} samples, {was.reason} → {now.reason}"


def _map_causes(a: Mapping[str, MapSource], b: Mapping[str, MapSource]) -> Iterator[str]:
    for name in sorted({*a, *b}):
        if name not in a or name not in b:
            yield f"map: {'added' if name not in a else 'removed'} {name}"
        elif a[name].sha256 != b[name].sha256:
            yield f"map: {name} is another one: {', '.join(_map_changes(a[name], b[name])) or 'its files were made again'}"


def _map_changes(a: MapSource, b: MapSource) -> Iterator[str]:
    for key in ("crs", "pixel_size_m", "rows", "cols", "sources"):
        if getattr(a, key) != getattr(b, key):
            yield f"{key} {_format_value(getattr(a, key))} → {_format_value(getattr(b, key))}"
    ours, theirs = ({} if entry.inputs is None else entry.inputs.files for entry in (a, b))
    yield from (f"another {role} file" for role in sorted({*ours, *theirs}) if ours.get(role) != theirs.get(role))


def _format_value(value: object) -> str:
    return "none" if value is None else str(value)


def _iterate_lines(found: Difference) -> Iterator[str]:
    if found.same:
        yield f"{found.a} and {found.b}: the same {found.samples['in both']} samples, made from the same"
        return
    yield f"{found.a} → {found.b}"
    yield from found.causes or ("no recorded cause: same code, recipe, logs, maps and region",)
    yield "samples: " + ", ".join(
        f"{count} {name}"
        for name, count in found.samples.items()
        if count or name in ("only in a", "only in b", "in both")
    )
    if found.moved:
        yield "splits: " + ", ".join(f"{count} from {name}" for name, count in found.moved.items())
    for what, findings in (("gone", found.findings_gone), ("new", found.findings_new)):
        yield from (f"{what}: {line}" for line in format_findings(findings))
    for name, change in found.changes.items():
        if change["largest"] > 0.0:
            count = f"{change['samples']:.0f} samples"
            yield f"{name} of {count}: changed by {change['median']:.3g} in the median, by {change['largest']:.3g} at most"
    for name, label in found.labels.items():
        if not np.allclose((label["mean_a"], label["std_a"]), (label["mean_b"], label["std_b"])):
            means = f"{label['mean_a']:.4g} → {label['mean_b']:.4g}"
            yield f"{name} of all samples: mean {means}, deviation {label['std_a']:.4g} → {label['std_b']:.4g}"
