"""Segments to patches from several maps: a sample lies on exactly one, the first in the order given that has data for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import MapError
from tcpipe.recipe import SampleConfig
from tcpipe.stages.sample import Sampled, ledger_by_loss, sample_segments
from tcpipe.tables.bits import Loss
from tcpipe.tables.columns import floats
from tcpipe.terrain.tiles import MapReader, TilePool

_ELSEWHERE = (Loss.OUTSIDE_MAP, Loss.NODATA)
"""What is lost so on one map may be found on the next; what is not traversable, or nobody knows where, is lost on all."""


@dataclass(frozen=True, slots=True)
class SampledOnMaps:
    """L6 before the split, by map, in the order of the maps.

    ``rows`` are the segments that each map has patches of, rising; ``sampled`` are those patches, in that order. ``lost_by`` is each
    segment's `Loss`, 0 if kept, (M,); ``ledger_m`` metres driven by loss; ``warnings`` those of all maps.
    """

    rows: tuple[NDArray[np.int64], ...]
    sampled: tuple[Sampled, ...]
    lost_by: NDArray[np.uint32]
    ledger_m: Mapping[str, float]
    warnings: tuple[str, ...]


def sample_on_maps(
    segments: pa.Table,
    sources: Sequence[MapReader],
    config: SampleConfig,
    *,
    gnss_crs: str,
    pools: Sequence[TilePool | None] | None = None,
) -> SampledOnMaps:
    """Return the patches of all segments that lie on one of the maps.

    Parameters
    ----------
    segments : as `sample_segments`.
    sources : the maps; where they overlap, the earlier one is taken.
    gnss_crs : geographic CRS of the segments' longitudes and latitudes.
    pools : as `sample_patches`, one a map.

    Raises
    ------
    TableError, MapError : as `sample_segments`; the maps have not the same layers or classes.
    """
    check_alike(sources)
    lost_by = np.full(segments.num_rows, Loss.OUTSIDE_MAP, np.uint32)
    waiting = np.arange(segments.num_rows)
    rows: list[NDArray[np.int64]] = []
    sampled: list[Sampled] = []
    for source, pool in zip(sources, pools or [None] * len(sources), strict=True):
        here = segments if len(waiting) == segments.num_rows else segments.take(pa.array(waiting))
        found = sample_segments(here, source, config, gnss_crs=gnss_crs, pool=pool)
        known = found.lost_by != Loss.OUTSIDE_MAP  # a hole in one map outweighs lying outside the next
        lost_by[waiting[known]] = found.lost_by[known]
        rows.append(waiting[found.kept])
        sampled.append(found)
        waiting = waiting[np.isin(found.lost_by, _ELSEWHERE)]
    warnings = dict.fromkeys(warning for found in sampled for warning in found.warnings)
    ledger_m = ledger_by_loss(floats(segments, "arc_length_m"), lost_by)
    return SampledOnMaps(tuple(rows), tuple(sampled), lost_by, ledger_m, tuple(warnings))


def check_alike(sources: Sequence[MapReader]) -> None:
    """Raise `MapError` if the maps have not the same layers and classes: their patches could not be learned from together."""
    first, problems = sources[0], []
    for other in sources[1:]:
        if set(other.layers) != set(first.layers):
            problems.append(
                f"map {other.name}: has {', '.join(other.layers)}, but map {first.name} has {', '.join(first.layers)}; "
                "maps of one dataset have the same layers"
            )
        elif "terrain" in first.layers and other.classes != first.classes:
            different = "; ".join(other.classes.differences(first.classes))
            problems.append(f"map {other.name}: its classes differ from those of map {first.name}: {different}")
    if problems:
        raise MapError(*problems)
