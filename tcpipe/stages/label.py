"""Segments to LabelledSegments: power, velocity, duration and energy of every metre, how wrong they may be, and what to know of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.cost.held_out import physics_of
from tcpipe.cost.labels import AboveStanding, Labels, above_standing, labels
from tcpipe.cost.physics import ALL, Metres, fit_physics
from tcpipe.cost.quality import bits, means_differ
from tcpipe.fusion.trajectory import DISPLACEMENT_LAGS_S
from tcpipe.geometry.piecewise_linear import interpolate, mean_between
from tcpipe.motion.pieces import piece_of_rows, spans_where
from tcpipe.motion.uncertainty import along_std_m, between_durations_m, displacement_std_m
from tcpipe.power.energy import Rule, energy_joule, samples_inside
from tcpipe.power.noise import energy_noise, resolution
from tcpipe.power.rails import Rail, power_watt
from tcpipe.power.standing import StandingPower, standing_power
from tcpipe.recipe import LabelConfig
from tcpipe.stages.label_facts import label_facts, label_findings
from tcpipe.stages.label_motion import clock_doubtful, motion_columns, motion_flags, power_flags
from tcpipe.stages.power_rails import energy_entries, rails_of
from tcpipe.tables.arrays import numbers, rows_where
from tcpipe.tables.bits import DropReason, Quality
from tcpipe.tables.columns import floats, integers, lonlat_deg
from tcpipe.tables.facts import PhysicsFacts
from tcpipe.tables.levels import (
    GATED_TRACK,
    LABELLED_SEGMENTS,
    GatedTrack,
    LabelledSegments,
    Segments,
    Streams,
    TrackInfo,
    add_findings,
)
from tcpipe.tables.wkb import line_column


def label_segments(
    segments: Segments,
    gated: GatedTrack,
    streams: Streams,
    config: LabelConfig,
    *,
    voltage_range_volt: tuple[float, float] | None,
) -> LabelledSegments:
    """Return the segments with w, v, T, E, their standard deviations as costs of the true metre, and quality bits.

    Parameters
    ----------
    streams : for its power; without it, or where it does not reach, power and energy are null.
    voltage_range_volt : [V], of the robot's profile; beyond it a label is flagged; no range, no flag.
    """
    rule: Rule = "averaged" if streams.power_averaged else config.integration
    parts, joules = [LABELLED_SEGMENTS.empty()], Counter[str]()
    variance_j2: list[dict[str, NDArray[np.float64]]] = []
    epochs: list[int] = np.unique(integers(gated.table, "epoch")).tolist()
    rails_by_epoch = {epoch: rails_of(streams, epoch) for epoch in epochs}
    standing = standing_power_of(gated.table, rails_by_epoch, rate_hz=gated.info.rate_hz)
    for epoch, rails in rails_by_epoch.items():
        rows, cut = (rows_where(table, "epoch", epoch) for table in (gated.table, segments.table))
        joules.update(energy_entries(rows, rails, rate_hz=gated.info.rate_hz, rule=rule))
        if not cut.num_rows:
            continue
        cost, above, causes = segment_costs(cut, rows, rails, gated.info, rule=rule, standing=standing)
        variance_j2.append(causes)
        spans = integers(cut, "start_ns"), integers(cut, "end_ns")
        count, mean_watt = samples_inside(rails, *spans)
        flags = {
            Quality.MEAN_POWER_DIFFERS: means_differ(mean_watt, cost.power_watt),
            Quality.CLOCK_DOUBTFUL: np.full(cut.num_rows, clock_doubtful(streams, gated.info)),
            **power_flags(cut, rails, range_volt=voltage_range_volt),
            **motion_flags(
                cut,
                rows,
                gated.info,
                arc_to_chord=config.flag_arc_to_chord,
                max_position_std_m=config.flag_position_std_m,
            ),
        }
        parts.append(
            LABELLED_SEGMENTS.table(
                **{name: cut[name] for name in cut.column_names},
                **motion_columns(cut, rows, streams, gated.info, cost),
                **{name: getattr(cost, name) for name in Labels.__slots__},
                **{name: getattr(above, name) for name in AboveStanding.__slots__},
                voltage_volt=mean_between(integers(rows, "stamp_ns"), floats(rows, "voltage_volt"), *spans),
                physics_power_watt=np.full(cut.num_rows, np.nan),
                power_samples=count,
                quality=bits(flags, cut.num_rows),
                geometry=line_column(*(lonlat_deg(cut, end) for end in ("start", "end"))),
            )
        )
    table, physics = with_physics(pa.concat_tables(parts).combine_chunks(), standing.watt)
    ledger_m, velocity = segments.ledger_m, config.velocity
    facts = label_facts(
        table, rails_by_epoch, joules, ledger_m, variance_j2, rule=rule, velocity=velocity, physics=physics
    )
    info = add_findings(segments.info, label_findings(facts), replace(segments.info.report.facts, label=facts))
    return LabelledSegments(table, info, segments.ledger_m)


_DISPLACEMENTS = [c.name for c in GATED_TRACK.columns if c.name.startswith("displacement_std_")]
_BETTER_HZ = 20.0


def segment_costs(
    cut: pa.Table, rows: pa.Table, rails: list[Rail], info: TrackInfo, *, rule: Rule, standing: StandingPower
) -> tuple[Labels, AboveStanding, dict[str, NDArray[np.float64]]]:
    """Return the labels of one epoch's segments, those above standing, and the variances of their energies by cause [J²].

    The causes are those of `tcpipe.cost.budget`.

    Parameters
    ----------
    rows : the gated track's rows of that epoch.
    """
    start_ns, end_ns, stamp_ns = integers(cut, "start_ns"), integers(cut, "end_ns"), integers(rows, "stamp_ns")
    spans = start_ns, end_ns, _still_ns(rows, info.rate_hz)
    noise = energy_noise(rails, *spans)
    better = energy_noise(rails, *spans, rate_hz=_BETTER_HZ)
    ground_mps = np.hypot(floats(rows, "east_velocity_mps"), floats(rows, "north_velocity_mps"))
    end_watt, noise_joule = power_watt(rails, end_ns), noise.std_joule()
    cost = labels(
        chord_m=floats(cut, "chord_m"),
        duration_s=(end_ns - start_ns).astype(np.float64) * 1e-9,
        energy_joule=energy_joule(rails, start_ns, end_ns, rule=rule),
        end_velocity_mps=interpolate(stamp_ns, ground_mps, end_ns),
        end_power_watt=end_watt,
        displacement_std_m=_displacement_std_m(cut, rows, smoothed=info.estimator == "smoother"),
        energy_noise_joule=noise_joule,
    )
    above = above_standing(
        cost,
        standing_watt=standing.watt,
        standing_std_watt=standing.std_watt,
        end_power_watt=end_watt,
        energy_noise_joule=noise_joule,
    )
    position = (end_watt * cost.duration_std_s) ** 2
    causes = {"position": position, "rate": noise.rate, "current": noise.current, "voltage": noise.voltage}
    return cost, above, {**causes, "at_20_hz": position + np.minimum(better.std_joule(), noise_joule) ** 2}


def _displacement_std_m(cut: pa.Table, rows: pa.Table, *, smoothed: bool) -> NDArray[np.float64]:
    """Return the error of each segment's displacement [m], shape (M,): as the smoother tells it, else as the rows' deviations allow."""
    start_ns, end_ns, stamp_ns = integers(cut, "start_ns"), integers(cut, "end_ns"), integers(rows, "stamp_ns")
    duration_s = (end_ns - start_ns).astype(np.float64) * 1e-9
    told_m = np.column_stack([interpolate(stamp_ns, floats(rows, name), start_ns) for name in _DISPLACEMENTS])
    told = between_durations_m(duration_s, told_s=DISPLACEMENT_LAGS_S, told_std_m=told_m)
    start_std_m, end_std_m = (
        along_std_m(
            interpolate(stamp_ns, floats(rows, "x_std_m"), at_ns),
            interpolate(stamp_ns, floats(rows, "y_std_m"), at_ns),
            floats(cut, "course_rad"),
        )
        for at_ns in (start_ns, end_ns)
    )
    modelled = displacement_std_m(
        velocity_std_mps=mean_between(stamp_ns, floats(rows, "forward_velocity_std_mps"), start_ns, end_ns),
        duration_s=duration_s,
        start_std_m=start_std_m,
        end_std_m=end_std_m,
        smoothed=smoothed,
    )
    return np.where(np.isnan(told), modelled, told)


def _still_ns(rows: pa.Table, rate_hz: float) -> NDArray[np.int64]:
    """Return begin and end [ns] of every stretch in which the robot stands, shape (S, 2)."""
    stamp_ns = integers(rows, "stamp_ns")
    piece = piece_of_rows(stamp_ns, integers(rows, "epoch"), period_ns=1e9 / rate_hz)
    standing = (numbers(rows["dropped_by"]) & np.uint32(DropReason.STANDING)) != 0
    return stamp_ns[spans_where(standing, piece)]


_EDGE_S = 0.3
"""After a stop and before a start motors draw."""


def standing_power_of(rows: pa.Table, rails: Mapping[int, list[Rail]], *, rate_hz: float) -> StandingPower:
    """Return the power while standing, of all rows of a gated track, and how sure it is.

    Parameters
    ----------
    rails : by clock epoch, for the step in which they tell currents.
    """
    piece = piece_of_rows(integers(rows, "stamp_ns"), integers(rows, "epoch"), period_ns=1e9 / rate_hz)
    standing = (numbers(rows["dropped_by"]) & np.uint32(DropReason.STANDING)) != 0
    halt, edge = np.full(rows.num_rows, -1), round(_EDGE_S * rate_hz)
    for number, (first, last) in enumerate(spans_where(standing, piece).tolist()):
        halt[first + edge : max(last + 1 - edge, first + edge)] = number
    power_watt = floats(rows, "power_watt")
    return standing_power(power_watt[standing], halt[standing], window_rows=round(rate_hz), step_watt=_step_watt(rails))


def _step_watt(rails: Mapping[int, list[Rail]]) -> float:
    """Return the step in which the power of all rails together is told [W]; 0 where none shows."""
    steps = [
        float(np.median(each.voltage_volt)) * resolution(each.current)
        for each in next((of for of in rails.values() if of), [])
        if len(each.voltage_volt)
    ]
    return float(np.linalg.norm(steps)) if steps else 0.0


def with_physics(table: pa.Table, standing_watt: float) -> tuple[pa.Table, PhysicsFacts]:
    """Return the labelled segments with the power that standing, drivetrain, rolling, grade and turning predict, and the fit.

    Parameters
    ----------
    table : labelled segments of a run.
    standing_watt : what the robot draws while it stands; NaN where that is not known.
    """
    metres = Metres(
        power_watt=floats(table, "power_watt"),
        velocity_mps=floats(table, "velocity_mps"),
        rise=(floats(table, "end_z_m") - floats(table, "start_z_m")) / floats(table, "chord_m"),
        turn_rate_radps=floats(table, "turn_rate_radps"),
        terrain=np.full(table.num_rows, ALL),
    )
    watt = standing_watt if np.isfinite(standing_watt) else None
    found = fit_physics(metres, standing_watt=watt)
    if found is None or not found.is_plausible():
        return table, PhysicsFacts(fitted=False, standing_watt=watt)
    predicted = np.where(np.isfinite(metres.power_watt), found.power_watt(metres), np.nan)
    odd = found.is_outlier(metres.power_watt - predicted)
    quality = numbers(table["quality"]) | np.where(odd, np.uint32(Quality.PHYSICS_OUTLIER), np.uint32(0))
    columns = {"physics_power_watt": predicted, "quality": quality.astype(np.uint32)}
    table = LABELLED_SEGMENTS.table(**{name: columns.get(name, table[name]) for name in table.column_names})
    resistance, rolling, drive = found.rolling_resistance(), found.of("rolling"), found.of("grade")
    return table, PhysicsFacts(
        fitted=True,
        standing_watt=watt,
        weight_over_efficiency_newton=None if drive is None else drive[0],
        rolling_newton=None if rolling is None else rolling[0],
        rolling_resistance=None if resistance is None else resistance[0],
        recovered_downhill=found.recovered,
        residual_watt=found.residual_watt,
        segments=found.segments,
        outliers=int(odd.sum()),
        fit=physics_of(metres, standing_watt=watt),
    )
