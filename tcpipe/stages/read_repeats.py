"""A power topic that repeats slower readings becomes the readings: all that follows sees the rate at which the device was read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.power.repeats import find_readings
from tcpipe.tables.arrays import texts
from tcpipe.tables.columns import floats, integers
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.tables.levels import STREAMS

_QUANTITIES = {"current": "current_amp", "voltage": "voltage_volt"}
_BETWEEN_EPOCHS_NS = 1_000_000_000_000
"""Their stamps may overlap; no reading lasts as long."""

Streams = dict[str, pa.Table]
Values = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class Repeats:
    """The rates [Hz] of the messages that carry a rail's current or voltage, and of the readings that they repeat."""

    rail: str
    quantity: str
    message_hz: float
    reading_hz: float


def without_repeats(streams: Streams) -> tuple[Streams, list[Repeats]]:
    """Return the streams with only the readings of power, and what was repeated; a table that repeats none stays as it is.

    A reading has the stamp of the first message that holds it.
    """
    power = streams.get("power")
    if power is None:
        return streams, []
    step_ns = np.where(np.diff(integers(power, "epoch")) != 0, _BETWEEN_EPOCHS_NS, np.diff(integers(power, "stamp_ns")))
    at_ns = np.concatenate(([0], np.cumsum(step_ns)))
    values = {quantity: floats(power, column) for quantity, column in _QUANTITIES.items()}
    kept = {quantity: np.isfinite(value) for quantity, value in values.items()}
    repeats: list[Repeats] = []
    for rail in pc.unique(power["rail"]).to_pylist():
        rows = np.flatnonzero(texts(power["rail"]) == rail)
        for quantity in _QUANTITIES:
            own = rows[np.isfinite(values[quantity][rows])]
            readings = _readings(at_ns, own, quantity, values)
            if readings is not None:
                kept[quantity][np.setdiff1d(own, readings)] = False
                repeats.append(Repeats(rail, quantity, _rate_hz(at_ns[own]), _rate_hz(at_ns[readings])))
    if not repeats:
        return streams, []
    columns = {name: power[name] for name in power.column_names}
    columns |= {of: np.where(kept[quantity], values[quantity], np.nan) for quantity, of in _QUANTITIES.items()}
    table = STREAMS["power"].table(**columns).filter(pa.array(kept["current"] | kept["voltage"]))
    return {**streams, "power": table}, repeats


def _readings(
    at_ns: NDArray[np.int64], own: NDArray[np.int64], quantity: str, values: Values
) -> NDArray[np.int64] | None:
    """Return the rows of a quantity's readings, by its own changes or, where these hardly show, by those of the other on the same rows."""
    found = find_readings(at_ns[own], values[quantity][own, None])
    if found is None and all(np.isfinite(value[own]).all() for value in values.values()):
        found = find_readings(at_ns[own], np.stack([value[own] for value in values.values()], axis=-1))
    return None if found is None else own[found]


def _rate_hz(at_ns: NDArray[np.int64]) -> float:
    step_ns = np.diff(at_ns)
    return 1e9 / float(np.mean(step_ns[step_ns < 1.5 * np.median(step_ns)]))


def find_repeats(repeats: Sequence[Repeats]) -> Iterator[Finding]:
    """Yield the finding that messages repeat readings, by the slowest of them; labels tell whether that is too slow."""
    if not repeats:
        return
    slowest = min(repeats, key=lambda of: of.reading_hz)
    names = {of: ", ".join(dict.fromkeys(getattr(each, of) for each in repeats)) for of in ("quantity", "rail")}
    message_hz, reading_hz = slowest.message_hz, slowest.reading_hz
    yield make_finding("power-readings-repeated", _POWER, names=names, message_hz=message_hz, reading_hz=reading_hz)


_POWER = Subject("role", "power")
