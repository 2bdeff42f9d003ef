"""run.json and manifest.json: what does not fit is named by file and key."""

import json
import re

import pytest
from synthetic_store import add_run, lanes, make_noise_facts, segments
from tcpipe.formats.run_documents import Manifest

from tcpipe.errors import StoreError
from tcpipe.formats.integrity import write_sealed
from tcpipe.formats.json_files import read_as
from tcpipe.store import Store, open_store


@pytest.fixture
def root(tmp_path):
    """The directory of a store with one run."""
    store = open_store(tmp_path / "store", create=True)
    add_run(store, "a", segments("a", *lanes(0.0, -5.0, 5.0)), facts=make_noise_facts())
    return tmp_path / "store"


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        (("counts", "segments"), "counts.segments: expected a whole number, got a list"),
        (("distance_by_reason_m", "kept"), "distance_by_reason_m[...]: expected a number, got a list"),
        (
            ("info", "report", "facts", "fuse", "rows"),
            "info.report.facts.fuse.rows: expected a whole number, got a list",
        ),
        (("info", "datum"), "info.datum: expected an object or null, got a list"),
    ],
)
def test_a_value_of_another_type_is_named_by_file_and_key(root, keys, line):
    (path,) = root.glob("runs/*/*/manifest-1.json")
    document = json.loads(path.read_text())
    place = document
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = []
    write_sealed(path, document)
    where = re.escape(f"{path}: is not what this version writes: {line}")
    with pytest.raises(StoreError, match=f"^{where}$"):
        read_as(path, Manifest)


def test_a_run_json_without_its_source_is_refused(root):
    (path,) = root.glob("runs/*/run-1.json")
    write_sealed(path, {"robot": "husky"})
    with pytest.raises(StoreError, match=r"run-1\.json: is not what this version writes: source is missing$"):
        Store(root).run_json(path.parent.name)
