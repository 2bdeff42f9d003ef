"""NMEA 0183: GGA, a GNSS position without a date and above the geoid; RMC and VTG, speed and course over ground.

Layout:
``$ttGGA,hhmmss.ss,ddmm.mm,N|S,dddmm.mm,E|W,quality,satellites,hdop,altitude,M,separation,M,age,station*checksum``; the
checksum is the exclusive or of all bytes between ``$`` and ``*``. Height above the ellipsoid = altitude + separation.
``$ttRMC,hhmmss.ss,A|V,ddmm.mm,N|S,dddmm.mm,E|W,speed [knots],course [deg],ddmmyy,variation,E|W,mode``; ``$ttVTG,course
[deg true],T,course [deg magnetic],M,speed [knots],N,speed [km/h],K,mode``; the mode is missing before v2.3. Source:
NMEA 0183 v4.11, sentences GGA, RMC, VTG.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import xor

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask

NS_PER_DAY = 86_400_000_000_000

KNOT_MPS = 1852.0 / 3600.0
_VAST = 1e6
_STATUS_OF_MODE = {"": 0, "A": 0, "P": 0, "D": 1, "R": 2, "F": 2}
"""Mode to NavSatStatus; others (estimated, manual, simulated, none) are no measurement."""
_SENTENCES = {
    kind: re.compile(rf"\$([A-Z]{{2}}{kind},[^*$\r\n]*)(?:\*([0-9A-Fa-f]{{2}}))?") for kind in ("GGA", "RMC", "VTG")
}
_TIME = re.compile(r"(\d{2})(\d{2})(\d{2})(?:\.(\d{1,9}))?\Z")


@dataclass(frozen=True, slots=True)
class Gga:
    """GGA sentences, shape (N,): their rows in the input, and their values; NaN and -1 for empty fields.

    ``time_of_day_ns`` is UTC since midnight, ``alt_m`` above the geoid; ``broken`` marks a wrong checksum or an
    unreadable field.
    """

    row: Ints
    broken: Mask
    time_of_day_ns: Ints
    lat_deg: Floats
    lon_deg: Floats
    quality: Ints
    hdop: Floats
    alt_m: Floats
    separation_m: Floats


@dataclass(frozen=True, slots=True)
class OverGround:
    """Sentences with speed and course, as `Gga`.

    ``time_of_day_ns`` is -1 without a time (VTG); ``course_rad`` clockwise from true north; ``status`` is -1 if the
    receiver marks the sentence as not valid.
    """

    row: Ints
    broken: Mask
    time_of_day_ns: Ints
    speed_mps: Floats
    course_rad: Floats
    status: Ints


def read_gga(sentences: Sequence[str]) -> Gga:
    """Return the GGA sentences among ``sentences``."""
    row, broken, (time_ns, lat, lon, quality, *others) = _read(sentences, "GGA", _parse_gga, 7)
    return Gga(row, broken, _to_integers(time_ns), lat, lon, _to_integers(quality), *others)


def read_over_ground(sentences: Sequence[str]) -> OverGround:
    """Return the RMC sentences, which have a time; without any, the VTG sentences."""
    has_rmc = any(_SENTENCES["RMC"].search(text) for text in sentences)
    kind, parse = ("RMC", _parse_rmc) if has_rmc else ("VTG", _parse_vtg)
    row, broken, (time_ns, speed, course, status) = _read(sentences, kind, parse, 4)
    return OverGround(row, broken, _to_integers(time_ns), speed, np.radians(course), _to_integers(status))


def _read(
    sentences: Sequence[str], kind: str, parse: Callable[[list[str]], tuple[float, ...]], width: int
) -> tuple[Ints, Mask, Floats]:
    """Return the places of sentences of a kind, which are damaged, and ``parse`` of their fields, shape (width, N)."""
    found = [(row, match) for row, text in enumerate(sentences) if (match := _SENTENCES[kind].search(text)) is not None]
    values = np.full((len(found), width), np.nan)
    broken = np.zeros(len(found), bool)
    for at, (_, match) in enumerate(found):
        try:
            values[at] = parse(_split_fields(*match.groups()))
        except (ValueError, KeyError, IndexError):
            broken[at] = True
    return np.array([row for row, _ in found], np.int64), broken, values.T


def _split_fields(body: str, checksum: str | None) -> list[str]:
    if checksum is not None and int(checksum, 16) != reduce(xor, body.encode("utf-8", "replace"), 0):
        raise ValueError(checksum)
    return body.split(",")


def _to_integers(values: Floats) -> Ints:
    """Return values as integers, -1 for missing ones."""
    return np.where(np.isfinite(values), values, -1).astype(np.int64)


def _parse_gga(parts: list[str]) -> tuple[float, ...]:
    """Return time of day [ns] and lat, lon [deg], quality, hdop, altitude, separation [m]."""
    latitude = _parse_degrees(parts[2], 2) * {"N": 1.0, "S": -1.0, "": np.nan}[parts[3]]
    longitude = _parse_degrees(parts[4], 3) * {"E": 1.0, "W": -1.0, "": np.nan}[parts[5]]
    numbers = [float(text) if text else np.nan for text in (parts[6], parts[8], parts[9], parts[11])]
    return _parse_time_of_day_ns(parts[1]), latitude, longitude, *numbers


def _parse_rmc(parts: list[str]) -> tuple[float, ...]:
    """Return time of day [ns], speed [m/s], course [deg] and status."""
    parts = _strip_and_pad(parts)
    status = _STATUS_OF_MODE.get(parts[12], -1) if parts[2] == "A" else -1
    return _parse_time_of_day_ns(parts[1]), _parse_number(parts[7]) * KNOT_MPS, _parse_number(parts[8]), status


def _parse_vtg(parts: list[str]) -> tuple[float, ...]:
    """Return the same as `_parse_rmc`, without time."""
    parts = _strip_and_pad(parts)
    speed = _parse_number(parts[5]) * KNOT_MPS if parts[5] else _parse_number(parts[7]) / 3.6
    return -1, speed, _parse_number(parts[1]), _STATUS_OF_MODE.get(parts[9], -1)


def _strip_and_pad(parts: list[str]) -> list[str]:
    """Return fields without blanks, and empty ones for the last three, which older sentences lack."""
    return [*map(str.strip, parts), *[""] * 3]


def _parse_number(text: str) -> float:
    """Return a speed or a course, NaN for an empty field; `ValueError` for impossible values."""
    value = float(text) if text else np.nan
    if abs(value) > _VAST:
        raise ValueError(text)
    return value


def _parse_degrees(text: str, degree_digits: int) -> float:
    """Return degrees of ``ddmm.mmmm``; NaN for an empty field."""
    return float(text[:degree_digits]) + float(text[degree_digits:]) / 60.0 if text else np.nan


def _parse_time_of_day_ns(text: str) -> int:
    """Return UTC since midnight [ns]; -1 where the field is empty or no time."""
    found = _TIME.match(text)
    if found is None:
        return -1
    hours, minutes, seconds = (int(part) for part in found.groups()[:3])
    if hours > 23 or minutes > 59 or seconds > 60:
        return -1
    nanoseconds = int((found[4] or "0").ljust(9, "0"))
    return ((hours * 60 + minutes) * 60 + seconds) * 1_000_000_000 + nanoseconds


def add_date(time_of_day_ns: Ints, log_time_ns: Ints) -> Ints:
    """Return UTC stamps [ns], shape (N,), on the day nearest to the log's clock; 0 for a negative (unknown) time.

    A constant offset between both clocks, even one near half a day, keeps one sign throughout: the first row decides,
    and later rows stay within half a day of its offset.
    """
    known = time_of_day_ns >= 0
    stamps = np.zeros(len(time_of_day_ns), np.int64)
    if not known.any():
        return stamps
    behind = time_of_day_ns[known] - log_time_ns[known] % NS_PER_DAY
    first = _wrap_to_zero(behind[:1])[0]
    stamps[known] = log_time_ns[known] + first + _wrap_to_zero(behind - first)
    return stamps


def _wrap_to_zero(offset_ns: Ints) -> Ints:
    return (offset_ns + NS_PER_DAY // 2) % NS_PER_DAY - NS_PER_DAY // 2
