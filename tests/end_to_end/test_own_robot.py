"""A robot that no profile knows, with a power message of its own, described in a recipe alone."""

import json
import struct

import numpy as np
import pytest
from mcap.writer import Writer
from simulated_streams import log_of, streams_of
from stored_files import manifest

from tcpipe.errors import DatasetError
from tcpipe.pipeline.dataset.runs import choose_runs
from tcpipe.pipeline.ingest import ingest
from tcpipe.recipe import Recipe
from tcpipe.simulation import make_tiny
from tcpipe.store import Store
from tcpipe.tables.bits import Quality
from tcpipe.tables.columns import to_floats, to_integers

RECIPE = """
robot = "scout"

[read]
ignore_topics = ["{theirs}"]

[robots.scout]
width_m = 0.6
length_m = 0.9
max_velocity_mps = 1.0
voltage_range_volt = [20.0, 30.0]

[[power_sources]]
type = "my_msgs/msg/Battery"
voltage = "bus.v"
current = "amps[0] + amps[1]"
averaged = {averaged}
sign = "drawn_negative"
"""
DEFINITION = f"Bus bus\nfloat64[2] amps\n{'=' * 80}\nMSG: my_msgs/Bus\nfloat64 v\n"


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A simulated drive's log, the same power as messages of a type of our own, and the recipe that says what they mean."""
    directory, scenario = tmp_path_factory.mktemp("own"), make_tiny()
    log = log_of(scenario, scenario.drives[0], directory / "site")
    streams = streams_of(log)
    table = streams.tables["power"]
    columns = (to_integers(table, "stamp_ns"), to_floats(table, "voltage_volt"), to_floats(table, "current_amp"))
    with (directory / "battery.mcap").open("wb") as out:
        writer = Writer(out)
        writer.start()
        schema = writer.register_schema("my_msgs/msg/Battery", "ros2msg", DEFINITION.encode())
        channel = writer.register_channel("/battery", "cdr", schema)
        for stamp_ns, volt, amp in zip(*(values.tolist() for values in columns), strict=True):
            payload = b"\0\1\0\0" + struct.pack("<ddd", volt, -0.25 * amp, -0.75 * amp)
            writer.add_message(channel, stamp_ns, payload, stamp_ns)
        writer.finish()
    recipe = directory / "tcpipe.toml"
    theirs, averaged = streams.sensors["power"].topic, str(streams.power_averaged).lower()
    recipe.write_text(RECIPE.format(theirs=theirs, averaged=averaged))
    return log, directory / "battery.mcap", recipe


def segments(store, result):
    return run_of(store, result).segments()


def run_of(store, result):
    (run,) = Store(store).find_runs(f"{result.run.run_id}/{result.run.recipe_id}")
    return run


def test_its_energy_is_that_of_the_same_drive_in_known_messages(drive, tmp_path):
    log, battery, recipe = drive
    (known,) = ingest([log], store=tmp_path / "store", recipe=Recipe(), robot="husky").results
    (ours,) = ingest([log, battery], store=tmp_path / "store", recipe=recipe, as_one=True).results
    assert (ours.status, ours.run.robot) == ("done", "scout")
    report = run_of(tmp_path / "store", ours).manifest.info.report
    assert not [of for of in report.findings if of.subject.name == "power"]
    one, other = (segments(tmp_path / "store", result) for result in (known, ours))
    assert one.num_rows == other.num_rows > 5
    assert set(other["robot"].to_pylist()) == {"scout"}
    np.testing.assert_allclose(to_floats(other, "energy_joule"), to_floats(one, "energy_joule"), rtol=1e-12)
    again = ingest([log, battery], store=tmp_path / "store", recipe=recipe, as_one=True).results[0]
    assert again.status == "unchanged"
    assert (
        json.loads(manifest(run_of(tmp_path / "store", ours)).read_text())["recipe"]["robots"]["scout"]["width_m"]
        == 0.6
    )
    with pytest.raises(DatasetError, match="no run of robot 'scout'"):  # the default recipe's runs know no scout
        choose(tmp_path / "store", Recipe(), "scout")


def choose(store, recipe, robot):
    return choose_runs(Store(store), recipe, state=Store(store).scan(), robot=robot, tags={})


def test_another_voltage_range_is_another_run(drive, tmp_path):
    log, battery, recipe = drive
    narrow = tmp_path / "narrow.toml"
    narrow.write_text(recipe.read_text().replace("[20.0, 30.0]", "[29.0, 30.0]"))
    both = [
        ingest([log, battery], store=tmp_path / "store", recipe=of, as_one=True).results[0] for of in (recipe, narrow)
    ]
    assert both[0].run.recipe_id != both[1].run.recipe_id
    flagged = [
        segments(tmp_path / "store", result)["quality"].to_numpy() & np.uint32(Quality.VOLTAGE_OUT_OF_RANGE)
        for result in both
    ]
    assert not flagged[0].any()
    assert flagged[1].any()
