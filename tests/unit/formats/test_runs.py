"""The record of a run: what does not fit is named by file and key, and each fact is written once."""

from dataclasses import replace

import pytest
from synthetic_store import add_run, lanes, make_fuse_facts, segments, supersede

from tcpipe.formats.json_files import parse_json
from tcpipe.store import open_store
from tcpipe.tables.findings import Subject, make_finding

DAMAGE = (make_finding("file-cut", Subject("file", "a.mcap")),)


@pytest.fixture
def store(tmp_path):
    """A store with one run."""
    store = open_store(tmp_path / "store", create=True)
    add_run(store, "a", segments("a", *lanes(0.0, -5.0, 5.0)), facts=make_fuse_facts(), findings=DAMAGE, damage=DAMAGE)
    return store


def read_plain(store):
    (run,) = store.runs()
    return parse_json(store.place.read(run.document), run.document)


def test_a_finding_is_written_once_and_is_there_again_in_what_is_read(store):
    (run,) = store.runs()
    assert run.manifest.findings == run.manifest.info.report.findings == run.facts.findings == DAMAGE
    assert read_plain(store)["info"]["report"].get("findings", []) == []
    assert store.place.read(run.document).count(b'"file-cut"') == 2, "as a finding, and as the damage of the log"


def test_tags_and_supersession_are_no_part_of_the_manifest(store):
    (run,) = store.runs()
    assert not {"tags", "superseded_by"} & read_plain(store).keys()
    store.put_run(store.scan(), replace(run.manifest, tags={"soil": "dry"}, superseded_by="b"))
    assert (store.runs()[0].manifest.tags, store.runs()[0].manifest.superseded_by) == ({}, None)
    add_run(store, "b", segments("b", *lanes(0.0, -5.0, 5.0)))
    supersede(store, "a", "b")
    assert store.find_runs("a")[0].manifest.superseded_by == "b"
