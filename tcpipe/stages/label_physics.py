"""The physics of a run: its prediction beside each label, a flag where the label is far from it, and what each term takes."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from tcpipe.cost.held_out import physics_of
from tcpipe.cost.physics import ALL, Metres, fit_physics
from tcpipe.tables.arrays import numbers
from tcpipe.tables.bits import Quality
from tcpipe.tables.columns import floats
from tcpipe.tables.facts import PhysicsFacts
from tcpipe.tables.levels import LABELLED_SEGMENTS


def with_physics(table: pa.Table, standing_watt: float) -> tuple[pa.Table, PhysicsFacts]:
    """Return the labelled segments with the power that standing, drivetrain, rolling, grade and turning predict, and the fit.

    Parameters
    ----------
    table : labelled segments of a run.
    standing_watt : what the robot draws while it stands; NaN where that is not known.
    """
    metres = Metres(
        power_watt=floats(table, "power_watt"),
        velocity_mps=floats(table, "velocity_mps"),
        rise=(floats(table, "end_z_m") - floats(table, "start_z_m")) / floats(table, "chord_m"),
        turn_rate_radps=floats(table, "turn_rate_radps"),
        terrain=np.full(table.num_rows, ALL),
    )
    watt = standing_watt if np.isfinite(standing_watt) else None
    found = fit_physics(metres, standing_watt=watt)
    if found is None or not found.is_plausible():
        return table, PhysicsFacts(fitted=False, standing_watt=watt)
    predicted = np.where(np.isfinite(metres.power_watt), found.power_watt(metres), np.nan)
    odd = found.is_outlier(metres.power_watt - predicted)
    quality = numbers(table["quality"]) | np.where(odd, np.uint32(Quality.PHYSICS_OUTLIER), np.uint32(0))
    columns = {"physics_power_watt": predicted, "quality": quality.astype(np.uint32)}
    table = LABELLED_SEGMENTS.table(**{name: columns.get(name, table[name]) for name in table.column_names})
    resistance, rolling, drive = found.rolling_resistance(), found.of("rolling"), found.of("grade")
    return table, PhysicsFacts(
        fitted=True,
        standing_watt=watt,
        weight_over_efficiency_newton=None if drive is None else drive[0],
        rolling_newton=None if rolling is None else rolling[0],
        rolling_resistance=None if resistance is None else resistance[0],
        recovered_downhill=found.recovered,
        residual_watt=found.residual_watt,
        segments=found.segments,
        outliers=int(odd.sum()),
        fit=physics_of(metres, standing_watt=watt),
    )
