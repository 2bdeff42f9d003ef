"""Quality of fixes: the codes and words of receivers, and the standard deviations that the recipe gives each quality.

Sources of the codes: NMEA 0183 (GGA, field 6), RTKLIB manual 2.4.2 (Q of solution files), u-blox F9 interface
description (carrSoln), MAVLink (GPS_FIX_TYPE), sensor_msgs/NavSatStatus, gps_common/GPSStatus. A ground-based
augmentation (2) is RTK, fixed or float.
"""

import re
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import AnyArray, Columns, Floats, Ints
from tcpipe.logs.expressions import simplify_name

NO_HEIGHT_M2 = 1e6
"""Variance of a height that is not measured."""

FIX_STD_M = {"rtk_fixed": 0.02, "rtk_float": 0.5, "differential": 1.0, "single": 4.0}
"""Horizontal standard deviation of a fix by its quality [m], of a GGA sentence at HDOP 1."""
_FIXED, _FLOAT, _DIFFERENTIAL, _SINGLE = range(4)
_NO_FIX, _UNKNOWN = -1.0, np.nan
_STATUS = np.array([2, 2, 1, 0, -1], np.int8)  # NavSatStatus by quality

CODES: dict[str, dict[int, float]] = {
    "gga": {1: _SINGLE, 2: _DIFFERENTIAL, 3: _SINGLE, 4: _FIXED, 5: _FLOAT, 9: _DIFFERENTIAL},
    "rtklib": {1: _FIXED, 2: _FLOAT, 3: _DIFFERENTIAL, 4: _DIFFERENTIAL, 5: _SINGLE, 6: _FLOAT},
    "ublox": {0: _SINGLE, 1: _FLOAT, 2: _FIXED},
    "mavlink": {2: _SINGLE, 3: _SINGLE, 4: _DIFFERENTIAL, 5: _FLOAT, 6: _FIXED, 7: _FIXED, 8: _FLOAT},
    "navsat": {0: _SINGLE, 1: _DIFFERENTIAL, 2: _UNKNOWN},
    "gps_common": {
        0: _SINGLE, 1: _DIFFERENTIAL, 2: _UNKNOWN, 18: _DIFFERENTIAL, 19: _FIXED, 20: _FLOAT, 33: _DIFFERENTIAL,
    },
    "words": {},
}  # fmt: skip
"""Quality by code; any other code is no fix."""
_WORDS: tuple[tuple[str, float], ...] = (
    (r"\bno\b|none|not|invalid|unknown|estimat|manual|simul", _NO_FIX),
    (r"float", _FLOAT),
    (r"fixed|rtk.?fix|integer|_int\b|\brtk\b", _FIXED),
    (r"dgps|dgnss|diff|sbas|waas|egnos|ppp", _DIFFERENTIAL),
    (r"single|auto|stand|\bspp|\bsps|gps|gnss|fix|[23]d", _SINGLE),
)
CODES_OF_NAMES = {"rtklib": r"q", "ublox": r"(.*[_.])?carr(ier)?_?sol\w*", "gga": r"(.*[_.])?(gga|fix|gps)_?qual(ity)?"}
"""Patterns of names, in lower case, of columns whose names state the kind of their codes."""
_EQUAL_FEWEST = 20


def split_codes(text: str) -> tuple[str | None, str]:
    """Return the kind of codes and the column of ``gga: quality``, or of a name that shows the kind: ``carrSoln``."""
    codes, colon, column = text.partition(":")
    if colon and codes.strip() in CODES:
        return codes.strip(), column.strip()
    named = (codes for codes, pattern in CODES_OF_NAMES.items() if re.fullmatch(pattern, simplify_name(text)))
    return next(named, None), text


def find_quality(names: Iterable[str]) -> list[str]:
    """Return the first name that may be a fix quality, with the likeliest codes: ``gga: quality``; [] without one."""
    likely = {"gga": r"(.*[_.])?(qual(ity)?|mode|fix_?(type|mode)?)", "navsat": r"(.*[_.])?status"}
    found = [
        f"{codes}: {name}"
        for codes, pattern in likely.items()
        for name in names
        if re.fullmatch(pattern, simplify_name(name))
    ]
    return found[:1]


def classify_fixes(values: AnyArray, codes: str) -> Floats:
    """Return the quality of each fix by its code or word, shape (N,): NaN if unknown, negative without a fix."""
    found = np.full(len(values), _NO_FIX)
    if np.issubdtype(values.dtype, np.number):
        for code, quality in CODES[codes].items():
            found[values == code] = quality
        return found
    for word in set(values.tolist()):
        text = str(word or "no").lower()
        found[values == word] = next((quality for pattern, quality in _WORDS if re.search(pattern, text)), _NO_FIX)
    return found


def classify_status(status: Ints, codes: str) -> Floats:
    """Return the quality of each fix by its status; a status that is always 0 is ignored, as drivers set no other."""
    return classify_fixes(status, codes) if np.any(status > 0) else np.full(len(status), _UNKNOWN)


def find_status(quality: Floats) -> NDArray[np.int8]:
    """Return NavSatStatus by quality, a ground-based augmentation where it is not known."""
    return _STATUS[np.where(np.isnan(quality), _FIXED, quality).astype(np.int64)]


def convert_gps_fix(columns: Columns) -> dict[str, AnyArray]:
    """Return the fields of gps_common/GPSFix as those of NavSatFix; without a covariance by its errors of 95 %."""
    quality = classify_status(columns["status.status"].astype(np.int64), "gps_common")
    made = {**columns, "fix_quality": quality}
    made["status.status"] = np.where(quality >= 0, find_status(quality), np.clip(columns["status.status"], -1, 2))
    if "err_horz" in columns and not np.any(columns["position_covariance_type"]):
        std_m = np.column_stack([columns[name].astype(float) / 2.0 for name in ("err_horz", "err_horz", "err_vert")])
        made["position_covariance"] = np.zeros((len(quality), 9))
        made["position_covariance"][:, ::4] = std_m**2
        made["position_covariance_type"] = np.where((std_m > 0).all(1), 2, 0)
    return made


def add_quality_std(columns: Columns, std_m: Mapping[str, float]) -> tuple[dict[str, AnyArray], int]:
    """Return fixes with the σ of their quality if they have none, or one σ for all; and the number of such fixes.

    ``std_m`` [m] goes before `FIX_STD_M`; heights have twice as much.
    """
    made = dict(columns)
    quality, dop = made.pop("fix_quality"), made.pop("dop", 1.0)
    known, east = quality >= 0, made["east_var_m2"]
    horizontal = (
        np.array([*{**FIX_STD_M, **std_m}.values(), np.nan])[np.where(known, quality, -1).astype(np.int64)] * dop
    )
    given = east[np.isfinite(east)]
    is_constant = given.size >= _EQUAL_FEWEST and np.ptp(given) == 0.0 and np.unique(quality).size > 1
    used = known & (np.isnan(east) | is_constant)
    for axis, times in (("east", 1.0), ("north", 1.0), ("up", 2.0)):
        variance = made[f"{axis}_var_m2"]
        made[f"{axis}_var_m2"] = np.where(used & (variance != NO_HEIGHT_M2), (times * horizontal) ** 2, variance)
    return made, int(np.count_nonzero(used))
