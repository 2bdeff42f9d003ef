"""Any command on a dataset after one that writes: neither hinders the other, and afterwards there is nothing to build."""

import itertools
import shutil

import pytest
from synthetic_store import add_run, lanes, open_world, segments

import tcpipe
from tcpipe.formats.dataset_files import read_samples
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.diff import diff
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.report import report
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder with a store and the dataset that was built from it."""
    here = tmp_path_factory.mktemp("pairs")
    store = open_world(here)
    for number, run_id in enumerate("abcde"):
        table = segments(run_id, *lanes((-8.0 + 4.0 * number,), -10.0, 10.0), start_ns=number * 10**13)
        add_run(store, run_id, table)
    build(here)
    return here


def build(here):
    return build_dataset(here / "dataset", store=here / "store", recipe=Recipe())


def explain_one(here):
    sample_id = read_samples(here / "dataset", ["sample_id"]).column("sample_id")[0].as_py()
    explain(sample_id, dataset=here / "dataset", store=here / "store")


COMMANDS = {
    "build": build,
    "report": lambda here: report(here / "dataset"),
    "report of the store": lambda here: report(here / "store"),
    "verify": lambda here: verify(here / "dataset"),
    "diff": lambda here: diff(here / "dataset", here / "dataset"),
    "explain": explain_one,
    "train": lambda here: tcpipe.train(here / "dataset", here / "model", model="linear"),
}


PAIRS = [*zip(itertools.cycle(("build", "report", "train")), COMMANDS)]
"""Each command after one that writes."""


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_two_commands_in_sequence_leave_a_whole_dataset_with_nothing_to_build(built, tmp_path, first, second):
    here = shutil.copytree(built, tmp_path / "here", copy_function=shutil.copy2)
    COMMANDS[first](here)
    COMMANDS[second](here)
    assert verify(here / "dataset").problems == ()
    again = build(here)
    assert (again.exit_code, again.foreign_files) == (0, ())
    assert verify(here / "store").problems == ()
