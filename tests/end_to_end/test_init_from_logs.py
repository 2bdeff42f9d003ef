"""A robot without a profile: ``init --from`` its log, at most two lines edited, and ``ingest`` gives labels with energy.

Four robots, of one simulated drive each; their energies are compared with the truth.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from changed_drives import NAMES, energy_ratio, make
from click.testing import CliRunner

from tcpipe.cli import cli
from tcpipe.formats.logs.writing import MessageStream, write_mcap
from tcpipe.formats.recipe_toml import parse_recipe, parse_toml
from tcpipe.simulation.route import Wander

SOLUTION = "std_msgs/Header header\nfloat64 lat\nfloat64 lon\nfloat32 height\nuint8 quality\n"
WHEELS = [f"{end}_{side}_wheel_joint" for end in ("front", "rear") for side in ("left", "right")]
HUSKY = {"gnss": "[0.1, 0.0, 0.9]", "imu": "[0.05, -0.1, 0.3], rpy_rad = [3.1416, 0.0, 1.5708]"}
"""Where the simulated robot's sensors sit, as somebody would measure it."""


@pytest.fixture(scope="module")
def drive():
    return make(Wander(25.0, (110.0, 30.0)))


def run(*words):
    return CliRunner().invoke(cli, [str(word) for word in words], standalone_mode=False)


def renamed(drive, *without):
    """The messages of a robot whose topics no profile knows."""
    names = {name: name.replace("/a200_0000/", "/").replace("platform/", "") for name in NAMES.values()}
    return [replace(stream, topic=names[stream.topic]) for stream in drive.without(*without).messages]


def stamped(stamp_ns, **columns):
    stamps = {"sec": (stamp_ns // 10**9).astype(np.int32), "nanosec": (stamp_ns % 10**9).astype(np.uint32)}
    return {**{f"header.stamp.{name}": of for name, of in stamps.items()}, **columns}


def power_at(drive, every=10):
    rows = slice(None, None, every)
    truth = drive.truth
    return tuple(values[rows] for values in (truth.stamp_ns, truth.voltage_volt, truth.current_amp, truth.right_share))


def watts(drive):
    stamp_ns, volt, amp, _ = power_at(drive)
    return [
        *renamed(drive, "power"),
        MessageStream("/base/power_w", "std_msgs/msg/Float32", stamp_ns, {"data": volt * amp}),
    ]


def joints(drive):
    stamp_ns, volt, amp, _ = power_at(drive)
    speed = np.interp(stamp_ns, drive.truth.stamp_ns, drive.truth.wheel_velocity_mps) / 0.165
    torque = np.maximum(volt * amp, 0.0) / np.where(np.abs(speed) > 0.05, speed, np.inf) / len(WHEELS)
    columns = stamped(stamp_ns, velocity=np.stack([speed] * 4, 1), effort=np.stack([torque] * 4, 1))
    stream = MessageStream("/joint_states", "sensor_msgs/msg/JointState", stamp_ns, columns, {"name": WHEELS})
    return [*renamed(drive, "power"), stream]


def own_fixes(drive):
    (fixes,) = (stream for stream in drive.messages if stream.topic == NAMES["gnss"])
    columns = {name: fixes.columns[name] for name in fixes.columns if name.startswith("header.stamp")}
    names = {"lat": "latitude", "lon": "longitude", "height": "altitude"}
    columns |= {name: fixes.columns[of] for name, of in names.items()}
    columns["quality"] = np.where(fixes.columns["status.status"] < 0, 0, 4).astype(np.uint8)
    frame = {"header.frame_id": fixes.constants["header.frame_id"]}
    own = MessageStream(
        "/rtk/solution", "acme_gnss/msg/Solution", fixes.log_time_ns, columns, frame, definition=SOLUTION
    )
    return [*renamed(drive, "gnss"), own]


def unplaced(drive):
    return [stream for stream in renamed(drive) if "tf" not in stream.topic]


def followed(text, *, removing):
    """The recipe with the lines that a person edits, and how many these are."""
    lines, edited = text.splitlines(), 0
    for number, line in enumerate(lines):
        key = re.match(r"# ([\w.]+) = ", line)
        if key and key[1] in removing:
            edited += 1
            place = HUSKY.get(key[1])
            lines[number] = f"{key[1]} = {{ xyz_m = {place} }}" if place else line.removeprefix("# ")
    return "\n".join(lines) + "\n", edited


@pytest.mark.parametrize(
    ("robot", "removing", "tolerance"),
    [
        (watts, ("power", "power_sources"), 0.03),
        (joints, ("power_sources",), 0.1),
        (own_fixes, ("gnss.quality",), 0.03),
        (unplaced, ("gnss", "imu"), 0.03),
    ],
)
def test_an_unknown_robot_needs_two_lines(drive, tmp_path, *, robot, removing, tolerance):
    log, recipe = tmp_path / "run.mcap", tmp_path / "tcpipe.toml"
    write_mcap(log, robot(drive))
    assert run("init", tmp_path, "--from", log).exit_code == 0
    proposed = recipe.read_text()
    everything = re.sub(r"^# (?=\[|\w+(\.\w+)* = )", "", proposed, flags=re.MULTILINE)
    parse_recipe(parse_toml(everything.replace("?", "0.1")), where="every comment removed, places measured")
    text, edited = followed(proposed, removing=removing)
    assert edited == len(removing) <= 2
    recipe.write_text(text)
    done = run("ingest", log, "--store", tmp_path / "store", "--recipe", recipe)
    (energy,) = re.findall("verdict: energy .*", done.output)
    assert "usable" in energy
    assert "not usable" not in energy
    assert "[no-gnss]" not in done.output
    assert energy_ratio(drive, tmp_path / "store") == pytest.approx(1.0, abs=tolerance)


def test_inspect_preflight_and_init_propose_the_same(drive, tmp_path):
    log = tmp_path / "run.mcap"
    write_mcap(log, joints(drive))
    inspected, expected = (run(command, log, "--robot", "generic").stdout for command in ("inspect", "preflight"))
    (tmp_path / "acme_msgs" / "msg").mkdir(parents=True)
    (tmp_path / "acme_msgs" / "msg" / "Other.msg").write_text("float32 data\n")
    call = ("init", tmp_path, "--from", log, "--robot", "generic", "--msgdef", tmp_path)
    run(*call)
    written = (tmp_path / "tcpipe.toml").read_text()
    assert expected.endswith(written)
    # `inspect` reads the first messages only: a value of them may be zero
    assert without_values(inspected).endswith(without_values(written))
    again = run(*call)
    assert "nothing to do" in again.output


def without_values(text):
    return re.sub(r"(?<=messages), [^;\n]*", "", text)


def test_a_recipe_settles_what_inspect_and_preflight_propose(drive, tmp_path):
    log, recipe = tmp_path / "run.mcap", tmp_path / "tcpipe.toml"
    write_mcap(log, unplaced(drive))
    recipe.write_text("[read.extrinsics]\nimu = { xyz_m = [0.1, 0.0, 0.2] }\n[read.topics]\nvisual_odometry = []\n")
    for command in ("inspect", "preflight"):
        output = run(command, log, "--recipe", recipe).output
        assert "at [0.1, 0.0, 0.2] m (recipe)" in output
        proposed = output.partition("These need no line.")[2]
        assert re.findall(r"^# (\w+) = ", proposed, flags=re.MULTILINE) == ["gnss"]
