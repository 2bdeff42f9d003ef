"""Do map and tracks lie on each other? Heights under every run's track against the map's, run by run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tcpipe.formats.dataset_card import MapRegistration
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.recipe import Recipe
from tcpipe.store import RunDirectory
from tcpipe.tables.columns import floats
from tcpipe.terrain.projection import Projection, area_of, parse_crs
from tcpipe.terrain.registration import Registration, register_track

_WARN_M = 0.5
"""A shift longer than this is a warning [m]: half a patch."""

_COLUMNS = ["lon_deg", "lat_deg", "alt_m", "x_std_m", "y_std_m"]


def register_runs(
    runs: Sequence[RunDirectory], source: MapFile, recipe: Recipe
) -> tuple[tuple[MapRegistration, ...], list[str]]:
    """Return how the map lies against each run that crosses enough of it, and a line for each that is off.

    Parameters
    ----------
    runs
        The runs whose tracks are compared: rows that are certain enough to be sampled.
    source
        The map.
    recipe
        ``read.gnss_crs`` and ``sample.max_position_std_m`` rule.

    """
    crs = parse_crs(source.grid.crs, where=f"map {source.name}")
    gnss_crs = parse_crs(recipe.read.gnss_crs, where="gnss_crs")
    projection = Projection(gnss_crs, crs, area_of(crs, source.grid.bounds_m))
    found, warnings = list[MapRegistration](), list[str]()
    for run in runs:
        registration = _register(run, source, projection, max_std_m=recipe.sample.max_position_std_m)
        if registration is None:
            continue
        found.append(_told(run.run_id, registration))
        if registration.significant and registration.shift_m > _WARN_M:
            warnings.append(f"run {run.run_id}: {_said(registration, source.name)}")
    return tuple(found), warnings


def _register(run: RunDirectory, source: MapFile, projection: Projection, *, max_std_m: float) -> Registration | None:
    track = run.table("track", _COLUMNS)
    lon, lat, height_m, x_std_m, y_std_m = (floats(track, name) for name in _COLUMNS)
    sure: NDArray[np.bool_] = np.hypot(x_std_m, y_std_m) <= max_std_m
    lonlat = np.stack([lon, lat], axis=1)[sure]
    return register_track(source, projection.forward(lonlat), height_m[sure])


def _told(run_id: str, found: Registration) -> MapRegistration:
    """Return what the card says: no shift where the ground cannot tell one."""
    told = bool(np.isfinite(found.shift_std_m))
    return MapRegistration(
        run_id=run_id,
        points=found.points,
        shift_xy_m=found.shift_xy_m if told else None,
        shift_std_m=found.shift_std_m if told else None,
        significant=found.significant,
        height_offset_m=found.height_offset_m,
        misfit_m=found.misfit_m,
        shifted_misfit_m=found.shifted_misfit_m if told else None,
    )


def _said(registration: Registration, name: str) -> str:
    east, north = registration.shift_xy_m
    parts = [f"{abs(east):.1f} m {'east' if east > 0 else 'west'}"] if abs(east) >= 0.05 else []
    parts += [f"{abs(north):.1f} m {'north' if north > 0 else 'south'}"] if abs(north) >= 0.05 else []
    most = " or more" if registration.at_reach else ""
    return (
        f"its ground lies {registration.shift_m:.1f} m{most} off on map {name} ({' and '.join(parts)}, ± {registration.shift_std_m:.2f} m; "
        f"shifted so, heights fit to {registration.shifted_misfit_m:.2f} m instead of {registration.misfit_m:.2f} m): check the CRS and "
        "pixel convention of the map's rasters, and read.gnss_crs"
    )
