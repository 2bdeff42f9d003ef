"""Findings reach the dataset: those of runs by code, its own, and one verdict; the page shows the worst first."""

import re

import numpy as np
import pyarrow as pa
import pytest
from made_tracks import with_columns
from synthetic_store import add_run, lanes, open_world, segments

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError
from tcpipe.formats.dataset_card import RunSource, group_dataset_findings, judge_dataset
from tcpipe.formats.finding_lines import format_groups
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.dataset.card import count_flagged
from tcpipe.pipeline.report import report
from tcpipe.recipe import Recipe
from tcpipe.tables.bits import Quality
from tcpipe.tables.findings import Subject, make_finding, select_findings

ROLE = Subject("role", "command")


def slow(fraction):
    return make_finding("driven-below-limit", ROLE, slow_fraction=fraction, limit_mps=0.95, top_mps=0.5)


def run(run_id, samples, *findings):
    return RunSource(run_id, "r", "husky", (), "", findings=findings, samples=samples)


def lines(*runs, own=()):
    return format_groups(group_dataset_findings(own, {of.run_id: of.findings for of in runs}), more="inspect")


def test_findings_of_one_code_are_one_line_with_how_many_runs_and_the_range():
    first, more = lines(run("a", 10, slow(0.6)), run("b", 30, slow(0.9), make_finding("no-command", ROLE)), run("c", 5))
    assert first == (
        "warning: 2 of 3 runs: Most of the drive was commanded below the robot's maximum speed (command; 60 % to 90 %) "
        "[driven-below-limit]"
    )
    assert more == "and 1 note: inspect"


def test_findings_of_the_dataset_on_runs_count_runs_that_are_left_out():
    gone = [make_finding("run-gone", Subject("run", name)) for name in ("x", "y")]
    assert lines(run("a", 1), own=gone)[0] == "warning: 2 of 3 runs: Run no longer in the store (x, y) [run-gone]"
    assert lines(run("a", 1), own=gone[:1])[0] == "warning: x: no longer in the store [run-gone]"


def test_the_verdict_is_by_runs_that_have_samples_with_one_reason_a_code():
    bad = make_finding("no-segments", Subject("run", "b"), names={"reason": "x"}, driven_m=9.0, lost_m=9.0)
    verdict = judge_dataset((), [run("a", 9, slow(0.6)), run("c", 9, slow(0.9)), run("b", 0, bad)], ())
    assert (verdict.position, verdict.time, verdict.energy) == ("usable", "usable with care", "usable")
    assert len(verdict.reasons) == 1


def test_a_bit_that_every_sample_carries_is_not_counted():
    both = Quality.NEAR_GAP | Quality.CURVED
    found = count_flagged(pa.chunked_array([pa.array([0, int(both), int(Quality.CURVED), 0], pa.uint16())]))
    assert (found.samples, found.share, found.by_bit) == (2, 0.5, {"near_gap": 1, "curved": 2})
    bits = int(Quality.NO_COMMAND) + np.array([0, 0, 0, int(Quality.CURVED)])
    found = count_flagged(pa.chunked_array([pa.array(bits, pa.uint16())]))
    assert (found.samples, found.share, found.by_bit) == (1, 0.25, {"no_command": 4, "curved": 1})
    nothing = count_flagged(pa.chunked_array([pa.array([], pa.uint16())]))
    assert (nothing.samples, nothing.share, nothing.by_bit) == (0, 0.0, {})


def test_where_no_position_is_sure_enough_it_is_said_how_sure_and_what_ingest_found(tmp_path):
    store = open_world(tmp_path)
    table = segments("a", *lanes([0.0], -10.0, 10.0))
    add_run(store, "a", with_columns(table, position_std_m=np.full(table.num_rows, 0.3)), findings=(slow(0.6),))
    with pytest.raises(DatasetError) as caught:
        build_dataset(tmp_path / "out", store=store.root, recipe=Recipe())
    nothing, how_sure, found = caught.value.problems
    assert "20 m position uncertain" in nothing
    assert "known to 0.30 m" in how_sure
    assert "max_position_std_m" in how_sure
    assert found.startswith("warning: a: ")
    assert "[driven-below-limit]" in found


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    directory = tmp_path_factory.mktemp("found")
    store = open_world(directory)
    for number, run_id in enumerate("ab"):
        table = segments(run_id, *lanes([4.0 * number], -10.0, 10.0), start_ns=number * 10**12)
        bits = np.where(np.arange(table.num_rows) < 5 * number, int(Quality.WEAK_GNSS), 0) | int(Quality.NO_COMMAND)
        add_run(store, run_id, with_columns(table, quality=bits), findings=(slow(0.1 * number + 0.6),))
    result = build_dataset(directory / "out", store=store.root, recipe=Recipe())
    report(directory / "out")
    return result, directory / "out"


def test_they_stand_in_the_commands_answer_the_card_and_what_is_opened(built):
    result, place = built
    assert "warning: 2 of 2 runs: Most of the drive was commanded below" in str(result)
    assert "verdict: position · usable\nverdict: time · usable with care\nverdict: energy · usable" in str(result)
    card = open_dataset(place).card
    assert (card.flagged_samples.samples, card.flagged_samples.share) == (5, 0.125)
    (flagged,) = select_findings(card.findings, "samples-flagged")
    assert (flagged.severity, flagged.names) == ("warning", {"flag": "weak_gnss"})
    assert card.findings_by_run == result.card.findings_by_run == {"a": (slow(0.6),), "b": (slow(0.7),)}
    assert card.verdict == result.card.verdict


def test_the_page_has_one_verdict_with_the_worst_first_and_no_praise(built):
    page = (built[1] / "report.html").read_text()
    box = page.split('aria-label="Verdict"')[1].split("</section>")[0]
    assert re.findall(r"(position|time|energy) <b>([a-z ]+)</b>", box) == [
        ("position", "usable"), ("time", "usable with care"), ("energy", "usable"),
    ]  # fmt: skip
    severities = re.findall(r'<li class="(error|warning|note)">', box)
    assert severities == sorted(severities, key=["error", "warning", "note"].index)
    assert "Good" not in box
    assert f'"flags":{int(Quality.WEAK_GNSS)}' in page  # the bit of all samples colours nothing


@pytest.mark.parametrize("holdout", ["sample", "block", "run"])
def test_a_split_that_shares_ground_is_never_told_to_hold_out_as_it_does(tmp_path, holdout):
    store = open_world(tmp_path)
    for number, run_id in enumerate("abc"):
        add_run(store, run_id, segments(run_id, *lanes(0.2 * number, -10.0, 10.0), start_ns=number * 10**15))
    built = build_dataset(tmp_path / "out", store=store.root, recipe=Recipe(), holdout=holdout)
    found = [of for of in select_findings(built.findings, "split-leakage") if of.subject.name == "test"]
    assert found or holdout == "block"
    assert all(remedy.recipe != {"split": {"holdout": holdout}} for of in found for remedy in of.remedies)
