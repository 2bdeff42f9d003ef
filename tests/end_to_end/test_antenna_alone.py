"""A folder of CSV files with fixes of an antenna, power and an IMU at 1 Hz, by the recipe that ``init --from`` proposes."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from tcpipe.cli import cli
from tcpipe.geometry.rotation import rotate
from tcpipe.simulation import compute_true_cost
from tcpipe.simulation.route import Leg, Pause, Reverse
from tcpipe.simulation.scenarios import DriveSpec, RasterSpec, Scenario, make_small_world
from tcpipe.simulation.sensors import Gnss, Imu, Mounting, Sensors
from tcpipe.simulation.site_files import simulate_readings
from tcpipe.store import Store
from tcpipe.tables.columns import to_floats, to_integers

ARM_M = (0.3, 0.0, 0.4)
PLAN = (
    Pause(2.0),
    Leg(((30.0, 34.0),)),
    Pause(1.0),
    Reverse(6.0),
    Pause(1.0),
    Leg(((30.0, 45.0), (14.0, 48.0))),
    Pause(2.0),
)


def run(*words):
    done = CliRunner().invoke(cli, [str(word) for word in words], standalone_mode=False)
    assert done.exception is None, done.output


def write(path, stamp_ns, **columns):
    header = ",".join(("timestamp (ns)", *columns))
    rows = np.column_stack((stamp_ns, *(values.astype(str) for values in columns.values())))
    path.write_text("\n".join((header, *map(",".join, rows.astype(str)))) + "\n")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Return the truth of a drive that reverses in its middle, and its only run."""
    here = tmp_path_factory.mktemp("antenna")
    (here / "log").mkdir()
    sensors = Sensors(gnss=Gnss(mounting=Mounting(ARM_M), outage_s=0.0), imu=Imu(rate_hz=1.0))
    spec = DriveSpec("antenna", PLAN, (14.0, 34.0), sensors=sensors)
    scenario = Scenario("antenna", make_small_world(), (spec,), ((1.0, 1.0), (80.0, 1.0), (80.0, 79.0)), RasterSpec())
    truth, readings = simulate_readings(scenario)
    fixes, imu = readings["gnss"], readings["imu"]
    names = {"latitude (deg)": "lat_deg", "longitude (deg)": "lon_deg", "alt_msl (m)": "alt_m"}
    place = {name: fixes.values[value] for name, value in names.items()}
    write(here / "log/gps.csv", fixes.stamp_ns, **place, fix_quality=np.full(fixes.stamp_ns.size, 4))
    step = slice(None, None, 40)
    write(here / "log/power.csv", truth.stamp_ns[step], **{"Power (w)": truth.power_watt[step]})
    motion = {f"Angular_Velocity_{a} (rad/s)": imu.values["angular_velocity_radps"][:, k] for k, a in enumerate("xyz")}
    motion |= {f"Linear_Acceleration_{a} (m/s²)": imu.values["specific_force_mps2"][:, k] for k, a in enumerate("xyz")}
    write(here / "log/imu.csv", imu.stamp_ns, **motion)
    run("init", "--from", here / "log", here)
    run("ingest", here / "log", "--recipe", here / "tcpipe.toml", "--store", here / "store", "--quiet")
    (found,) = Store(here / "store").runs()
    return truth, found


def test_the_proposed_recipe_keeps_nearly_all_metres_also_those_driven_backward(drive):
    truth, found = drive
    distance_m = found.manifest.distance_by_reason_m
    assert distance_m["kept"] > 0.6 * truth.distance_m[-1]
    assert distance_m["reversing"] < 0.5
    backward = truth.at(to_integers(found.segments(), "start_ns")).forward_velocity_mps < -0.3
    assert backward.sum() >= 3
    codes = [finding.code for finding in found.manifest.info.report.findings]
    assert codes.count("track-of-antenna") == codes.count("direction-assumed") == codes.count("imu-too-slow") == 1
    assert "sensor-not-placed" not in codes


def test_labels_are_those_of_the_metres_of_the_antenna(drive):
    truth, found = drive
    segments = found.segments()
    place = rotate(truth.quat_xyzw, np.broadcast_to(ARM_M, truth.enu_m.shape))
    true = compute_true_cost(replace(truth, enu_m=truth.enu_m + place), to_integers(segments, "start_ns"))
    for quantity, unit in (("duration", "s"), ("energy", "joule")):
        label, std = to_floats(segments, f"{quantity}_{unit}"), to_floats(segments, f"{quantity}_std_{unit}")
        error = label - getattr(true, f"{quantity}_{unit}")
        assert np.mean(np.abs(error) < 2.0 * std) > 0.9
        assert abs(np.mean(error)) < 0.03 * np.mean(label)
