"""NMEA 0183: GGA, a GNSS position without a date and above the geoid; RMC and VTG, speed and course over ground.

Layout: ``$ttGGA,hhmmss.ss,ddmm.mm,N|S,dddmm.mm,E|W,quality,satellites,hdop,altitude,M,separation,M,age,station*checksum``;
the checksum is the exclusive or of all bytes between ``$`` and ``*``. Height above the ellipsoid = altitude + separation.
``$ttRMC,hhmmss.ss,A|V,ddmm.mm,N|S,dddmm.mm,E|W,speed [knots],course [deg],ddmmyy,variation,E|W,mode``;
``$ttVTG,course [deg true],T,course [deg magnetic],M,speed [knots],N,speed [km/h],K,mode``; the mode is missing before v2.3.
Source: NMEA 0183 v4.11, sentences GGA, RMC, VTG.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

NS_PER_DAY = 86_400_000_000_000

KNOT_MPS = 1852.0 / 3600.0
_VAST = 1e6
_STATUS_OF_MODE = {"": 0, "A": 0, "P": 0, "D": 1, "R": 2, "F": 2}
"""Mode to NavSatStatus; others (estimated, manual, simulated, none) are no measurement."""
_RMC_OR_VTG = re.compile(r"\$([A-Z]{2}(RMC|VTG),[^*$\r\n]*)(?:\*([0-9A-Fa-f]{2}))?")
_GGA = re.compile(r"\$([A-Z]{2}GGA,[^*$\r\n]*)(?:\*([0-9A-Fa-f]{2}))?")
_TIME = re.compile(r"(\d{2})(\d{2})(\d{2})(?:\.(\d{1,9}))?\Z")


@dataclass(frozen=True, slots=True)
class Gga:
    """Sentences that are GGA, shape (N,): where they stood in the input, and what they say; NaN and -1 where a field is empty.

    ``time_of_day_ns`` is UTC since midnight, ``alt_m`` above the geoid; ``broken`` marks a wrong checksum or an unreadable field.
    """

    row: NDArray[np.int64]
    time_of_day_ns: NDArray[np.int64]
    lat_deg: Floats
    lon_deg: Floats
    quality: NDArray[np.int64]
    hdop: Floats
    alt_m: Floats
    separation_m: Floats
    broken: NDArray[np.bool_]


def read_gga(sentences: Sequence[str]) -> Gga:
    """Return the GGA sentences among ``sentences``."""
    rows: list[int] = []
    values: list[tuple[float, ...] | None] = []
    times: list[int] = []
    for row, sentence in enumerate(sentences):
        found = _GGA.search(sentence)
        if found is None:
            continue
        fields = _parse_fields(found[1], found[2])
        rows.append(row)
        times.append(-1 if fields is None else fields[0])
        values.append(None if fields is None else fields[1])
    table = np.array([(np.nan,) * 6 if value is None else value for value in values], np.float64).reshape(-1, 6)
    return Gga(
        np.array(rows, np.int64),
        np.array(times, np.int64),
        table[:, 0],
        table[:, 1],
        np.where(np.isfinite(table[:, 2]), table[:, 2], -1).astype(np.int64),
        table[:, 3],
        table[:, 4],
        table[:, 5],
        np.array([value is None for value in values], bool),
    )


@dataclass(frozen=True, slots=True)
class OverGround:
    """Sentences that tell speed and course, shape (N,): where they stood, and what they say; NaN where a field is empty.

    ``time_of_day_ns`` is UTC since midnight, -1 where there is none (VTG); ``course_rad`` clockwise from true north; ``status`` is -1
    where the receiver does not stand for it; ``broken`` marks a wrong checksum or an unreadable field.
    """

    row: NDArray[np.int64]
    time_of_day_ns: NDArray[np.int64]
    speed_mps: Floats
    course_rad: Floats
    status: NDArray[np.int64]
    broken: NDArray[np.bool_]


def read_over_ground(sentences: Sequence[str]) -> OverGround:
    """Return the RMC sentences, which have a time, or where there are none the VTG sentences."""
    found = [(row, match) for row, text in enumerate(sentences) if (match := _RMC_OR_VTG.search(text)) is not None]
    kind = "RMC" if any(match[2] == "RMC" for _, match in found) else "VTG"
    told = [(row, _parse_ground_velocity(match[1], kind, match[3])) for row, match in found if match[2] == kind]
    none = (-1, np.nan, np.nan, -1)
    times, speed, course, status = (
        zip(*(none if fields is None else fields for _, fields in told), strict=True) if told else ((),) * 4
    )
    return OverGround(
        np.array([row for row, _ in told], np.int64),
        np.array(times, np.int64),
        np.array(speed, np.float64),
        np.radians(np.array(course, np.float64)),
        np.array(status, np.int64),
        np.array([fields is None for _, fields in told], bool),
    )


def _parse_ground_velocity(body: str, kind: str, checksum: str | None) -> tuple[int, float, float, int] | None:
    """Return time of day [ns], speed [m/s], course [deg] and status; None where the sentence is broken."""
    if checksum is not None and int(checksum, 16) != _compute_checksum(body):
        return None
    parts = [part.strip() for part in body.split(",")] + [""] * 3
    try:
        if kind == "RMC":
            status = _STATUS_OF_MODE.get(parts[12], -1) if parts[2] == "A" else -1
            return _time_of_day_ns(parts[1]), _number(parts[7]) * KNOT_MPS, _number(parts[8]), status
        speed = _number(parts[5]) * KNOT_MPS if parts[5] else _number(parts[7]) / 3.6
        return -1, speed, _number(parts[1]), _STATUS_OF_MODE.get(parts[9], -1)
    except (ValueError, IndexError):
        return None


def _number(text: str) -> float:
    """Return a speed or a course, NaN for an empty field; `ValueError` for what neither can be."""
    value = float(text) if text else np.nan
    if abs(value) > _VAST:
        raise ValueError(text)
    return value


def _parse_fields(body: str, checksum: str | None) -> tuple[int, tuple[float, ...]] | None:
    """Return time of day [ns] and lat, lon [deg], quality, hdop, altitude, separation [m]; None where the sentence is broken."""
    if checksum is not None and int(checksum, 16) != _compute_checksum(body):
        return None
    parts = body.split(",")
    if len(parts) < 12:
        return None
    try:
        latitude = _parse_degrees(parts[2], 2) * {"N": 1.0, "S": -1.0, "": np.nan}[parts[3]]
        longitude = _parse_degrees(parts[4], 3) * {"E": 1.0, "W": -1.0, "": np.nan}[parts[5]]
        numbers = [float(text) if text else np.nan for text in (parts[6], parts[8], parts[9], parts[11])]
    except (ValueError, KeyError):
        return None
    return _time_of_day_ns(parts[1]), (latitude, longitude, *numbers)


def _compute_checksum(body: str) -> int:
    total = 0
    for byte in body.encode("utf-8", "replace"):
        total ^= byte
    return total


def _parse_degrees(text: str, degree_digits: int) -> float:
    """Return degrees of ``ddmm.mmmm``; NaN for an empty field."""
    return float(text[:degree_digits]) + float(text[degree_digits:]) / 60.0 if text else np.nan


def _time_of_day_ns(text: str) -> int:
    """Return UTC since midnight [ns]; -1 where the field is empty or no time."""
    found = _TIME.match(text)
    if found is None:
        return -1
    hours, minutes, seconds = (int(part) for part in found.groups()[:3])
    if hours > 23 or minutes > 59 or seconds > 60:
        return -1
    nanoseconds = int((found[4] or "0").ljust(9, "0"))
    return ((hours * 60 + minutes) * 60 + seconds) * 1_000_000_000 + nanoseconds


def add_date(time_of_day_ns: NDArray[np.int64], log_time_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return UTC stamps: each time of day on the day that keeps it nearest to the log's clock, midnight included.

    Parameters
    ----------
    time_of_day_ns : [ns], shape (N,), since midnight UTC; negative where unknown.
    log_time_ns : [ns], shape (N,).

    Returns
    -------
    [ns], shape (N,), 0 where unknown. A constant offset between both clocks, even one near half a day, keeps one sign throughout: the
    first row decides, and later rows stay within half a day of its offset.
    """
    known = time_of_day_ns >= 0
    stamps = np.zeros(len(time_of_day_ns), np.int64)
    if not known.any():
        return stamps
    behind = time_of_day_ns[known] - log_time_ns[known] % NS_PER_DAY
    first = _wrap_to_zero(behind[:1])[0]
    stamps[known] = log_time_ns[known] + first + _wrap_to_zero(behind - first)
    return stamps


def _wrap_to_zero(offset_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    wrapped: NDArray[np.int64] = (offset_ns + NS_PER_DAY // 2) % NS_PER_DAY - NS_PER_DAY // 2
    return wrapped
