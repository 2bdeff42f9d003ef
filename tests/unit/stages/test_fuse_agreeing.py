"""Which sensor is left out where they contradict each other: the one that is alone, or the one without which the others agree."""

import numpy as np
import pytest

from tcpipe.errors import FusionError
from tcpipe.fusion.checks.audit import Tally
from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, Measurements, Positions
from tcpipe.recipe import FuseConfig
from tcpipe.stages import fuse as stage
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_sections import Fused
from tcpipe.tables.facts import SensorChecks
from tcpipe.tables.findings import Remedy, StageReport, Subject
from tcpipe.tables.levels import Sensor, Streams

STAMP_NS = np.arange(5, dtype=np.int64)
ROLES = ("gnss", "imu", "wheel_odometry", "visual_odometry")
STREAMS = Streams({}, {role: Sensor(f"/{role}", "x/msg/Y", role, "why") for role in ROLES}, "husky")
NOTHING = StageReport((), SensorChecks())


def odometry():
    return BodyVelocities(STAMP_NS, np.zeros((5, 3)), np.ones((5, 3)), np.zeros(5), np.ones(5))


def inputs(*, visual=True, imu=True):
    quat = np.full((5, 4), np.nan)
    heard = Measurements(
        gnss=Positions(STAMP_NS, np.zeros((5, 3)), np.ones((5, 3))),
        imu=InertialMeasurements(STAMP_NS, np.zeros((5, 3)), np.zeros((5, 3)), quat, 0.01, 0.1) if imu else None,
        wheels=odometry(),
        visual=odometry() if visual else None,
    )
    return FusionInputs((15.0, 47.0, 400.0), {0: heard})


def contradicted(windows, *, alone=0, sensor="visual_odometry"):
    return [Tally(sensor, "displacement", 20, windows, alone)]


@pytest.fixture
def fusing(monkeypatch):
    """Fuse by a table: what the audit says of each set of sensors; all others are contradicted."""
    tried = []

    def put(told, lost=()):
        def fuse(given, *_):
            (heard,) = given.measurements.values()
            tried.append(frozenset(heard.sensors()))
            tallies = told.get(tried[-1], contradicted(15))
            astray = 12 if tried[-1] in lost else 0
            return Fused(found=[None], tallies=tallies, windows=20, astray=astray)

        monkeypatch.setattr(stage, "fuse_sections", fuse)
        return tried

    return put


def agreed(given):
    found, sanity, _ = stage.fuse_agreeing(given, NOTHING, STREAMS, FuseConfig(), run=Subject("run", "r"))
    return set(found.measurements[0].sensors()), sanity


def test_sensors_that_agree_are_fused_once(fusing):
    tried = fusing({frozenset(ROLES): contradicted(2)})
    sensors, sanity = agreed(inputs())
    assert (sensors, sanity.facts.excluded, len(tried)) == (set(ROLES), {}, 1)


def test_one_that_is_alone_in_most_of_the_way_is_left_out(fusing):
    tried = fusing({frozenset(ROLES): contradicted(0, alone=15, sensor="gnss")})
    sensors, sanity = agreed(inputs())
    assert sensors == set(ROLES) - {"gnss"}
    assert len(tried) == 2 + len(ROLES)
    (finding,) = sanity.findings
    assert (finding.code, finding.subject.name, finding.names["topic"]) == ("contradicted-by-others", "gnss", "/gnss")
    assert finding.remedies == (Remedy("exclude", {"read.topics": {"gnss": []}}),)


def test_fixes_against_one_odometry_are_left_out_without_being_blamed(fusing):
    """An IMU confirms how wheels turn, not how far they go: whoever knows that they err leaves them out instead."""
    every = frozenset(ROLES) - {"visual_odometry"}
    fusing({every: contradicted(0, alone=15, sensor="gnss")})
    sensors, sanity = agreed(inputs(visual=False))
    assert sensors == {"imu", "wheel_odometry"}
    (finding,) = sanity.findings
    assert (finding.subject.name, finding.names["suspect"]) == ("gnss", "wheel_odometry")
    assert finding.remedies == (Remedy("exclude_suspect", {"read.topics": {"wheel_odometry": []}}),)


def test_the_one_without_which_the_others_agree_is_left_out(fusing):
    fusing({frozenset(ROLES) - {"imu"}: contradicted(1)})
    sensors, sanity = agreed(inputs())
    assert sensors == set(ROLES) - {"imu"}
    assert list(sanity.facts.excluded) == ["imu"]


def test_where_either_of_two_would_do_nobody_can_tell_and_none_is_left_out(fusing):
    fusing({frozenset(ROLES) - {role}: contradicted(1) for role in ("imu", "gnss")})
    sensors, sanity = agreed(inputs())
    assert (sensors, sanity.facts.excluded) == (set(ROLES), {})


def test_of_several_it_is_the_one_whose_others_confirm_each_other_though_another_stands_alone(fusing):
    """An IMU that leads the track off the fixes: without the fixes nothing tells what wheels and IMU tell, so they agree."""
    every = frozenset(ROLES) - {"visual_odometry"}
    ways = [Tally(role, "displacement", 20, 0, 0) for role in ("gnss", "wheel_odometry")]
    turns = [Tally("imu", "turn", 20, 0, 0)]
    fusing(
        {
            every: contradicted(0, alone=15, sensor="gnss"),
            every - {"imu"}: ways,
            every - {"gnss"}: [ways[1], *turns],
        }
    )
    sensors, sanity = agreed(inputs(visual=False))
    assert sensors == {"gnss", "wheel_odometry"}
    assert list(sanity.facts.excluded) == ["imu"]


def test_of_two_sensors_nobody_can_tell_and_nothing_is_tried(fusing):
    tried = fusing({frozenset({"gnss"}): contradicted(0), frozenset({"wheel_odometry"}): contradicted(0)})
    sensors, _ = agreed(inputs(visual=False, imu=False))
    assert sensors == {"gnss", "wheel_odometry"}
    assert len(tried) == 1


@pytest.mark.parametrize("visual", [True, False])
def test_of_a_track_that_goes_astray_the_imu_is_tried_first(fusing, visual):
    roles = frozenset(ROLES) if visual else frozenset(ROLES) - {"visual_odometry"}
    fusing({roles: contradicted(0)}, lost=[roles])
    sensors, sanity = agreed(inputs(visual=visual))
    assert sensors == roles - {"imu"}
    assert sanity.facts.excluded == {"imu": "misleads-track"}


def test_a_track_that_goes_astray_without_its_imu_too_is_mended_by_the_only_other_that_does(fusing):
    roles = frozenset(ROLES)
    lost = [roles, *(roles - {role} for role in ("imu", "gnss", "wheel_odometry"))]
    fusing({roles: contradicted(0)}, lost=lost)
    assert agreed(inputs())[0] == roles - {"visual_odometry"}
    fusing({roles: contradicted(0)}, lost=lost[:-1])  # either of two: nobody can tell
    with pytest.raises(FusionError):
        agreed(inputs())


def test_a_track_that_goes_astray_whatever_is_left_out_is_refused(fusing):
    roles = frozenset(ROLES)
    fusing({roles: contradicted(0)}, lost=[roles, *(roles - {role} for role in roles)])
    with pytest.raises(FusionError) as error:
        agreed(inputs())
    (finding,) = error.value.findings
    assert (finding.code, finding.numbers) == ("track-contradicts-sensors", {"astray_fraction": 0.6})
