"""Audit the uncertainty of a run: withhold fixes, fuse the other data, and compare the track with the fixes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
from scipy.special import betaincinv

from tcpipe.arrays import Floats, Ints, Mask
from tcpipe.errors import FusionError, UsageError, align_columns, clean_lines
from tcpipe.formats.atomic import Location
from tcpipe.formats.logs.log_joining import open_single_log
from tcpipe.formats.object_storage import format_path, is_url
from tcpipe.formats.recipe_toml import load_profiles, resolve_recipe
from tcpipe.fusion.measurements import DOPPLER, FIXES, PAUSE_NS, Positions
from tcpipe.fusion.signals import compute_seconds, integrate_signal, is_in_gap
from tcpipe.geometry.datum import enu_from_geodetic, geodetic_from_enu
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rpy
from tcpipe.progress import step
from tcpipe.recipe import FuseConfig, Recipe
from tcpipe.stages.fuse import fuse_run
from tcpipe.stages.fuse_inputs import Section, prepare_sections
from tcpipe.stages.message_arrays import find_fixes_role, use_pose_as_fixes
from tcpipe.stages.read import find_read_config, read_run
from tcpipe.store import find_named_run, is_path, is_store
from tcpipe.tables.columns import number_column, read_float_columns, select_rows, to_integers
from tcpipe.tables.levels import Streams, Track

WINDOWS_S = (10.0, 30.0, 60.0)
"""Lengths of the windows without fixes [s]."""
END_S = 5.0
"""Time at either end of a run in which fixes stay [s]: the track starts from them and ends at them."""
LEAST_WINDOW_M = 1.0
"""Least distance of a window [m]: in a shorter one the robot is stationary."""

Calibration = Literal["overconfident", "calibrated", "underconfident", "undecided"]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Withheld fixes less the antenna that the track predicts, one a second.

    Attributes
    ----------
    window_s : length of the windows.
    window : number of the window, shape (N,).
    error_m, std_m : east and north, and its σ, both the track's and the fix's, shape (N, 2).
    """

    window_s: float
    window: Ints
    error_m: Floats
    std_m: Floats


@dataclass(frozen=True, slots=True)
class WithheldScore:
    """Errors against withheld fixes over windows of one length [m], and the share of errors within the claimed σ.

    The values of a window share its errors: ``calibration`` counts a window as one observation. It names a share whose
    exact binomial 95 % interval excludes that of the normal distribution; fewer than five windows are ``undecided``.
    """

    window_s: float
    windows: int
    compared: int
    median_error_m: float
    p95_error_m: float
    median_std_m: float
    within_1_sigma: float
    within_2_sigma: float
    calibration: Calibration


def score_comparisons(comparisons: Sequence[Comparison]) -> WithheldScore:
    """Return the score of comparisons of one length, of one run or of several."""
    error_m, std_m = (np.concatenate([getattr(each, name) for each in comparisons]) for name in ("error_m", "std_m"))
    normalized, sizes_m = np.abs(error_m / std_m), np.linalg.norm(error_m, axis=1)
    windows = sum(len(np.unique(each.window)) for each in comparisons)
    within = (float(np.mean(normalized < 1.0)), float(np.mean(normalized < 2.0)))
    return WithheldScore(
        window_s=comparisons[0].window_s,
        windows=windows,
        compared=len(error_m),
        median_error_m=float(np.median(sizes_m)),
        p95_error_m=float(np.quantile(sizes_m, 0.95)),
        median_std_m=float(np.median(np.linalg.norm(std_m, axis=1))),
        within_1_sigma=within[0],
        within_2_sigma=within[1],
        calibration=_judge_coverage(within, windows),
    )


def _judge_coverage(within: tuple[float, float], windows: int) -> Calibration:
    """Return whether the shares inside 1σ and 2σ fit a normal distribution; few windows can share one fault."""
    if windows < 5:
        return "undecided"
    count_1, count_2 = (share * windows for share in within)
    if count_2 < windows and betaincinv(count_2 + 1.0, windows - count_2, 0.975) < 0.9545:
        return "overconfident"
    is_low = count_1 > 0.0 and betaincinv(count_1, windows - count_1 + 1.0, 0.025) > 0.6827
    return "underconfident" if is_low else "calibrated"


def place_windows(span_s: float, length_s: float) -> Floats:
    """Return start and end of evenly spaced windows in a span [s], shape (N, 2); a gap is at least a window long."""
    inner_s = span_s - 2.0 * END_S
    count = max(int((inner_s + length_s) / (2.0 * length_s)), 0)
    gap_s = (inner_s - count * length_s) / max(count - 1, 1)
    starts_s = END_S + (0.5 * gap_s if count == 1 else 0.0) + np.arange(count) * (length_s + gap_s)
    return np.stack([starts_s, starts_s + length_s], -1)


class TrackRows:
    """The rows of a track's clock epoch, for interpolation: stamps, and columns of the level TRACK by name."""

    def __init__(self, stamp_ns: Ints, columns: Mapping[str, Floats], rate_hz: float) -> None:
        self.stamp_ns, self.columns = stamp_ns, columns
        self._longest_ns = round(1.5e9 / rate_hz)
        """A longer step is a gap."""

    def find(self, stamp_ns: Ints) -> Mask:
        """Return whether there is a track at each stamp, shape (N,)."""
        return ~is_in_gap(self.stamp_ns, stamp_ns, stamp_ns, longest_ns=self._longest_ns)

    def interpolate(self, name: str, stamp_ns: Ints) -> Floats:
        """Return a column at stamps [ns], shape (N,); an angle is continuous."""
        values = np.unwrap(self.columns[name]) if name.endswith("_rad") else self.columns[name]
        zero_ns = int(self.stamp_ns[0])
        return np.interp(compute_seconds(stamp_ns, zero_ns), compute_seconds(self.stamp_ns, zero_ns), values)

    def measure_length_m(self, start_ns: int, end_ns: int) -> float:
        """Return the horizontal length of the track between two stamps, without gaps."""
        rows = slice(*np.searchsorted(self.stamp_ns, (start_ns, end_ns)))
        steps = np.hypot(np.diff(self.columns["x_m"][rows]), np.diff(self.columns["y_m"][rows]))
        return float(steps[np.diff(self.stamp_ns[rows]) <= self._longest_ns].sum())


def compare_fixes(
    fixes: Positions, rows: TrackRows, windows_ns: Ints, numbers: Ints, *, arm_m: Floats, arm_std_m: Floats
) -> Comparison:
    """Compare one fix a second in some windows with the track; fixes within a second have nearly the same error.

    The uncertainty of the lever arm is part of base_link's σ, not of the antenna's, and is subtracted.
    """
    number = np.searchsorted(windows_ns[:, 0], fixes.stamp_ns) - 1
    start_ns, end_ns = windows_ns[np.maximum(number, 0)].T
    inside = np.flatnonzero(np.isin(number, numbers) & (fixes.stamp_ns < end_ns) & rows.find(fixes.stamp_ns))
    second = (fixes.stamp_ns - start_ns) // 1_000_000_000
    chosen = inside[np.unique([number[inside], second[inside]], axis=1, return_index=True)[1]]
    if not chosen.size:
        raise FusionError("no fix is on the track of the other sensors")
    stamp_ns = fixes.stamp_ns[chosen]
    rpy = [rows.interpolate(f"{name}_rad", stamp_ns) for name in ("roll", "pitch", "yaw")]
    rotation = matrix_from_quat(quat_from_rpy(*rpy))[:, :2]
    predicted = np.stack([rows.interpolate(f"{axis}_m", stamp_ns) for axis in "xy"], -1) + rotation @ arm_m
    std = np.stack([rows.interpolate(f"{axis}_std_m", stamp_ns) for axis in "xy"], -1)
    variance = np.maximum(std**2 - rotation**2 @ arm_std_m**2, 0.0) + fixes.variance_m2[chosen, :2]
    window_s = float(windows_ns[0, 1] - windows_ns[0, 0]) * 1e-9
    return Comparison(window_s, number[chosen], fixes.position_enu_m[chosen, :2] - predicted, np.sqrt(variance))


@dataclass(frozen=True, slots=True)
class WithheldComparisons:
    """Comparisons of a run by window length, and reasons of missing ones; without fixes, ratios of track to odometry."""

    comparisons: tuple[Comparison, ...]
    skipped: tuple[str, ...]
    length_ratios: dict[str, float]


def compare_withheld(streams: Streams, config: FuseConfig, *, run_id: str) -> WithheldComparisons:
    """Withhold fixes in windows of each length, and compare them with the track from the other data.

    All windows of a length are withheld together, so that each length needs only one fusion.

    Raises `FusionError`: no sensor measures motion.
    """
    sections = prepare_sections(use_pose_as_fixes(streams)[0], config)
    if not sections:
        raise FusionError(f"{run_id}: no sensor measures motion")
    section, fuse = max(sections, key=lambda section: section.driven_m), partial(fuse_run, config=config, run_id=run_id)
    comparisons, skipped = list[Comparison](), list[str]()
    gnss = section.measurements.gnss
    if gnss is None:
        return WithheldComparisons((), ("without fixes",), _compare_lengths(fuse(streams), section))
    if not section.measurements.odometries():
        skipped.append("no other sensor measures motion")
    span_s = float(gnss.stamp_ns[-1] - gnss.stamp_ns[0]) * 1e-9
    for length_s in WINDOWS_S if not skipped else ():
        windows_ns = int(gnss.stamp_ns[0]) + np.round(place_windows(span_s, length_s) * 1e9).astype(np.int64)
        if not windows_ns.size:
            skipped.append(f"{length_s:.0f} s: covers {span_s:.0f} s, {length_s + 2.0 * END_S:.0f} s are needed")
            break
        try:
            step(f"fusing without {len(windows_ns)} x {length_s:.0f} s of fixes")
            track = fuse(withhold(streams, section.clock_epoch, windows_ns))
            arm_m = np.asarray(streams.sensors[find_fixes_role(streams)].xyz_m)
            comparisons.append(_compare_fixes(track, section, gnss, windows_ns, arm_m))
        except FusionError as error:
            skipped.append(f"{length_s:.0f} s: {error.problems[0]}")
    return WithheldComparisons(tuple(comparisons), tuple(skipped), {})


_OTHER_ARM = {"lever-arm-unknown", "lever-arm-contradicted"}  # findings of an antenna that is elsewhere than stated


def _compare_fixes(track: Track, section: Section, gnss: Positions, windows_ns: Ints, arm_m: Floats) -> Comparison:
    """Compare withheld fixes with a track; `FusionError` if the track has no fixes left, or no motion there."""
    facts = track.info.report.facts
    if facts.fuse is not None and not {*FIXES}.intersection(facts.fuse.sensors):
        raise FusionError("tcpipe excludes the other fixes of the run")
    rows = _select_rows(track, section)
    moving = np.array([rows.measure_length_m(*window) >= LEAST_WINDOW_M for window in windows_ns])
    if not moving.any():
        raise FusionError("the other sensors have no track in the windows, or the robot is stationary there")
    datum = track.info.datum
    if datum is None or section.datum_deg_m is None:
        raise FusionError("the track of the other sensors has only local coordinates")
    places = geodetic_from_enu(gnss.position_enu_m, datum_deg_m=section.datum_deg_m)
    moved = enu_from_geodetic(*places, datum_deg_m=(datum.lon_deg, datum.lat_deg, datum.alt_m))
    arm_std_m = np.zeros(3)
    if facts.fuse and any(finding.code in _OTHER_ARM for finding in track.info.report.findings):
        arm = facts.fuse.longest.parameters["antenna"]
        arm_m, arm_std_m = arm_m + arm.value, np.asarray(arm.std)
    fixes, numbers = replace(gnss, position_enu_m=moved), np.flatnonzero(moving)
    return compare_fixes(fixes, rows, windows_ns, numbers, arm_m=arm_m, arm_std_m=arm_std_m)


def withhold(streams: Streams, epoch: int, windows_ns: Ints) -> Streams:
    """Return the streams of a clock epoch without fixes and receiver velocities in windows [ns], shape (N, 2)."""

    def keep(table: pa.Table) -> pa.Table:
        stamp_ns = to_integers(table, "stamp_ns")
        inside = np.searchsorted(windows_ns[:, 0], stamp_ns, "right") > np.searchsorted(windows_ns[:, 1], stamp_ns)
        return table.filter(number_column(~(inside & (to_integers(table, "clock_epoch") == epoch))))

    without = (*FIXES, DOPPLER)
    return replace(
        streams, tables={name: keep(table) if name in without else table for name, table in streams.tables.items()}
    )


def _compare_lengths(track: Track, section: Section) -> dict[str, float]:
    """Return the ratio of the horizontal length of the track to the distance of each odometry, by role."""
    rows = _select_rows(track, section)
    if rows.stamp_ns.size == 0:
        return {}
    ends_ns = rows.stamp_ns[[0, -1]]
    length_m = rows.measure_length_m(int(ends_ns[0]), int(ends_ns[1]) + 1)
    ratios = {}
    for role, odometry in section.measurements.odometries().items():
        zero_ns, speed = int(odometry.stamp_ns[0]), np.abs(odometry.velocity_mps[:, :1])
        way_m = integrate_signal(compute_seconds(odometry.stamp_ns, zero_ns), speed, compute_seconds(ends_ns, zero_ns))
        odometer_m = float(way_m[1, 0] - way_m[0, 0])
        if odometer_m > LEAST_WINDOW_M:
            ratios[role] = length_m / odometer_m
    return ratios


def _select_rows(track: Track, section: Section) -> TrackRows:
    table, (start_ns, end_ns) = select_rows(track.table, "clock_epoch", section.clock_epoch), section.span_ns
    stamp_ns = to_integers(table, "stamp_ns")
    table = table.filter(number_column((stamp_ns >= start_ns - PAUSE_NS) & (stamp_ns <= end_ns + PAUSE_NS)))
    return TrackRows(to_integers(table, "stamp_ns"), read_float_columns(table), track.info.rate_hz)


_HEADER = ("window", "windows", "values", "error", "95 %", "σ", "≤ 1σ", "≤ 2σ", "")


@dataclass(frozen=True, slots=True)
class Audit:
    """How well a run's track predicts fixes that were withheld from it."""

    run: str
    robot: str
    scores: tuple[WithheldScore, ...]
    """By length of the windows without fixes."""
    skipped: tuple[str, ...]
    """Windows that could not be withheld, and why."""
    length_ratios: Mapping[str, float]
    """Without fixes: length of the track over the distance of each odometry, by role."""

    def __str__(self) -> str:
        """Return it as a table, in metres."""
        lines = [f"{self.run}: robot {self.robot}"]
        if self.scores:
            lines += ["m: median and 95 % of the errors of withheld fixes, their median σ; shares inside 1σ and 2σ", ""]
            lines += align_columns([_HEADER, *map(_make_row, self.scores)], str.rjust)
        lines += [f"track / {role}: {ratio:.4f} of its distance" for role, ratio in self.length_ratios.items()]
        lines += [f"not audited: {line}" for line in self.skipped]
        return clean_lines(lines)


def _make_row(score: WithheldScore) -> tuple[str, ...]:
    return (
        f"{score.window_s:.0f} s",
        *(str(count) for count in (score.windows, score.compared)),
        *(f"{value:.3f}" for value in (score.median_error_m, score.p95_error_m, score.median_std_m)),
        *(f"{share:.0%}" for share in (score.within_1_sigma, score.within_2_sigma)),
        score.calibration,
    )


def audit(
    run: Location,
    *,
    recipe: Recipe | Location | None = None,
    robot: str | None = None,
    message_definitions: Path | None = None,
    store: Location = "tcpipe-store",
) -> Audit:
    """Withhold fixes in windows, fuse the other data, and compare the track with the withheld fixes.

    Raises `UsageError`: the run is too short, or has no sensor other than the one to be withheld; `LogError`,
    `RecipeError`, `StoreError`, `FusionError`: it cannot be read or fused.

    Parameters
    ----------
    run : a log, or a run of the store (RUN or RUN/RECIPE), which is fused with its own recipe.
    recipe, robot, message_definitions : how a log is read and fused, as `tcpipe.pipeline.ingest.ingest` takes them.
    store : where a run is looked up.
    """
    name = format_path(run)
    streams, config = read_audited(run, recipe, robot=robot, message_definitions=message_definitions, store=store)
    compared = compare_withheld(streams, config, run_id=name)
    skipped = tuple(f"{find_fixes_role(streams)}, {reason}" for reason in compared.skipped)
    if not compared.comparisons and not compared.length_ratios:
        raise UsageError(f"{name}: nothing can be withheld and compared", *skipped)
    scores = tuple(score_comparisons([each]) for each in compared.comparisons)
    return Audit(name, streams.robot, scores, skipped, compared.length_ratios)


def read_audited(
    run: Location,
    recipe: Recipe | Location | None,
    *,
    robot: str | None = None,
    message_definitions: Path | None = None,
    store: Location = "tcpipe-store",
) -> tuple[Streams, FuseConfig]:
    """Return the streams of a log or of a stored run, and fusion's settings; parameters and errors as for `audit`."""
    if not is_path(run):
        stored = find_named_run(run, store)
        return stored.streams(), stored.manifest.recipe.fuse
    if is_store(run):
        raise UsageError(f"{run}: is a store; name one of its runs: tcpipe audit RUN --store {run}")
    path, recipe = run if is_url(run) else Path(run), resolve_recipe(recipe)
    step("reading")
    with open_single_log(path, message_definitions=message_definitions, tables=recipe.tables) as log:
        read = find_read_config(recipe, log.topics)
        return read_run(log, read, robot=robot or recipe.robot, known=load_profiles(recipe)), recipe.fuse
