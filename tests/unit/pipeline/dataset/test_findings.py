"""What ingest found reaches the dataset: by cause, with its runs and samples, and the doubtful as one number."""

import numpy as np
import pyarrow as pa
import pytest
from synthetic_store import add_run, add_world, lanes, segments

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError
from tcpipe.formats.dataset_card import RunSource
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.dataset.findings import doubt_in_words, doubtful, findings_in_words, findings_of_runs
from tcpipe.recipe import Recipe
from tcpipe.store import open_store
from tcpipe.tables.bits import Quality

LATE = "gnss: its stamps seem {} s late against imu (± 0.01 s, by speed)"


def run(run_id, samples, *warnings):
    return RunSource(run_id, "r", "husky", (), "", warnings=warnings, samples=samples)


def test_lines_that_differ_by_their_figures_are_one_cause():
    runs = [run("a", 10, LATE.format("0.21"), "power: none"), run("b", 30, LATE.format("-1.3e-2")), run("c", 5)]
    late, power = findings_of_runs(runs)
    assert (late.example, late.runs, late.samples) == (LATE.format("0.21"), ("a", "b"), 40)
    assert (power.runs, power.samples) == (("a",), 10)
    assert findings_in_words((late, power)) == [
        f"found at ingest of 2 runs (40 samples): {LATE.format('0.21')}",
        "found at ingest of a (10 samples): power: none",
    ]


def test_a_topic_of_another_name_is_no_other_cause():
    lines = [f"gnss: {topic}: 53 of 2266 messages are not used" for topic in ("/a200_0000/fix", "/navsat/fix")]
    (found,) = findings_of_runs([run("a", 1, lines[0]), run("b", 2, lines[1])])
    assert found.samples == 3
    assert len(findings_of_runs([run("a", 1, "power: at 1 Hz / averaged", "power: at 1 Hz or averaged")])) == 2


def test_many_causes_are_cut_and_counted():
    lines = findings_in_words(findings_of_runs([run("a", 1, *(f"cause {'x' * n}" for n in range(1, 12)))]))
    assert len(lines) == 9
    assert lines[-1].startswith("found at ingest: 3 more causes")


def test_any_bit_makes_a_sample_doubtful_once():
    both = Quality.NEAR_GAP | Quality.CURVED
    found = doubtful(pa.chunked_array([pa.array([0, int(both), int(Quality.CURVED), 0], pa.uint16())]))
    assert (found.samples, found.share, found.by_bit) == (2, 0.5, {"near_gap": 1, "curved": 2})
    assert doubt_in_words(found, 4) == "doubtful: 2 of 4 samples (50.0 %) carry a quality flag: 2 curved, 1 near gap"
    nothing = doubtful(pa.chunked_array([pa.array([], pa.uint16())]))
    assert (nothing.samples, nothing.share, nothing.by_bit) == (0, 0.0, {})


def test_where_no_position_is_sure_enough_it_is_said_how_sure_and_what_ingest_found(tmp_path):
    store = open_store(tmp_path / "store", create=True)
    add_world(store, tmp_path)
    table = segments("a", *lanes([0.0], -10.0, 10.0))
    place = table.column_names.index("position_std_m")
    table = table.set_column(place, table.schema.field(place), pa.array(np.full(table.num_rows, 0.3)))
    add_run(store, "a", table, warnings=(LATE.format(0.4),))
    with pytest.raises(DatasetError) as caught:
        build_dataset(tmp_path / "out", store=store.root, recipe=Recipe())
    nothing, how_sure, found = caught.value.problems
    assert "20 m position uncertain" in nothing
    assert "known to 0.30 m" in how_sure
    assert "max_position_std_m" in how_sure
    assert found == f"found at ingest of a (0 samples): {LATE.format(0.4)}"


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    directory = tmp_path_factory.mktemp("found")
    store = open_store(directory / "store", create=True)
    add_world(store, directory)
    for number, run_id in enumerate("ab"):
        table = segments(run_id, *lanes([4.0 * number], -10.0, 10.0), start_ns=number * 10**12)
        place = table.column_names.index("quality")
        bits = np.where(np.arange(table.num_rows) < 5 * number, int(Quality.WEAK_GNSS), 0)
        table = table.set_column(place, table.schema.field(place), pa.array(bits, table.schema.field(place).type))
        add_run(store, run_id, table, warnings=(LATE.format(0.1 * number + 0.1),))
    return build_dataset(directory / "out", store=store.root, recipe=Recipe()), directory / "out"


def test_they_stand_in_the_commands_answer_the_card_the_page_and_what_is_opened(built):
    result, place = built
    assert "doubtful: 5 of 40 samples (12.5 %) carry a quality flag: 5 weak gnss" in str(result)
    assert f"found at ingest of 2 runs (40 samples): {LATE.format(0.1)}" in str(result)
    card = open_dataset(place).card
    assert (card.doubtful.samples, card.doubtful.share) == (5, 0.125)
    assert [(finding.runs, finding.samples) for finding in card.findings] == [(("a", "b"), 40)]
    page = (place / "report.html").read_text()
    assert "12.5 %" in page
    assert "What ingest found of the runs" in page
