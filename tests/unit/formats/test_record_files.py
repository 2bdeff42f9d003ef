"""Records: a fact is one file, whoever writes it; the first wins; what is broken is named and written again."""

import errno
import json
import os
import subprocess
import sys
from dataclasses import dataclass

import pytest

from tcpipe.formats.atomic import put_file
from tcpipe.formats.place import DirectoryPlace
from tcpipe.formats.record_files import Sighting, Superseded, put_record, read_record, read_records


@dataclass(frozen=True, slots=True)
class Fact:
    """Something to remember."""

    a: int


def test_a_fact_is_written_once_and_never_changed(tmp_path):
    assert put_record(DirectoryPlace(tmp_path), "kind/fact", Fact(1))
    written = (tmp_path / "kind" / "fact.json").stat().st_mtime_ns
    assert not put_record(DirectoryPlace(tmp_path), "kind/fact", Fact(2))
    assert (tmp_path / "kind" / "fact.json").stat().st_mtime_ns == written
    assert read_record(DirectoryPlace(tmp_path), "kind/fact", Fact) == Fact(1)
    assert read_record(DirectoryPlace(tmp_path), "kind/other", Fact) is None
    assert [path.name for path in tmp_path.iterdir()] == ["kind"]


@pytest.mark.parametrize("broken", ["", "{", "[]", '{"a": 1}'])
def test_a_broken_record_is_named_left_out_and_written_again(tmp_path, caplog, broken):
    put_record(DirectoryPlace(tmp_path), "kind/one", Fact(1))
    put_record(DirectoryPlace(tmp_path), "kind/two", Fact(2))
    (tmp_path / "kind" / "one.json").write_text(broken)
    assert [record.a for record in read_records(DirectoryPlace(tmp_path), "kind", Fact)] == [2]
    assert "one.json" in caplog.text
    assert put_record(DirectoryPlace(tmp_path), "kind/one", Fact(1))
    assert [record.a for record in read_records(DirectoryPlace(tmp_path), "kind", Fact)] == [1, 2]


def test_a_record_of_another_form_is_none(tmp_path, caplog):
    put_record(DirectoryPlace(tmp_path), "logs/where/what", Fact(1))
    assert list(read_records(DirectoryPlace(tmp_path), "logs/where", Sighting)) == []
    assert "log is missing" in caplog.text
    sighting = Sighting(("/a.bag",), ((1, 2),), "0")
    assert put_record(DirectoryPlace(tmp_path), "logs/where/what", sighting)
    assert read_record(DirectoryPlace(tmp_path), "logs/where/what", Sighting) == sighting


def test_of_many_writers_one_wins(tmp_path):
    program = (
        "import sys; from pathlib import Path; from tcpipe.formats.place import DirectoryPlace\n"
        "from tcpipe.formats.record_files import Superseded, put_record\n"
        "won = [put_record(DirectoryPlace(Path(sys.argv[1])), f'kind/{n}', Superseded('run', sys.argv[2], n)) for n in range(30)]\n"
        "import json; print(json.dumps(won))"
    )
    writers = [
        subprocess.Popen([sys.executable, "-c", program, str(tmp_path), str(by)], stdout=subprocess.PIPE)
        for by in range(3)
    ]
    won = [json.loads(writer.communicate(timeout=60)[0]) for writer in writers]
    assert [sum(each) for each in zip(*won, strict=True)] == [1] * 30
    for n in range(30):
        assert won[int(read_record(DirectoryPlace(tmp_path), f"kind/{n}", Superseded).by)][n]


def test_a_file_system_without_hard_links(tmp_path, monkeypatch):
    def refused(*_, **__):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    path = tmp_path / "kind" / "fact.json"
    assert [put_file(path, text, staging=tmp_path) for text in (b"first", b"second")] == [True, False]
    assert path.read_text() == "first"


def test_what_a_killed_writer_left_goes_with_the_next_fact(tmp_path):
    put_record(DirectoryPlace(tmp_path), "kind/one", Fact(1))
    (tmp_path / ".tmp-new-0123abcd").mkdir()
    put_record(DirectoryPlace(tmp_path), "other/two", Fact(2))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kind", "other"]
