"""The page of a dataset: its samples on the map, labels, losses, repeatability, leakage."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyproj import Transformer
from scipy.spatial import cKDTree

from tcpipe.arrays import AnyInts, Floats
from tcpipe.errors import DatasetError, StoreError, UsageError
from tcpipe.formats.dataset_card import LOCAL, DatasetCard, group_dataset_findings, judge_dataset
from tcpipe.formats.dataset_files import read_intact_card, read_samples, sample_columns
from tcpipe.formats.documents import BLOBS
from tcpipe.formats.json_files import Json
from tcpipe.formats.place import REPORT
from tcpipe.report.colours import CLASS_COLOURS, DROPPED, FAINT, KEPT, SPLIT_COLOURS, choose_class_colours
from tcpipe.report.label_sections import (
    LABELS,
    QUALITY_WORDS,
    find_distinguishing_bits,
    make_budget_sections,
    make_physics_sections,
    make_quality_section,
    make_repeatability_section,
)
from tcpipe.report.maps import draw_dataset_map
from tcpipe.report.page import Column, Link, PageSection, make_shown_column, pack_columns, render_page, show_verdict
from tcpipe.report.pictures import make_patches_data
from tcpipe.report.plots import Plot, draw_waterfall
from tcpipe.splits.assignment import SPLITS
from tcpipe.stages.sample import separate_frames
from tcpipe.store import Store, is_store
from tcpipe.tables.columns import read_ends_deg, read_ends_m, to_floats

MOST_SAMPLES = 100_000
"""On the page: of more the first ones, since their order is random."""

SAMPLE_COLUMNS = (
    *("sample_id", "split", "run_id", "start_ns", "start_lon_deg", "start_lat_deg", "end_lon_deg", "end_lat_deg"),
    *("start_x_m", "start_y_m", "end_x_m", "end_y_m"),
    *("terrain_class", "terrain_name", "slope_rad", "yaw_change_rad", "quality"),
    *(column for *columns, _ in LABELS.values() for column in columns),
)
"""Columns of samples.parquet that the page needs, those that the dataset has."""


def render_dataset_report(directory: Path, beside: Path | None = None, *, samples: pa.Table | None = None) -> str:
    """Return the HTML page of the dataset in ``directory``; `DatasetError` for another data model.

    ``beside`` is the directory of the dataset; the page links to runs of stores in it. ``samples`` has at least
    `SAMPLE_COLUMNS`; None reads them. If patches or pictures are lost or damaged, the page says so and omits them.
    """
    card = read_intact_card(directory)
    if samples is None:
        there = sample_columns(directory)
        samples = read_samples(directory, [name for name in SAMPLE_COLUMNS if name in there])
    xy_m, shown = select_samples(card, samples)
    plots, lost = draw_dataset_map(directory, card, xy_m)
    quality = samples.column("quality").to_numpy()
    try:
        patches = make_patches_data(directory, card, samples, len(xy_m)) if card.layers else None
    except DatasetError as error:
        patches, lost = None, [*lost, f"no patches are shown: {error.problems[0]}"]
    hrefs = {} if beside is None else _find_run_pages(beside, card)
    stores = sorted(
        name
        for name in {href.split("/")[1] for href in hrefs.values()}
        if ((beside or directory) / name / REPORT).is_file()
    )
    groups = group_dataset_findings(card.findings, card.findings_by_run, card.findings_by_map)
    return render_page(
        title=f"Dataset {card.name}",
        lead=card.description or f"{card.format} format, data model {card.data_model_version}",
        verdict=show_verdict(judge_dataset(card.findings, card.runs, card.maps), groups=groups),
        numbers=[
            (f"{card.samples}", "samples"),
            *((f"{card.splits[split]}", split) for split in SPLIT_COLOURS),
            (f"{len(card.runs)}", "runs"),
            (f"{sum(card.distance_by_reason_m.values()):.0f} m", "driven"),
            (f"{100 * card.flagged_samples.share:.1f} %", "flagged samples"),
            *(("none", name) for name in card.absent_labels),
        ],
        links=[Link(f"All runs of {name}", f"../{name}/{REPORT}") for name in stores],
        warnings=lost,
        sections=[
            _make_map_section(len(xy_m), card.samples, plots),
            *([_SELECTION] if samples.num_rows else []),
            PageSection(
                "Labels",
                parts=[
                    make_quality_section(quality, "samples"),
                    *make_physics_sections(dict(card.physics)),
                    *make_budget_sections(card.energy_budget),
                ],
            ),
            PageSection(
                "Distance breakdown",
                "Used and excluded distances add up to the odometer.",
                plots=[draw_waterfall(card.distance_by_reason_m)],
            ),
            replace(make_repeatability_section(card.repeatability), parts=_make_class_sections(card)),
            _make_audit_section(card),
            _make_run_section(card, hrefs),
            _make_provenance_section(card),
        ],
        script="dataset.js" if samples.num_rows else "",
        data=_make_data(card, samples, shown, patches=patches, map_plot=plots[0], hrefs=hrefs),
    )


_SELECTION = PageSection(
    "Selected samples", "Patches and table show the selection. Travel is to the right.", controls="selection.html"
)


def _make_map_section(shown: int, count: int, plots: list[Plot]) -> PageSection:
    text = "Dashed: region of the split; the buffer is in no split. A click selects the nearest sample, with shift one more; "
    text += "a drag in the plot or the histogram selects all within. Filters combine."
    if shown < count:
        text += f" Of {count} samples {shown}, drawn at random, are shown."
    if not shown:
        return PageSection("The samples on the map", "There is none.")
    return PageSection("The samples on the map", text, controls="dataset.html", plots=plots)


def _make_data(
    card: DatasetCard, samples: pa.Table, shown: Json, *, patches: Json, map_plot: Plot, hrefs: Mapping[str, str]
) -> dict[str, Json]:
    colours = choose_class_colours(card.classes)
    names = [renderer.name or "" for renderer in map_plot.figure.renderers]
    return {
        "count": card.samples,
        "samples": shown,
        "patches": patches,
        "ground": [name.removeprefix("layer ") for name in names if name.startswith("layer ")],
        "classes": [{"id": entry.id, "name": entry.name, "colour": colours[entry.id]} for entry in card.classes],
        "splits": [{"name": name, "colour": SPLIT_COLOURS[name], "count": card.splits[name]} for name in SPLIT_COLOURS],
        "runs": [
            {"id": run.run_id, "first_ns": str(first), "href": hrefs.get(run.run_id)}
            for run, first in zip(card.runs, find_first_starts_ns(card, samples), strict=True)
        ],
        "quality": [[int(bit), words] for bit, words in QUALITY_WORDS.items()],
        "colours": list(CLASS_COLOURS),
        "unknown": FAINT,
        "clean": KEPT,
        "flagged": DROPPED,
        "flags": find_distinguishing_bits(samples.column("quality").to_numpy()),
    }


def _find_run_pages(beside: Path, card: DatasetCard) -> dict[str, str]:
    """Return the relative address of the page of each of the card's runs that a store in ``beside`` has, by run id."""
    wanted, found = {(run.run_id, run.recipe_id) for run in card.runs}, dict[str, str]()
    for path in sorted(runs.parent for runs in beside.glob("*/runs")):
        with suppress(StoreError, UsageError):  # no store that can be read
            rows = Store(path).scan().runs.values() if is_store(path) else ()
            names = {row.run_id: row.blob for row in rows if row.blob and (row.run_id, row.recipe_id) in wanted}
            found |= {run_id: f"../{path.name}/{BLOBS}/{blob}/{REPORT}" for run_id, blob in names.items()}
    return found


def _make_audit_section(card: DatasetCard) -> PageSection:
    rows = [
        (
            part.split,
            part.samples,
            part.overlapping_samples,
            part.same_track_pairs,
            part.repeated_place_samples,
            *(
                "none" if distance_m is None else f"{distance_m:.1f} m"
                for distance_m in (part.nearest_train_min_m, part.nearest_train_median_m)
            ),
        )
        for part in card.split.audit
    ]
    counts = ("samples", "overlap train", "neighbours of train", "places near train")
    header = ("split", *counts, "nearest train", "median")
    text = "Held-out samples near training samples. On the map: colour by distance to the nearest training sample, or tick its lines."
    return PageSection("Leakage audit", text, header=header, rows=rows)


def _make_class_sections(card: DatasetCard) -> list[PageSection]:
    names = sorted({name for counts in card.terrain.values() for name in counts})
    rows = [(name, *(card.terrain[split].get(name, 0) for split in SPLIT_COLOURS)) for name in names]
    return [PageSection("Samples by class", header=("class", *SPLIT_COLOURS), rows=rows)] if rows else []


def _make_run_section(card: DatasetCard, hrefs: Mapping[str, str]) -> PageSection:
    runs = [
        (
            Link(run.run_id, hrefs[run.run_id]) if run.run_id in hrefs else run.run_id,
            run.robot,
            ", ".join(run.logs),
            f"{run.samples}",
            "none" if run.energy_budget is None else f"{100 * run.energy_budget.total:.1f} %",
        )
        for run in card.runs
    ]
    text = "'tcpipe report DATASET' links the pages of the runs if the store is next to the dataset."
    if hrefs:
        text = "Links lead to the pages of the runs, once 'tcpipe report STORE' has written them."
    header = ("run", "robot", "log", "samples", "noise floor of E")
    return PageSection("Runs", text, header=header, rows=runs)


def _make_provenance_section(card: DatasetCard) -> PageSection:
    """Return the inputs from which the dataset can be built again."""
    rules = card.recipe.split
    rows = [
        ("made by", f"tcpipe {card.tcpipe_version}, data model {card.data_model_version}, {card.format} format"),
        ("inputs", card.inputs),
        ("recipe of ingest", ", ".join(sorted({run.recipe_id for run in card.runs}))),
        ("split", f"held out by {rules.holdout}, test fraction {rules.test_fraction:g}, seed {rules.seed}"),
        ("patches", f"{card.patch_m:g} m, {card.patch_px} px: {', '.join(card.layers)}" if card.layers else "none"),
        ("labels", ", ".join(f"{name} of {count}" for name, count in card.labels.items())),
        *(
            (
                f"map {grid.name}",
                f"{grid.cols} × {grid.rows} px of {1000 * grid.pixel_size_m:.0f} mm, {grid.crs}, sha256 {grid.sha256 or 'unknown'}",
            )
            for grid in card.maps
        ),
        *((f"log of {run.run_id}", f"sha256 {run.sha256}") for run in card.runs if run.sha256),
        ("licence", card.licence or "none given"),
        ("creator", card.creator or "none given"),
    ]
    text = "The same inputs give the same dataset; dataset.json contains its recipe and the checksum of every file."
    return PageSection("Provenance", text, header=("what", "is"), rows=rows, folded=True)


def find_nearest_train_m(xy_m: Floats, split: AnyInts) -> tuple[Floats, NDArray[np.int32]]:
    """Return distance [m] and row of the nearest training sample of each held-out sample, shape (N,); NaN elsewhere.

    ``split`` is the number of each sample's split in `SPLITS`, shape (N,).
    """
    apart, nearest = np.full(len(xy_m), np.nan), np.zeros(len(xy_m), np.int32)
    held, train = (np.flatnonzero(np.isin(SPLITS, names)[split]) for names in (("test", "unseen"), "train"))
    if len(held) and len(train):
        apart[held], found = cKDTree(xy_m[train]).query(xy_m[held])
        nearest[held] = train[found]
    return apart, nearest


def select_samples(card: DatasetCard, table: pa.Table) -> tuple[Floats, Json]:
    """Return the middles of the page's samples in the first map's plane, or the dataset's own, (N, 2), and columns."""
    xy_m = _read_middles_m(card, table)
    apart_m, nearest = find_nearest_train_m(xy_m, _find_indices(table, "split", SPLITS))
    starts_ns = np.array(find_first_starts_ns(card, table), np.int64)
    table = table.slice(0, MOST_SAMPLES)
    count = table.num_rows
    columns: dict[str, Column] = {"x": ("steps", xy_m[:count, 0]), "y": ("steps", xy_m[:count, 1])}
    for name, (column, std, digits) in LABELS.items():
        columns[name] = make_shown_column(digits, to_floats(table, column))
        columns[f"{name}_std"] = ("half", to_floats(table, std))
    for name, column in (("slope", "slope_rad"), ("turn", "yaw_change_rad")):
        columns[name] = ("half", np.degrees(to_floats(table, column)))
    run = _find_indices(table, "run_id", [source.run_id for source in card.runs])
    after = table.column("start_ns").to_numpy() - starts_ns[run]
    near = (apart_m < np.sqrt(2.0) * card.patch_m) & (nearest < count)
    columns |= {
        "apart": ("half", apart_m[:count]),
        "split": ("u8", _find_indices(table, "split", SPLITS)),
        "class": ("u8", table.column("terrain_class").fill_null(0).to_numpy()),
        "quality": ("u16", table.column("quality").to_numpy()),
        "run": ("u16", run),
        "after_s": ("u32", after // 10**9),
        "after_ns": ("u32", after % 10**9),
        "nearest": ("u32", np.where(near, nearest, np.arange(len(near)))[:count]),
    }
    return xy_m[:count], {"packed": pack_columns(columns), "ids": _find_odd_ids(table)}


def _read_middles_m(card: DatasetCard, table: pa.Table) -> Floats:
    if card.without_coordinates:
        return np.asarray(np.mean(read_ends_m(table), axis=0))
    if card.plane_crs == LOCAL:
        frames = np.argsort(np.argsort(find_first_starts_ns(card, table), kind="stable"))
        frame = frames[_find_indices(table, "run_id", [run.run_id for run in card.runs])]
        return np.asarray(np.mean(separate_frames(frame, read_ends_m(table)), axis=0))
    to_map = Transformer.from_crs(card.recipe.read.gnss_crs, card.plane_crs, always_xy=True)
    middle_deg = np.mean(read_ends_deg(table), axis=0)
    return np.column_stack(to_map.transform(*middle_deg.T)).reshape(-1, 2)


def _find_indices(table: pa.Table, column: str, names: Sequence[str]) -> NDArray[np.int32]:
    """Return the place of each row's name among ``names``, shape (N,); 0 of an unknown one."""
    indices = pc.index_in(table.column(column), value_set=pa.array(names, pa.string()))
    return np.asarray(indices.fill_null(0).to_numpy(), np.int32)


def find_first_starts_ns(card: DatasetCard, table: pa.Table) -> list[int]:
    """Return when each run's first sample begins [ns]; 0 if it has none."""
    first = table.select(["run_id", "start_ns"]).group_by("run_id").aggregate([("start_ns", "min")])
    starts_ns = dict(zip(*(first.column(name).to_pylist() for name in ("run_id", "start_ns_min")), strict=True))
    return [starts_ns.get(run.run_id, 0) for run in card.runs]


def _find_odd_ids(table: pa.Table) -> Sequence[str] | None:
    """Return the ids where they are not the run's and the start's, which the page puts together itself."""
    ids = table.column("sample_id").to_pylist()
    made = zip(table.column("run_id").to_pylist(), table.column("start_ns").to_pylist(), strict=True)
    return None if ids == [f"{run}-{start}" for run, start in made] else ids
