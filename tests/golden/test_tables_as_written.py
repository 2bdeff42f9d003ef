"""Tables as loggers write them, against plain sums over their rows by the csv module: power in watts, counters, currents, wheels."""

import csv
import io
import math
from itertools import pairwise

import numpy as np
import pytest

from tcpipe.formats.logs.log_joining import open_logs
from tcpipe.formats.recipe_toml import load_profiles, parse_recipe
from tcpipe.pipeline.ingest import ingest
from tcpipe.power.rails import integrate_recorded_energy
from tcpipe.stages.message_arrays import make_rails
from tcpipe.stages.read import find_read_config, read_run
from tcpipe.tables.columns import to_floats

ROWS = 400
WHEELS = {
    "file": "run_*.csv",
    "columns": {"linear_x": "(left_kmh + right_kmh) / 7.2", "angular_z": "(right_kmh - left_kmh) / 3.6 / 0.6"},
    "units": {"linear_x": "m/s", "angular_z": "rad/s"},
}


def written(volt: float = 24.0) -> str:
    """A log of 20 s at 20 Hz: times in ms from 0, wheels, current, power and a counter of what was drawn."""
    lines, joule = ["t (ms),left_kmh,right_kmh,I [mA],Power (w),used_Wh"], 0.0
    for k in range(ROWS):
        amp = 5.0 + 2.0 * math.sin(k / 9.0) + (k % 7) / 7.0
        joule += volt * amp * 0.05 if k else 0.0
        lines.append(f"{50 * k},{3.6 + k % 3},{4.0 + k % 2},{1000 * amp:.6f},{volt * amp:.8f},{joule / 3600:.12f}")
    return "\n".join(lines) + "\n"


def rows(text: str) -> list[dict[str, float]]:
    return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(io.StringIO(text))]


def read(folder, power: dict):
    recipe = parse_recipe(
        {"tables": {"wheel_odometry": WHEELS, "power": {"file": "run_*.csv", **power}}}, where="recipe"
    )
    with open_logs([folder / "run_07.csv"], tables=recipe.tables) as log:
        return read_run(log, find_read_config(recipe, log.topics), robot="generic", known=load_profiles(recipe))


@pytest.fixture
def folder(tmp_path):
    for number in ("07", "08"):
        (tmp_path / f"run_{number}.csv").write_text(written())
    return tmp_path


def energy_joule(streams) -> float:
    rails = make_rails(streams, 0)
    rule = "averaged" if streams.power_averaged else "exact"
    ends = np.array([0]), np.array([10**12])
    return float(integrate_recorded_energy(rails, *ends, rule=rule)[0])


def test_watts_currents_at_a_nominal_voltage_and_counters_are_one_energy(folder):
    table = rows(written())
    trapezoid = sum(0.025 * (a["Power (w)"] + b["Power (w)"]) for a, b in pairwise(table))
    counted = 3600.0 * (table[-1]["used_Wh"] - table[1]["used_Wh"])  # a mean needs a row before
    for power, wanted in (
        ({"columns": {"power": "Power (w)"}}, trapezoid),
        ({"columns": {"current": "I [mA]"}, "nominal_voltage_volt": 24.0}, trapezoid),
        (
            {
                "columns": {"current": "`I [mA]` / 2 + `I [mA]` / 2"},
                "units": {"current": "mA"},
                "nominal_voltage_volt": 24.0,
            },
            trapezoid,
        ),
        ({"columns": {"energy": "used_Wh"}}, counted),
    ):
        assert energy_joule(read(folder, power)) == pytest.approx(wanted, rel=1e-9), power


def test_wheels_of_two_sides_are_a_velocity_and_a_yaw_rate(folder):
    odometry = read(folder, {"columns": {"power": "Power (w)"}}).tables["wheel_odometry"]
    table = rows(written())
    forward = [(row["left_kmh"] + row["right_kmh"]) / 2 / 3.6 for row in table]
    turn = [(row["right_kmh"] - row["left_kmh"]) / 3.6 / 0.6 for row in table]
    assert to_floats(odometry, "velocity_x_mps").tolist() == pytest.approx(forward, rel=1e-12)
    assert to_floats(odometry, "angular_velocity_z_radps").tolist() == pytest.approx(turn, rel=1e-12)
    assert np.diff(odometry["stamp_ns"].to_numpy()).tolist() == [50_000_000] * (ROWS - 1)


def test_an_assumed_voltage_is_said_and_widens_the_gain_and_watts_have_no_voltage(folder):
    nominal = {"columns": {"current": "I [mA]"}, "nominal_voltage_volt": 24.0, "nominal_voltage_std_fraction": 0.05}
    report = read(folder, nominal).report
    (found,) = [of for of in report.findings if of.code == "voltage-assumed"]
    assert (found.numbers["voltage_volt"], found.numbers["std_fraction"]) == (24.0, 0.05)
    assert report.facts.power.gain_std_fraction == pytest.approx(math.hypot(0.02, 0.05))
    watts = read(folder, {"columns": {"power": "Power (w)"}}).report
    assert not [of for of in watts.findings if of.code == "voltage-assumed"]
    assert (watts.facts.power.gain_std_fraction, watts.facts.power.offset_std_amp) == (0.02, 5.0)


def test_the_files_of_one_number_are_one_run_and_a_missing_one_costs_its_own(folder, tmp_path):
    (folder / "imu_07.csv").write_text(
        "time_s,x,y,z,ax,ay,az\n" + "".join(f"{k / 100},0,0,0,0,0,9.8\n" for k in range(2000))
    )
    axes = {f"angular_velocity_{axis}": axis for axis in "xyz"} | {
        f"linear_acceleration_{axis}": f"a{axis}" for axis in "xyz"
    }
    power = {"file": "run_*.csv", "columns": {"power": "Power (w)"}}
    tables = {"wheel_odometry": WHEELS, "power": power, "imu": {"file": "imu_*.csv", "columns": axes}}
    recipe = parse_recipe({"tables": tables}, where="recipe")
    done, failed = ingest([folder], store=tmp_path / "store", recipe=recipe).results
    assert (done.status, done.run.run_id.rpartition("-")[0]) == ("done", f"{folder.name}_imu_07")
    assert failed.status == "failed"
    assert "there is no imu_08.csv here" in failed.problems[0]
    (again,) = ingest([folder / "run_07.csv"], store=tmp_path / "store", recipe=recipe).results
    assert (again.status, again.run.run_id) == ("unchanged", done.run.run_id)
