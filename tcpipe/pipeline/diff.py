"""Changes between two datasets and their causes: code, recipe keys, logs, maps, region; and shifts of labels."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tcpipe.arrays import Floats, Ints, Mask
from tcpipe.errors import clean_lines
from tcpipe.formats.atomic import Location
from tcpipe.formats.dataset_card import DatasetCard, MapSource, RecordChange, compare_records, format_value
from tcpipe.formats.dataset_files import find_places_in_files, open_patches, read_card, read_samples, sample_columns
from tcpipe.formats.finding_lines import format_findings
from tcpipe.formats.published_outputs import fetch_directory
from tcpipe.splits.assignment import SPLITS
from tcpipe.tables.columns import to_integers
from tcpipe.tables.findings import Finding, Findings, Subject
from tcpipe.tables.levels import LABEL_STD

_LABELLED = {*LABEL_STD, *LABEL_STD.values(), "fused_velocity_mps"}
_DRAWN = ("split", "fold")
_SHARED = 0.9  # smallest shared fraction of the time of two samples that are compared


@dataclass(frozen=True, slots=True)
class Difference:
    """Comparison of two datasets; ``str`` of it is the command's output."""

    a: str
    b: str
    causes: tuple[str, ...]
    """Differences of the inputs of both."""
    samples: Mapping[str, int]
    """Samples only in one, in both, and how many of these differ in labels, other columns, patches or fold."""
    moved: Mapping[str, int]
    """Samples of both by the splits that they moved between, ``train to test`` …."""
    labels: Mapping[str, Mapping[str, float]]
    """For every label: means and deviations over all samples."""
    changes: Mapping[str, Mapping[str, float]]
    """For every label and its σ: median and largest absolute change, of a label also in σ of the first
    (``largest_in_std``); over the samples of one run that share most of their time."""
    findings_gone: Findings
    """Findings of the first, by code and subject, that the second lacks: its own, its runs' and its maps'."""
    findings_new: Findings
    differing: int
    """Number of samples that only one has, or that have other values, another split or another patch."""
    same: bool
    """Whether both are equal."""

    @property
    def exit_code(self) -> int:
        """1 if anything differs."""
        return 0 if self.same else 1

    def __str__(self) -> str:
        """Return causes and effects as plain lines."""
        return clean_lines(_iterate_lines(self))


_CHANGES = ("only in a", "only in b", "other labels", "other columns", "other patches", "other fold")


def diff(a: Location, b: Location) -> Difference:
    """Compare two datasets; `DatasetError` if either is no dataset."""
    first, second = fetch_directory(a), fetch_directory(b)
    cards = read_card(first), read_card(second)
    columns = [sample_columns(directory) for directory in (first, second)]
    shared = [name for name in columns[0] if name in columns[1]]
    tables = tuple(read_samples(directory, ["sample_id", "split", *LABEL_STD]) for directory in (first, second))
    at = pc.index_in(tables[0].column("sample_id"), value_set=tables[1].column("sample_id").combine_chunks())
    row = at.to_numpy(zero_copy_only=False)  # row of b for each row of a, NaN if it is missing
    in_a = np.flatnonzero(np.isfinite(row))
    in_b = row[in_a].astype(np.int64)
    both = ((first, in_a), (second, in_b))
    splits = [table.column("split").to_numpy()[rows] for table, rows in zip(tables, (in_a, in_b), strict=True)]
    masks = {
        "other labels": _find_differing(both, [name for name in shared if name in _LABELLED]),
        "other columns": _find_differing(both, [name for name in shared if name not in (*_LABELLED, *_DRAWN)]),
        "other patches": _find_differing_patches((first, second), cards, tables, in_a, in_b),
        "other fold": _find_differing(both, [name for name in shared if name == "fold"]),
    }
    counts = {
        "only in a": tables[0].num_rows - len(in_a),
        "only in b": tables[1].num_rows - len(in_a),
        "in both": len(in_a),
        **{name: int(mask.sum()) for name, mask in masks.items()},
    }
    moves = {f"{a} to {b}": int(((splits[0] == a) & (splits[1] == b)).sum()) for a in SPLITS for b in SPLITS if a != b}
    moved = {name: count for name, count in moves.items() if count}
    causes = list_causes(*cards)
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
        labels={
            name: {
                f"{what}_{end}": float(getattr(_read_values(table, name), what)())
                for end, table in zip("ab", tables, strict=True)
                for what in ("mean", "std")
            }
            for name in LABEL_STD
            if all(map(len, tables))
        },
        changes=_measure_changes((first, second)),
        findings_gone=gone,
        findings_new=new,
        differing=counts["only in a"]
        + counts["only in b"]
        + int(np.any([*masks.values(), splits[0] != splits[1]], 0).sum()),
        same=same,
    )


def _find_all(card: DatasetCard) -> dict[tuple[str, str, Subject], Finding]:
    """Return every finding of a dataset by its run or map, its code and its subject."""
    groups = [("", card.findings), *card.findings_by_run.items(), *card.findings_by_map.items()]
    return {(where, finding.code, finding.subject): finding for where, findings in groups for finding in findings}


def _read_values(table: pa.Table, name: str) -> Floats:
    return np.asarray(table.column(name).to_numpy(), float)


def _measure_changes(directories: tuple[Path, Path]) -> dict[str, dict[str, float]]:
    """Return statistics of the changes of each label and its σ, over samples of both datasets at the same time."""
    matched = _match_by_time(*(read_samples(directory, ["run_id", "start_ns", "end_ns"]) for directory in directories))
    statistics = dict[str, dict[str, float]]()
    for name in (*LABEL_STD, *LABEL_STD.values()):
        ours, theirs = (
            _read_values(read_samples(directory, [name]), name)[rows]
            for directory, rows in zip(directories, matched, strict=True)
        )
        change = np.abs(theirs - ours)
        is_known = np.isfinite(change)
        if not is_known.any():
            continue
        count, change = int(is_known.sum()), change[is_known]
        statistics[name] = {"samples": count, "median": float(np.median(change)), "largest": float(change.max())}
        if std := LABEL_STD.get(name):
            std_a = _read_values(read_samples(directories[0], [std]), std)[matched[0]][is_known]
            statistics[name]["largest_in_std"] = float((change[std_a > 0.0] / std_a[std_a > 0.0]).max(initial=0.0))
    return statistics


def _match_by_time(a: pa.Table, b: pa.Table) -> tuple[Ints, Ints]:
    """Return rows of samples in both that are of one run and share most of their time, shape (M,) each."""
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
    enough = shared_ns >= _SHARED * np.maximum(end_a[in_a] - begin_a[in_a], end_b[in_b] - begin_b[in_b])
    return in_a[enough], in_b[enough]


def _find_differing(both: Sequence[tuple[Path, Ints]], names: Sequence[str]) -> Mask:
    """Mark the given rows of two datasets, (N,), that differ in any column; values missing in both are equal."""
    other = np.zeros(len(both[0][1]), bool)
    for name in names:  # one at a time: a large dataset has gigabytes of them
        ours, theirs = (read_samples(directory, [name]).column(name).take(rows) for directory, rows in both)
        one_null = pc.xor(pc.is_null(ours), pc.is_null(theirs))
        other |= pc.coalesce(pc.not_equal(ours, theirs), one_null).to_numpy()
    return other


def _find_differing_patches(
    directories: tuple[Path, Path],
    cards: tuple[DatasetCard, DatasetCard],
    tables: Sequence[pa.Table],
    in_a: Ints,
    in_b: Ints,
) -> Mask:
    """Mark samples of both, (N,), with different pixels: all if layers or size differ, none if one has no patches."""
    if not (cards[0].layers and cards[1].layers):
        return np.zeros(len(in_a), bool)
    if set(cards[0].layers) != set(cards[1].layers) or cards[0].patch_px != cards[1].patch_px:
        return np.ones(len(in_a), bool)
    ours, theirs = (
        _hash_patches(directory, card, table) for directory, card, table in zip(directories, cards, tables, strict=True)
    )
    return np.asarray(ours[in_a] != theirs[in_b])


def _hash_patches(directory: Path, card: DatasetCard, table: pa.Table) -> Ints:
    """Return a hash of the pixels of every patch, in the order of the samples, shape (N,)."""
    files = open_patches(directory, card)
    hashes = np.empty(table.num_rows, np.int64)
    for piece in range(len(files.starts) - 1):
        pixels = files.read(piece, files.layers)
        count = len(next(iter(pixels.values())))
        flat = [np.ascontiguousarray(layer).reshape(count, -1).view(np.uint8) for layer in pixels.values()]
        hashes[files.starts[piece] : files.starts[piece + 1]] = [
            hash(b"".join(part.tobytes() for part in parts)) for parts in zip(*flat, strict=True)
        ]
    return hashes[find_places_in_files(card, table.column("split").to_numpy())]


_WORDS = {
    "versions": "version", "runs": "run", "tags": "chosen tags", "maps": "map", "map_names": "order of maps",
    "file_format": "format",
}  # fmt: skip
"""Names of fields of `DatasetInputs` in messages; other fields keep their name."""
_DIGEST = re.compile(r"[0-9a-f]{64}")


def list_causes(a: DatasetCard, b: DatasetCard) -> tuple[str, ...]:
    """Return a line for each difference between the recorded inputs of two datasets, in the order of the fields."""
    changes = list(compare_records(a.made_from, b.made_from))
    lines = [_describe_change(change, a, b) for change in changes]
    if a.inputs != b.inputs and not changes:
        lines.append("inputs: differ, but a dataset without coordinates does not store them")
    return tuple(lines)


def _describe_change(change: RecordChange, a: DatasetCard, b: DatasetCard) -> str:
    """Return the difference of an entry: both values, or, for content, only that it differs."""
    field = change.path[0]
    head, name = _WORDS.get(field, field.replace("_", " ")), f" {change.name}" if change.name else ""
    values = (change.was, change.now)
    is_content = any(isinstance(value, Mapping) or _DIGEST.fullmatch(str(value)) for value in values)
    if not is_content:
        return f"{head}:{name} {format_value(change.was)} → {format_value(change.now)}"
    if None in values:
        return f"{head}: {'added' if change.was is None else 'removed'}{name}"
    maps = [next((each for each in card.maps if field == "maps" and each.name == change.name), None) for card in (a, b)]
    details = ", ".join(_map_changes(*maps)) if maps[0] and maps[1] else ""  # type: ignore[arg-type]
    return f"{head}:{name} is another one{f': {details}' if details else ''}"


def _map_changes(a: MapSource, b: MapSource) -> Iterator[str]:
    for key in ("crs", "pixel_size_m", "rows", "cols", "sources"):
        if getattr(a, key) != getattr(b, key):
            yield f"{key} {format_value(getattr(a, key))} → {format_value(getattr(b, key))}"
    ours, theirs = ({} if entry.inputs is None else entry.inputs.files for entry in (a, b))
    yield from (f"another {role} file" for role in sorted({*ours, *theirs}) if ours.get(role) != theirs.get(role))


def _iterate_lines(found: Difference) -> Iterator[str]:
    """Yield causes and effects of a difference as lines of text."""
    if found.same:
        yield f"{found.a} and {found.b}: the same {found.samples['in both']} samples, made from the same"
        return
    yield f"{found.a} → {found.b}"
    yield from found.causes or ("no recorded cause: they are made from the same",)
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
        figures = (label["mean_a"], label["std_a"]), (label["mean_b"], label["std_b"])
        if not np.allclose(*figures, equal_nan=True):
            means = f"{label['mean_a']:.4g} → {label['mean_b']:.4g}"
            yield f"{name} of all samples: mean {means}, deviation {label['std_a']:.4g} → {label['std_b']:.4g}"
