"""What fusing says of a run: sums over sections, and from where on it is a finding."""

from types import SimpleNamespace

import numpy as np
import pytest

from tcpipe.fusion.measurements import (
    InertialMeasurements,
    InitialState,
    Measurements,
    Positions,
    TrackSection,
)
from tcpipe.fusion.preparation import Prepared
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse_findings import find_fuse_findings, make_fuse_facts
from tcpipe.stages.fuse_inputs import Section, prepare_sections
from tcpipe.stages.fuse_sections import make_section_facts
from tcpipe.tables.facts import ChangeFacts, GateReset, SectionFacts
from tcpipe.tables.findings import Subject, make_finding
from tcpipe.tables.levels import STREAMS, Sensor, Streams

PLACE = (15.0, 47.0, 400.0)
ALL = ("gnss", "imu", "wheel_odometry")


def section(*, sensors=ALL, heading_from="course over ground", **said):
    told = {"nis_mean": {}, "measurements": {}, "rejected": {}} | said
    return SectionFacts(**told, sensors=sensors, heading_from=heading_from)


def warned(inputs, *sections, skipped_s=0.0):
    facts = make_fuse_facts([inputs], sections, rows=7, skipped_s=skipped_s)
    return find_fuse_findings([inputs], facts, run=Subject("run", "r"))


def prepared(*, invalid=0, repeated=0, variances_replaced=0):
    return Prepared(np.zeros(invalid, np.int64), repeated, variances_replaced)


def test_changes_are_findings_in_order_of_time():
    def change(kind, start_s, end_s, size):
        return ChangeFacts(kind, "gnss", round(start_s * 1e9), round(end_s * 1e9), size)

    first = (change("antenna", 30, 60, 0.2), change("slow", 5, 80, 0.7))
    findings = warned(
        Section(0, datum_deg_m=PLACE), section(changes=first), section(changes=(change("slow", 90, 95, 0.1),))
    )
    found = [(each.span_s, each.names["change"]) for each in findings if each.code == "sensor-changed"]
    slow = "positions err slowly by {} m (1σ), more than they claim"
    assert found == [
        ((5.0, 80.0), slow.format("0.70")),
        ((30.0, 60.0), "it was moved by 0.20 m on the robot"),
        ((90.0, 95.0), slow.format("0.10")),
    ]


def test_sections_add_up_and_their_innovations_are_averaged_by_count():
    first = section(nis_mean={"gnss": 1.0, "imu": None}, measurements={"gnss": 30, "imu": 5}, rejected={"gnss": 3})
    second = section(nis_mean={"gnss": 2.0}, measurements={"gnss": 10}, rejected={"gnss": 4}, sensors=("gnss",))
    inputs = Section(0, datum_deg_m=PLACE, prepared={"gnss": prepared(invalid=2)})
    facts = make_fuse_facts([inputs], [first, second], rows=7, skipped_s=1.5)
    assert facts.measurements == {"gnss": 40, "imu": 5}
    assert facts.rejected == {"gnss": 7, "imu": 0}
    assert facts.nis_mean == {"gnss": pytest.approx(1.25)}
    assert facts.sensors == ALL
    assert (facts.rows, facts.skipped_s, facts.set_aside) == (
        7,
        1.5,
        {"gnss": {"invalid": 2, "repeated": 0, "variances_replaced": 0}},
    )
    assert facts.sections == (first, second)


def test_a_section_says_where_it_lies_and_what_it_began_with():
    at = np.arange(3, dtype=np.int64)
    imu = InertialMeasurements(at, np.zeros((3, 3)), np.zeros((3, 3)), np.full((3, 4), np.nan), 0.01, 0.1)
    heard = Measurements(gnss=Positions(at, np.zeros((3, 3)), np.ones((3, 3))), imu=imu)
    yaw = np.array([0.0, 0.0, np.sin(0.25), np.cos(0.25)])
    began = InitialState(np.zeros(3), np.ones(3), yaw, 0.1, 0.3, heading_from="orientation")
    found = SimpleNamespace(facts=section(), stamp_ns=np.arange(4))
    told = make_section_facts(TrackSection(2, 10, 20, heard), began, found)
    assert (told.clock_epoch, told.start_ns, told.end_ns, told.rows) == (2, 10, 20, 4)
    assert set(told.sensors) == {"gnss", "imu"}
    assert (told.gyro_noise_radps, told.heading_from) == (0.01, "orientation")
    alone = make_section_facts(TrackSection(2, 10, 20, Measurements(gnss=heard.gnss)), began, found)
    assert alone.gyro_noise_radps is None


def test_nothing_is_said_where_nothing_is_odd():
    inputs = Section(0, datum_deg_m=PLACE, prepared={"gnss": prepared(repeated=5)})
    assert warned(inputs, section(measurements={"gnss": 10}, rejected={"gnss": 1})) == ()


@pytest.mark.parametrize(("rejected", "said"), [(1, False), (2, True)])
def test_rejections_are_a_finding_beyond_a_tenth(rejected, said):
    found = warned(Section(0, datum_deg_m=PLACE), section(measurements={"gnss": 10}, rejected={"gnss": rejected}))
    assert [(of.code, of.subject.name) for of in found] == [("measurements-rejected", "gnss")] * said
    for finding in found:
        assert finding.numbers == {"rejected_fraction": 0.2, "rejected_count": 2, "measurement_count": 10}
        assert finding.remedies[0].recipe == {"read.topics": {"gnss": []}}


def test_the_only_sensor_of_motion_is_not_proposed_to_be_excluded():
    counts = {"measurements": {"wheel_odometry": 10}, "rejected": {"wheel_odometry": 2}}
    (finding,) = warned(Section(0), section(sensors=("imu", "wheel_odometry"), **counts))
    assert (finding.code, finding.remedies) == ("measurements-rejected", ())


@pytest.mark.parametrize(("common", "said"), [(None, []), (0.02, []), (0.03, [0.03])])
def test_a_scale_that_nothing_shows_is_a_finding_beyond_two_hundredths(common, said):
    found = warned(Section(0, datum_deg_m=PLACE), section(common_scale_std=common), section(common_scale_std=0.01))
    assert [of.numbers["scale_std_fraction"] for of in found] == said
    assert all(of.names == {"reason": "coarse-gnss"} for of in found)


def test_without_fixes_they_would_show_the_scale():
    (finding,) = warned(
        Section(0, datum_deg_m=PLACE), section(common_scale_std=0.03, sensors=("imu", "wheel_odometry"))
    )
    assert (finding.code, finding.subject.name) == ("odometry-scale-unobservable", "wheel_odometry")
    assert finding.names == {"reason": "no-gnss"}


def test_a_track_without_a_place_is_a_finding():
    assert warned(Section(0), section()) == ()  # a log without fixes was found when it was read
    (finding,) = warned(Section(0, prepared={"gnss": prepared()}), section())
    assert finding.code == "local-frame"


def test_rows_that_were_set_aside_are_counted_but_not_those_of_a_sensor_that_was_refused():
    sleeps, blind = (make_finding("pose-increments", Subject("role", role)) for role in ("imu", "visual_odometry"))
    inputs = Section(
        0,
        datum_deg_m=PLACE,
        prepared={
            "gnss": prepared(variances_replaced=4),
            "imu": prepared(invalid=2),
            "visual_odometry": prepared(invalid=9),
        },
        findings=(sleeps, blind),
        excluded={
            "visual_odometry": make_finding(
                "yaw-rate-sign", Subject("role", "visual_odometry"), names={"reference": "imu"}
            )
        },
    )
    assert warned(inputs, section(), skipped_s=0.55) == (
        sleeps,
        make_finding("variances-replaced", Subject("role", "gnss"), row_count=4),
        make_finding("values-unusable", Subject("role", "imu"), row_count=2),
        make_finding("sections-skipped", Subject("run", "r"), skipped_s=0.55),
    )


def test_a_sensor_that_left_the_path_is_one_finding_with_its_worst():
    worst = GateReset(30_000_000_000, 40_000_000_000, 2.5)
    first = section(gate_resets=(GateReset(10, 20, 1.0),))
    (gnss,) = warned(Section(0, datum_deg_m=PLACE), first, section(gate_resets=(worst,)))
    assert (gnss.code, gnss.subject.name, gnss.span_s) == ("gnss-contradicts-odometry", "gnss", (30.0, 40.0))
    assert gnss.numbers == {"off_m": 2.5, "event_count": 2}
    assert gnss.names == {"suspect": "wheel_odometry"}
    third = section(gate_resets=(worst,), sensors=(*ALL, "visual_odometry"))
    assert warned(Section(0, datum_deg_m=PLACE), third)[0].names == {}


STAMP_NS = 1_700_000_000_000_000_000 + np.arange(4, dtype=np.int64) * 1_000_000_000


@pytest.fixture
def streams():
    times = {
        "stamp_ns": STAMP_NS,
        "log_time_ns": STAMP_NS,
        "clock_epoch": np.zeros(4, np.int16),
        "fix_status": np.full(4, 2, np.int8),
    }
    unknown = np.full(4, np.nan)
    place = {"lon_deg": 15.0 + np.arange(4) * 1e-5, "lat_deg": np.full(4, 47.0), "alt_m": np.full(4, 400.0)}
    axes = ("east", "north", "up")
    fixes = STREAMS["gnss"].table(**times, **place, **{f"{axis}_var_m2": np.full(4, 1e-4) for axis in axes})
    velocity = dict(
        zip([f"{axis}_velocity_mps" for axis in axes], (np.full(4, 0.76), np.zeros(4), unknown), strict=True)
    )
    told = STREAMS["gnss_velocity"].table(**times, **velocity, **{f"{axis}_var_m2ps2": unknown for axis in axes})
    roles = ("gnss", "gnss_velocity")
    sensors = {role: Sensor(f"/{role}", "x/msg/Y", "gps", "why", (0.1, 0.0, 0.9), placed_by="recipe") for role in roles}
    return Streams(dict(zip(roles, (fixes, told), strict=True)), sensors, "husky")


@pytest.mark.parametrize("estimator", ["smoother", "ukf"])
def test_what_no_receiver_claims_is_the_recipes(streams, estimator):
    (section,) = prepare_sections(streams, FuseConfig(estimator, gnss_velocity_std_mps=0.2))
    found = section.measurements
    assert set(found.sensors()) == {"gnss", "gnss_velocity"}
    assert found.doppler.velocity_enu_mps[0].tolist() == [0.76, 0.0, 0.0]
    assert found.doppler.variance_m2ps2[0] == pytest.approx([0.04, 0.04, 1e6])
