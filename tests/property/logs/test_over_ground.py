"""Whatever the speed and the course: a sentence that is written is read back, and its velocity is never surer than it may be."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tcpipe.logs import roles
from tcpipe.logs.messages import read_messages
from tcpipe.logs.nmea import KNOT_MPS

STAMP_NS = 1_700_000_000_000_000_000
SLOW_MPS = 0.3


def rmc(knots: float, course: str) -> str:
    body = f"GNRMC,101325.00,A,4704.0,N,01526.0,E,{knots:.3f},{course},130324,,,R"
    checksum = 0
    for byte in body.encode():
        checksum ^= byte
    return f"${body}*{checksum:02X}"


@settings(max_examples=200, deadline=None)
@given(st.floats(0.0, 60.0), st.floats(0.0, 359.99), st.booleans())
def test_a_sentence_is_read_back_within_its_digits(knots: float, course_deg: float, empty: bool) -> None:  # noqa: FBT001
    told = "" if empty else f"{course_deg:.2f}"
    columns = {"log_time_ns": np.array([STAMP_NS]), "sentence": np.array([rmc(knots, told)])}
    found = read_messages(columns, "gnss_velocity", roles.NMEA_SENTENCE)
    speed = float(f"{knots:.3f}") * KNOT_MPS
    if speed < SLOW_MPS:
        assert found.columns["east_velocity_mps"][0] == found.columns["north_velocity_mps"][0] == 0.0
        # Wherever on the circle it goes: the mean square of either axis.
        assert found.columns["east_var_m2ps2"][0] >= speed**2 / 2
    elif empty:
        assert found.dropped == {"not_finite": 1}
    else:
        east, north = (found.columns[f"{axis}_velocity_mps"][0] for axis in ("east", "north"))
        assert np.isclose(np.hypot(east, north), speed)
        apart = np.angle(complex(north, east) * np.exp(-1j * np.radians(course_deg)))
        assert abs(apart) <= np.radians(0.006)
        assert np.isnan(found.columns["east_var_m2ps2"][0])
