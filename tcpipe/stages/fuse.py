"""Fuse: streams become one track of base_link, 20 times a second, with its uncertainty (L1 to L2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from tcpipe.errors import FusionError
from tcpipe.recipe import FuseConfig
from tcpipe.stages.clock_doctor import clock_findings, with_offset_cost
from tcpipe.stages.fix_lag import with_lag_on_path
from tcpipe.stages.fuse_agreeing import fuse_agreeing
from tcpipe.stages.fuse_audit import audit_findings
from tcpipe.stages.fuse_columns import rejections_table
from tcpipe.stages.fuse_findings import fuse_facts, fuse_findings
from tcpipe.stages.fuse_inputs import FusionInputs, prepare_inputs
from tcpipe.stages.fuse_mounting_findings import mounting_findings
from tcpipe.stages.fuse_sanity import sane_inputs
from tcpipe.stages.read_pose import GNSS, pose_as_fixes, recipe_role
from tcpipe.tables.findings import Finding, StageReport, Subject, make_finding
from tcpipe.tables.levels import TRACK, Datum, Streams, Track, TrackInfo


def fuse_run(streams: Streams, config: FuseConfig, *, run_id: str) -> Track:
    """Return the track of a run.

    Each clock epoch, and each stretch between long pauses, is fused for itself; rows stand in order of epoch and stamp. Stamps are
    multiples of the track's period; where no sensor tells motion for ``max_gap_s`` there are no rows, so a gap is a step in the stamps.

    Parameters
    ----------
    streams : what `read_run` made of a log.
    config : estimator, rate and noise.
    run_id : stands in the track's info.

    Raises
    ------
    FusionError : nothing tells motion, or the estimate breaks down.
    """
    # 1. A pose made elsewhere is what the fixes are.
    #    Streams become measurements: one frame, one set of units, usable variances; sensors that cannot be right are left out.
    streams, local = pose_as_fixes(streams)
    run = Subject("run", run_id)
    inputs, sanity = sane_inputs(prepare_inputs(streams, config), streams)
    # 2. Each stretch for itself: where it starts, filter and smoother; again where that shows other mountings, or a sensor to be alone.
    inputs, sanity, fused = fuse_agreeing(inputs, sanity, streams, config, run=run)
    if not fused.found:
        raise FusionError("no motion to fuse", findings=(_find_nothing(streams, inputs, run), *sanity.findings))
    columns = {name: np.concatenate([part[name] for part in fused.columns]) for name in fused.columns[0]}
    if local:
        columns |= {name: np.full_like(columns[name], np.nan) for name in ("lon_deg", "lat_deg", "alt_m")}
    table = TRACK.table(**columns)
    datum = None if local or inputs.datum_deg_m is None else Datum(*inputs.datum_deg_m, crs=streams.gnss_crs)
    # 3. What was left out, where sensors disagree with the track, and whether their clocks agree.
    summary = fuse_facts(inputs, fused.facts, rows=table.num_rows, skipped_s=fused.skipped_s)
    clocks = with_lag_on_path(clock_findings(streams, inputs), fused, inputs, streams)
    table = with_offset_cost(table, clocks.facts)
    mounting, audit = mounting_findings(inputs, streams), audit_findings(fused, inputs, streams)
    found = (sanity, mounting, audit, clocks)
    findings = (
        *fuse_findings(inputs, summary, run=run, fixes=recipe_role(GNSS, streams)),
        *(finding for each in found for finding in each.findings),
    )
    facts = replace(
        streams.report.facts,
        fuse=summary,
        sensor_checks=sanity.facts,
        mounting=mounting.facts,
        audit=audit.facts,
        clock_offsets=clocks.facts,
    )
    report = StageReport((*_drop_places(streams.report.findings, findings), *findings), facts)
    info = TrackInfo(run_id, streams.robot, datum, config.rate_hz, config.estimator, report)
    return Track(table, rejections_table(inputs, fused.found), info)


def _drop_places(read: tuple[Finding, ...], fused: tuple[Finding, ...]) -> Iterator[Finding]:
    """Yield the findings of reading; one without extrinsics suggests none where fusing has estimated them."""
    estimated = {role for finding in fused for of in finding.remedies for role in of.recipe.get("read.placement", ())}
    for finding in read:
        is_estimated = finding.code == "sensor-not-placed" and finding.subject.name in estimated
        yield replace(finding, remedies=()) if is_estimated else finding


def _find_nothing(streams: Streams, inputs: FusionInputs, run: Subject) -> Finding:
    rows: dict[str, Any] = {f"{role}_row_count": table.num_rows for role, table in streams.tables.items()}
    rows |= {f"{role}_unusable_count": count["invalid"] for role, count in inputs.counts.items() if count["invalid"]}
    return make_finding("no-motion", run, **rows)
