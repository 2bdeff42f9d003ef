"""What fusing says of a run: sums over stretches, and from where on a person is warned."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from tcpipe.fusion.measurements import InertialMeasurements, InitialState, Measurements, Positions
from tcpipe.fusion.stretches import Stretch
from tcpipe.stages.fuse_findings import fuse_facts, fuse_warnings, stretch_facts
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.tables.facts import Reopening, StretchFacts

PLACE = (15.0, 47.0, 400.0)
ALL = ("gnss", "imu", "wheel_odometry")


def stretch(*, sensors=ALL, heading_from="course over ground", **said):
    told = {"nis_mean": {}, "measurements": {}, "rejected": {}, "covariance_repairs": 0} | said
    return StretchFacts(**told, sensors=sensors, heading_from=heading_from)


def warned(inputs, *stretches, skipped_s=0.0):
    return fuse_warnings(inputs, fuse_facts(inputs, stretches, rows=7, skipped_s=skipped_s))


def counts(**said):
    return {"invalid": 0, "repeated": 0, "variances_replaced": 0} | said


def test_stretches_add_up_and_their_innovations_are_averaged_by_count():
    first = stretch(nis_mean={"gnss": 1.0, "imu": None}, measurements={"gnss": 30, "imu": 5}, rejected={"gnss": 3})
    second = stretch(nis_mean={"gnss": 2.0}, measurements={"gnss": 10}, rejected={"gnss": 4}, sensors=("gnss",))
    inputs = FusionInputs(PLACE, counts={"gnss": counts(invalid=2)})
    facts = fuse_facts(inputs, [first, second], rows=7, skipped_s=1.5)
    assert facts.measurements == {"gnss": 40, "imu": 5}
    assert facts.rejected == {"gnss": 7, "imu": 0}
    assert facts.nis_mean == {"gnss": pytest.approx(1.25)}
    assert facts.sensors == ALL
    assert (facts.rows, facts.skipped_s, facts.set_aside) == (7, 1.5, inputs.counts)
    assert facts.stretches == (first, second)


def test_a_stretch_says_where_it_lies_and_what_it_began_with():
    at = np.arange(3, dtype=np.int64)
    imu = InertialMeasurements(at, np.zeros((3, 3)), np.zeros((3, 3)), np.full((3, 4), np.nan), 0.01, 0.1)
    heard = Measurements(gnss=Positions(at, np.zeros((3, 3)), np.ones((3, 3))), imu=imu)
    yaw = np.array([0.0, 0.0, np.sin(0.25), np.cos(0.25)])
    began = InitialState(np.zeros(3), np.ones(3), yaw, 0.1, 0.3, heading_from="orientation")
    found = SimpleNamespace(facts=stretch(), stamp_ns=np.arange(4))
    told = stretch_facts(Stretch(2, 10, 20, heard), began, found)
    assert (told.epoch, told.start_ns, told.end_ns, told.rows) == (2, 10, 20, 4)
    assert set(told.sensors) == {"gnss", "imu"}
    assert (told.gyro_noise_radps, told.accelerometer_noise_mps2) == (0.01, 0.1)
    assert told.initial_yaw_rad == pytest.approx(0.5)
    assert (told.initial_yaw_std_rad, told.heading_from) == (0.3, "orientation")
    alone = stretch_facts(Stretch(2, 10, 20, Measurements(gnss=heard.gnss)), began, found)
    assert alone.gyro_noise_radps is None
    assert alone.accelerometer_noise_mps2 is None


def test_nothing_is_said_where_nothing_is_odd():
    inputs = FusionInputs(PLACE, counts={"gnss": counts(repeated=5)})
    assert warned(inputs, stretch(measurements={"gnss": 10}, rejected={"gnss": 2})) == ()


@pytest.mark.parametrize(("rejected", "said"), [(2, False), (3, True)])
def test_refusals_are_told_beyond_a_fifth(rejected, said):
    lines = warned(FusionInputs(PLACE), stretch(measurements={"gnss": 10}, rejected={"gnss": rejected}))
    assert any(f"gnss: {rejected} of 10 measurements were refused" in line for line in lines) == said
    assert any("leave it out, write in the recipe under [read.topics]: gnss = []" in line for line in lines) == said


@pytest.mark.parametrize(("common", "said"), [(None, None), (0.02, None), (0.03, "3%")])
def test_a_scale_that_nothing_tells_is_told_beyond_two_hundredths(common, said):
    lines = warned(FusionInputs(PLACE), stretch(common_scale_std=common), stretch(common_scale_std=0.01))
    assert [re.search(r"(\d+%)", line)[1] for line in lines] == ([] if said is None else [said])
    assert all("these fixes are too few or too coarse to tell it" in line for line in lines)


def test_without_fixes_they_would_tell_the_scale():
    lines = warned(FusionInputs(PLACE), stretch(common_scale_std=0.03, sensors=("imu", "wheel_odometry")))
    assert "a GNSS would tell it" in lines[0]


def test_a_track_without_a_place_or_without_an_imu_is_warned_of():
    assert warned(FusionInputs(None), stretch()) == ()  # a log without fixes was warned of when it was read
    (line,) = warned(FusionInputs(None, counts={"gnss": counts()}), stretch())
    assert line.startswith("no GNSS position is used: the track lies in a local frame")
    (line,) = warned(FusionInputs(PLACE), stretch(sensors=("gnss",)))
    assert line.startswith("no IMU is used")


def test_a_heading_that_the_course_does_not_tell_is_warned_of_where_the_track_has_a_place():
    told = stretch(heading_from="the IMU", epoch=1)
    (line,) = warned(FusionInputs(PLACE), stretch(), told)
    assert line == "clock epoch 1: no 5 m of course over ground, so its initial yaw is from the IMU"
    assert warned(FusionInputs(None), told) == ()


def test_rows_that_were_set_aside_are_counted_but_not_those_of_a_sensor_that_was_refused():
    inputs = FusionInputs(
        PLACE,
        counts={"gnss": counts(variances_replaced=4), "imu": counts(invalid=2), "visual_odometry": counts(invalid=9)},
        remarks=["imu: it sleeps", "visual_odometry: it is blind"],
        refused=frozenset({"visual_odometry"}),
    )
    assert warned(inputs, stretch(), skipped_s=0.55) == (
        "imu: it sleeps",
        "gnss: 4 rows without a usable variance; the recipe's is used",
        "imu: 2 rows without a usable value",
        "0.6 s between pauses or clock steps hold too little to place a track",
    )


def test_a_sensor_that_left_the_path_is_told_once_with_its_worst():
    worst = Reopening("gnss", 30, 40, 2.5)
    first = stretch(reopenings=(Reopening("gnss", 10, 20, 1.0), Reopening("wheel_odometry", 1, 2, 0.4)))
    lines = warned(FusionInputs(PLACE), first, stretch(reopenings=(worst,)))
    assert [line.split(":")[0] for line in lines] == ["gnss", "wheel_odometry"]
    assert "2 times it contradicted the other sensors for seconds, most by 2.50 m from 30 to 40 ns" in lines[0]
    assert "1 times it contradicted the other sensors for seconds, most by 0.40 m/s from 1 to 2 ns" in lines[1]
    assert lines[0].endswith("; or wheel_odometry errs there: nothing else tells how far the robot goes")
    assert lines[1].endswith("surroundings")
    third = stretch(reopenings=(worst,), sensors=(*ALL, "visual_odometry"))
    assert warned(FusionInputs(PLACE), third)[0].endswith("surroundings")
