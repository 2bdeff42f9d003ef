"""The physics baseline of a run: its prediction beside each label, and a flag where the label is far from it."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from tcpipe.cost.physics import fit_physics
from tcpipe.tables.arrays import numbers
from tcpipe.tables.bits import Quality
from tcpipe.tables.columns import floats
from tcpipe.tables.findings import PhysicsFacts
from tcpipe.tables.levels import LABELLED_SEGMENTS


def with_physics(table: pa.Table, standing_watt: float) -> tuple[pa.Table, PhysicsFacts]:
    """Return the labelled segments with the power that rolling resistance and grade predict, and the fit.

    Parameters
    ----------
    table : labelled segments of a run.
    standing_watt : [W], what the robot draws while it stands; NaN where that is not known.
    """
    speed = floats(table, "velocity_mps")
    rise = (floats(table, "end_z_m") - floats(table, "start_z_m")) / floats(table, "chord_m")
    power = floats(table, "power_watt")
    standing = standing_watt if np.isfinite(standing_watt) else None
    found = fit_physics(power_watt=power, velocity_mps=speed, rise=rise, standing_watt=standing or 0.0)
    if found is None:
        return table, PhysicsFacts(fitted=False, standing_watt=standing)
    predicted = np.where(np.isfinite(power), found.power_watt(velocity_mps=speed, rise=rise), np.nan)
    odd = found.is_outlier(power - predicted)
    quality = numbers(table["quality"]) | np.where(odd, np.uint32(Quality.PHYSICS_OUTLIER), np.uint32(0))
    columns = {"physics_power_watt": predicted, "quality": quality.astype(np.uint32)}
    table = LABELLED_SEGMENTS.table(**{name: columns.get(name, table[name]) for name in table.column_names})
    return table, PhysicsFacts(
        fitted=True,
        standing_watt=standing,
        weight_over_efficiency_newton=found.drive_newton or None,
        rolling_newton=found.rolling_newton,
        rolling_resistance=found.rolling_resistance,
        recovered_downhill=found.recovered,
        residual_watt=found.residual_watt,
        segments=found.segments,
        outliers=int(odd.sum()),
    )
