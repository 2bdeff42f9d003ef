"""Power of joints: messages of sensor_msgs/JointState through the installed command; the energy that numpy makes of the same numbers."""

import re
from pathlib import Path

import numpy as np
import pytest
from changed_drives import make
from installed_command import tcpipe

from tcpipe.formats.logs.writing import MessageStream, write_mcap
from tcpipe.simulation.route import Wander
from tcpipe.store import Store
from tcpipe.tables.columns import to_floats, to_integers

TYPE, TOPIC = "sensor_msgs/msg/JointState", "/joint_states"
WHEELS = ("front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel")
RECIPE = f"""
[[power_sources]]
type = "{TYPE}"
joints = "(front|rear)_(left|right)_wheel"
loss_watt_per_nm2 = 0.05
"""
STEP_NS, LOSS = 20_000_000, 0.05


@pytest.fixture(scope="module")
def drive():
    return make(Wander(30.0, (110.0, 30.0))).without("power")


def joints_of(drive):
    """Return stamps [ns], torques [N m] and speeds [rad/s] of four wheels, shape (N, 4); the inner wheels brake now and then."""
    stamp_ns = np.arange(drive.truth.stamp_ns[0], drive.truth.stamp_ns[-1], STEP_NS)
    t = (stamp_ns - stamp_ns[0])[:, None] * 1e-9
    k = np.arange(4)
    torque = 6.0 + 8.0 * np.sin(0.9 * t + k) + 0.5 * np.cos(7.0 * t)
    speed = 5.0 + np.cos(0.4 * t - k)
    return stamp_ns, torque, speed


def messages_of(stamp_ns, torque, speed, *, stream_of=0):
    """Return the wheels in one order or, with an arm among them, in another."""
    order = (0, 1, 2, 3) if stream_of == 0 else (3, 1, 0, 2)
    names = [WHEELS[k] for k in order]
    effort, velocity = torque[:, order], speed[:, order]
    if stream_of:
        names.insert(2, "arm_wheel_lift")
        effort, velocity = np.insert(effort, 2, 300.0, axis=1), np.insert(velocity, 2, 2.0, axis=1)
    values = {"effort": effort, "velocity": velocity, "position": np.zeros_like(effort)}
    columns = {name: np.ascontiguousarray(value) for name, value in values.items()}
    header = {"header.stamp.sec": stamp_ns // 10**9, "header.stamp.nanosec": stamp_ns % 10**9}
    return MessageStream(TOPIC, TYPE, stamp_ns, {**header, **columns}, {"name": names})


def ingest(directory: Path, drive, streams, recipe=RECIPE):
    write_mcap(directory / "run.mcap", [*drive.messages, *streams])
    (directory / "tcpipe.toml").write_text(recipe)
    done = tcpipe("ingest", "run.mcap", "--store", "store", cwd=directory)
    (run,) = Store(directory / "store").runs()
    return done.stdout + done.stderr, run


def energy_of(run, stamp_ns, watt):
    """Return the integral of straight lines between samples over each segment [J]."""
    at, begin, end = (
        np.asarray(of - stamp_ns[0]) * 1e-9
        for of in (stamp_ns, *(to_integers(run.segments(), f"{name}_ns") for name in ("start", "end")))
    )
    energy = []
    for first, last in zip(begin, end, strict=True):
        nodes = np.concatenate(([first], at[(at > first) & (at < last)], [last]))
        power = np.interp(nodes, at, watt)
        energy.append(np.sum(0.5 * (power[1:] + power[:-1]) * np.diff(nodes)))
    return np.array(energy)


def joint_watt(torque, speed):
    return torque * speed + LOSS * torque**2


def test_energy_is_the_sum_of_torque_times_speed_and_the_loss(drive, tmp_path):
    stamp_ns, torque, speed = joints_of(drive)
    odd = np.arange(len(stamp_ns)) % 3 == 1
    streams = [
        messages_of(*(of[rows] for of in (stamp_ns, torque, speed)), stream_of=i) for i, rows in enumerate((~odd, odd))
    ]
    arm = MessageStream(
        TOPIC, TYPE, stamp_ns[5::50] + 3, {}, {"name": ["arm_lift"], "effort": np.ones(1), "velocity": np.ones(1)}
    )
    printed, run = ingest(tmp_path, drive, [*streams, arm])
    each = joint_watt(torque, speed)
    assert (each < 0.0).mean() > 0.05
    drawn = np.maximum(each, 0.0)
    expected = energy_of(run, stamp_ns, drawn.sum(axis=1))
    assert len(expected) > 15
    np.testing.assert_allclose(to_floats(run.segments(), "energy_joule"), expected, rtol=1e-9)
    assert run.segments()["voltage_volt"].null_count == len(expected)
    assert run.track().table["current_amp"].null_count == run.track().table.num_rows
    line = next(line for line in printed.splitlines() if line.endswith("[power-from-joints]"))
    loss, returned = LOSS * np.sum(torque**2) / drawn.sum(), (drawn - each).sum() / drawn.sum()
    assert all(f"{100 * share:.3g} %" in line for share in (loss, returned)), line
    assert "mechanical power" in line
    assert "not electrical" in line
    sensor = run.manifest.info.report.facts.label.power_sensor
    assert sensor.gain_std_fraction == pytest.approx(np.hypot(0.1 * (1 + loss), 0.3 * loss), rel=1e-6)
    assert sensor.offset_std_amp == 0.0
    common = to_floats(run.segments(), "energy_common_std_joule")
    assert np.all(common >= 0.999 * sensor.gain_std_fraction * expected)


def test_what_is_given_back_counts_where_the_recipe_says_so_and_units_and_signs_are_its_own(drive, tmp_path):
    stamp_ns, torque, speed = joints_of(drive)
    recipe = (
        RECIPE + 'recovered = true\nsign = "drawn_negative"\ntorque_scale = 0.001\nspeed_scale = 0.10471975511965977\n'
    )
    rpm = speed * 30.0 / np.pi
    _, run = ingest(tmp_path, drive, [messages_of(stamp_ns, -1000.0 * torque, rpm)], recipe)
    expected = energy_of(run, stamp_ns, joint_watt(torque, speed).sum(axis=1))
    np.testing.assert_allclose(to_floats(run.segments(), "energy_joule"), expected, rtol=1e-6)


def test_sides_with_a_loss_each_are_rails_that_are_summed(drive, tmp_path):
    stamp_ns, torque, speed = joints_of(drive)
    sides = "".join(
        f'\n[[power_sources]]\ntype = "{TYPE}"\njoints = ".*_{side}_wheel"\nrail = "{side}"\nloss_watt_per_nm2 = {loss}\n'
        for side, loss in (("left", 0.02), ("right", 0.3))
    )
    _, run = ingest(tmp_path, drive, [messages_of(stamp_ns, torque, speed)], sides)
    each = torque * speed + np.array([0.02, 0.3, 0.02, 0.3]) * torque**2
    expected = energy_of(run, stamp_ns, np.maximum(each, 0.0).sum(axis=1))
    np.testing.assert_allclose(to_floats(run.segments(), "energy_joule"), expected, rtol=1e-9)


def test_efforts_that_are_missing_leave_segments_without_energy(drive, tmp_path):
    stamp_ns, torque, speed = joints_of(drive)
    lost = (np.arange(len(stamp_ns)) > 0.4 * len(stamp_ns)) & (np.arange(len(stamp_ns)) < 0.5 * len(stamp_ns))
    holes = torque.copy()
    holes[lost, 2] = np.nan
    printed, run = ingest(tmp_path, drive, [messages_of(stamp_ns, holes, speed)])
    energy = to_floats(run.segments(), "energy_joule")
    begin, end = (to_integers(run.segments(), f"{name}_ns") for name in ("start", "end"))
    touches = (end > stamp_ns[lost][0]) & (begin < stamp_ns[lost][-1])
    assert not np.isfinite(energy[touches]).any()
    assert np.isfinite(energy[~touches]).all()
    watt, at_ns = to_floats(run.track().table, "power_watt"), to_integers(run.track().table, "stamp_ns")
    first, last = stamp_ns[lost][[0, -1]]
    assert np.isnan(watt[(at_ns > first) & (at_ns < last)]).all()
    assert np.isfinite(watt[(at_ns < first) | (at_ns > last) & (at_ns < stamp_ns[-2])]).all()
    assert "[power-gaps]" in printed


@pytest.mark.parametrize(
    ("change", "recipe", "reasons"),
    [
        (lambda torque: np.full_like(torque, np.nan), RECIPE, "no-effort.*front_left_wheel"),
        (lambda torque: -np.abs(torque), RECIPE, "torque-against-motion"),
        (np.asarray, RECIPE.replace("(front|rear)_(left|right)", "middle"), "no-joint.*middle_wheel.*front_left_wheel"),
        (np.asarray, RECIPE + RECIPE.replace("(front|rear)", "front"), "joint-in-two-tables.*front_left_wheel"),
    ],
)
def test_what_cannot_be_power_is_rejected_with_the_reason(drive, tmp_path, change, recipe, reasons):
    stamp_ns, torque, speed = joints_of(drive)
    printed, run = ingest(tmp_path, drive, [messages_of(stamp_ns, change(torque), speed)], recipe)
    (line,) = [line for line in printed.splitlines() if line.endswith("[power-rejected]")]
    assert re.search(reasons, line)
    assert run.segments()["energy_joule"].null_count == run.segments().num_rows


def test_joints_without_a_table_are_no_power_and_inspect_names_the_lines(drive, tmp_path):
    stamp_ns, torque, speed = joints_of(drive)
    printed, run = ingest(tmp_path, drive, [messages_of(stamp_ns, torque, speed)], "")
    assert "[no-power]" in printed
    assert run.segments()["energy_joule"].null_count == run.segments().num_rows
    told = tcpipe("inspect", "run.mcap", cwd=tmp_path).stdout
    assert re.search(r"/joint_states.*joints = ", told)
