"""The pipeline: what becomes of a run's streams, stage by stage."""

from __future__ import annotations

from tcpipe.formats.robot_files import load_profiles
from tcpipe.progress import step
from tcpipe.recipe import IngestSections
from tcpipe.tables.levels import LabelledSegments, MaskedTrack, Streams, Track


def run_stages(
    streams: Streams, sections: IngestSections, *, run_id: str
) -> tuple[Track, MaskedTrack, LabelledSegments]:
    """Run fuse, gate, segment and label over the streams of one run.

    A stage gets its own section, and of the others nothing but the chord; no section that `recipe_id` is not the hash of is in reach.
    """
    from tcpipe.stages.fuse import fuse_run  # noqa: PLC0415  kernels load only when there is work
    from tcpipe.stages.label import label_segments  # noqa: PLC0415
    from tcpipe.stages.mask import mask_track  # noqa: PLC0415
    from tcpipe.stages.segment import segment_track  # noqa: PLC0415

    profile = load_profiles(sections).robots[streams.robot]
    step("fusing")
    track = fuse_run(streams, sections.fuse, run_id=run_id)
    step("cutting and labelling")
    masked = mask_track(
        track,
        sections.mask,
        max_velocity_mps=profile.max_velocity_mps,
        max_plausible_mps=profile.max_plausible_mps,
        chord_m=sections.segment.chord_m,
    )
    segments = segment_track(masked, sections.segment)
    labelled = label_segments(segments, masked, streams, sections.label, voltage_range_volt=profile.voltage_range_volt)
    return track, masked, labelled
