"""Names that would colour a terminal, turn its text round, or be read as HTML: of topics, logs, tags, frames, classes."""

import csv
import json
import re
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
from installed_command import tcpipe
from mcap.writer import Writer
from stored_files import map_path, only_run

from tcpipe.errors import MapError
from tcpipe.formats.maps.building import read_class_scheme

DRAWS_DATASET_PAGES = True

TERMINAL = "\x1b]0;owned\x07\x1b[31m\u202e\x9b2J"
HTML = '<script>alert("1")</script>'
CLASSES = (HTML, "a|b `c` [red]*d*", r"$\oops{$ {{ 7 * 7 }}")
"""Names of classes that can be printed; the first, second and third of the table."""


@pytest.fixture(scope="module")
def work(tmp_path_factory, tiny_site):
    here = tmp_path_factory.mktemp("names")
    with tiny_site.rasters["classes"].open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row, name in zip(rows, [*CLASSES, *(f"{HTML}{n}" for n in range(len(rows)))], strict=False):
        row["name"] = name
    with (here / "classes.csv").open("w", newline="") as stream:
        table = csv.DictWriter(stream, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    log = here / f"run{TERMINAL}{HTML.replace('/', '')}{tiny_site.logs[0].suffix}"
    shutil.copy(tiny_site.logs[0], log)
    layers = [item for role in ("height", "ortho", "terrain") for item in (f"--{role}", tiny_site.rasters[role])]
    return here, log, layers


def harmless(done, *codes):
    """Assert that the output holds no character that a terminal obeys; return it."""
    assert done.returncode in codes, done.stderr
    assert "Traceback" not in done.stderr
    for text in (done.stdout, done.stderr):
        assert all(c.isprintable() or c == "\n" for c in text), ascii(text)
    return done.stdout


def test_no_command_prints_or_writes_a_name_as_anything_but_text(work):
    here, log, layers = work
    ingest = ("ingest", log, "--tag", f"{TERMINAL}={HTML}{TERMINAL}")
    harmless(tcpipe(*ingest, cwd=here), 0, 3)
    harmless(tcpipe("add-map", "site", *layers, "--classes", "classes.csv", cwd=here), 0)
    harmless(tcpipe("build-dataset", cwd=here), 0, 3)
    run = only_run(here / "tcpipe-store").run_id
    for path in (run, "tcpipe-store", map_path(here / "tcpipe-store", "site"), "dataset"):
        harmless(tcpipe("inspect", path, cwd=here), 0, 3)
    json.loads(harmless(tcpipe("inspect", run, "--json", cwd=here), 0, 3))
    for path in ("tcpipe-store", "dataset"):
        harmless(tcpipe("report", path, cwd=here), 0)
    sample = pq.read_table(here / "dataset/samples.parquet")["sample_id"][0].as_py()
    harmless(tcpipe("explain", sample, cwd=here), 0)
    harmless(tcpipe("diff", "dataset", "dataset", cwd=here), 0)
    pages = [*here.rglob("report.html")]
    assert len(pages) == 3  # of the run, the store and the dataset
    for page in pages:
        text = page.read_text()
        assert "<script>alert" not in text
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e]", text), page


@pytest.mark.parametrize("name", [f"grass{TERMINAL}", "grass\x1f", "gr\u200bass", "two\nlines", "line\u2028end"])
def test_a_class_name_that_cannot_be_printed_is_refused(tmp_path, name):
    (tmp_path / "c.csv").write_text(f'value,id,name,traversable\n4,1,"{name}",yes\n')
    (tmp_path / "c.toml").write_text(f"[[class]]\nvalue = 4\nid = 1\nname = {json.dumps(name)}\ntraversable = true\n")
    for table in ("c.csv", "c.toml"):
        with pytest.raises(MapError, match="characters that cannot be printed"):
            read_class_scheme(tmp_path / table)


def test_topics_types_and_frames_of_a_log_are_printed_as_text(work):
    here, *_ = work
    path = here / "topics.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema(f"std_msgs/msg/{TERMINAL}", "ros2msg", b"string data")
        channel = writer.register_channel(f"/t{TERMINAL}\n{HTML}", "cdr", schema)
        writer.add_message(channel, 10**18, np.zeros(8, np.uint8).tobytes(), 10**18)
        writer.finish()
    lines = harmless(tcpipe("inspect", path, "--full", cwd=here), 0, 1, 3)
    assert r"\x1b[31m" in lines
    harmless(tcpipe("inspect", path, "--json", cwd=here), 0, 1, 3)
    harmless(tcpipe("ingest", path, cwd=here), 1)
    harmless(tcpipe("export", path, here / "out", cwd=here), 0, 1, 3)
