"""Where a track bears no segment: without power, where the next metre is uncertain or jumps, too fast, and between contradictions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tcpipe.errors import FusionError
from tcpipe.fusion.trajectory import DISPLACEMENT_LAGS_S
from tcpipe.motion.distance_breakdown import JUMP_M, compute_unexplained_m
from tcpipe.motion.row_sections import Floats, Mask, MotionRows
from tcpipe.motion.uncertainty import compute_along_std_m, compute_chord_ahead_std_m
from tcpipe.recipe import MaskConfig
from tcpipe.tables.catalogue import read_threshold
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.tables.levels import TRACK, Track

_DISPLACEMENTS = [c.name for c in TRACK.columns if c.name.startswith("displacement_std_")]


@dataclass(frozen=True, slots=True)
class Gaps:
    """Rows in a gap by cause, and the findings."""

    without_power: Mask
    uncertain: Mask
    jumps: Mask
    contradicted: Mask
    implausible: Mask
    findings: tuple[Finding, ...]

    @property
    def rows(self) -> Mask:
        """All of them."""
        return self.without_power | self.uncertain | self.jumps | self.contradicted | self.implausible

    def counts(self) -> dict[str, int]:
        """Return the number of rows by cause; a row may have several."""
        causes = ("without_power", "uncertain", "jumps", "contradicted", "implausible")
        return {name: int(getattr(self, name).sum()) for name in causes}


def find_gaps(track: Track, rows: MotionRows, *, chord_m: float, config: MaskConfig, max_plausible_mps: float) -> Gaps:
    """Return the rows that bear no segment, by cause: no power in a run that has power, a moving row whose next chord is uncertain, a jump.

    An error of scale that all of a run has in common makes no segment worse than the next: it is left out of a chord's own uncertainty.
    Where its sensors contradict each other in most of the way undecided, they are all rows of the run. Rows faster than
    ``max_plausible_mps`` [m/s] are no driving; see `find_implausible`.
    """
    power = to_floats(track.table, "power_watt")
    without_power = np.isnan(power) & bool(np.isfinite(power).any())
    moving = np.abs(rows.velocity_mps) >= config.turning_velocity_mps
    uncertain = moving & (_compute_chord_std_m(track, rows, chord_m, config) > config.max_relative_position_std_m)
    off_m = _compute_unexplained_m(track, rows)
    jumps = np.zeros(len(moving), dtype=np.bool_)
    steps = np.flatnonzero(off_m > config.max_relative_position_std_m)
    jumps[steps] = jumps[steps + 1] = True
    run, findings = Subject("run", track.info.run_id), []
    share = float(without_power[moving].mean()) if moving.any() else 0.0
    if share > read_threshold("power-gaps", "min_lost_fraction"):
        findings.append(make_finding("power-gaps", Subject("role", "power"), lost_fraction=share))
    share = float(uncertain[moving].mean()) if moving.any() else 0.0
    if share > read_threshold("distance-uncertain", "min_lost_fraction"):
        limit_m = config.max_relative_position_std_m
        findings.append(
            make_finding("distance-uncertain", run, lost_fraction=share, chord_m=chord_m, max_std_m=limit_m)
        )
    if far := int((off_m > JUMP_M).sum()):
        stamp_ns, furthest = to_integers(track.table, "stamp_ns"), int(np.argmax(off_m))
        at_s = (int(stamp_ns[furthest]) - int(stamp_ns[0])) / 1e9
        jump_m = float(off_m.max())
        findings.append(make_finding("position-jumps", run, span_s=(at_s, at_s), jump_m=jump_m, jump_count=far))
    audit = track.info.report.facts.audit
    contradicted = np.full(len(moving), bool(audit and audit.undecided))
    implausible, too_fast = find_implausible(track, rows, jumps, max_plausible_mps)
    return Gaps(without_power, uncertain, jumps, contradicted, implausible, (*findings, *too_fast))


def _compute_chord_std_m(track: Track, rows: MotionRows, chord_m: float, config: MaskConfig) -> Floats:
    table = track.table
    course = np.arctan2(to_floats(table, "north_velocity_mps"), to_floats(table, "east_velocity_mps"))
    common_mps = _compute_common_std_mps(track)
    told_m = np.column_stack([to_floats(table, name) for name in _DISPLACEMENTS])
    return compute_chord_ahead_std_m(
        rows,
        velocity_std_mps=_subtract_variance(to_floats(table, "forward_velocity_std_mps"), common_mps),
        position_std_m=compute_along_std_m(to_floats(table, "x_std_m"), to_floats(table, "y_std_m"), course),
        chord_m=chord_m,
        slowest_mps=config.turning_velocity_mps,
        smoothed=track.info.estimator == "smoother",
        told_s=DISPLACEMENT_LAGS_S,
        told_std_m=_subtract_variance(told_m, common_mps[:, None] * DISPLACEMENT_LAGS_S),
    )


def _compute_common_std_mps(track: Track) -> Floats:
    """Return the part of each row's velocity deviation that its whole stretch has in common, since nothing tells how long a metre is."""
    table = track.table
    stamp_ns, epoch = to_integers(table, "stamp_ns"), to_integers(table, "clock_epoch")
    speed_mps = np.linalg.norm([to_floats(table, f"{name}_velocity_mps") for name in ("east", "north", "up")], axis=0)
    scale_std = np.zeros(len(speed_mps))
    fuse = track.info.report.facts.fuse
    for stretch in fuse.stretches if fuse else ():
        inside = (epoch == stretch.clock_epoch) & (stamp_ns >= stretch.start_ns) & (stamp_ns <= stretch.end_ns)
        scale_std[inside] = stretch.common_scale_std or 0.0
    common_mps: Floats = scale_std * speed_mps
    return common_mps


def _subtract_variance(std: Floats, part: Floats) -> Floats:
    """Return a deviation less a part of it; NaN where it is not known."""
    return np.sqrt(np.maximum(std**2 - part**2, 0.0))


def _compute_unexplained_m(track: Track, rows: MotionRows) -> Floats:
    table = track.table
    position_m = np.column_stack([to_floats(table, f"{axis}_m") for axis in "xyz"])
    velocity_mps = np.column_stack([to_floats(table, f"{name}_velocity_mps") for name in ("east", "north", "up")])
    return np.append(compute_unexplained_m(to_integers(table, "stamp_ns"), position_m, velocity_mps, rows.piece), 0.0)


_WINDOW_S = 60.0
_DRIVES_MPS = 0.1


def find_implausible(track: Track, rows: MotionRows, jumps: Mask, limit_mps: float) -> tuple[Mask, tuple[Finding, ...]]:
    """Return the rows faster than a limit, by velocity or by the step between two rows, and the finding of them.

    Parameters
    ----------
    jumps : rows beside a jump of the position, shape (N,): a jump is no speed.
    limit_mps : [m/s].

    Raises
    ------
    FusionError : the moving median of the speed, over a minute of driving, exceeds the limit.
    """
    table = track.table
    speed_mps = np.hypot(to_floats(table, "east_velocity_mps"), to_floats(table, "north_velocity_mps"))
    step_mps = np.hypot(*(np.diff(to_floats(table, f"{axis}_m")) for axis in "xy")) / rows.period_s
    step_mps = np.where((np.diff(rows.piece) == 0) & ~(jumps[1:] & jumps[:-1]), step_mps, 0.0)
    speed_mps = np.maximum(speed_mps, np.maximum(np.append(step_mps, 0.0), np.append(0.0, step_mps)))
    implausible: Mask = speed_mps > limit_mps
    if not implausible.any():
        return implausible, ()
    driving_mps = speed_mps[speed_mps > _DRIVES_MPS]
    window = min(driving_mps.size, rows.count(_WINDOW_S))
    faster = np.concatenate(([0], np.cumsum(driving_mps > limit_mps)))
    run, median_mps = Subject("run", track.info.run_id), float(np.median(driving_mps))
    numbers = {"fast_s": implausible.sum() * rows.period_s, "limit_mps": limit_mps, "median_mps": median_mps}
    if 2 * int((faster[window:] - faster[:-window]).max()) > window:
        finding = make_finding("track-too-fast", run, severity="error", action="rejected", **numbers)
        raise FusionError("the track is faster than plausible", findings=(finding, *track.info.report.findings))
    return implausible, (make_finding("track-too-fast", run, **numbers),)
