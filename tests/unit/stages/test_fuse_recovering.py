"""Which sensor is left out where the track contradicts all of them: the one without which it recovers."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.errors import FusionError
from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, Measurements, Positions
from tcpipe.recipe import FuseConfig
from tcpipe.stages import fuse as stage
from tcpipe.stages.fuse_inputs import Section
from tcpipe.stages.fuse_sections import Fused
from tcpipe.tables.findings import Subject
from tcpipe.tables.levels import Sensor, Streams

STAMP_NS = np.arange(5, dtype=np.int64)
ROLES = ("gnss", "imu", "wheel_odometry", "visual_odometry")
STREAMS = Streams({}, {role: Sensor(f"/{role}", "x/msg/Y", role, "why") for role in ROLES}, "husky")


def odometry():
    return BodyVelocities(STAMP_NS, np.zeros((5, 3)), np.ones((5, 3)), np.zeros(5), np.ones(5))


def inputs(*, visual=True, imu=True, wheels=True):
    quat = np.full((5, 4), np.nan)
    heard = Measurements(
        gnss=Positions(STAMP_NS, np.zeros((5, 3)), np.ones((5, 3))),
        imu=InertialMeasurements(STAMP_NS, np.zeros((5, 3)), np.zeros((5, 3)), quat, 0.01, 0.1) if imu else None,
        wheels=odometry() if wheels else None,
        visual=odometry() if visual else None,
    )
    return Section(0, heard, datum_deg_m=(15.0, 47.0, 400.0))


@pytest.fixture
def fusing(monkeypatch):
    """Fuse sets of sensors of which some lead a track astray."""
    tried = []

    def put(lost=()):
        def fuse(given, *_):
            tried.append(frozenset(given.measurements.sensors()))
            return Fused(found=[None], windows=20, astray=12 if tried[-1] in lost else 0)

        monkeypatch.setattr(stage, "fuse_section", fuse)
        return tried

    return put


def recovered(given):
    found, _ = stage.fuse_recovering(given, STREAMS, FuseConfig(), run=Subject("run", "r"))
    return set(found.measurements.sensors()), {role: of.code for role, of in found.excluded.items()}


def test_a_track_that_follows_its_sensors_is_fused_once(fusing):
    tried = fusing()
    sensors, excluded = recovered(inputs())
    assert (sensors, excluded, len(tried)) == (set(ROLES), {}, 1)


@pytest.mark.parametrize("visual", [True, False])
def test_of_a_track_that_goes_astray_the_imu_is_tried_first(fusing, visual):
    roles = frozenset(ROLES) if visual else frozenset(ROLES) - {"visual_odometry"}
    fusing(lost=[roles])
    sensors, excluded = recovered(inputs(visual=visual))
    assert sensors == roles - {"imu"}
    assert excluded == {"imu": "misleads-track"}


def test_a_track_that_goes_astray_without_its_imu_too_is_mended_by_the_only_other_that_does(fusing):
    roles = frozenset(ROLES)
    lost = [roles, *(roles - {role} for role in ("imu", "gnss", "wheel_odometry"))]
    fusing(lost=lost)
    assert recovered(inputs())[0] == roles - {"visual_odometry"}
    fusing(lost=lost[:-1])  # either of two: nobody can tell
    with pytest.raises(FusionError):
        recovered(inputs())


def test_a_track_that_goes_astray_whatever_is_left_out_is_refused(fusing):
    roles = frozenset(ROLES)
    fusing(lost=[roles, *(roles - {role} for role in roles)])
    with pytest.raises(FusionError) as error:
        recovered(inputs())
    (finding,) = error.value.findings
    assert (finding.code, finding.numbers) == ("track-contradicts-sensors", {"astray_fraction": 0.6})


def test_an_epoch_that_contradicts_every_sensor_costs_only_its_own_track(fusing):
    roles = frozenset(ROLES) - {"visual_odometry"}
    fusing(lost=[roles, *(roles - {role} for role in roles)])
    sections = [inputs(), replace(inputs(visual=False), clock_epoch=1)]
    _, fused, (error,) = stage.fuse_sections(sections, STREAMS, FuseConfig(), run=Subject("run", "r"))
    assert (fused.windows, fused.astray) == (20, 0)
    assert [finding.code for finding in error.findings] == ["track-contradicts-sensors"]


@pytest.mark.parametrize("imu", [False, True])
def test_a_single_sensor_of_motion_that_contradicts_itself_is_named_and_not_to_be_excluded(fusing, imu):
    fusing(lost=[frozenset({"gnss"}), frozenset({"gnss", "imu"})])
    with pytest.raises(FusionError) as error:
        recovered(inputs(imu=imu, visual=False, wheels=False))
    (finding,) = error.value.findings
    assert (finding.code, finding.subject.name) == ("sensor-contradicts-itself", "gnss")
