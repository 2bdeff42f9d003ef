"""Judge the train/test split of any table of samples for spatial leakage."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.errors import DatasetError, UsageError, clean_lines
from tcpipe.formats.atomic import write_text
from tcpipe.formats.covariates import read_rows
from tcpipe.geometry.datum import enu_from_geodetic
from tcpipe.pipeline.options import CheckSplitOptions
from tcpipe.report.colours import CLASS_COLOURS, CURSOR, SPLIT_COLOURS
from tcpipe.report.page import Section, render_page
from tcpipe.report.plots import make_map_plot
from tcpipe.splits.audit import count_neighbours, measure_leakage
from tcpipe.tables.columns import to_floats, to_numbers, to_texts
from tcpipe.tables.options import as_function

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

_SUFFIXES = (".csv", ".parquet")
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+")
_DEGREES = ({"lon", "lng", "long", "longitude"}, {"lat", "latitude"})
"""Words in the names of columns of degrees."""
_SAME_PLACE = 1e-3
"""Footprints are equal if their corners are, to this share of a side."""
_MOST_APART_M = 1e6
"""Largest distance from the first sample in its plane [m]: lengths along the line of sight are 1.2 % too short there."""


@dataclass(frozen=True, slots=True)
class SplitLeakage:
    """A held-out split against the training samples."""

    split: str
    samples: int
    leaking_samples: int
    """Those that share ground with a training sample or are its neighbour on a run."""
    overlapping_samples: int
    """Those whose footprint shares ground with a training footprint."""
    neighbour_samples: int | None
    """Those that follow or precede a training sample on one run; None without a column of runs."""
    nearest_train_median_m: float
    """Median distance from a footprint to the nearest training footprint [m]."""
    nearest_train_min_m: float
    """Smallest of these distances [m]."""
    near_fraction: float
    """Share of the samples for which it is at most the side of a footprint."""


@dataclass(frozen=True, slots=True)
class SplitCheck:
    """Leakage of the held-out splits of a table, and how it was judged."""

    table: str
    train_samples: int
    unused_samples: int
    """Samples that are neither in train nor held out."""
    footprint_m: float
    """Side of a sample's square of ground [m]."""
    neighbours_within_m: float | None
    """Largest distance of neighbours on a run [m]; None without a column of runs."""
    limit_fraction: float
    """Share of a held-out split that may leak."""
    above_limit: tuple[str, ...]
    """Held-out splits that leak more."""
    held_out: tuple[SplitLeakage, ...]

    def __str__(self) -> str:
        """Return it as lines and a table."""
        rows = self.make_table()
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return clean_lines([*self.describe(), "", *("  ".join(map(str.rjust, row, widths)).rstrip() for row in rows)])

    def describe(self) -> list[str]:
        """Return lines on what was judged, how, and with which result."""
        within_m = self.neighbours_within_m
        on_run = f"adjacent on a run, at most {within_m:.3g} m apart" if within_m else "not judged without --run"
        return [
            f"{self.table}: {self.train_samples} training samples; {self.unused_samples} samples in no split",
            f"footprint {self.footprint_m:g} m; neighbours: {on_run}",
            f"limit: {self.limit_fraction:.4g} of a split may leak; above it: {', '.join(self.above_limit) or 'none'}",
        ]

    def make_table(self) -> list[tuple[str, ...]]:
        """Return the figures as a table, the head first."""
        head = ("held out", "samples", "leaking", "share ground", "neighbours", "nearest: median", "minimum")
        rows: list[tuple[str, ...]] = [(*head, f"within {self.footprint_m:g} m")]
        for of in self.held_out:
            leaking = f"{of.leaking_samples} ({of.leaking_samples / of.samples:.1%})"
            neighbours = "" if of.neighbour_samples is None else str(of.neighbour_samples)
            apart = (f"{of.nearest_train_median_m:.2f} m", f"{of.nearest_train_min_m:.2f} m", f"{of.near_fraction:.1%}")
            rows.append((of.split, str(of.samples), leaking, str(of.overlapping_samples), neighbours, *apart))
        return rows


def run_check_split(options: CheckSplitOptions) -> SplitCheck:
    """Judge each held-out split of a table against its training samples, and write a page if ``html`` is given.

    A sample leaks if its footprint shares ground with a training footprint, or if it is next to a training sample on its run.
    ``str`` of the result is what the command prints. Raises `UsageError` where an option is out of its range; `DatasetError` where the
    table cannot be judged, with a problem for each wrong column.
    """
    path, xy = Path(options.table), options.xy.split(",") if isinstance(options.xy, str) else [*options.xy]
    xy = [name.strip() for name in xy]
    if options.html is not None and Path(options.html).resolve() == path.resolve():
        raise UsageError(f"--html {options.html}: is the table itself; give another file")
    if len(xy) not in (2, 4):
        raise UsageError(f"--xy {','.join(xy)}: expected two columns, X,Y, or four, X0,Y0,X1,Y1")
    table, split, is_used = _read_samples(options, path, xy)
    is_train, ends_m = split == options.train, _read_positions(path, table, xy, is_used)
    held = {str(name): split == name for name in np.unique(split[is_used & ~is_train])}
    row = np.arange(table.num_rows)
    order = row if options.time is None else _rank(table.column(options.time))
    run = row if options.run is None else _rank(table.column(options.run))
    chord_m = max(_compute_median_step_m(run, order, np.mean(ends_m, axis=0)), options.footprint_m)
    footprints_m = _make_footprints(ends_m, options.footprint_m)
    is_neighbour = count_neighbours(is_train, run, order, footprints_m, chord_m=chord_m) > 0
    # A robot at rest gives thousands of samples at one place: each place is compared once.
    first, place = _find_places(footprints_m, options.footprint_m)
    at_place = {name: np.bincount(place, rows) > 0 for name, rows in {"": is_train, **held}.items()}
    ground = measure_leakage(at_place.pop(""), at_place, first, first, footprints_m[first], chord_m=chord_m)
    checked, leaking = [], [np.empty(0, np.int64)]
    for name, found in ground.items():
        rows = np.flatnonzero(held[name])
        at = np.searchsorted(found.rows, place[rows])
        shares_ground, nearest_m = found.shares_ground[at], found.nearest_m[at]
        leaking.append(rows[shares_ground | is_neighbour[rows]])
        of_split = SplitLeakage(
            split=name,
            samples=len(rows),
            leaking_samples=len(leaking[-1]),
            overlapping_samples=int(shares_ground.sum()),
            neighbour_samples=None if options.run is None else int(is_neighbour[rows].sum()),
            nearest_train_median_m=float(np.median(nearest_m)),
            nearest_train_min_m=float(nearest_m.min()),
            near_fraction=float((nearest_m <= options.footprint_m).mean()),
        )
        checked.append(of_split)
    result = SplitCheck(
        table=str(path),
        train_samples=int(is_train.sum()),
        unused_samples=int((~is_used).sum()),
        footprint_m=options.footprint_m,
        neighbours_within_m=None if options.run is None else 1.5 * chord_m,
        limit_fraction=options.limit_fraction,
        above_limit=tuple(of.split for of in checked if of.leaking_samples > options.limit_fraction * of.samples),
        held_out=tuple(checked),
    )
    if options.html is not None:
        shown = {options.train: is_train, **held, "leaking samples": np.concatenate(leaking)}
        places_m = {name: np.mean(ends_m, axis=0)[of] for name, of in shown.items()}
        write_text(Path(options.html), render_split_page(result.describe(), result.make_table(), places_m))
    return result


check_split = as_function(CheckSplitOptions, run_check_split)


def _find_places(footprints_m: Floats, side_m: float) -> tuple[Ints, Ints]:
    """Return the first sample at each place, (P,), and the number of each sample's place, (N,); footprints of one place are equal."""
    corners = np.round(footprints_m.reshape(-1, 8) / (_SAME_PLACE * side_m))
    _, first, place = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    return first, place.reshape(-1)


def _rank(column: pa.ChunkedArray) -> Ints:
    """Return the place of each value among the different values of a column, shape (N,)."""
    return to_numbers(pc.rank(column, tiebreaker="dense")).astype(np.int64)


def _compute_median_step_m(run: Ints, order: Ints, centres_m: Floats) -> float:
    """Return the median distance between samples that follow one another on a run [m]; 0 if no run has two."""
    rows = np.lexsort((order, run))
    steps_m = np.linalg.norm(np.diff(centres_m[rows], axis=0), axis=1)
    known = (np.diff(run[rows]) == 0) & np.isfinite(steps_m)
    return float(np.median(steps_m[known])) if known.any() else 0.0


def _make_footprints(ends_m: Sequence[Floats], side_m: float) -> Floats:
    """Return the corners of squares around the middle, (N, 4, 2), along start to end, or along the axes if these are one point."""
    along = ends_m[-1] - ends_m[0]
    along[~along.any(axis=1)] = 1.0, 0.0
    along *= 0.5 * side_m / np.linalg.norm(along, axis=1)[:, None]
    left = np.column_stack([-along[:, 1], along[:, 0]])
    around = np.stack([-along - left, along - left, along + left, left - along], axis=1)
    return np.asarray(np.mean(ends_m, axis=0)[:, None] + around)


def _read_samples(options: CheckSplitOptions, path: Path, xy: Sequence[str]) -> tuple[pa.Table, NDArray[np.str_], Mask]:
    """Return the columns of the table, the split of each sample, and which samples are judged; `DatasetError` has all problems."""
    flags = dict.fromkeys(xy, "--xy") | {options.split: "--split"}
    flags |= {name: flag for name, flag in ((options.run, "--run"), (options.time, "--time")) if name is not None}
    if path.suffix.lower() not in _SUFFIXES:
        raise DatasetError(f"{path}: unknown type of file; expected a table that ends in {' or '.join(_SUFFIXES)}")
    frame, there = read_rows(path, flags)
    named = ", ".join(there)
    problems = [f"no column {name!r} ({flag}); there are {named}" for name, flag in flags.items() if name not in there]
    problems += ["the table has no rows"] if frame.width and frame.is_empty() else []
    table, split, is_used = frame.to_arrow(), np.full(frame.height, ""), np.ones(frame.height, np.bool_)
    if options.split in there and frame.height:
        split = to_texts(table.column(options.split).cast(pa.string()).fill_null(""))
        unused = [options.unused] if isinstance(options.unused, str) else [*options.unused]
        if options.train in unused:
            problems.append(f"--unused {options.train}: is the value of training samples (--train); remove it")
        is_used = (split == options.train) | ~np.isin(split, ["", *unused])
        values = f"column {options.split} has {', '.join(np.unique(split[split != ''])) or 'no value'}"
        if not (split == options.train).any():
            problems.append(f"no training samples, {options.train!r}: {values}; name their value (--train)")
        if not (is_used & (split != options.train)).any():
            problems.append(f"no held-out samples: {values}; expected a value besides --train and --unused")
    for name in table.column_names if frame.height else ():
        if name in xy or name != options.split:
            problems += _find_column_problems(table, name, is_used, is_number=name in xy)
    if problems:
        raise DatasetError(*(f"{path}: {problem}" for problem in problems))
    return table, split, is_used


def _find_column_problems(table: pa.Table, name: str, is_used: Mask, *, is_number: bool) -> Iterator[str]:
    """Yield a line if a column is no number but should be, or if samples that are judged have no value."""
    column = table.column(name)
    if is_number and not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
        example = next(iter(column.drop_null()), None)
        yield f"column {name} is {column.type}, as {str(example)!r}; expected numbers with a decimal point"
        return
    is_known = np.isfinite(to_floats(table, name)) if is_number else to_numbers(column.is_valid())
    if (lost := is_used & ~is_known).any():
        count, first = np.count_nonzero(lost), np.argmax(lost) + 1
        yield f"column {name} has no value in {count} rows, first in row {first}; fill them, or leave their split empty"


def _read_positions(path: Path, table: pa.Table, xy: Sequence[str], is_used: Mask) -> list[Floats]:
    """Return the start and the end, or the position, of each sample [m], (N, 2) each; degrees in the plane of the first sample."""
    ends = [np.column_stack([to_floats(table, name) for name in pair]) for pair in (xy[:2], xy[2:]) if pair]
    words = [{word.lower() for word in _WORD.findall(name)} for name in xy]
    if not any(found & {*_DEGREES[0], *_DEGREES[1]} for found in words):
        return ends
    least, most = (np.array([bound(end[is_used], axis=0) for end in ends]) for bound in (np.min, np.max))
    is_named = all(found & _DEGREES[number % 2] for number, found in enumerate(words))
    if not is_named or (np.maximum(-least, most) > (180.0, 90.0)).any():
        expected = "expected longitude before latitude [deg], or metres in columns whose names have no lon or lat"
        raise DatasetError(
            f"{path}: --xy {','.join(xy)} is from {least.min(0).tolist()} to {most.max(0).tolist()}; {expected}"
        )
    lon_deg, lat_deg = ends[0][is_used][0].tolist()
    ends_m = [enu_from_geodetic(end[:, 0], end[:, 1], 0.0, datum_deg_m=(lon_deg, lat_deg, 0.0)) for end in ends]
    apart_m = max(float(np.linalg.norm(end[is_used], axis=1).max()) for end in ends_m)
    if apart_m > _MOST_APART_M:
        text = f"samples are up to {apart_m / 1e3:.0f} km from the first one; expected at most {_MOST_APART_M / 1e3:.0f} km"
        raise DatasetError(f"{path}: {text} for longitude and latitude; judge a table for each region")
    return [end[:, :2] for end in ends_m]


_MOST_POINTS = 50_000
"""On the map: of more, equally spaced ones."""


def render_split_page(
    lines: Sequence[str], rows: Sequence[Sequence[str]], places_m: Mapping[str, NDArray[np.float64]]
) -> str:
    """Return the HTML page: ``lines`` of text, the table ``rows``, head first, and a map of ``places_m``.

    These are the positions [m], (N, 2), of each split by its name, and at last those of the samples that leak.
    """
    others = iter(CLASS_COLOURS[1:] * len(places_m))
    colours = {name: SPLIT_COLOURS.get(name) or next(others) for name in places_m} | {"leaking samples": CURSOR}
    alt = "Map of the samples by split; the table below lists the counts."
    plot = replace(make_map_plot(alt=alt, axes=("x [m]", "y [m]"), height_px=420), legend=colours)
    every = -(-sum(map(len, places_m.values())) // _MOST_POINTS)
    for name, xy_m in places_m.items():
        look = {"size": 9, "fill_alpha": 0.0} if name == "leaking samples" else {"size": 5}
        plot.figure.scatter(*xy_m[::every].T, color=colours[name], **look)
    parts = [Section("Held-out splits", "Distances are between footprints.", header=rows[0], rows=rows[1:])]
    sections = [Section("Map", f"One of {every} samples." if every > 1 else "", plots=[plot]), *parts]
    return render_page(title="Check of a split", lead=lines[0], numbers=[], warnings=lines[1:], sections=sections)
