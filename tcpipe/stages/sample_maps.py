"""Segments to patches from several maps: a sample lies on exactly one, the first in the order given that has data for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import MapError
from tcpipe.recipe import SampleConfig
from tcpipe.stages.sample import Sampled, sample_segments
from tcpipe.tables.bits import Loss
from tcpipe.terrain.sampling import joined
from tcpipe.terrain.tiles import MapReader, TilePool, projection_to

_ELSEWHERE = (Loss.OUTSIDE_MAP, Loss.NODATA)
"""What is lost so on one map may be found on the next; what is not traversable, or nobody knows where, is lost on all."""


def sample_on_maps(
    segments: pa.Table,
    sources: Sequence[MapReader],
    config: SampleConfig,
    *,
    gnss_crs: str,
    pools: Sequence[TilePool | None] | None = None,
) -> Sampled:
    """Return the patches of all segments that lie on one of the maps, map by map.

    Parameters
    ----------
    segments : as `sample_segments`.
    sources : the maps; where they overlap, the earlier one is taken.
    gnss_crs : geographic CRS of the segments' longitudes and latitudes.
    pools : as `sample_patches`, one a map.

    Raises
    ------
    TableError, MapError : as `sample_segments`; the maps have not the same layers or classes, or lie too far from one another.
    """
    check_alike(sources)
    lost_by = np.full(segments.num_rows, Loss.OUTSIDE_MAP, np.uint32)
    waiting = np.arange(segments.num_rows)
    parts: list[Sampled] = []
    for number, (source, pool) in enumerate(zip(sources, pools or [None] * len(sources), strict=True)):
        here = segments if len(waiting) == segments.num_rows else segments.take(pa.array(waiting))
        found = sample_segments(here, source, config, gnss_crs=gnss_crs, pool=pool)
        known = found.lost_by != Loss.OUTSIDE_MAP  # a hole in one map outweighs lying outside the next
        lost_by[waiting[known]] = found.lost_by[known]
        place = np.full(found.kept.size, number, np.uint8)
        placed = _in_first_plane(found, source, sources[0])
        parts.append(replace(found, kept=waiting[found.kept], map_index=place, footprint_xy_m=placed))
        waiting = waiting[np.isin(found.lost_by, _ELSEWHERE)]
    return Sampled(
        kept=np.concatenate([part.kept for part in parts]),
        map_index=np.concatenate([part.map_index for part in parts]),
        patches=joined([part.patches for part in parts]),
        footprint_xy_m=np.concatenate([part.footprint_xy_m for part in parts]),
        footprint_lonlat_deg=np.concatenate([part.footprint_lonlat_deg for part in parts]),
        lost_by=lost_by,
        findings=tuple(dict.fromkeys(finding for part in parts for finding in part.findings)),
    )


def _in_first_plane(sampled: Sampled, source: MapReader, first: MapReader) -> NDArray[np.float64]:
    """Return footprints in the CRS of the first map [m], in which splits are drawn and distances measured."""
    if source.grid.crs == first.grid.crs:
        return sampled.footprint_xy_m
    placed = projection_to(first, "EPSG:4326").forward(sampled.footprint_lonlat_deg)
    if not np.isfinite(placed).all():
        raise MapError(f"map {source.name}: lies too far from map {first.name} for one dataset; build one from each")
    return placed


def check_alike(sources: Sequence[MapReader]) -> None:
    """Raise `MapError` if the maps have not the same layers and classes: their patches could not be learned from together."""
    first, problems = sources[0], []
    for other in sources[1:]:
        if set(other.layers) != set(first.layers):
            problems.append(
                f"map {other.name}: has {', '.join(other.layers)}, but map {first.name} has {', '.join(first.layers)}; "
                "maps of one dataset have the same layers"
            )
            continue
        for name, layer in first.layers.items():
            its = other.layers[name]
            if its.kind != layer.kind or its.unit != layer.unit:
                problems.append(
                    f"map {other.name}: {name} is {its.kind} [{its.unit}], but {layer.kind} [{layer.unit}] in map {first.name}"
                )
            elif layer.classes is not None and its.classes is not None and its.classes != layer.classes:
                different = "; ".join(its.classes.differences(layer.classes))
                of = "its classes" if name == "terrain" else f"its classes of {name}"
                problems.append(f"map {other.name}: {of} differ from those of map {first.name}: {different}")
    if problems:
        raise MapError(*problems)
