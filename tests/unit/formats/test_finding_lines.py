"""Findings become lines in one place: the worst first, at most eight, with their remedy and code; notes are counted."""

from dataclasses import replace

import pytest

from tcpipe.formats.finding_lines import (
    describe_finding,
    format_findings,
    format_group,
    format_groups,
    format_number,
    format_remedy_blocks,
    format_verdict,
    group_findings,
    list_findings,
)
from tcpipe.tables.findings import Remedy, Subject, Verdict, judge, judge_again, make_finding

COMMAND = Subject("role", "command")
NOTE = make_finding("no-command", COMMAND)
EMPTY = make_finding("no-segments", Subject("run", "a"), names={"reason": "gap"}, driven_m=12.0, lost_m=10.04)


def slow(fraction):
    numbers = {"slow_fraction": fraction, "limit_mps": 0.95, "top_mps": 0.6}
    keep = Remedy("keep", recipe={"mask": {"require_full_speed": False}})
    return make_finding("driven-below-limit", COMMAND, remedies=[keep], **numbers)


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("late_s", 0.12345, "0.123 s"),
        ("share_fraction", 0.5, "50 %"),
        ("row_count", 12345.0, "12345"),
        ("angle_rad", 0.1, "5.73°"),
    ],
)
def test_numbers_have_the_unit_of_their_suffix_and_three_digits(name, value, text):
    assert format_number(name, value) == text


def test_a_line_says_what_was_observed_what_to_do_and_its_code():
    (line,) = format_findings([slow(0.7)])
    observed = "warning: 70 % of the moving track was commanded below 0.95 m/s; the top command was 0.6 m/s"
    assert line == f"{observed}. To accept any speed: [mask] require_full_speed = false [driven-below-limit]"


def test_the_worst_comes_first_at_most_eight_and_notes_are_counted_apart():
    findings = [NOTE, *(slow(0.1 * n) for n in range(1, 10)), EMPTY]
    lines = format_findings(findings, more="tcpipe inspect RUN")
    assert len(lines) == 9
    assert lines[0].startswith("error: no segments from 12 m driven; largest loss: gap, 10 m")
    assert lines[-1] == "and 2 more findings and 1 note: tcpipe inspect RUN"
    assert len(list_findings(findings)) == 11
    assert format_findings([NOTE]) == ["and 1 note"]
    assert format_findings([]) == []


def test_a_recipe_that_fits_in_no_line_stands_below_its_finding():
    source = {"type": "std_msgs/msg/Float32", "topic": "/current", "current": "data", "rail": "a", "sign": "auto"}
    found = replace(slow(0.7), remedies=(Remedy("keep", recipe={"power_sources": [source]}),))
    line, *block = format_findings([found])
    assert line.endswith("To accept any speed: the recipe below [driven-below-limit]")
    assert block[:2] == ["    [[power_sources]]", '    type = "std_msgs/msg/Float32"']
    assert format_remedy_blocks([found, found]) == [line.strip() for line in block]


def test_findings_of_several_runs_are_one_line_a_code():
    groups = group_findings([("a", [NOTE, slow(0.6)]), ("b", [slow(0.7)]), ("c", [EMPTY, NOTE])], 3)
    assert [(group.code, list(group.of)) for group in groups] == [
        ("no-segments", ["c"]), ("driven-below-limit", ["a", "b"]), ("no-command", ["a", "c"])
    ]  # fmt: skip
    assert format_group(groups[0]).startswith("c: no segments from 12 m driven")
    title = "Most of the drive was commanded below the robot's maximum speed"
    assert (
        format_group(groups[1])
        == f"2 of 3 runs: {title} (command; 60 % to 70 %). To accept any speed: [mask] require_full_speed = false [driven-below-limit]"
    )
    assert format_groups(groups, more="tcpipe report STORE")[-1] == "and 1 note: tcpipe report STORE"


def test_a_finding_of_another_version_or_without_its_fields_is_a_line_all_the_same():
    assert describe_finding(replace(NOTE, code="no-such-code")) == "command: no such code"
    assert "?" in describe_finding(replace(EMPTY, names={}))
    old = replace(slow(0.7), remedies=(Remedy("gone", recipe={"no_such_table": {"key": 1}}),))
    assert "gone: [no_such_table] key = 1" in format_findings([old])[0]


def test_a_verdict_is_one_line_and_judged_again_by_another_catalogue():
    assert format_verdict(Verdict()) == "position, time and energy usable"
    assert format_verdict(judge([slow(0.7)])) == "time usable with care; position and energy usable"
    old = Verdict(catalogue="another")
    assert judge_again(old, [EMPTY]) == judge([EMPTY])
    assert judge_again(Verdict(), [EMPTY]) == Verdict()
