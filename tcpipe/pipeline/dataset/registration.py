"""Do map and tracks lie on each other? Heights under every run's track against the map's, run by run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import MapError
from tcpipe.formats.dataset_card import MapRegistration
from tcpipe.formats.json_files import recast
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.recipe import Recipe
from tcpipe.recipe.suggestions import recipe_key
from tcpipe.tables.columns import floats
from tcpipe.terrain.projection import Projection
from tcpipe.terrain.registration import Registration, register_track
from tcpipe.terrain.tiles import projection_to

_WARN_M = 0.5
"""A shift longer than this is a warning [m]: half a patch."""

_MAP_ERROR_M = 0.1
"""What a good elevation model, and a robot that nods on its suspension, are off by [m]."""
_BEYOND = 3.0
"""A misfit is a warning from so many times what is expected."""

_COLUMNS = ["lon_deg", "lat_deg", "alt_m", "x_std_m", "y_std_m", "z_std_m"]


def register_runs(
    runs: Sequence[RunDirectory], source: MapFile, recipe: Recipe
) -> tuple[tuple[MapRegistration, ...], list[str]]:
    """Return how the map lies against each run that crosses enough of it, and a line for each that is off.

    Parameters
    ----------
    runs : the runs whose tracks are compared: rows that are certain enough to be sampled.
    source : the map.
    recipe : ``read.gnss_crs`` and ``sample.max_position_std_m`` rule.

    Raises
    ------
    MapError : the map's heights are in feet.
    """
    projection = projection_to(source, recipe.read.gnss_crs)
    found, warnings = list[MapRegistration](), list[str]()
    for run in runs:
        registration, expected_m = _register(run, source, projection, max_std_m=recipe.sample.max_position_std_m)
        if registration is None:
            continue
        if registration.scale.is_feet():
            raise MapError(_in_feet(registration, run.run_id, source.name))
        found.append(_told(run.run_id, registration, expected_m))
        if registration.significant and registration.shift_m > _WARN_M:
            warnings.append(f"run {run.run_id}: {_said(registration, source.name)}")
        if (unlike := _unlike(registration, expected_m, source.name)) is not None:
            warnings.append(f"run {run.run_id}: {unlike}")
    return tuple(found), warnings


def _register(
    run: RunDirectory, source: MapFile, projection: Projection, *, max_std_m: float
) -> tuple[Registration | None, float]:
    """Return how the map lies against a run, and the misfit that is to be expected [m]."""
    track = run.table("track", _COLUMNS)
    lon, lat, height_m, x_std_m, y_std_m, z_std_m = (floats(track, name) for name in _COLUMNS)
    sure: NDArray[np.bool_] = np.hypot(x_std_m, y_std_m) <= max_std_m
    lonlat = np.stack([lon, lat], axis=1)[sure]
    expected_m = float(np.hypot(np.sqrt(np.mean(z_std_m[sure] ** 2)), _MAP_ERROR_M)) if sure.any() else _MAP_ERROR_M
    return register_track(source, projection.forward(lonlat), height_m[sure]), expected_m


def _in_feet(found: Registration, run_id: str, name: str) -> str:
    return (
        f"map {name}: where run {run_id} rises by 1 m, its heights rise by {1 / found.scale.value:.2f}: they are in feet and were read "
        f"as metres; say so in the file (gdal_edit -units ft FILE) and add the map again (tcpipe add-map {name} --height FILE ... --force)"
    )


def _unlike(found: Registration, expected_m: float, name: str) -> str | None:
    """Return a line where heights of map and track are more unlike than they may be."""
    if found.scale.is_off():
        return (
            f"where it rises by 1 m, the heights of map {name} rise by {1 / found.scale.value:.2f} m: check unit, scale and vertical "
            "datum of the map's heights"
        )
    misfit_m = found.shifted_misfit_m if found.significant else found.misfit_m
    if misfit_m <= _BEYOND * expected_m:
        return None
    return (
        f"its heights and those of map {name} are {misfit_m:.2f} m apart (standard deviation, the constant taken out), wanted "
        f"{expected_m:.2f} m: slopes and height patches may be of other ground (a surface model with vegetation, another year or place?)"
    )


def _told(run_id: str, found: Registration, expected_m: float) -> MapRegistration:
    """Return what the card says: no shift where the ground cannot tell one."""
    untold = {} if np.isfinite(found.shift_std_m) else dict.fromkeys(("shift_xy_m", "shift_std_m", "shifted_misfit_m"))
    return recast(
        found,
        MapRegistration,
        **untold,
        run_id=run_id,
        height_scale=found.scale.value if found.scale.is_known else None,
        height_scale_std=found.scale.std if found.scale.is_known else None,
        expected_misfit_m=expected_m,
    )


def _said(registration: Registration, name: str) -> str:
    east, north = registration.shift_xy_m
    parts = [f"{abs(east):.1f} m {'east' if east > 0 else 'west'}"] if abs(east) >= 0.05 else []
    parts += [f"{abs(north):.1f} m {'north' if north > 0 else 'south'}"] if abs(north) >= 0.05 else []
    most = " or more" if registration.at_reach else ""
    return (
        f"its ground lies {registration.shift_m:.1f} m{most} off on map {name} ({' and '.join(parts)}, ± {registration.shift_std_m:.2f} m; "
        f"shifted so, heights fit to {registration.shifted_misfit_m:.2f} m instead of {registration.misfit_m:.2f} m): check the CRS and "
        f"pixel convention of the map's rasters, and the {recipe_key('read.gnss_crs')}"
    )
