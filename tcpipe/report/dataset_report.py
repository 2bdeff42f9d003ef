"""The page of a dataset: the split on the map, what the patches look like, what was learned and lost."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyproj import Transformer

from tcpipe.formats.dataset_card import DatasetCard, MapSource, RunSource
from tcpipe.formats.dataset_files import OVERVIEW, open_patches, read_current_card, read_samples, rows_in_files
from tcpipe.formats.geojson import PolygonGeometry
from tcpipe.report.balance import balance_sections
from tcpipe.report.colours import SPLIT_COLOURS
from tcpipe.report.error_budget import budget_sections
from tcpipe.report.figures import (
    against_slope,
    histograms,
    patch_gallery,
    path_on_map,
)
from tcpipe.report.overview import Bounds, joint_bounds_m, read_overview
from tcpipe.report.page import Number, Section, render_page
from tcpipe.report.physics import physics_sections
from tcpipe.report.plots import waterfall
from tcpipe.report.quality import quality_sections
from tcpipe.tables.bits import Quality, name_of

_GALLERY = 10

_COLUMNS = (
    "split",
    "start_lon_deg",
    "start_lat_deg",
    "terrain_class",
    "terrain_name",
    "slope_rad",
    "power_watt",
    "velocity_mps",
    "duration_s",
    "energy_joule",
    "quality",
)


def dataset_report(directory: Path) -> str:
    """Return the HTML page of the dataset in ``directory``; `DatasetError` if it is none, or of another data model."""
    card, samples = read_current_card(directory), read_samples(directory, _COLUMNS)
    driven = sum(card.ledger_m.values())
    splits = {split: card.splits[split] for split in SPLIT_COLOURS}
    return render_page(
        title=f"Dataset {card.name}",
        lead=card.description or f"{card.format} format, data model {card.data_model_version}",
        numbers=[
            Number(f"{card.samples}", "samples"),
            *(Number(f"{count}", split) for split, count in splits.items()),
            Number(f"{len(card.runs)}", "runs"),
            Number(f"{driven:.0f} m", "driven"),
            *([] if card.doubtful is None else [Number(f"{100 * card.doubtful.share:.1f} %", "doubtful samples")]),
        ],
        warnings=[*card.problems, *card.warnings],
        sections=[
            _split_section(directory, card, samples),
            _gallery_section(directory, card, samples),
            *_label_sections(card, samples),
            *quality_sections(_quality_counts(samples), "samples"),
            *_finding_sections(card),
            *physics_sections(dict(card.physics)),
            *budget_sections(card.energy_budget),
            Section(
                "Where every metre went",
                "In samples and lost add up to the odometer.",
                plots=[waterfall(card.ledger_m)],
            ),
            *_removal_sections(card),
            *balance_sections(card.balance),
            _audit_section(card),
            *_table_sections(card),
        ],
    )


def _floats(samples: pa.Table, name: str) -> NDArray[np.float64]:
    values: NDArray[np.float64] = samples.column(name).to_numpy(zero_copy_only=False).astype(float)
    return values


def _split_section(directory: Path, card: DatasetCard, samples: pa.Table) -> Section:
    crs = card.maps[0].crs
    x_min_m, y_min_m, x_max_m, y_max_m = joint_bounds_m([(grid.crs, _bounds_m(grid)) for grid in card.maps])
    to_map = Transformer.from_crs(card.recipe.read.gnss_crs, crs, always_xy=True)
    region_to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    x, y = to_map.transform(_floats(samples, "start_lon_deg"), _floats(samples, "start_lat_deg"))
    outlines = [np.column_stack(region_to_map.transform(ring[:, 0], ring[:, 1])) for ring in _rings(card.split.region)]
    svg = path_on_map(
        np.asarray(x),
        np.asarray(y),
        samples.column("split").to_numpy(zero_copy_only=False),
        SPLIT_COLOURS,
        backdrop=read_overview(directory / OVERVIEW),
        extent_m=(x_min_m, x_max_m, y_min_m, y_max_m),
        outlines_m=outlines,
        labels=("easting [m]", "northing [m]"),
    )
    text = "Where each sample begins, on the map; dashed: the split's region. Samples in the buffer are in no split."
    return Section("The split on the map", text, svg)


def _bounds_m(grid: MapSource) -> Bounds:
    width_m, height_m = grid.cols * grid.pitch_m, grid.rows * grid.pitch_m
    return grid.x_min_m, grid.y_max_m - height_m, grid.x_min_m + width_m, grid.y_max_m


def _rings(region: Mapping[str, PolygonGeometry] | None) -> list[NDArray[np.float64]]:
    """Return every ring of every polygon of the region, lon and lat, each of shape (M, 2)."""
    rings = []
    for geometry in (region or {}).values():
        polygons = (geometry.coordinates,) if geometry.type == "Polygon" else geometry.coordinates
        rings += [np.array(ring, dtype=float)[:, :2] for polygon in polygons for ring in polygon]
    return rings


def _gallery_section(directory: Path, card: DatasetCard, samples: pa.Table) -> Section:
    chosen = _spread(samples)
    files = open_patches(directory, card)
    splits = samples.column("split").to_numpy(zero_copy_only=False)
    place = np.empty(samples.num_rows, dtype=np.int64)  # where each row of samples lies in the files
    for name, rows in rows_in_files(card, splits).items():
        place[splits == name] = rows
    stacks: dict[str, list[NDArray[np.generic]]] = {layer: [] for layer in files.layers}
    for row in chosen:
        piece = int(np.searchsorted(files.starts, place[row], side="right")) - 1
        pixels = files.read(piece, list(stacks))
        for layer, stack in stacks.items():
            stack.append(pixels[layer][place[row] - files.starts[piece]])
    titles = [
        f"{samples.column('terrain_name')[row].as_py() or 'sample'}\n"
        f"{np.degrees(samples.column('slope_rad')[row].as_py()):+.0f}°  {samples.column('power_watt')[row].as_py():.0f} W\n"
        f"{samples.column('velocity_mps')[row].as_py():.2f} m/s"
        for row in chosen
    ]
    text = "Travel is to the right; height is above each patch's own minimum. Above: class, slope, power, velocity."
    svg = patch_gallery({layer: np.stack(stack) for layer, stack in stacks.items()}, titles)
    return Section("Patches", text, svg)


def _spread(samples: pa.Table) -> list[int]:
    """Return rows spread over classes and slopes: the same dataset shows the same ones."""
    names = samples.column("terrain_name").to_pylist()
    slope = _floats(samples, "slope_rad")
    by_class: dict[str | None, list[int]] = {}
    for row in np.argsort(slope, kind="stable").tolist():
        by_class.setdefault(names[row], []).append(row)
    share = max(1, _GALLERY // len(by_class))
    chosen = [
        rows[int(position)]
        for _, rows in sorted(by_class.items(), key=lambda item: str(item[0]))
        for position in np.unique(np.linspace(0, len(rows) - 1, share).astype(int))
    ]
    return chosen[:_GALLERY]


def _label_sections(card: DatasetCard, samples: pa.Table) -> list[Section]:
    labels = {"w [W]": "power_watt", "v [m/s]": "velocity_mps", "T [s]": "duration_s", "E [J]": "energy_joule"}
    ids = np.nan_to_num(_floats(samples, "terrain_class")).astype(int)
    names = {entry.id: entry.name for entry in card.classes}
    series = {"power w [W]": _floats(samples, "power_watt"), "velocity v [m/s]": _floats(samples, "velocity_mps")}
    return [
        Section(
            "Power and velocity against slope",
            "What the model has to learn, and how far class and slope alone explain it.",
            against_slope(_floats(samples, "slope_rad"), series, ids, names),
        ),
        Section(
            "Labels",
            "One value a sample.",
            histograms({label: _floats(samples, name) for label, name in labels.items()}, of_what="samples"),
        ),
    ]


def _quality_counts(samples: pa.Table) -> dict[str, int]:
    quality = samples.column("quality").to_numpy()
    return {name_of(bit): int(((quality & int(bit)) != 0).sum()) for bit in Quality}


def _audit_section(card: DatasetCard) -> Section:
    rows = [
        (
            part.split,
            part.samples,
            part.overlapping_samples,
            part.same_track_pairs,
            part.repeated_place_samples,
            "none" if part.nearest_train_min_m is None else f"{part.nearest_train_min_m:.1f} m",
            "none" if part.nearest_train_median_m is None else f"{part.nearest_train_median_m:.1f} m",
        )
        for part in card.split.audit
    ]
    header = (
        "split",
        "samples",
        "overlap train",
        "neighbours of train",
        "places train knows",
        "nearest train",
        "median",
    )
    return Section("Leakage audit", "How much of what tests has been seen in training.", header=header, rows=rows)


def _finding_sections(card: DatasetCard) -> list[Section]:
    """Return what ingest found of the runs, by cause; nothing where it found nothing."""
    rows = [(found.example, ", ".join(found.runs), found.samples) for found in card.findings]
    text = "One line a cause, with the figures of the first of its runs; each run's own page has them all."
    return (
        [Section("What ingest found of the runs", text, header=("found", "runs", "samples"), rows=rows)] if rows else []
    )


def _removal_sections(card: DatasetCard) -> list[Section]:
    """Return what of each class and slope is in samples; nothing for datasets of before, and where nothing was driven."""
    found = []
    for groups, what in ((card.removal.by_class, "class"), (card.removal.by_slope, "slope along travel")):
        rows = [
            (
                group.name,
                f"{group.driven_m:.0f}",
                f"{100 * group.used_share:.0f} %",
                ", ".join(f"{name.replace('_', ' ')} {metres:.0f}" for name, metres in _largest(group.removed_m)),
            )
            for group in groups
        ]
        if rows:
            text = "Where the shares differ, what is removed depends on the ground."
            header = (what, "driven [m]", "in samples", "removed by [m]")
            found.append(Section(f"Metres in use by {what}", text, header=header, rows=rows))
    return found


def _largest(metres: Mapping[str, float]) -> list[tuple[str, float]]:
    """Return the three largest entries of half a metre or more."""
    return sorted(((n, m) for n, m in metres.items() if m >= 0.5), key=lambda item: (-item[1], item[0]))[:3]


def _table_sections(card: DatasetCard) -> list[Section]:
    sections = []
    if card.terrain:
        names = sorted({name for counts in card.terrain.values() for name in counts})
        rows = [(name, *(card.terrain[split].get(name, 0) for split in SPLIT_COLOURS)) for name in names]
        sections.append(Section("Samples by class", header=("class", *SPLIT_COLOURS), rows=rows))
    runs = [(run.run_id, run.robot, run.recipe_id, _floor(run)) for run in card.runs]
    sections.append(Section("Runs", header=("run", "robot", "recipe", "noise floor of E"), rows=runs, figures_from=3))
    return sections


def _floor(run: RunSource) -> str:
    return "none" if run.energy_budget is None else f"{100 * run.energy_budget.total:.1f} %"
