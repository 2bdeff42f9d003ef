"""Datasets without coordinates: metres and seconds from unknown origins, numbers for names, a card of listed fields."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Floats
from tcpipe.errors import DatasetError
from tcpipe.formats.dataset_card import LOCAL, DatasetCard, DatasetInputs, RunSource, SplitResult, judge_dataset
from tcpipe.formats.parquet import ROWS_PER_GROUP
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.geometry.datum import enu_from_geodetic
from tcpipe.pipeline.dataset.content import Content
from tcpipe.pipeline.dataset.inputs import ChosenInputs
from tcpipe.recipe import Recipe
from tcpipe.splits.audit import LOCAL_PLACES
from tcpipe.tables.columns import read_lonlat_deg, to_floats, to_integers
from tcpipe.tables.facts import HeldOut
from tcpipe.tables.findings import Finding, Findings, Subject, read_catalogue
from tcpipe.tables.levels import COORDINATES

_ENDS = ("start", "end")
_DIGITS = 4  # digits of metres and radians: finer ones would show how places differ from chords, and so the latitude

_DOCS = {
    "run_id": "number of the run",
    **{f"{end}_ns": f"time at the segment's {end}, since the start of the first sample" for end in _ENDS},
    **dict.fromkeys(LOCAL_PLACES, "place in one plane, from an origin that is not published"),
    "course_rad": "direction start to end, counter-clockwise from the x axis",
    "height_min_m": "smallest height in the patch, above a height that is not published; the height layer is above it",
}
"""Meanings of columns that differ from those of other datasets."""

_KEPT_FIELDS = (
    "data_model_version", "tcpipe_version", "inputs", "name", "description", "licence", "creator", "samples", "robots", "splits",
    "folds_of_train", "terrain", "label_statistics_of_train", "patch_m", "patch_px", "layers", "tensor", "classes",
    "energy_budget", "labels", "distance_by_reason_m", "repeatability", "flagged_samples", "physics", "added_columns", "shards",
    "checksums",
)  # fmt: skip
"""Fields of the card that are published unchanged."""

_KEPT_SECTIONS = ("fuse", "mask", "segment", "label", "sample", "split", "dataset")
"""Sections of the recipe that name no topics, files or robots."""

_KEPT_SUBJECTS = ("role", "class", "layer", "slope", "split")  # kinds of subjects whose names the dataset has anyway


@dataclass(frozen=True, slots=True)
class Publication:
    """Origins of places, times and heights, and public names."""

    datum_deg_m: tuple[float, float, float]
    """ENU origin of the plane of x and y, a sample's start."""
    low_xy_m: Floats
    start_ns: int
    height_m: float
    plane_scale: float
    """Metres of that plane to a metre of ``chord_m``: they differ by the height of the ground above the ellipsoid."""
    map_scale: float
    """Metres of the first map's plane to a metre of the ground."""
    runs: Mapping[str, str]
    maps: Mapping[str, str]
    robots: Mapping[str, str]
    columns: Mapping[str, str]
    """Columns of covariates."""

    def convert_samples(self, samples: pa.Table) -> pa.Table:
        """Return rows of the samples table without coordinates, with public names, places, times and heights."""
        start_m, end_m = (_place(samples, end, self.datum_deg_m) / self.plane_scale - self.low_xy_m for end in _ENDS)
        places = zip(LOCAL_PLACES, (*start_m.T, *end_m.T), strict=True)
        columns: dict[str, Any] = {name: axis_m.round(_DIGITS) for name, axis_m in places}
        columns["course_rad"] = np.arctan2(*(end_m - start_m).T[::-1]).round(_DIGITS)
        columns["height_min_m"] = to_floats(samples, "height_min_m") - self.height_m
        columns |= {f"{end}_ns": to_integers(samples, f"{end}_ns") - self.start_ns for end in _ENDS}
        for name, public in (("run_id", self.runs), ("map", self.maps), ("robot", self.robots)):
            columns[name] = [public.get(value) for value in samples.column(name).to_pylist()]
        ids = [f"{run}-{stamp}" for run, stamp in zip(columns["run_id"], columns["start_ns"].tolist(), strict=True)]
        columns |= {"sample_id": ids, "segment_id": ids}
        for name, values in columns.items():
            field = samples.schema.field(name)
            if name in _DOCS:
                field = field.with_metadata({"unit": field.metadata[b"unit"], "doc": _DOCS[name]})
            array = pa.array(values, field.type, from_pandas=True)
            samples = samples.set_column(samples.schema.get_field_index(name), field, array)
        return samples.drop_columns(list(COORDINATES)).replace_schema_metadata(None)

    def convert_content(self, content: Content) -> Content:
        """Return content whose samples are without coordinates, tags and names of tables."""
        added = content.samples.added.select(list(self.columns)).rename_columns(list(self.columns.values()))
        bare = pa.schema([field.with_metadata({"unit": "", "doc": ""}) for field in added.schema])
        return replace(content, samples=replace(content.samples, added=added.cast(bare), convert=self.convert_samples))

    def convert_inputs(self, inputs: ChosenInputs) -> ChosenInputs:
        """Return inputs whose runs have public names, and without logs, tags and recipe."""
        runs = tuple(
            RunSource(
                run_id=self.runs[run.run_id], recipe_id="", robot=self.robots[run.robot], logs=(), sha256="",
                driven_m=run.driven_m, findings=run.findings, energy_budget=run.energy_budget,
            )
            for run in inputs.sources
        )  # fmt: skip
        return replace(inputs, sources=runs)

    def make_card(self, card: DatasetCard) -> DatasetCard:
        """Return the public card of a dataset with converted content and inputs; findings of maps become its own."""
        of_maps = (finding for source in card.maps for finding in source.findings)
        names = {**self.runs, **{name: name for name in self.runs.values()}}
        findings = keep_public(dict.fromkeys((*card.findings, *of_maps)), names)
        runs = tuple(replace(run, findings=keep_public(run.findings, names)) for run in card.runs)
        recipe = replace(Recipe(), **{name: getattr(card.recipe, name) for name in _KEPT_SECTIONS})
        made_from = DatasetInputs(
            versions=card.made_from.versions, recipe=replace(recipe, split=replace(recipe.split, holdout_tag="")),
            robots=card.robots, file_format=card.format, labels=card.made_from.labels, without_coordinates=True,
        )  # fmt: skip
        return DatasetCard(
            **{name: getattr(card, name) for name in _KEPT_FIELDS}, made_from=made_from, label=replace(card.label, includes=()),
            split=SplitResult(card.split.buffer_m, None, tuple(map(self._convert_distances, card.split.audit))),
            runs=runs, maps=(), findings=findings, verdict=judge_dataset(findings, runs, ()), without_coordinates=True,
        )  # fmt: skip

    def _convert_distances(self, held: HeldOut) -> HeldOut:
        """Return an entry of the audit with distances in metres of the ground."""
        names = ("nearest_train_min_m", "nearest_train_median_m")
        known = {name: value for name in names if (value := getattr(held, name)) is not None}
        return replace(held, **{name: round(value / self.map_scale, _DIGITS) for name, value in known.items()})


def _place(samples: pa.Table, end: str, datum_deg_m: tuple[float, float, float]) -> Floats:
    """Return x, y of an end of segments in the plane of a datum [m], shape (N, 2)."""
    lon_deg, lat_deg = read_lonlat_deg(samples, end).T
    return enu_from_geodetic(lon_deg, lat_deg, 0.0, datum_deg_m=datum_deg_m)[:, :2]


def make_publication(content: Content, inputs: ChosenInputs, *, patch_m: float) -> Publication:
    """Return the origins, by the samples of a dataset, and its public names."""
    if content.plane == LOCAL:
        raise DatasetError(
            "--without-coordinates: the runs have no GNSS, so their positions on Earth are unknown; remove the option"
        )
    low_m, height_m, start_ns = np.full(2, np.inf), math.inf, np.iinfo(np.int64).max
    datum, plane_chord, chord_chord = (0.0, 0.0, 0.0), 0.0, 0.0
    for number, piece in enumerate(content.samples.pieces()):
        if number == 0 and piece.num_rows:
            datum = (*read_lonlat_deg(piece, "start")[0].tolist(), 0.0)
        start_m, end_m = (_place(piece, end, datum) for end in _ENDS)
        chord_m = to_floats(piece, "chord_m")
        plane_chord += float((np.hypot(*(end_m - start_m).T) * chord_m).sum())
        chord_chord += float((chord_m**2).sum())
        low_m = np.concatenate([low_m[None], start_m, end_m]).min(axis=0)
        height_m = float(np.fmin.reduce(to_floats(piece, "height_min_m"), initial=height_m))
        start_ns = int(to_integers(piece, "start_ns").min(initial=start_ns))
    corners_m = content.samples.sampled.footprint_xy_m[content.samples.patch[:ROWS_PER_GROUP]]
    sides_m = np.hypot(*(corners_m[:, 1] - corners_m[:, 0]).T)
    plane_scale = plane_chord / chord_chord if chord_chord else 1.0
    shipped, robots = load_shipped_profiles().robots, sorted({run.robot for run in inputs.sources})
    return Publication(
        datum, np.floor(low_m / plane_scale), start_ns, np.floor(height_m) if np.isfinite(height_m) else 0.0, plane_scale,
        map_scale=float(sides_m.mean()) / patch_m if len(sides_m) else 1.0,
        runs={run.run_id: f"run{number:04}" for number, run in enumerate(inputs.sources, 1)},
        maps={name: f"map{number}" for number, name in enumerate(inputs.map_names, 1)},
        robots={name: name if name in shipped else f"robot{number}" for number, name in enumerate(robots, 1)},
        columns={
            name: f"covariates{number}{name.removeprefix(Path(table.name).stem)}"
            for number, table in enumerate(content.covariates, 1)
            for name in table.samples_without
        },
    )  # fmt: skip


def keep_public(findings: Iterable[Finding], runs: Mapping[str, str]) -> Findings:
    """Return findings with the fields that the catalogue calls public; ``runs`` are public names of runs."""
    kept = list[Finding]()
    for finding in findings:
        entry, kind, name = read_catalogue().get(finding.code), finding.subject.kind, finding.subject.name
        public = entry.public if entry else ()
        name = name if kind in _KEPT_SUBJECTS else runs.get(name, kind) if kind == "run" else kind
        numbers = {field: number for field, number in finding.numbers.items() if field in public}
        names = {field: text for field, text in finding.names.items() if field in public}
        subject = Subject(kind, name)
        kept.append(Finding(finding.code, finding.severity, subject, finding.action, numbers=numbers, names=names))
    return tuple(kept)
