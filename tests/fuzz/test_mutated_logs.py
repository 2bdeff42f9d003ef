"""A few mutations of each container, always the same; the campaign of ten thousand is ``python benchmarks/faults.py mutations``."""

import importlib.util
import sys
from pathlib import Path

import pytest

_spec = importlib.util.spec_from_file_location("mutated_logs", Path(__file__).with_name("mutated_logs.py"))
mutated_logs = importlib.util.module_from_spec(_spec)
sys.modules[_spec.name] = mutated_logs
_spec.loader.exec_module(mutated_logs)

COUNT = 240


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    return {clean.kind: clean for clean in mutated_logs.clean_logs(tmp_path_factory.mktemp("logs"))}


def test_nothing_is_lost_or_changed_unsaid():
    found = list(mutated_logs.findings(COUNT, seed=1))
    assert [finding.what for finding in found if finding.verdict == "silent"] == []
    assert {finding.verdict for finding in found} >= {"refused", "same", "told"}


def test_the_oracle_sees_what_is_lost_or_changed(logs):
    """A reader that forgets messages, or what it knows of damage, would be found."""
    clean = logs["mcap, plain, crc"]
    assert mutated_logs.judged(clean, clean.data, set()) == ("same", "")
    payload = next(iter(clean.rows))
    forgotten = mutated_logs.Clean(
        "", clean.data, clean.rows + type(clean.rows)([("/color", 1, "{}")]), clean.own, (), (), ()
    )
    assert mutated_logs.judged(forgotten, clean.data, set())[0] == "silent"
    changed = type(clean.rows)(
        {("/color", 1, "{}") if row == payload else row: count for row, count in clean.rows.items()}
    )
    other = mutated_logs.Clean("", clean.data, changed, clean.own, (), (), ())
    assert mutated_logs.judged(other, clean.data, set())[0] == "silent"


def test_a_message_owns_its_bytes_only(logs):
    clean = logs["db3, 4096"]
    owned = [byte for byte, rows in enumerate(clean.own) if rows]
    assert 0 < len(owned) < len(clean.data) / 2
    assert not any(logs["mcap, zstd, crc"].own)
