"""One drive that two computers recorded counts once; two robots that drive together are two drives."""

from dataclasses import replace

import numpy as np
import pytest
from changed_drives import make
from installed_command import tcpipe

from tcpipe.formats.logs.writing import write_bag, write_mcap
from tcpipe.formats.recipe_toml import load_recipe
from tcpipe.pipeline.dataset.inputs import remove_duplicates
from tcpipe.pipeline.dataset.runs import choose_runs
from tcpipe.pipeline.ingest import ingest
from tcpipe.simulation.route import Wander
from tcpipe.store import Store


def take(store):
    return remove_duplicates(choose_runs(store, load_recipe(None), state=store.scan(), robot=None, tags={}).runs)


def trim(message, begin, late_ns):
    """Return the messages after a share ``begin`` of them, received later."""
    if message.latched:
        return message
    first = int(begin * len(message.log_time_ns))
    columns = {name: values[first:] for name, values in message.columns.items()}
    return replace(message, log_time_ns=message.log_time_ns[first:] + late_ns, columns=columns)


def move_east(columns):
    noise_deg = np.random.default_rng(7).normal(0, 5e-8, len(columns["latitude"]))
    return {"longitude": columns["longitude"] + 1.5 / 76_000 + noise_deg}


@pytest.fixture(scope="module")
def drive():
    return make(Wander(35.0, (110.0, 30.0)))


def test_one_drive_in_an_mcap_and_a_trimmed_bag_counts_once(drive, tmp_path):
    write_mcap(tmp_path / "a.mcap", drive.messages)
    write_bag(tmp_path / "b.bag", [trim(message, 0.3, 20_000_000) for message in drive.messages])
    assert ingest([tmp_path / "a.mcap", tmp_path / "b.bag"], store=tmp_path / "store").exit_code in (0, 3)
    found = take(Store(tmp_path / "store"))
    (finding,) = found.findings
    assert finding.code == "drive-recorded-twice"
    assert finding.numbers["duplicate_count"] >= finding.numbers["segment_count"] - 1


def test_each_answer_to_the_question_works_when_it_is_typed(drive, tmp_path):
    """Two receivers of one drive, on computers that share no sensor, cannot be distinguished from two robots."""
    logs = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    write_mcap(logs[0], drive.without("imu", "visual").messages)
    other = drive.without("wheels").changed("gnss", move_east)
    topics = [replace(each, topic=f"/rover{each.topic}") if "fix" in each.topic else each for each in other.messages]
    write_mcap(logs[1], topics)
    assert ingest(logs, store=tmp_path / "tcpipe-store").exit_code in (0, 3)
    store = Store(tmp_path / "tcpipe-store")
    (question,) = take(store).findings
    assert question.code == "drives-overlap"
    remedies = {remedy.name: remedy.command.split()[1:] for remedy in question.remedies}
    assert tcpipe(*remedies["two_robots"], cwd=tmp_path).returncode in (0, 3)
    assert take(store).findings == ()
    assert tcpipe(*remedies["one_drive"], cwd=tmp_path).returncode in (0, 3)
    (answered,) = take(store).findings
    assert answered.code == "drive-recorded-twice"
