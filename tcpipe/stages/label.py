"""Segments to LabelledSegments: power, velocity, duration and energy of each segment, with uncertainty and findings."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from itertools import chain

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Floats
from tcpipe.cost.labels import Labels, SensorError, combine_flags, compute_labels, subtract_idle_power
from tcpipe.cost.physics import ALL, FitSamples, fit_and_validate_physics, fit_physics
from tcpipe.fusion.measurements import DISPLACEMENT_LAGS_S
from tcpipe.geometry.piecewise_linear import interpolate, mean_between
from tcpipe.motion.row_sections import find_runs
from tcpipe.motion.uncertainty import compute_along_std_m, compute_displacement_std_m, find_common_scale_std
from tcpipe.power.noise import estimate_energy_noise, estimate_resolution
from tcpipe.power.rails import (
    IdlePower,
    Rail,
    Rule,
    compute_power_watt,
    count_samples_inside,
    estimate_idle_power,
    integrate_energy,
)
from tcpipe.power.sampling import estimate_delay_variance
from tcpipe.recipe import LabelConfig
from tcpipe.robots import Robot
from tcpipe.stages.label_motion import (
    find_label_findings,
    find_motion_flags,
    find_power_flags,
    is_clock_doubtful,
    make_label_facts,
    make_motion_columns,
    number_row_pieces,
    sum_energy_entries,
)
from tcpipe.stages.label_uncertainty import (
    audit_power_sensor,
    count_confirming_sensors,
    find_negative_idle,
    find_sensor_findings,
    find_stationary_ns,
    find_unpowered_motion,
    make_sensor_error,
)
from tcpipe.stages.label_witnesses import find_witnesses
from tcpipe.stages.message_arrays import make_rails
from tcpipe.tables.bits import DropReason, Quality
from tcpipe.tables.columns import (
    make_lines,
    read_ends_deg,
    read_rise,
    read_spans_ns,
    select_rows,
    to_floats,
    to_integers,
    to_numbers,
)
from tcpipe.tables.facts import PhysicsFacts, PowerSensorFacts
from tcpipe.tables.levels import (
    LABELLED_SEGMENTS,
    MASKED_TRACK,
    LabelledSegments,
    MaskedTrack,
    Segments,
    Streams,
    TrackInfo,
    add_findings,
)


def label_segments(
    segments: Segments, masked: MaskedTrack, streams: Streams, config: LabelConfig, *, robot: Robot
) -> LabelledSegments:
    """Return the segments with w, v, T, E, their standard deviations, and quality bits.

    Power and energy are null if ``streams`` has no power. ``robot`` is the profile: its range of voltages flags labels
    outside it, and its mass serves to verify the scale of the power.
    """
    rule: Rule = "averaged" if streams.power_averaged else config.integration
    parts, joules = [LABELLED_SEGMENTS.empty()], Counter[str]()
    variance_j2: list[dict[str, Floats]] = []
    epochs: list[int] = np.unique(to_integers(masked.table, "clock_epoch")).tolist()
    rails_by_epoch = {epoch: make_rails(streams, epoch) for epoch in epochs}
    power = audit_power_sensor(masked.table, rails_by_epoch, masked.info, config)
    standing = find_idle_power(masked.table, rails_by_epoch, rate_hz=masked.info.rate_hz, unsettled_s=power.unsettled_s)
    for epoch, rails in rails_by_epoch.items():
        rows, cut = (select_rows(table, "clock_epoch", epoch) for table in (masked.table, segments.table))
        joules.update(sum_energy_entries(rows, rails, rate_hz=masked.info.rate_hz, rule=rule))
        if not cut.num_rows:
            continue
        sensor = make_sensor_error(cut, rails, power, rule=rule)
        power = replace(power, lost_signs=power.lost_signs + int(np.count_nonzero(sensor.sign_joule)))
        cost, net, causes = compute_segment_costs(
            cut, rows, rails, masked.info, rule=rule, standing=standing, sensor=sensor, power=power
        )
        variance_j2.append(causes)
        spans = read_spans_ns(cut)
        count, mean_watt = count_samples_inside(rails, *spans)
        flags = {
            Quality.POWER_MEAN_MISMATCH: np.abs(mean_watt - cost.power_watt) > _MISMATCH * np.abs(cost.power_watt),
            Quality.CLOCK_DOUBTFUL: np.full(cut.num_rows, is_clock_doubtful(streams, masked.info)),
            **find_power_flags(cut, rails, range_volt=robot.voltage_range_volt),
            **find_motion_flags(
                cut,
                rows,
                masked.info,
                arc_to_chord=config.flag_arc_to_chord,
                max_position_std_m=config.flag_position_std_m,
            ),
        }
        parts.append(
            LABELLED_SEGMENTS.table(
                **{name: cut[name] for name in cut.column_names},
                **make_motion_columns(cut, rows, streams, masked.info, cost),
                **{name: getattr(cost, name) for name in Labels.__slots__},
                **net,
                voltage_volt=mean_between(to_integers(rows, "stamp_ns"), to_floats(rows, "voltage_volt"), *spans),
                power_samples=count,
                confirming_sensor_count=count_confirming_sensors(cut, streams, masked.info.report.facts),
                quality=combine_flags(flags, cut.num_rows),
                geometry=make_lines(*read_ends_deg(cut)),
            )
        )
    table = pa.concat_tables(parts).combine_chunks()
    needed_watt, physics = fit_run_physics(table, standing.watt)
    start_ns = int(masked.table["stamp_ns"][0].as_py()) if masked.table.num_rows else 0
    quality, unpowered = to_numbers(table["quality"]).copy(), []
    for segment_rows, finding in find_unpowered_motion(table, needed_watt, physics, masked.info, start_ns):
        quality[segment_rows] |= np.uint32(Quality.UNPOWERED)
        unpowered.append(finding)
    columns = {name: table[name] for name in table.column_names}
    table = LABELLED_SEGMENTS.table(**columns | {"quality": quality})
    distance_by_reason_m, velocity = segments.distance_by_reason_m, config.velocity
    facts = make_label_facts(
        table, rails_by_epoch, joules, distance_by_reason_m, variance_j2, rule=rule, velocity=velocity, physics=physics
    )
    facts = replace(facts, power_sensor=None if facts.energy_joule is None else power)
    findings = [
        *find_label_findings(facts, chain(*rails_by_epoch.values())),
        *find_sensor_findings(facts, masked.info, start_ns),
        *unpowered,
    ]
    findings += find_witnesses(table, replace(masked.info.report.facts, label=facts), robot)
    kind, rails = masked.info.report.facts.power, next(iter(rails_by_epoch.values()), [])
    findings += find_negative_idle(standing, facts.median_power_watt, kind, rails)
    info = add_findings(segments.info, findings, replace(segments.info.report.facts, label=facts))
    return LabelledSegments(table, info, segments.distance_by_reason_m)


_DISPLACEMENTS = [c.name for c in MASKED_TRACK.columns if c.name.startswith("displacement_std_")]
_BETTER_HZ = 20.0


def compute_segment_costs(
    cut: pa.Table,
    rows: pa.Table,
    rails: list[Rail],
    info: TrackInfo,
    *,
    rule: Rule,
    standing: IdlePower,
    sensor: SensorError,
    power: PowerSensorFacts,
) -> tuple[Labels, dict[str, Floats], dict[str, Floats]]:
    """Return the labels of one epoch's segments, the net labels, and the variances of their energies by cause [J²].

    ``cut`` and ``rows`` are the epoch's segments and rows of the masked track.
    """
    (start_ns, end_ns), stamp_ns = read_spans_ns(cut), to_integers(rows, "stamp_ns")
    spans = start_ns, end_ns, find_stationary_ns(rows, info.rate_hz)
    noise = estimate_energy_noise(rails, *spans, smoothing=power.smoothing)
    better = estimate_energy_noise(rails, *spans, rate_hz=_BETTER_HZ, smoothing=power.smoothing)
    ground_mps = np.hypot(to_floats(rows, "east_velocity_mps"), to_floats(rows, "north_velocity_mps"))
    end_watt, delay_j2 = compute_power_watt(rails, end_ns), np.zeros(cut.num_rows)
    if power.delay_s is not None:
        delay_j2 = estimate_delay_variance(rails, start_ns, end_ns, *power.delay_s, rule=rule)
    noise_joule = np.sqrt(noise.std_joule() ** 2 + delay_j2)
    scale_std = find_common_scale_std(info.report.facts.fuse, start_ns, to_integers(cut, "clock_epoch"))
    cost = compute_labels(
        chord_m=to_floats(cut, "chord_m"),
        duration_s=(end_ns - start_ns).astype(float) * 1e-9,
        energy_joule=integrate_energy(rails, start_ns, end_ns, rule=rule),
        end_velocity_mps=interpolate(stamp_ns, ground_mps, end_ns),
        end_power_watt=end_watt,
        displacement_std_m=_compute_displacement_std_m(cut, rows, smoothed=info.estimator == "smoother"),
        energy_noise_joule=noise_joule,
        common_displacement_std_m=scale_std * to_floats(cut, "chord_m"),
        sensor=sensor,
    )
    net = subtract_idle_power(
        cost,
        idle_watt=standing.watt,
        idle_std_watt=standing.std_watt,
        end_power_watt=end_watt,
        energy_noise_joule=noise_joule,
        sensor=sensor,
    )
    position = end_watt**2 * (cost.duration_std_s**2 - cost.duration_common_std_s**2)
    causes = {"position": position, "rate": noise.rate, "current": noise.current, "voltage": noise.voltage}
    causes |= {"common": cost.energy_common_std_joule**2, "delay": delay_j2}
    return cost, net, {**causes, "at_20_hz": position + np.minimum(better.std_joule(), noise.std_joule()) ** 2}


def _compute_displacement_std_m(cut: pa.Table, rows: pa.Table, *, smoothed: bool) -> Floats:
    """Return the error of each segment's displacement [m], shape (M,): the smoother's, else by the rows' σ."""
    (start_ns, end_ns), stamp_ns = read_spans_ns(cut), to_integers(rows, "stamp_ns")
    duration_s = (end_ns - start_ns).astype(float) * 1e-9
    lag_std_m = np.column_stack([interpolate(stamp_ns, to_floats(rows, name), start_ns) for name in _DISPLACEMENTS])
    start_std_m, end_std_m = (
        compute_along_std_m(
            interpolate(stamp_ns, to_floats(rows, "x_std_m"), at_ns),
            interpolate(stamp_ns, to_floats(rows, "y_std_m"), at_ns),
            to_floats(cut, "course_rad"),
        )
        for at_ns in (start_ns, end_ns)
    )
    return compute_displacement_std_m(
        velocity_std_mps=mean_between(stamp_ns, to_floats(rows, "forward_velocity_std_mps"), start_ns, end_ns),
        duration_s=duration_s,
        start_std_m=start_std_m,
        end_std_m=end_std_m,
        smoothed=smoothed,
        lags_s=DISPLACEMENT_LAGS_S,
        lag_std_m=lag_std_m,
    )


_MISMATCH = 0.05  # share of the mean power by which the plain mean of its samples may differ
_EDGE_S = 0.3  # after a stop and before a start motors draw


def find_idle_power(
    rows: pa.Table, rails: Mapping[int, list[Rail]], *, rate_hz: float, unsettled_s: tuple[float, float]
) -> IdlePower:
    """Return the idle power of a masked track, with σ; ``rails`` (by clock epoch) give the resolution."""
    piece = number_row_pieces(rows, rate_hz)
    standing = (to_numbers(rows["dropped_by"]) & np.uint32(DropReason.STATIONARY)) != 0
    halt = np.full(rows.num_rows, -1)
    begin, end = (round((_EDGE_S + more_s) * rate_hz) for more_s in unsettled_s)
    for number, (first, last) in enumerate(find_runs(standing, piece).tolist()):
        halt[first + begin : max(last + 1 - end, first + begin)] = number
    power_watt = to_floats(rows, "power_watt")
    return estimate_idle_power(
        power_watt[standing], halt[standing], window_rows=round(rate_hz), step_watt=_step_watt(rails)
    )


def _step_watt(rails: Mapping[int, list[Rail]]) -> float:
    """Return the resolution of the power of all rails together [W]; 0 if none shows."""
    steps = [
        float(np.median(each.voltage_volt)) * estimate_resolution(each.current)
        for each in next((of_epoch for of_epoch in rails.values() if of_epoch), [])
        if len(each.voltage_volt)
    ]
    return float(np.linalg.norm(steps)) if steps else 0.0


def make_fit_samples(table: pa.Table) -> FitSamples:
    """Return segments or samples as input of the fit; the rise is that of the track."""
    names = [ALL] * table.num_rows
    if "terrain_name" in table.column_names:
        names = table.column("terrain_name").fill_null(ALL).to_pylist()
    return FitSamples(
        power_watt=to_floats(table, "power_watt"),
        velocity_mps=to_floats(table, "velocity_mps"),
        rise=read_rise(table),
        mean_abs_yaw_rate_radps=to_floats(table, "mean_abs_yaw_rate_radps"),
        terrain=np.array(names, np.str_),
    )


def fit_run_physics(table: pa.Table, idle_watt: float) -> tuple[Floats, PhysicsFacts]:
    """Return the power [W] by speed, slope and turning of each segment, NaN without a fit, and the run's fit.

    Ground classes are unknown here: mud in a meadow has a large residual without any error.
    """
    metres = make_fit_samples(table)
    watt = idle_watt if np.isfinite(idle_watt) else None
    found = fit_physics(metres, idle_watt=watt)
    needed_watt = np.full(table.num_rows, np.nan) if found is None else found.power_watt(metres)
    return needed_watt, PhysicsFacts(watt, fit_and_validate_physics(metres, idle_watt=watt))
