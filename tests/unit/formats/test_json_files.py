"""JSON documents as dataclasses: what is written is read again, and what does not fit is named by file and key."""

import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tcpipe.errors import StoreError
from tcpipe.formats.json_files import parse_typed, parse_typed_json, read_as, to_compact_json, to_json, write_json


@dataclass(frozen=True, slots=True)
class Counts:
    """How many of what."""

    segments: int
    lost_m: float | None = None


@dataclass(frozen=True, slots=True)
class Document:
    """A document."""

    counts: Counts
    names: tuple[str, ...] = ()
    place_m: tuple[float, float] = (0.0, 0.0)
    by_role: Mapping[str, Counts] = field(default_factory=dict)


@pytest.mark.parametrize("write", [to_json, to_compact_json])
def test_the_name_of_a_file_that_is_no_text_is_read_again(write):
    document = Document(Counts(1), ("/logs/a\udcff.mcap",))
    assert parse_typed_json(write(document), Document, "it") == document


def test_what_is_written_is_read_again(tmp_path):
    document = Document(Counts(3, 0.5), ("a", "ü"), (1.0, -2.0), {"imu": Counts(0)})
    write_json(tmp_path / "document.json", document)
    assert read_as(tmp_path / "document.json", Document) == document


def test_keys_that_are_missing_have_defaults_unknown_ones_are_left_aside_and_a_whole_number_is_a_number():
    document = parse_typed({"counts": {"segments": 1, "lost_m": 2, "later": []}, "new": None}, Document, Path("x"))
    assert document == Document(Counts(1, 2.0))


@pytest.mark.parametrize(
    ("value", "line"),
    [
        ({}, "counts is missing"),
        ({"counts": {}}, "counts.segments is missing"),
        ({"counts": {"segments": "3"}}, "counts.segments: expected a whole number, got a text"),
        ({"counts": {"segments": 0.5}}, "counts.segments: expected a whole number, got a number"),
        ({"counts": {"segments": True}}, "counts.segments: expected a whole number, got true or false"),
        ({"counts": {"segments": 1, "lost_m": []}}, "counts.lost_m: expected a number or null, got a list"),
        ({"counts": None}, "counts: expected an object, got null"),
        ({"counts": {"segments": 1}, "names": ["a", 1]}, "names[1]: expected a text, got a whole number"),
        ({"counts": {"segments": 1}, "place_m": [1.0]}, "place_m: expected a list of length 2"),
        ({"counts": {"segments": 1}, "by_role": {"imu": {}}}, "by_role[...].segments is missing"),
    ],
)
def test_what_does_not_fit_is_named_by_file_and_key(tmp_path, value, line):
    path = tmp_path / "document.json"
    path.write_text(json.dumps(value))
    with pytest.raises(StoreError) as caught:
        read_as(path, Document)
    assert str(caught.value).removesuffix(", got 1") == f"{path}: does not have the format of this version: {line}"


def test_threads_that_meet_a_document_at_once_all_read_it():
    """In a process of its own: msgspec alone would end it."""
    program = """
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from tcpipe.formats.json_files import parse_typed, to_plain
from tcpipe.formats.runs import LogOrigin

sys.setswitchinterval(1e-6)
known, together = LogOrigin(("a.mcap",), "b", 1), Barrier(8)

def read(_):
    together.wait()
    return parse_typed(to_plain(known), LogOrigin, "a document")

with ThreadPoolExecutor(8) as pool:
    assert set(map(repr, pool.map(read, range(8)))) == {repr(known)}
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)
