"""Power that no topic plays, or that is refused: the recipe as the commands print it gives labels with energy."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from changed_drives import NAMES, energy_ratio, make
from click.testing import CliRunner
from stored_files import only_run

from tcpipe.cli import cli
from tcpipe.formats.logs.writing import MessageStream, write_mcap
from tcpipe.simulation.route import Wander

FLOAT = "std_msgs/msg/Float32"


@pytest.fixture(scope="module")
def drive():
    return make(Wander(35.0, (110.0, 30.0)))


def bare(stamp_ns, name, values):
    return MessageStream(name, FLOAT, stamp_ns, {"data": np.asarray(values, np.float64)})


def floats_of(drive, kind):
    """The drive with its power in Float32 topics: one voltage and current, or several ESCs in mA on one rail beside others."""
    every = slice(None, None, 10)
    truth = drive.truth
    stamp_ns, volt, amp, right = (
        values[every] for values in (truth.stamp_ns, truth.voltage_volt, truth.current_amp, truth.right_share)
    )
    if kind == "one":
        made = [bare(stamp_ns, "/bus/voltage", volt), bare(stamp_ns, "/bus/current", amp)]
    else:
        made = [bare(stamp_ns, "/bus/voltage", volt), bare(stamp_ns, "/bus/current", amp + 2.0)]
        made += [bare(stamp_ns, f"/esc{i}/current", 1000.0 * amp * part) for i, part in enumerate((right, 1.0 - right))]
    image = MessageStream("/camera/image", "sensor_msgs/msg/Image", stamp_ns[:100], {})
    return [*drive.without("power").messages, *made, image]


def run(*words):
    return CliRunner().invoke(cli, [str(word) for word in words], standalone_mode=False)


def block_of(output):
    """The lines of a recipe that a command prints, as they are."""
    lines = [line.strip() for line in output.splitlines()]
    first = next(at for at, line in enumerate(lines) if line.startswith("["))
    rest = (at for at, line in enumerate(lines) if at > first and not (line.startswith("[") or " = " in line))
    return "\n".join(lines[first : next(rest, len(lines))])


@pytest.mark.parametrize("kind", ["one", "escs in mA"])
def test_bare_numbers_are_read_by_the_recipe_as_it_is_printed(drive, tmp_path, kind):
    log = tmp_path / "run.mcap"
    write_mcap(log, floats_of(drive, kind))
    told = run("inspect", log).output, run("ingest", log, "--store", tmp_path / "without").output
    block = block_of(told[1])
    # `inspect` prints the recipe of `init`, uncertain lines of which are comments.
    proposed = told[0].partition("# Proposed by tcpipe")[2].partition("\n")[2]
    lines = (line.removeprefix("# ") for line in proposed.splitlines() if line.startswith("[") or " = " in line)
    values = tomllib.loads("\n".join(lines))
    assert {key: values[key] for key in ("read", "power_sources")} == tomllib.loads(block)
    for output in told:
        assert any("/bus/voltage" in line for line in output.splitlines() if line.endswith("[power-candidates]"))
    (tmp_path / "tcpipe.toml").write_text(block + "\n")
    cured = run("ingest", log, "--store", tmp_path / "with", "--recipe", tmp_path / "tcpipe.toml")
    assert "[no-power]" not in cured.output
    assert energy_ratio(drive, tmp_path / "with") == pytest.approx(1.0, abs=0.03)


def test_currents_in_milliamperes_come_first_and_are_cured_by_the_recipe_as_it_is_printed(drive, tmp_path):
    other = tuple(
        replace(m, columns={n: 1000.0 * v if "current" in n else v for n, v in m.columns.items()})
        if m.topic == NAMES["power"]
        else m
        for m in drive.messages
    )
    log = tmp_path / "run.mcap"
    write_mcap(log, other)
    told = run("ingest", log, "--store", tmp_path / "without").output
    assert any(line.strip().startswith("error: ") for line in told.splitlines() if line.endswith("[power-rejected]"))
    run("report", tmp_path / "without")
    page = Path(only_run(tmp_path / "without").folder.where("report.html"))
    verdict = page.read_text().split('class="verdict"')[1].split("</section>")[0]
    assert "energy <b>not usable</b>" in verdict
    assert "current_scale = 0.001" in verdict.split("[power-rejected]")[1].split("</pre>")[0]
    (tmp_path / "tcpipe.toml").write_text(block_of(told) + "\n")
    run("ingest", log, "--store", tmp_path / "with", "--recipe", tmp_path / "tcpipe.toml")
    assert energy_ratio(drive, tmp_path / "with") == pytest.approx(1.0, abs=0.03)
