"""A pose made elsewhere (SLAM, post-processing): placed on the earth where the recipe says in which CRS it is; it stands in for GNSS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pyarrow as pa

from tcpipe.errors import MapError, RecipeError
from tcpipe.geometry.datum import geodetic_from_enu
from tcpipe.logs.roles import RoleAssignment
from tcpipe.recipe import ReadConfig
from tcpipe.tables.columns import to_floats
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.tables.levels import STREAMS, Streams

POSE, GNSS = "pose", "gnss"
_ROLE = Subject("role", POSE)
_ANYWHERE_DEG_M = (0.0, 45.0, 0.0)
"""Where a frame that is nowhere on the earth is taken to lie while its positions are fused: east, north and up stay what they are."""


def find_recipe_role(role: str, streams: Streams) -> str:
    """Return the role by which the recipe knows what is fused as ``role``: a pose that stands in for GNSS is a pose there."""
    roles = streams.report.facts.roles
    return POSE if role == GNSS and POSE in roles and GNSS not in roles else role


def place_pose(
    streams: Mapping[str, pa.Table], assignment: RoleAssignment, config: ReadConfig
) -> tuple[dict[str, pa.Table], str, tuple[Finding, ...]]:
    """Return the streams with the pose in longitude and latitude, the CRS of these, and findings.

    Raises
    ------
    RecipeError : `read.pose_crs` is no projected CRS.
    """
    if POSE not in streams:
        return dict(streams), config.gnss_crs, ()
    found = make_finding("pose-used-as-gnss", _ROLE, names={"topic": assignment.roles[POSE].topics[0]})
    if config.pose_crs is None:
        return dict(streams), config.gnss_crs, (found, make_finding("pose-not-georeferenced", _ROLE))
    from pyproj import Transformer  # noqa: PLC0415  only where a pose is placed

    from tcpipe.terrain.projection import format_crs, parse_crs  # noqa: PLC0415

    try:
        crs = parse_crs(config.pose_crs, where="recipe read.pose_crs")
    except MapError as error:
        raise RecipeError(*error.problems) from None
    if not crs.is_projected or crs.geodetic_crs is None:
        raise RecipeError(f"recipe read.pose_crs: {crs.name} is not projected (metres); positions in degrees play gnss")
    pose = streams[POSE]
    lon, lat = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True).transform(
        to_floats(pose, "x_m"), to_floats(pose, "y_m")
    )
    columns = {name: pose[name] for name in pose.column_names} | {"lon_deg": lon, "lat_deg": lat, "alt_m": pose["z_m"]}
    return {**streams, POSE: STREAMS[POSE].table(**columns)}, format_crs(crs.geodetic_crs.to_2d()), (found,)


def convert_pose_to_fixes(streams: Streams) -> tuple[Streams, bool]:
    """Return the streams with the pose as the fixes of a GNSS, and whether these lie in a frame that is nowhere on the earth."""
    pose = streams.tables.get(POSE)
    if pose is None:
        return streams, False
    lon, lat, alt = (to_floats(pose, name) for name in ("lon_deg", "lat_deg", "alt_m"))
    local = bool(np.isnan(lon).any())
    if local:
        place = np.column_stack([to_floats(pose, f"{axis}_m") for axis in "xyz"])
        lon, lat, alt = geodetic_from_enu(place, datum_deg_m=_ANYWHERE_DEG_M)
    kept = {name: pose[name] for name in pose.column_names if name in STREAMS[GNSS].names()}
    fixes = STREAMS[GNSS].table(
        **kept | {"lon_deg": lon, "lat_deg": lat, "alt_m": alt, "fix_status": np.zeros(pose.num_rows, np.int8)}
    )
    tables = {role: table for role, table in streams.tables.items() if role != POSE} | {GNSS: fixes}
    sensors = {role: sensor for role, sensor in streams.sensors.items() if role != POSE} | {GNSS: streams.sensors[POSE]}
    return replace(streams, tables=tables, sensors=sensors), local
