"""The quality of fixes by the codes and words of receivers, and the deviations that it stands for."""

import numpy as np
import pytest

from tcpipe.formats.logs.log_joining import open_logs
from tcpipe.formats.recipe_toml import load_profiles, load_shipped_profiles, parse_recipe
from tcpipe.logs.field_mapping import make_mapped_message, read_fields
from tcpipe.logs.messages import read_messages
from tcpipe.logs.roles import assign_roles
from tcpipe.logs.topics import Topic
from tcpipe.stages.read import find_read_config, read_run
from tcpipe.tables.columns import to_floats

NAV_SAT_FIX, GPS_FIX = "sensor_msgs/msg/NavSatFix", "gps_common/msg/GPSFix"
FIXED, FLOAT, DIFFERENTIAL, SINGLE = 0.02, 0.5, 1.0, 4.0


def fixes(status, variance=None, rows=40, **others):
    covariance = np.zeros((rows, 9))
    covariance[:, ::4] = np.broadcast_to(0.0 if variance is None else variance, rows)[:, None]
    times = np.arange(rows) * 10**8
    return {
        "log_time_ns": times,
        "header.stamp.sec": times // 10**9,
        "header.stamp.nanosec": times % 10**9,
        "latitude": np.linspace(47.0, 47.001, rows),
        "longitude": np.full(rows, 15.4),
        "altitude": 400.0 + 0.01 * np.arange(rows),
        "status.status": np.resize(np.asarray(status), rows),
        "position_covariance": covariance,
        "position_covariance_type": np.full(rows, 0 if variance is None else 2, np.uint8),
        **others,
    }


def east_std(columns, kind=NAV_SAT_FIX, **std_m):
    return np.sqrt(read_messages(columns, "gnss", kind, fix_std_m=std_m).columns["east_var_m2"]).round(9).tolist()


@pytest.mark.parametrize(
    ("codes", "values", "wanted"),
    [
        ("gga", [1, 2, 3, 4, 5, 9], [SINGLE, DIFFERENTIAL, SINGLE, FIXED, FLOAT, DIFFERENTIAL]),
        ("rtklib", [1, 2, 3, 4, 5, 6], [FIXED, FLOAT, DIFFERENTIAL, DIFFERENTIAL, SINGLE, FLOAT]),
        ("gps_common", [0, 1, 18, 19, 20, 33], [SINGLE, DIFFERENTIAL, DIFFERENTIAL, FIXED, FLOAT, DIFFERENTIAL]),
        ("ublox", [0, 1, 2], [SINGLE, FLOAT, FIXED]),
        ("mavlink", [2, 3, 4, 5, 6, 7, 8], [SINGLE, SINGLE, DIFFERENTIAL, FLOAT, FIXED, FIXED, FLOAT]),
        ("words", ["RTK fixed", "Float", "NARROW_INT", "3D fix", "DGPS", "RTK_FLOAT", "single"],
         [FIXED, FLOAT, FIXED, SINGLE, DIFFERENTIAL, FLOAT, SINGLE]),
    ],
)  # fmt: skip
def test_codes_and_words_of_a_column_are_deviations(tmp_path, codes, values, wanted):
    rows = [(1_760_456_485 + k / 10, values[k % len(values)]) for k in range(2 * len(values))]
    lines = "".join(f"{at},{47 + k / 1e6},15.4,{400 + k / 100},{value}\n" for k, (at, value) in enumerate(rows))
    none = "1760456490,47,15.4,400,no fix\n" if codes == "words" else "1760456490,47,15.4,400,77\n"
    (tmp_path / "gnss.csv").write_text("t,lat,lon,alt,state\n" + lines + none)
    columns = {"latitude": "lat", "longitude": "lon", "altitude": "alt", "quality": f"{codes}: state"}
    recipe = parse_recipe({"tables": {"gnss": {"file": "gnss.csv", "columns": columns}}}, where="recipe")
    with open_logs([tmp_path], tables=recipe.tables) as log:
        streams = read_run(log, find_read_config(recipe, log.topics), robot="generic", known=load_profiles(recipe))
        assert log.findings == []
    assert np.sqrt(to_floats(streams.tables["gnss"], "east_var_m2")).tolist() == pytest.approx(2 * wanted)
    assert np.sqrt(to_floats(streams.tables["gnss"], "up_var_m2")).tolist() == pytest.approx(
        [2 * std for std in 2 * wanted]
    )


def test_what_codes_mean_is_told_by_a_clear_name_alone():
    place = {"latitude": "lat", "longitude": "lon"}
    for name, codes in (("Q", "rtklib"), ("pvt.carr_soln", "ublox"), ("fix_quality", "gga"), ("gps_qual", "gga")):
        found = read_fields("r", "gnss", {**place, "quality": name}, {}, ["lat", "lon", name])
        assert found["quality"].codes == codes
    for name in ("quality", "fix_type", "mode"):
        (said,) = read_fields("r", "gnss", {**place, "quality": name}, {}, ["lat", "lon", name])
        assert f'"gga: {name}"' in said
    columns = fixes(0) | {"lat": np.full(40, 47.0), "lon": np.full(40, 15.0), "carrSoln": np.resize([0, 1, 2], 40)}
    made = make_mapped_message("gnss", columns, {**place, "quality": "carrSoln"})
    assert east_std(made)[:3] == [SINGLE, FLOAT, FIXED]


def test_a_covariance_goes_before_the_quality_unless_it_is_one_for_all():
    assert east_std(fixes([0, 1]))[:2] == [SINGLE, DIFFERENTIAL]
    assert east_std(fixes([0, 1]), single=2.5)[:2] == [2.5, DIFFERENTIAL]
    assert east_std(fixes([0, 1], 0.09))[:2] == [SINGLE, DIFFERENTIAL]  # 0.3 m for both
    assert east_std(fixes([0, 1], np.linspace(0.09, 0.16, 40)))[0] == 0.3  # the receiver's own
    assert east_std(fixes([1, 1], 0.09))[0] == 0.3
    assert np.isnan(east_std(fixes(0))).all()  # a status that is never set
    assert np.isnan(east_std(fixes([0, 2]))[1])  # RTK, fixed or float


def test_gps_fix_is_a_position_with_the_errors_it_states():
    speed = {"speed": np.ones(40), "track": np.zeros(40)}
    found = east_std(fixes([19, 20, 18, 33, 0], **speed), GPS_FIX)
    assert found[:5] == [FIXED, FLOAT, DIFFERENTIAL, DIFFERENTIAL, SINGLE]
    errors = {"err_horz": np.full(40, 0.06), "err_vert": np.full(40, 0.1)}
    assert east_std(fixes(19, **speed, **errors), GPS_FIX)[0] == 0.03
    read = read_messages(fixes([-1, 19, 20, 0], **speed), "gnss", GPS_FIX)
    assert (read.dropped, read.columns["fix_status"].tolist()[:3]) == ({"no_fix": 10}, [2, 2, 0])


@pytest.mark.parametrize("beside", [False, True])
def test_gps_fix_is_gnss_and_its_velocity_unless_there_are_plain_fixes(beside):
    topics = [Topic("/gps/gpsfix", GPS_FIX, 100, 0, 10**10, "ros1", "")]
    topics += [Topic("/gps/fix", NAV_SAT_FIX, 100, 0, 10**10, "ros1", "")] if beside else []
    found = assign_roles(topics, {}, known=load_shipped_profiles())
    wanted = "/gps/fix" if beside else "/gps/gpsfix"
    assert {role: of.topics for role, of in found.roles.items()} == {
        "gnss": (wanted,),
        "gnss_velocity": ("/gps/gpsfix",),
    }
    chosen = assign_roles(topics, {"gnss": ["/gps/gpsfix"]}, known=load_shipped_profiles())
    assert set(chosen.roles) == {"gnss", "gnss_velocity"}
