"""What the robot of a run draws while it stands."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa

from tcpipe.motion.pieces import piece_of_rows, spans_where
from tcpipe.power.noise import resolution
from tcpipe.power.rails import Rail
from tcpipe.power.standing import StandingPower, standing_power
from tcpipe.tables.arrays import numbers
from tcpipe.tables.bits import DropReason
from tcpipe.tables.columns import floats, integers

_EDGE_S = 0.3
"""After a stop and before a start motors draw."""


def standing_power_of(rows: pa.Table, rails: Mapping[int, list[Rail]], *, rate_hz: float) -> StandingPower:
    """Return the power while standing, of all rows of a gated track, and how sure it is.

    Parameters
    ----------
    rails : by clock epoch, for the step in which they tell currents.
    """
    piece = piece_of_rows(integers(rows, "stamp_ns"), integers(rows, "epoch"), period_ns=1e9 / rate_hz)
    standing = (numbers(rows["dropped_by"]) & np.uint32(DropReason.STANDING)) != 0
    halt, edge = np.full(rows.num_rows, -1), round(_EDGE_S * rate_hz)
    for number, (first, last) in enumerate(spans_where(standing, piece).tolist()):
        halt[first + edge : max(last + 1 - edge, first + edge)] = number
    power_watt = floats(rows, "power_watt")
    return standing_power(power_watt[standing], halt[standing], window_rows=round(rate_hz), step_watt=_step_watt(rails))


def _step_watt(rails: Mapping[int, list[Rail]]) -> float:
    """Return the step in which the power of all rails together is told [W]; 0 where none shows."""
    steps = [
        float(np.median(each.voltage_volt)) * resolution(each.current)
        for each in next((of for of in rails.values() if of), [])
        if len(each.voltage_volt)
    ]
    return float(np.linalg.norm(steps)) if steps else 0.0
