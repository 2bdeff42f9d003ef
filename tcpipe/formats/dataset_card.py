"""The card of a dataset, ``dataset.json``: all that is needed to use, cite and check it, as dataclasses."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Literal

from tcpipe.arrays import Box
from tcpipe.formats.finding_lines import FindingGroup, group_findings
from tcpipe.formats.geojson import PolygonGeometry
from tcpipe.formats.integrity import Checksum, FileChecksums
from tcpipe.formats.json_files import Json, digest, to_plain
from tcpipe.formats.maps.map_facts import Description, MapInputs
from tcpipe.recipe import Recipe
from tcpipe.tables.facts import EnergyBudget, Floor, HeldOut, PhysicsFit
from tcpipe.tables.findings import Finding, Findings, Verdict, judge_by_code, omit
from tcpipe.tables.levels import LABELS
from tcpipe.terrain.layers import TerrainClass


@dataclass(frozen=True, slots=True)
class RunInputs:
    """One run of a dataset, by the content of its log and segments."""

    recipe_id: str
    robot: str
    logs: tuple[str, ...]
    """Names of its log's files."""
    sha256: str
    """Checksum of its log."""
    segments_sha256: str | None
    tags: Mapping[str, str]
    message_definitions: str = omit("")
    """Hash of the definitions that were given for types which the log does not define."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetInputs:
    """Everything that a dataset is made of; files are named by the sha256 of their content."""

    versions: Mapping[str, str]
    """``results`` and ``tables``."""
    recipe: Recipe
    """Without its section ``train``."""
    runs: Mapping[str, RunInputs] = field(default_factory=dict)
    """By id."""
    robots: tuple[str, ...]
    """The robots that recorded the runs."""
    tags: Mapping[str, str] = field(default_factory=dict)
    """Tags that a run had to have."""
    maps: Mapping[str, str] = field(default_factory=dict)
    """By name: sha256 over the map's files."""
    map_names: tuple[str, ...] = ()
    """In order of priority where maps overlap; none: a dataset without patches."""
    region: Mapping[str, str] | None = None
    """By kind of polygon: the sha256 of its coordinates."""
    covariates: Mapping[str, str] = field(default_factory=dict)
    """By file: its sha256."""
    file_format: str
    labels: tuple[str, ...] = ()
    """Labels that every sample needs; none: the default."""
    without_patches: bool = False
    """Whether the user declined patches (``--without-patches``)."""
    without_coordinates: bool

    @property
    def parts(self) -> dict[str, str]:
        """Hash of each part, by the name of its field."""
        return {entry.name: digest([getattr(self, entry.name)]) for entry in fields(self)}

    @property
    def digest(self) -> str:
        """Hash over all of it: the same inputs make the same dataset."""
        return digest(self.parts)


@dataclass(frozen=True, slots=True)
class RecordChange:
    """One entry of a record that differs from another's."""

    path: tuple[str, ...]
    """Field, then keys below it."""
    was: Json
    """None: it was not there."""
    now: Json
    """None: it is not there any more."""

    @property
    def name(self) -> str:
        """Keys below the field, with dots between."""
        return ".".join(self.path[1:])


def compare_records(was: DatasetInputs, now: DatasetInputs) -> Iterator[RecordChange]:
    """Yield every entry in which two records differ, in the order of their fields."""
    yield from _compare((), to_plain(was), to_plain(now))


def _compare(path: tuple[str, ...], was: Json, now: Json) -> Iterator[RecordChange]:
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        for key in dict.fromkeys((*was, *now)):
            yield from _compare((*path, key), was.get(key), now.get(key))
    elif was != now:
        yield RecordChange(path, was, now)


_LONGEST_VALUE = 80


def format_value(value: Json) -> str:
    """Return a value of a record as text, a long one cut, with a digest of the whole."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        value = [f"{key}={item}" for key, item in value.items()]
    if isinstance(value, list | tuple):
        value = ", ".join(map(str, value))
    text = "none" if value in (None, "") else str(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}… ({digest(text)[:8]})"


KIND = "tcpipe dataset"

LOCAL = "local"
"""Plane of runs without GNSS: each in its own frame, side by side."""


@dataclass(frozen=True, slots=True)
class LabelColumns:
    """Which columns of samples.parquet train, and which velocity that is."""

    columns: tuple[str, str]
    velocity: str
    includes: tuple[str, ...] = omit(())
    """Loads other than the drives in the power of any run."""


@dataclass(frozen=True, slots=True)
class LabelStatistics:
    """Statistics of a label over train, for normalisation, in the label's unit; null without training samples."""

    count: int
    mean: float | None
    std: float | None
    min: float | None
    max: float | None


@dataclass(frozen=True, slots=True)
class SplitResult:
    """Result of the recipe's section ``split``, and of its audit."""

    buffer_m: float
    """As it was used."""
    region: Mapping[str, PolygonGeometry] | None
    """By kind: train_test, unseen, exclude."""
    audit: tuple[HeldOut, ...]


@dataclass(frozen=True, slots=True)
class RunSource:
    """A run that the dataset is made from."""

    run_id: str
    recipe_id: str
    robot: str
    logs: tuple[str, ...]
    """Names of its log's files."""
    sha256: str
    """Checksum of its log."""
    segments_sha256: str | None = None
    driven_m: float | None = None
    tags: Mapping[str, str] | None = None
    findings: Findings = omit(())
    """Findings of its ingest."""
    energy_budget: EnergyBudget | None = None
    samples: int = 0


@dataclass(frozen=True, slots=True)
class Covariate:
    """A table joined to the samples by time: its file, its time span (UTC), and samples without a value by column."""

    name: str
    checksum: Checksum
    rows: int
    time_column: str
    first: str
    last: str
    samples_without: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class FlaggedSamples:
    """Samples with a quality flag that not all samples have: their number, share (0 to 1), and number by flag."""

    samples: int
    share: float
    by_bit: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class MapRegistration:
    """Registration of a map to a track (`tcpipe.terrain.registration`); no shift or scale unless the ground has one."""

    run_id: str
    points: int
    shift_xy_m: tuple[float, float] | None
    shift_std_m: float | None
    significant: bool
    height_offset_m: float
    misfit_m: float
    shifted_misfit_m: float | None
    height_scale: float | None = None
    """Metres that the track rises where the map rises by one."""
    height_scale_std: float | None = None
    expected_misfit_m: float | None = None
    """Misfit by the track's own height errors and the map's resolution [m]."""
    applied_std_m: float | None = omit()
    """DRMS of the shift, where the run's positions were moved by it."""


def list_shifts(registrations: Iterable[MapRegistration]) -> dict[str, tuple[float, float, float]]:
    """Return by run the shift that was applied, x and y, and its DRMS [m]."""
    return {
        registration.run_id: (*registration.shift_xy_m, registration.applied_std_m)
        for registration in registrations
        if registration.shift_xy_m is not None and registration.applied_std_m is not None
    }


@dataclass(frozen=True, slots=True)
class MapSource:
    """A map that the dataset was sampled from: its location and its sources."""

    name: str
    layers: tuple[str, ...]
    crs: str
    x_min_m: float
    y_max_m: float
    pixel_size_m: float
    rows: int
    cols: int
    sha256: str | None = None
    """Over the checksums of its files."""
    sources: Mapping[str, str] | None = None
    covered: Mapping[str, float] | None = None
    height_min_m: float | None = None
    height_max_m: float | None = None
    class_share: Mapping[str, float] | None = None
    class_shares: Mapping[str, Mapping[str, float]] | None = field(default=None, metadata={"json": (None, {})})
    """By layer, of a user's own categorical ones."""
    classes_from: str | None = None
    inputs: MapInputs | None = None
    findings: Findings = omit(())
    """Findings of building it."""
    registration: tuple[MapRegistration, ...] = ()

    @property
    def bounds_m(self) -> Box:
        """Least x and y, greatest x and y in its plane [m]."""
        width_m, height_m = self.cols * self.pixel_size_m, self.rows * self.pixel_size_m
        return self.x_min_m, self.y_max_m - height_m, self.x_min_m + width_m, self.y_max_m


@dataclass(frozen=True, slots=True)
class Shard:
    """A Parquet file of patches: its path in the dataset, split and rows."""

    path: str
    split: str
    rows: int


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetCard:
    """All of dataset.json but its seal."""

    kind: str = KIND
    data_model_version: str
    tcpipe_version: str
    inputs: str
    """Digest of ``made_from``: the same inputs make the same dataset."""
    made_from: DatasetInputs
    """The inputs; a dataset without coordinates omits runs, maps, region and files."""
    name: str
    description: str
    licence: str = ""
    creator: str = ""
    samples: int
    robots: tuple[str, ...] = ()
    splits: Mapping[str, int]
    """Samples by split."""
    folds_of_train: tuple[int, ...] = ()
    terrain: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    """Samples by split and terrain name."""
    label_statistics_of_train: Mapping[str, LabelStatistics] = field(default_factory=dict)
    patch_m: float
    patch_px: int
    layers: Mapping[str, Description]
    """By layer: its numpy type, value of no data, and CF attributes (`tcpipe.formats.maps.map_facts`)."""
    tensor: Mapping[str, str | tuple[str, ...]]
    """``channels``, and by layer the conversion of stored values to a channel from 0 to 1."""
    classes: tuple[TerrainClass, ...]
    label: LabelColumns
    energy_budget: EnergyBudget | None = None
    labels: Mapping[str, int]
    """Samples that have each label (`tcpipe.tables.levels.LABELS`); 0: the label is absent."""
    plane: str = omit("")
    """Without a map: CRS of the plane in which footprints and regions are compared; `LOCAL` where runs have no GNSS."""
    split: SplitResult
    distance_by_reason_m: Mapping[str, float]
    """Distance breakdown of the runs [m]."""
    repeatability: Mapping[str, Floor | None]
    """How well each label repeats itself; None if no place was driven twice."""
    runs: tuple[RunSource, ...]
    maps: tuple[MapSource, ...]
    flagged_samples: FlaggedSamples
    """How many samples carry a quality flag."""
    findings: Findings = ()
    """Findings of the dataset itself: its choice of runs, sampling and splits. Runs and maps have their own."""
    verdict: Verdict
    """By all findings of the dataset, its maps and the runs that have samples."""
    physics: Mapping[str, PhysicsFit] = omit({})
    """Physics fitted on train by robot, if any: idle, drivetrain, rolling, grade and turning by class."""
    covariates: tuple[Covariate, ...] = omit(())
    added_columns: Mapping[str, str] = omit({})
    """Columns of samples.parquet beyond its schema: run tags and covariates, each with its meaning."""
    without_coordinates: bool = omit(False)
    """Whether places are metres from an unpublished origin; then names, times, maps and regions are omitted too."""
    shards: tuple[Shard, ...]
    checksums: FileChecksums
    """By path inside the dataset."""

    @property
    def recipe(self) -> Recipe:
        """The recipe that it was built with."""
        return self.made_from.recipe

    @property
    def absent_labels(self) -> tuple[str, ...]:
        """Labels that no sample has."""
        return tuple(name for name in LABELS if not self.labels.get(name))

    @property
    def plane_crs(self) -> str:
        """CRS of the plane in which footprints and regions are compared: that of the first map, else `LOCAL`."""
        return self.maps[0].crs if self.maps else self.plane

    @property
    def format(self) -> str:
        """``zarr`` or ``parquet``."""
        return self.made_from.file_format

    @property
    def findings_by_run(self) -> dict[str, Findings]:
        """Findings of ingest, of every run."""
        return {run.run_id: run.findings for run in self.runs}

    @property
    def findings_by_map(self) -> dict[str, Findings]:
        """Findings of building each map."""
        return {source.name: source.findings for source in self.maps}


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedDataset(DatasetCard):
    """Card of a dataset."""

    kind: Literal["dataset"] = "dataset"
    path: str


def judge_dataset(findings: Iterable[Finding], runs: Iterable[RunSource], maps: Iterable[MapSource]) -> Verdict:
    """Return the verdict on a dataset, with the worst finding of each code as reasons, by its runs with samples."""
    of_runs = (finding for run in runs if run.samples for finding in run.findings)
    return judge_by_code([*findings, *of_runs, *(finding for source in maps for finding in source.findings)])


def group_dataset_findings(
    findings: Sequence[Finding], by_run: Mapping[str, Sequence[Finding]], by_map: Mapping[str, Sequence[Finding]] = {}
) -> list[FindingGroup]:
    """Return all findings of a dataset grouped by code, with the number of runs or maps and the word for them."""
    own = [(finding.subject.name, [finding]) for finding in findings if finding.subject.kind != "run"]
    of_runs = [(finding.subject.name, [finding]) for finding in findings if finding.subject.kind == "run"]
    runs = len({*by_run, *(name for name, _ in of_runs)})
    return [
        *group_findings(own),
        *group_findings([*of_runs, *by_run.items()], runs),
        *group_findings(by_map.items(), len(by_map), "maps"),
    ]
