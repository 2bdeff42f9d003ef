"""run.json and manifest.json: those of a kept store are read whole, and what does not fit is named by file and key."""

import json
import re
import tarfile
from dataclasses import fields
from pathlib import Path

import pytest

from tcpipe.errors import StoreError
from tcpipe.formats.integrity import SEAL, write_sealed
from tcpipe.formats.json_files import read_as, to_plain
from tcpipe.formats.run_documents import Manifest, RunJson
from tcpipe.pipeline.migrate import migrate
from tcpipe.store import Store
from tcpipe.tables.facts import PhysicsFacts, StretchFacts

KEPT = Path(__file__).parents[2] / "data" / "store-2.1.tar.xz"
SINCE = {
    "blamed": True,
    "from_middle_s": 0.0,
    "drift_ppm": 0.0,
    "covariance_repairs": 0,
    "sha256_of": "log",
    "gnss_velocity_std_mps": 0.1,
    "streams": {},
    "streams_key": "",
    "outline": "",
}
"""Keys that are always there since, and what they hold where they were left out."""


@pytest.fixture
def kept(tmp_path):
    """A store of data model 2.1, brought to this one."""
    with tarfile.open(KEPT) as archive:
        archive.extractall(tmp_path, filter="data")
    migrate(tmp_path / "store")
    return tmp_path / "store"


def without(value, since):
    """The value without keys of these names that hold what they do where they were left out."""
    if isinstance(value, dict):
        return {key: without(of, since) for key, of in value.items() if key not in since or of != since[key]}
    return [without(of, since) for of in value] if isinstance(value, list) else value


@pytest.mark.parametrize(("pattern", "cls"), [("runs/*/run-1.json", RunJson), ("runs/*/*/manifest-1.json", Manifest)])
def test_a_kept_document_is_read_whole_and_written_as_it_was(kept, pattern, cls):
    (path,) = kept.glob(pattern)
    written = json.loads(path.read_text())
    del written[SEAL]
    clocks = written.get("info", {}).get("report", {}).get("facts", {}).get("clock_offsets", {})
    for offset in clocks.get("offsets", {}).values():
        del offset["recipe"]  # since 3.0 the remedy of a finding
        del offset["drift_s_per_h"], offset["drift_std_s_per_h"], offset["drifts"]  # since 3.0 in ppm, where it is sure
    for pair in clocks.get("pairs", ()):
        del pair["drift_s_per_h"], pair["drift_std_s_per_h"], pair["windows"]
    facts = written.get("info", {}).get("report", {}).get("facts", {})
    facts.pop("mounting", None)  # since 3.0 the parameters of sections
    for name in set(facts.get("sensor_checks", {})) - {"excluded"}:
        del facts["sensor_checks"][name]
    for section in facts.get("fuse", {}).get("stretches", ()):  # since 3.0 the parameters of sections
        for name in set(section) - {each.name for each in fields(StretchFacts)}:
            del section[name]
    for each in facts.get("audit", {}).get("disagreements", ()):
        del each["what"], each["unit"], each["alone"]  # since 3.0 always of the distance, in metres
    physics = facts.get("label", {}).get("physics", {})
    for name in set(physics) - {each.name for each in fields(PhysicsFacts)}:
        del physics[name]  # since 4.0 in the fit, or gone
    written.get("recipe", {}).get("fuse", {}).pop("engine", None)  # since 3.0 without effect
    assert without(to_plain(read_as(path, cls)), SINCE) == without(written, SINCE)


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
def test_a_value_of_another_type_is_named_by_file_and_key(kept, keys, line):
    (path,) = kept.glob("runs/*/*/manifest-1.json")
    document = json.loads(path.read_text())
    place = document
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = []
    write_sealed(path, document)
    where = re.escape(f"{path}: is not what this version writes: {line}")
    with pytest.raises(StoreError, match=f"^{where}$"):
        read_as(path, Manifest)


def test_a_run_json_without_its_source_is_refused(kept):
    (path,) = kept.glob("runs/*/run-1.json")
    write_sealed(path, {"robot": "husky"})
    with pytest.raises(StoreError, match=r"run-1\.json: is not what this version writes: source is missing$"):
        Store(kept).run_json(path.parent.name)
