"""Time offsets of simulated drives with every fault: each is found, and no other."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from simulated_streams import log_of, streams_of
from suggested_recipes import proposed

from tcpipe.fusion.measurements import BodyVelocities, Measurements, Positions
from tcpipe.recipe import FuseConfig, ReadConfig
from tcpipe.simulation import find_scenario
from tcpipe.stages.fuse import fuse_run
from tcpipe.stages.fuse_clocks import correct_clocks, find_clock_jumps, find_clocks, find_offsets
from tcpipe.stages.fuse_inputs import Section, prepare_sections
from tcpipe.stages.label_motion import is_clock_doubtful
from tcpipe.tables.findings import Subject, select_findings, sort_findings

LATE_S = {"gnss": 0.25, "wheel_odometry": 0.15, "imu": -0.10, "visual_odometry": 0.20}
WITHIN_S = {"gnss": 0.020, "wheel_odometry": 0.020, "imu": 0.020, "visual_odometry": 0.020}
FAULTS = {role: f"{role.split('_')[0]}_clock_offset" for role in LATE_S}


@pytest.fixture(scope="module")
def drive_log(tmp_path_factory):
    """Return the log of a drive of the demo in which some sensors are late."""

    @cache
    def make(index, seed, *late):
        demo = find_scenario("demo")
        drive = demo.drives[index]
        faults = replace(drive.faults, **{FAULTS[role]: True for role in late})
        return log_of(demo, replace(drive, faults=faults), tmp_path_factory.mktemp("drive"), seed=seed)

    return make


def doctor(log, config=None):
    """Return clock facts and findings of a drive."""
    streams = streams_of(log, config)
    (section,) = find_clocks(prepare_sections(streams, FuseConfig()))
    return SimpleNamespace(facts=section.clocks, findings=tuple(find_offsets([section], streams)))


def test_a_clean_drive_gives_no_warning(drive_log):
    found = doctor(drive_log(1, 31))
    assert found.findings == ()
    assert {"imu", "wheel_odometry", "visual_odometry"} <= {found.facts.reference, *found.facts.offsets}


@pytest.mark.parametrize("late", [("wheel_odometry",), ("imu",), ("gnss",)])
def test_the_sensor_that_is_late_is_found_and_by_how_much(drive_log, late):
    found = doctor(drive_log(1, 42, *late))
    significant = {name: offset for name, offset in found.facts.offsets.items() if offset.is_significant}
    assert set(significant) == set(late)
    assert {finding.subject: finding.code for finding in found.findings} == {
        Subject("role", role): "time-offset" for role in late
    }
    for finding in found.findings:
        role = finding.subject.name
        assert significant[role].offset_s == pytest.approx(LATE_S[role], abs=WITHIN_S[role])
        assert finding.action == "corrected"
        assert finding.numbers["offset_s"] == significant[role].offset_s
        said = proposed(finding)["read"]["time_offset_s"]
        assert said == {role: pytest.approx(-LATE_S[role], abs=WITHIN_S[role] + 0.005)}


def test_the_remedy_corrects_it(drive_log):
    log = drive_log(1, 42, "gnss")
    offsets_s: dict[str, float] = {}
    for finding in doctor(log).findings:
        offsets_s |= proposed(finding)["read"]["time_offset_s"]
    assert doctor(log, ReadConfig(time_offset_s=offsets_s)).findings == ()
    # What a partly corrected log proposes holds for the log as it is: the offset in the recipe is counted in.
    (again,) = doctor(log, ReadConfig(time_offset_s={**offsets_s, "gnss": offsets_s["gnss"] / 2})).findings
    assert proposed(again)["read"]["time_offset_s"]["gnss"] == pytest.approx(offsets_s["gnss"], abs=0.011)


def test_an_offset_is_taken_out_of_the_stamps_that_are_fused(drive_log):
    streams = streams_of(drive_log(1, 42, "wheel_odometry"))
    before = find_clocks(prepare_sections(streams, FuseConfig()))
    after = correct_clocks(before, streams)
    measured = [section.measurements for (section,) in (before, after)]
    moved_s = (measured[1].wheels.stamp_ns - measured[0].wheels.stamp_ns) * 1e-9
    assert moved_s == pytest.approx(-LATE_S["wheel_odometry"], abs=WITHIN_S["wheel_odometry"])
    assert measured[1].imu is measured[0].imu
    assert not any(offset.is_significant for offset in find_clocks(after)[0].clocks.offsets.values())


def test_a_sensor_on_another_clock_is_excluded_until_the_recipe_states_the_offset(drive_log):
    """The remedy includes what the recipe adds already: here all of the offset."""
    log = drive_log(1, 31)
    good, off = streams_of(log), streams_of(log, ReadConfig(time_offset_s={"gnss": 18.0}))
    before, after = (fuse_run(streams, FuseConfig(), run_id="run").info for streams in (good, off))
    findings = after.report.findings
    (finding,) = select_findings(findings, "clocks-differ")
    assert (finding.subject.name, finding.severity, finding.action) == ("gnss", "error", "excluded")
    assert finding.numbers["offset_s"] == pytest.approx(18.0, abs=0.03)
    assert proposed(finding)["read"]["time_offset_s"] == {"gnss": pytest.approx(0.0, abs=0.03)}
    assert sort_findings(findings)[0] is finding
    more = {each.code for each in findings} - {each.code for each in before.report.findings}
    assert more <= {"clocks-differ", "local-frame", "odometry-scale-unobservable"}
    assert "gnss" not in after.report.facts.fuse.sensors
    assert is_clock_doubtful(off, after)
    assert not is_clock_doubtful(good, before)


def test_a_short_drive_says_what_it_cannot_tell(tmp_path):
    """One start and one stop in half a minute, fixes of a metre: their clock is not spoken of, the gyroscope's is."""
    tiny = find_scenario("tiny")
    drive = tiny.drives[0]
    sensors = replace(drive.sensors, gnss=replace(drive.sensors.gnss, std_m=1.0, rate_hz=1.0))
    faults = replace(drive.faults, gnss_noise=True, wheel_noise=True, imu_noise=True)
    found = doctor(log_of(tiny, replace(drive, sensors=sensors, faults=faults), tmp_path))
    assert "gnss" not in found.facts.offsets
    assert found.findings == ()
    assert not any(pair.determined for pair in found.facts.pairs if pair.late == "gnss")


def driving(gap_s, *, moves):
    """Wheels and fixes at 1 m/s with a gap after 10 s, in which the robot ``moves`` on or the clock was set forward."""
    true_s = np.arange(0.0, 20.0, 0.1)
    stamp_s = np.where(true_s < 10.0, true_s, true_s + gap_s)
    place = np.column_stack((stamp_s if moves else true_s, np.zeros((200, 2))))
    stamp_ns, one = np.round(stamp_s * 1e9).astype(np.int64), np.ones((200, 3))
    wheels = BodyVelocities(stamp_ns, one, one, one[:, 0])
    return Section(0, Measurements(gnss=Positions(stamp_ns, place, one), wheels=wheels))


def test_a_gap_of_all_sensors_in_which_the_robot_did_not_drive_is_a_step_of_their_clock():
    ((after_ns, finding),) = find_clock_jumps([driving(3.0, moves=False)])
    assert (after_ns, finding.code) == (13 * 10**9, "clock-step")
    assert (finding.numbers["at_s"], finding.numbers["step_s"]) == pytest.approx((13.0, 3.1))
    assert not list(find_clock_jumps([driving(3.0, moves=True)]))
    assert not list(find_clock_jumps([driving(0.2, moves=False)]))
    alone = replace(driving(3.0, moves=False).measurements, gnss=None)
    assert not list(find_clock_jumps([Section(0, alone)]))
