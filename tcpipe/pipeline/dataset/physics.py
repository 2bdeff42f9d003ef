"""The physics of each robot of a dataset, by class of terrain."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tcpipe.cost.held_out import physics_of
from tcpipe.cost.physics import ALL, Metres
from tcpipe.tables.columns import floats
from tcpipe.tables.facts import PhysicsFit

PHYSICS_COLUMNS = ("start_ns", "start_z_m", "end_z_m", "chord_m", "turn_rate_radps", "standing_power_watt")
"""Columns of samples.parquet that the fit reads, beside those of the labels."""


def physics_by_robot(samples: pa.Table) -> dict[str, PhysicsFit]:
    """Return the fit of each robot's samples, whatever their split; robots for which none can be are left out.

    Parameters
    ----------
    samples : with `PHYSICS_COLUMNS`, labels, robot and terrain.
    """
    found = {}
    for robot in sorted(pc.unique(samples.column("robot")).to_pylist()):
        mine = samples.filter(pc.equal(samples.column("robot"), robot)).sort_by("start_ns")
        fit = physics_of(metres_of(mine), standing_watt=standing_of(mine))
        if fit is not None:
            found[robot] = fit
    return found


def metres_of(samples: pa.Table) -> Metres:
    """Return samples, or segments, as physics takes them; the rise is that of the track, which every segment has."""
    names = (
        samples.column("terrain_name").fill_null(ALL).to_pylist()
        if "terrain_name" in samples.column_names
        else [ALL] * samples.num_rows
    )
    return Metres(
        power_watt=floats(samples, "power_watt"),
        velocity_mps=floats(samples, "velocity_mps"),
        rise=(floats(samples, "end_z_m") - floats(samples, "start_z_m")) / floats(samples, "chord_m"),
        turn_rate_radps=floats(samples, "turn_rate_radps"),
        terrain=np.array(names, np.str_),
    )


def standing_of(samples: pa.Table) -> float | None:
    """Return the power while standing [W], the mean over the samples of what their runs tell; None where none stood."""
    watt = floats(samples, "standing_power_watt")
    return float(np.nanmean(watt)) if np.isfinite(watt).any() else None
