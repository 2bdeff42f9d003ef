"""Do map and tracks lie on each other? Heights under every run's track against the map's, run by run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import MapError
from tcpipe.formats.dataset_card import MapRegistration
from tcpipe.formats.json_files import convert_record
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.recipe import Recipe
from tcpipe.tables.catalogue import read_threshold
from tcpipe.tables.columns import to_floats
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.terrain.projection import Projection
from tcpipe.terrain.registration import Registration, register_track
from tcpipe.terrain.tiles import find_map_projection

_COLUMNS = ["lon_deg", "lat_deg", "alt_m", "x_std_m", "y_std_m", "z_std_m"]


def register_runs(
    runs: Sequence[RunDirectory], source: MapFile, recipe: Recipe
) -> tuple[tuple[MapRegistration, ...], list[Finding]]:
    """Return how the map lies against each run that crosses enough of it, and findings on those that are off.

    Parameters
    ----------
    runs : the runs whose tracks are compared: rows that are certain enough to be sampled.
    source : the map.
    recipe : ``read.gnss_crs`` and ``sample.max_position_std_m`` rule.

    Raises
    ------
    MapError : the map's heights are in feet.
    """
    projection = find_map_projection(source, recipe.read.gnss_crs)
    registrations, findings = list[MapRegistration](), list[Finding]()
    for run in runs:
        registration, expected_m = _register(run, source, projection, max_std_m=recipe.sample.max_position_std_m)
        if registration is None:
            continue
        if registration.scale.is_feet():
            raise MapError(_describe_feet(registration, run.run_id, source.name))
        registrations.append(_describe(run.run_id, registration, expected_m))
        findings += _find_shift(registration, run.run_id, source.name)
        findings += _find_other_heights(registration, expected_m, run.run_id, source.name)
    return tuple(registrations), findings


def _register(
    run: RunDirectory, source: MapFile, projection: Projection, *, max_std_m: float
) -> tuple[Registration | None, float]:
    """Return how the map lies against a run, and the misfit that is to be expected [m]."""
    track = run.table("track", _COLUMNS)
    lon, lat, height_m, x_std_m, y_std_m, z_std_m = (to_floats(track, name) for name in _COLUMNS)
    sure: NDArray[np.bool_] = np.hypot(x_std_m, y_std_m) <= max_std_m
    lonlat = np.stack([lon, lat], axis=1)[sure]
    map_error_m = read_threshold("map-heights-differ", "map_error_m")
    expected_m = float(np.hypot(np.sqrt(np.mean(z_std_m[sure] ** 2)), map_error_m)) if sure.any() else map_error_m
    return register_track(source, projection.forward(lonlat), height_m[sure]), expected_m


def _describe_feet(found: Registration, run_id: str, name: str) -> str:
    return (
        f"map {name}: where run {run_id} rises by 1 m, its heights rise by {1 / found.scale.value:.2f}: they are in feet and were read "
        f"as metres; say so in the file (gdal_edit -units ft FILE) and add the map again (tcpipe add-map {name} --height FILE ... --force)"
    )


def _find_shift(found: Registration, run_id: str, name: str) -> tuple[Finding, ...]:
    """Return the finding, if any, that the map is shifted against the track."""
    if not found.significant or found.shift_m <= read_threshold("map-shifted", "min_shift_m"):
        return ()
    east_m, north_m = found.shift_xy_m
    finding = make_finding(
        "map-shifted",
        Subject("run", run_id),
        severity="error" if found.shift_m >= read_threshold("map-shifted", "error_shift_m") else None,
        names={"map": name},
        shift_m=found.shift_m,
        std_m=found.shift_std_m,
        east_m=east_m,
        north_m=north_m,
        misfit_m=found.misfit_m,
        shifted_misfit_m=found.shifted_misfit_m,
    )
    return (finding,)


def _find_other_heights(found: Registration, expected_m: float, run_id: str, name: str) -> tuple[Finding, ...]:
    """Return the finding, if any, that heights of map and track differ by more than they may."""
    subject, names = Subject("run", run_id), {"map": name}
    if found.scale.is_off():
        return (make_finding("map-height-scale", subject, names=names, map_rise_m=1 / found.scale.value),)
    misfit_m = found.shifted_misfit_m if found.significant else found.misfit_m
    if misfit_m <= read_threshold("map-heights-differ", "max_misfit_ratio") * expected_m:
        return ()
    return (make_finding("map-heights-differ", subject, names=names, misfit_m=misfit_m, expected_m=expected_m),)


def _describe(run_id: str, found: Registration, expected_m: float) -> MapRegistration:
    """Return what the card says: no shift where the ground cannot tell one."""
    untold = {} if np.isfinite(found.shift_std_m) else dict.fromkeys(("shift_xy_m", "shift_std_m", "shifted_misfit_m"))
    return convert_record(
        found,
        MapRegistration,
        **untold,
        run_id=run_id,
        height_scale=found.scale.value if found.scale.is_known else None,
        height_scale_std=found.scale.std if found.scale.is_known else None,
        expected_misfit_m=expected_m,
    )
