"""GGA, RMC and VTG sentences against positions worked out by hand; checksums are those of the sentences' makers."""

from datetime import UTC, datetime

import numpy as np

from tcpipe.logs.messages import read_messages
from tcpipe.logs.nmea import NS_PER_DAY, add_date, read_gga, read_over_ground
from tcpipe.logs.roles import NMEA_SENTENCE

S = 1_000_000_000

# The example of the NMEA 0183 manuals: 48 deg 07.038' N, 11 deg 31.000' E, 545.4 m above the geoid, which is 46.9 m above the ellipsoid.
MANUAL = "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47"


def signed(body: str) -> str:
    checksum = 0
    for character in body:
        checksum ^= ord(character)
    return f"${body}*{checksum:02X}"


def test_the_manuals_sentence() -> None:
    found = read_gga([MANUAL])
    assert found.time_of_day_ns[0] == ((12 * 60 + 35) * 60 + 19) * S
    assert abs(found.lat_deg[0] - 48.1173) < 1e-12  # 48 + 7.038 / 60
    assert abs(found.lon_deg[0] - 11.516666666666667) < 1e-12  # 11 + 31 / 60
    assert (found.quality[0], found.hdop[0], found.alt_m[0], found.separation_m[0]) == (1, 0.9, 545.4, 46.9)
    assert not found.broken[0]


def test_south_west_and_the_precision_of_rtk() -> None:
    # Sugar Loaf: 22 deg 56' 55.7418" S, 43 deg 9' 23.4012" W.
    body = "GNGGA,235959.950,2256.92903000,S,04309.39002000,W,4,24,0.53,395.123,M,-5.512,M,1.0,0000"
    found = read_gga([signed(body)])
    assert found.lat_deg[0] == -(22 + 56.92903 / 60)
    assert found.lon_deg[0] == -(43 + 9.39002 / 60)
    assert found.time_of_day_ns[0] == 86_399_950_000_000
    assert abs(found.alt_m[0] + found.separation_m[0] - 389.611) < 1e-9


def test_other_sentences_are_skipped_and_broken_ones_marked() -> None:
    sentences = [
        "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A",
        MANUAL,
        MANUAL.replace("4807", "4817"),  # the checksum tells
        "noise before " + MANUAL + "\r\n",
        "$GPGGA,123519,4807.038,N*47",
        signed("GPGGA,123519,48x7.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"),
        "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,",  # without a checksum: optional in the standard
    ]
    found = read_gga(sentences)
    assert found.row.tolist() == [1, 2, 3, 4, 5, 6]
    assert found.broken.tolist() == [False, True, False, True, True, False]


def test_no_fix_has_empty_fields() -> None:
    found = read_gga([signed("GPGGA,,,,,,0,00,99.99,,,,,,")])
    assert not found.broken[0]
    assert found.quality[0] == 0
    assert np.isnan(found.lat_deg[0])
    assert found.time_of_day_ns[0] == -1


def at(*parts: int) -> int:
    return int(datetime(*parts, tzinfo=UTC).timestamp()) * S


def test_the_date_comes_from_the_log_over_midnight_too() -> None:
    log = np.array([at(2024, 2, 28, 23, 59, 59), at(2024, 2, 29, 0, 0, 1), at(2024, 2, 29, 0, 0, 2)])
    # The fix is made just before it is logged: the second sentence still carries the evening's time.
    time_of_day = np.array([NS_PER_DAY - 2 * S, NS_PER_DAY - S // 2, 2 * S])
    expected = [at(2024, 2, 28, 23, 59, 58), at(2024, 2, 29) - S // 2, at(2024, 2, 29, 0, 0, 2)]
    assert add_date(time_of_day, log).tolist() == expected


def test_a_clock_half_a_day_off_keeps_its_side_and_unknown_times_are_zero() -> None:
    log = at(2024, 6, 1, 6) + np.arange(100) * S
    noise = np.where(np.arange(100) % 2, S // 10, -S // 10)
    time_of_day = (log - NS_PER_DAY // 2 + noise) % NS_PER_DAY
    time_of_day[50] = -1
    found = add_date(time_of_day, log)
    offset = np.delete(found - log, 50)
    assert found[50] == 0
    assert np.ptp(offset) == 2 * (S // 10)


def test_speed_in_knots_and_course_from_north() -> None:
    # The manuals' RMC: 22.4 knots of 1852 m an hour, course 84.4 degrees; it has no mode yet.
    manual = "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A"
    fixed = signed("GNRMC,101325.20,A,4704.0,N,01526.0,E,1.944,270.00,130324,,,R,V")
    void = signed("GNRMC,101325.40,V,,,,,,,130324,,,N")
    guessed = signed("GNRMC,101325.60,A,4704.0,N,01526.0,E,1.944,270.00,130324,,,E")
    found = read_over_ground([manual, MANUAL, fixed, void, guessed, fixed.replace("1.944", "2.944")])
    assert found.row.tolist() == [0, 2, 3, 4, 5]
    assert abs(found.speed_mps[0] - 11.523555555555555) < 1e-12  # 22.4 * 1852 / 3600
    assert abs(found.course_rad[0] - 1.4730578886832142) < 1e-12  # 84.4 * pi / 180
    assert found.time_of_day_ns[:2].tolist() == [45_319 * S, 36_805_200_000_000]
    assert abs(found.speed_mps[1] - 1.0000800) < 1e-9
    assert found.status.tolist() == [0, 2, -1, -1, -1]
    assert found.broken.tolist() == [False, False, False, False, True]  # the last: its checksum tells


def test_numbers_that_no_receiver_means_make_a_sentence_broken() -> None:
    odd = ("inf", "-inf", "1e300", "x", "1,2")
    sentences = [
        signed(f"GNRMC,101325.00,A,,,,,{speed},{course},130324,,,R")
        for text in odd
        for speed, course in ((text, "1.0"), ("1.0", text))
    ]
    found = read_over_ground([*sentences, "$GNRMC", "$GNRMC,", "$GPRMC,1*00", signed("GNRMC,9,A,,,,,nan,nan,,,,R")])
    told = read_messages(
        {"log_time_ns": np.arange(len(sentences)) + S, "sentence": np.array(sentences)}, "gnss_velocity", NMEA_SENTENCE
    )
    assert np.isfinite(told.columns["east_velocity_mps"]).all()
    assert found.broken[:8].all()


def test_vtg_speaks_where_there_is_no_rmc_and_has_no_time() -> None:
    knots = signed("GPVTG,054.7,T,034.4,M,005.5,N,010.2,K")  # the manuals' sentence
    kilometres = signed("GNVTG,90.00,T,,M,,N,3.600,K,D")
    found = read_over_ground([knots, kilometres, signed("GNVTG,,T,,M,0.012,N,0.022,K,A")])
    assert np.allclose(found.speed_mps, [5.5 * 1852 / 3600, 1.0, 0.012 * 1852 / 3600])
    assert np.allclose(np.degrees(found.course_rad[:2]), [54.7, 90.0])
    assert np.isnan(found.course_rad[2])
    assert found.time_of_day_ns.tolist() == [-1, -1, -1]
    assert found.status.tolist() == [0, 1, 0]
