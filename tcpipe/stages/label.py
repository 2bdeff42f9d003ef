"""Segments to LabelledSegments: power, velocity, duration and energy of every metre, how wrong they may be, and what to know of them."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.cost.labels import AboveStanding, Labels
from tcpipe.cost.quality import bits, means_differ
from tcpipe.geometry.piecewise_linear import mean_between
from tcpipe.power.energy import Rule, samples_inside
from tcpipe.recipe import LabelConfig
from tcpipe.stages.label_cost import segment_costs
from tcpipe.stages.label_facts import label_facts, label_findings
from tcpipe.stages.label_motion import motion_columns
from tcpipe.stages.label_physics import with_physics
from tcpipe.stages.label_quality import clock_doubtful, motion_flags, power_flags
from tcpipe.stages.label_standing import standing_power_of
from tcpipe.stages.power_rails import energy_entries, rails_of
from tcpipe.tables.arrays import rows_where
from tcpipe.tables.bits import Quality
from tcpipe.tables.columns import floats, integers, lonlat_deg
from tcpipe.tables.levels import LABELLED_SEGMENTS, GatedTrack, LabelledSegments, Segments, Streams, add_findings
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
