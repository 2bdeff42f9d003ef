"""Time and energy of whole ingested drives, measured and predicted, as a file."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tcpipe import __version__
from tcpipe.arrays import accumulate
from tcpipe.cost.adaptation import MeasuredRun, Metres, predict
from tcpipe.cost.coverage import find_miscalibration, measure_coverage
from tcpipe.cost.prediction_errors import COVERAGE
from tcpipe.dataset import Dataset
from tcpipe.dataset.energies import ENERGIES
from tcpipe.errors import ModelError, UsageError, clean_lines
from tcpipe.formats.atomic import Location, clear
from tcpipe.formats.dataset_card import list_shifts
from tcpipe.formats.finding_lines import format_findings, list_verdict
from tcpipe.formats.json_files import write_json
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.formats.object_storage import is_url, make_absolute
from tcpipe.formats.published_outputs import open_output, require_card
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.learning.evaluation import find_large_error
from tcpipe.learning.models import Model
from tcpipe.learning.training import compute_dataset_checksum
from tcpipe.pipeline.dataset.map_checks import register_runs
from tcpipe.planning.cost_model import Reason, check_model, predict_segments
from tcpipe.planning.path_cost import find_added_turning
from tcpipe.recipe import Recipe, SampleConfig
from tcpipe.splits.audit import CLOSE, PLACES, are_near, compute_middles
from tcpipe.stages.sample import Shifts
from tcpipe.store import Store, open_store, take_one_run
from tcpipe.tables.bits import flag_names
from tcpipe.tables.columns import read_ends_deg, to_floats
from tcpipe.tables.findings import PREDICTED, Finding, Findings, Subject, Verdict, judge, make_finding, read_threshold
from tcpipe.terrain.sampling import make_patch_frames
from tcpipe.terrain.tiles import MapReader, find_map_projection

UNCERTAIN, UNLABELLED = "position_uncertain", "no_label"
"""Reasons against the comparison of a segment, in addition to `Reason`."""


@dataclass(frozen=True, slots=True)
class IntervalComparison:
    """Measured and predicted sum of a drive, and the ends of its interval, None if the model has no errors."""

    measured: float
    predicted: float
    low: float | None
    high: float | None

    @property
    def off_percent(self) -> float:
        """Return the error of the prediction [%]."""
        return 100.0 * (self.predicted / self.measured - 1.0) if self.measured else float("nan")

    @property
    def held(self) -> bool | None:
        """Return whether the measured sum is inside the interval."""
        return None if self.low is None or self.high is None else self.low <= self.measured <= self.high


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveCost:
    """A drive: distances driven and compared, and time and energy of the compared segments, measured and predicted."""

    run_id: str
    log: str
    map: str
    driven_m: float
    """Odometer of the whole drive."""
    segments_m: float
    """Distance in segments: without starts, stops, turns in place, reversing [m]."""
    compared_m: float
    """Distance of segments with labels, on ground inside the training range [m]."""
    rest_m: Mapping[str, float]
    """Distance of the other segments by reason; a segment may have several [m]."""
    samples_in_training: int
    """Number of training samples of this drive; the drive is a holdout if this is 0."""
    near_training_percent: float
    """Share of segments whose middle is within 1.05 chords of the middle of a training sample of any drive [%]."""
    duration_s: IntervalComparison
    energy_joule: IntervalComparison
    label_energy: str

    @property
    def held_back(self) -> bool:
        """Return whether no part of the drive was used for training."""
        return self.samples_in_training == 0


def find_drive(store: Store, log: str) -> StoredRun:
    """Return the run of a log (path, URL, RUN or RUN/RECIPE); `UsageError` for no run or several."""
    state = store.scan()
    found = store.find_runs(log, state) or [
        run for run in store.runs(state) if make_absolute(log) in run.facts.log.paths
    ]
    if not found:
        raise UsageError(
            f"{log}: {store.root} has no run of this log or name; "
            "expected the path of an ingested log, a run or RUN/RECIPE"
        )
    return take_one_run(log, found)


Reasons = Sequence[Sequence[str]]
"""Reasons against the comparison of each segment; empty if it is compared."""


def predict_run(
    model: Model,
    source: MapReader,
    run: StoredRun,
    *,
    gnss_crs: str | None = None,
    sample: SampleConfig | None = None,
    shift: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[MeasuredRun, Reasons]:
    """Return predictions and labels of a run's segments in order, and reasons against comparing each.

    ``gnss_crs``: of the fixes (None: as ingested); ``sample`` limits the position's standard deviation; ``shift`` moves
    the run on the map (x, y) and adds to its standard deviation [m].
    """
    check_model(model, source)
    segments = run.segments().sort_by("start_ns")
    values = {
        name: to_floats(segments, name)
        for name in ("chord_m", "arc_length_m", "duration_s", "mean_abs_yaw_rate_radps", "position_std_m")
    }
    measured, length_m = to_floats(segments, ENERGIES[model.card.label_energy].energy), values["arc_length_m"]
    turn_rad = values["mean_abs_yaw_rate_radps"] * values["duration_s"]
    projection = find_map_projection(source, gnss_crs or run.manifest.recipe.read.gnss_crs)
    start, end = (projection.forward(ends_deg) + shift[:2] for ends_deg in read_ends_deg(segments))
    frames = make_patch_frames(start, end, values["chord_m"])
    prediction = predict_segments(model, source, frames, turn_radpm=turn_rad / length_m)
    duration, class_id = values["chord_m"] / prediction.velocity_mps, prediction.terrain_class
    turning = find_added_turning(model)
    turn_joule = 0.0 if turning is None else turning.energy_joule(turn_rad, length_m, class_id, is_driven=True)
    distance_m = accumulate(np.linalg.norm(np.diff(start, axis=0), axis=1))[: len(start)]
    energy = prediction.power_watt * duration + np.nan_to_num(turn_joule)
    both = {
        "duration": (duration, values["duration_s"], prediction.duration_std_s),
        "energy": (energy, measured, prediction.energy_std_joule),
    }
    rise_m = length_m * np.tan(prediction.slope_rad)
    is_near = model.find_near(compute_middles([to_floats(segments, name) for name in PLACES]))
    metres = {
        name: Metres(predicted, label, class_id, distance_m, length_m, duration, rise_m, turn_rad, std, is_near)
        for name, (predicted, label, std) in both.items()
    }
    uncertain = np.hypot(values["position_std_m"], shift[2]) > (sample or SampleConfig()).max_position_std_m
    reasons = [
        [*flag_names(bits, Reason), *[UNCERTAIN] * bool(unsure), *[UNLABELLED] * (not known)]
        for bits, unsure, known in zip(
            prediction.reasons, uncertain, np.isfinite(measured + values["duration_s"]), strict=True
        )
    ]
    return MeasuredRun(run.run_id, metres), reasons


def collect_runs(model: Model, source: MapFile, store: Store, logs: Sequence[str]) -> list[MeasuredRun]:
    """Return drives' labelled segments on known ground, predicted and measured; `UsageError` for a drive without any.

    They may be of another robot, payload or season, for adaptation of a model. They are moved onto the map as the
    default recipe says (``sample.align``).
    """
    runs = [find_drive(store, log) for log in logs]
    recipe = replace(Recipe(), read=runs[0].manifest.recipe.read)
    shifts, collected = find_shifts(source, recipe, runs)[0], list[MeasuredRun]()
    for run in runs:
        shift = shifts.get(run.run_id, (0.0, 0.0, 0.0))
        found, reasons = predict_run(model, source, run, sample=recipe.sample, shift=shift)
        is_good = np.array([not why for why in reasons], bool)
        if not is_good.any():
            named = ", ".join(_list_names(reasons)).replace("_", " ") or "it has no segments"
            raise UsageError(
                f"run {run.run_id}: no labelled segment on ground that {model.name} knows to adapt it by ({named})"
            )
        collected.append(MeasuredRun(run.run_id, {name: metres.take(is_good) for name, metres in found.metres.items()}))
    return collected


def _list_names(reasons: Reasons) -> list[str]:
    return sorted({name for why in reasons for name in why})


def find_shifts(source: MapFile, recipe: Recipe, runs: Sequence[StoredRun]) -> tuple[Shifts, list[Finding]]:
    """Return the shifts of runs on a map, and findings; {} without ``sample.align``."""
    if not recipe.sample.align:
        return {}, []
    registrations, findings = register_runs(runs, source, recipe)
    return list_shifts(registrations), findings


def compute_drive_cost(
    model: Model, source: MapReader, run: StoredRun, data: Dataset, *, log: str, shifts: Shifts | None = None
) -> DriveCost:
    """Return the measured and predicted cost of a drive.

    ``data``: the model's training dataset; ``log``: the user's name of the drive; ``shifts``: of runs on the map.
    `ModelError`, `UsageError`: it is of another robot, or has no segments.
    """
    if run.facts.robot != model.card.robot:
        raise ModelError(f"{log}: is of robot {run.facts.robot}, model {model.name} of {model.card.robot}")
    segments = run.segments()
    if not segments.num_rows:
        raise UsageError(f"{log}: run {run.run_id} has no segments to compare; see 'tcpipe report' for why")
    recipe, shift = data.card.recipe, (shifts or {}).get(run.run_id, (0.0, 0.0, 0.0))
    found, reasons = predict_run(model, source, run, gnss_crs=recipe.read.gnss_crs, sample=recipe.sample, shift=shift)
    errors, trained, length_m = model.errors, data["train"], found.metres["energy"].length_m
    near = are_near(
        compute_middles([to_floats(segments, name) for name in PLACES]),
        compute_middles([trained.column(name) for name in PLACES]),
        within_m=CLOSE * model.card.chord_m, in_degrees=True,
    )  # fmt: skip
    is_good = np.array([not why for why in reasons], bool)
    good = {name: metres.take(is_good) for name, metres in found.metres.items()}
    sums = {
        name: IntervalComparison(
            float(metres.measured.sum()), float(metres.predicted.sum()),
            *((None, None) if errors is None else predict(errors[name], metres).total.interval),
        )
        for name, metres in good.items()
    }  # fmt: skip
    return DriveCost(
        run_id=run.run_id, log=log, map=source.name, driven_m=run.facts.driven_m,
        segments_m=float(length_m.sum()), compared_m=float(length_m[is_good].sum()),
        rest_m={name: float(length_m[[name in why for why in reasons]].sum()) for name in _list_names(reasons)},
        samples_in_training=int((trained.column("run_id").astype(np.str_) == run.run_id).sum()),
        near_training_percent=100.0 * float(near.mean()),
        duration_s=sums["duration"], energy_joule=sums["energy"], label_energy=model.card.label_energy,
    )  # fmt: skip


def format_drive(drive: DriveCost) -> list[str]:
    """Return a drive as plain lines."""
    rest = ", ".join(f"{metres:.0f} m {name.replace('_', ' ')}" for name, metres in drive.rest_m.items())
    lines = [
        f"{drive.run_id}: {drive.compared_m:.0f} of {drive.driven_m:.0f} m driven are compared; "
        f"{drive.segments_m:.0f} m are in segments" + (f", of them not compared: {rest}" if rest else ""),
        (
            f"{drive.run_id}: {drive.near_training_percent:.0f} % of its segments "
            f"are within {CLOSE:g} chords of a training sample"
        ),
    ]
    above = ", net" if drive.label_energy == "net" else ""
    for called, value, unit in (("time", drive.duration_s, "s"), (f"energy{above}", drive.energy_joule, "J")):
        if drive.compared_m:
            interval = (
                "no interval" if value.low is None or value.high is None
                else f"{'inside' if value.held else 'OUTSIDE'} the {COVERAGE:.0%} prediction interval "
                f"{value.low:.0f} to {value.high:.0f}"
            )  # fmt: skip
            lines.append(
                f"{drive.run_id}: {called} {value.measured:.0f} {unit} measured, "
                f"{value.predicted:.0f} {unit} predicted "
                f"({value.off_percent:+.1f} %; {interval})"
            )
    return lines


JSON = "drives.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Drives:
    """All of drives.json."""

    kind: str = "tcpipe drives"
    tcpipe_version: str = __version__
    model: str
    model_checksum: str
    drives: tuple[DriveCost, ...]
    findings: Findings
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class DrivesResult:
    """Result and its path; the command prints its ``str``."""

    path: str
    values: Drives

    def __str__(self) -> str:
        """Return each drive as plain lines."""
        lines = [line for drive in self.values.drives for line in format_drive(drive)]
        lines += [f"verdict: {line}" for line in list_verdict(self.values.verdict, PREDICTED)]
        lines += format_findings(self.values.findings)
        return clean_lines((*lines, f"{self.path}/{JSON}"))


def evaluate_drives(
    model: Model, data: Dataset, source: MapFile, logs: Sequence[str], *, store: Location, out: Location
) -> DrivesResult:
    """Compare drives with a model's predictions and write ``drives.json`` into the directory ``out``, or to a URL.

    If the dataset's runs were moved onto their map (``sample.align``), drives are moved, too.

    Raises `ModelError`, `MapError` or `UsageError` if model, map or a drive cannot be used, ``data`` is not what the
    model was trained on, so that its training samples are unknown, or ``out`` is a file.
    """
    trained = model.card.dataset
    if compute_dataset_checksum(data.card) != trained.sha256:
        raise ModelError(
            f"{model.name}: was trained on another dataset ({trained.name}, {trained.sha256[:12]}) than {data.path}; "
            "expected that one, to find out whether a drive was used for training"
        )
    opened = open_store(store)
    runs = [find_drive(opened, log) for log in logs]
    shifts, moved = find_shifts(source, data.card.recipe, runs)
    found = tuple(
        compute_drive_cost(model, source, run, data, log=log, shifts=shifts)
        for run, log in zip(runs, logs, strict=True)
    )
    findings = (*_find_doubts(found, Subject("model", model.name)), *moved)
    values = Drives(
        model=model.name, model_checksum=model.checksum, drives=found,
        findings=findings, verdict=judge(findings),
    )  # fmt: skip
    if not is_url(out):
        clear(Path(out))
        if Path(out).exists() and not Path(out).is_dir():
            raise UsageError(f"{out}: is a file, expected a directory to write {JSON} into")
    with open_output(out, JSON) as place:
        place.mkdir(parents=True, exist_ok=True)
        write_json(place / JSON, values)
    return DrivesResult(require_card(str(out), [JSON]).place.where(), values)


def _find_doubts(drives: Sequence[DriveCost], model: Subject) -> Iterator[Finding]:
    """Yield errors of sums and intervals, and the drives that are not compared."""
    for drive in drives:
        if not drive.held_back:
            yield make_finding(
                "drive-in-training", Subject("run", drive.run_id), trained_count=drive.samples_in_training
            )
    compared = [drive for drive in drives if drive.held_back and drive.compared_m]
    if not compared:
        yield make_finding("no-drive-compared", model)
    for name, quantity in (("time", "duration_s"), ("energy", "energy_joule")):
        sums: dict[str, IntervalComparison] = {drive.run_id: getattr(drive, quantity) for drive in compared}
        for run_id, comparison in sums.items():
            yield from find_large_error(abs(comparison.off_percent) / 100.0, name, Subject("run", run_id))
        if held := [comparison.held for comparison in sums.values() if comparison.held is not None]:
            yield from find_miscalibration(measure_coverage(np.array(held), np.arange(len(held))), name, model)
    if 0 < len(compared) < read_threshold("few-drives", "min_drive_count"):
        yield make_finding("few-drives", model, drive_count=len(compared))
