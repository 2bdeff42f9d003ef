"""The page of a store says of each run what its documents say, names what failed, and tells a change over the nights from scatter."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from page_reading import data_of
from stored_files import flip, manifest
from synthetic_store import add_run, driven, lanes, open_world, segments, supersede, tag_run

from tcpipe.errors import StoreError, UsageError
from tcpipe.formats import documents
from tcpipe.formats.documents import make_key
from tcpipe.formats.place import open_place
from tcpipe.formats.recipe_toml import ingest_key
from tcpipe.formats.runs import Call, LogFailure, StoredMap
from tcpipe.pipeline import report as report_module
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.problems import acknowledge
from tcpipe.pipeline.report import report
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import ReadConfig, Recipe
from tcpipe.store import open_store
from tcpipe.tables.findings import Subject, make_finding
from tcpipe.tables.levels import DATA_MODEL_VERSION

EVIL = "<b>\"'&\x1b[31m\u202e</script>"
OLD = replace(Recipe(), read=ReadConfig(ignore_topics=["/none"]))


def add(store, run_id, number, **how):
    table = segments(run_id, *lanes(np.array([float(number)]), -10.0, 10.0), start_ns=10**18 + number * 10**14)
    add_run(store, run_id, table, **how)


def driven_below_limit(slow_fraction):
    speeds = {"slow_fraction": slow_fraction, "limit_mps": 0.95, "top_mps": 0.6}
    return make_finding("driven-below-limit", Subject("role", "command"), **speeds)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Runs a and b in a dataset, b with an older ingestion too, c of a damaged log and in none, d superseded by a; two logs failed."""
    here = tmp_path_factory.mktemp("store page")
    store = open_world(here)
    add(store, "b", 1, recipe=OLD)
    for number, run_id in enumerate(("a", "b", "d")):
        found = [driven_below_limit(0.6 + 0.1 * number)] if number < 2 else []
        add(store, run_id, number, findings=found, tags={"site": EVIL})
    supersede(store, "d", "a")
    build_dataset(here / "dataset", store=store.root)
    add(store, "c", 3, distance_by_reason_m={"kept": 20.0, "gap": 60.0, "stationary": 5.0})
    put_failure(store, LogFailure("1" * 64, ("/logs/junk",), (f"/logs/junk: {EVIL} is no log",), "0"))
    put_failure(store, LogFailure("a", ("/logs/a.mcap",), ("/logs/a.mcap: was cut",), "0"))
    failed = {"/logs/passing.mcap": "No space left on device", "/logs/b.mcap": "No space left on device"}
    call = Call(command="ingest", version="0", exit_code=3, counts={"failed": 1}, failed=failed)
    store.put(store.scan(), "calls", "f" * 16, call)
    return store


def put_failure(store, failure):
    store.put(store.scan(), "failed", make_key(failure.content), failure)


def shown(store):
    page = report(store.root, runs=False)[0]
    return page, *read_rows(store)


def read_rows(store):
    html = open_place(store.root).read("report.html").decode()
    told = data_of(html)
    rows = [dict(zip(told["fields"], row, strict=True)) for row in told["rows"]]
    return html, told, rows


def test_each_run_is_there_as_its_documents_say(store):
    page, _, told, rows = shown(store)
    assert page.path == str(store.root / "report.html")
    assert [(row["run"], row["state"]) for row in rows] == [
        ("c", "current"), ("d", "superseded"), ("b", "current"), ("b", "of another recipe"), ("a", "current")
    ]  # fmt: skip
    for row, run_id in ((rows[0], "c"), (rows[-1], "a")):
        (run,) = store.find_runs(run_id)
        made = run.manifest
        assert (row["robot"], row["segments"]) == (made.robot, made.counts.segments)
        assert row["driven"] == pytest.approx(sum(made.distance_by_reason_m.values()), abs=0.05)
        assert row["used"] == pytest.approx(
            100.0 * made.distance_by_reason_m["kept"] / sum(made.distance_by_reason_m.values()), abs=0.01
        )
        assert row["start_ms"] == run.table("segments").column("start_ns").to_numpy().min() // 10**6
    assert [told["datasets"][n] for row in rows for n in row["datasets"]] == ["dataset"] * 2
    assert [row["codes"] for row in rows] == [[], [], [0], [], [0]]
    assert [row["verdict"] for row in rows] == [
        "usable", "usable", "usable with care", "usable", "usable with care"
    ]  # fmt: skip
    assert not report(store.root, runs=False)[0].changed


def test_the_verdict_is_that_of_the_current_runs_with_findings_by_code(store):
    html = shown(store)[1]
    box = "".join(html.split('<section class="verdict')[1:3]).rsplit("</section>", 1)[0]
    assert '<span class="usable">position <b>usable</b></span>' in box
    assert '<span class="usable-with-care">time <b>usable with care</b></span>' in box
    assert "Most of the drive was commanded below" in box
    assert "2 of 3 runs: command; 60 % to 70 %" in box


def test_sums_are_of_the_ruling_recipe_without_superseded_runs(store):
    _, html, *_ = shown(store)
    key = ingest_key(Recipe())
    driven_m = sum(run.facts.driven_m for run in store.runs() if run.facts.ingest_key == key)
    assert f"<div><b>{driven_m:.0f} m</b><span>driven</span></div>" in html
    assert "<div><b>3</b><span>runs</span></div>" in html
    losses = html.split("<h2>Distance breakdown</h2>")[1].split("</section>")[0]
    assert losses.index("<td>gap</td>") < losses.index("<td>stationary</td>")


def test_what_failed_is_named_until_its_content_gives_a_run_or_a_person_acknowledges_it(store):
    _, html, *_ = shown(store)
    part = html.split("<h2>Failed, damaged and empty</h2>")[1].split("</section>")[0]
    assert "is no log" in part
    assert "failed permanently" in part
    assert "passing.mcap" in part
    assert "was cut" not in part  # the run of that content is there
    assert "b.mcap" not in part
    acknowledge(["/logs/junk"], store=store.root)
    part = shown(store)[1].split("<h2>Failed, damaged and empty</h2>")[1].split("</section>")[0]
    assert "<td>acknowledged</td>" in part


def test_names_are_text_and_pages_are_led_to_where_they_are(store):
    _, html, _, rows = shown(store)
    assert "<b>\"'" not in html
    assert "\x1b" not in html
    assert "\u202e" not in html
    assert not any(row["href"] for row in rows)
    assert 'href="../dataset/report.html"' in html
    pages = report(store.root)
    assert [page.path for page in pages[1:]] == [run.folder.where("report.html") for run in store.runs()]
    for row in shown(store)[3]:
        assert (row["href"] != "") == (row["run"] != "d")
        assert not row["href"] or (store.root / row["href"]).is_file()
    assert not [line for line in verify(store.root).problems if "report.html" in line]


def test_a_store_of_failed_logs_alone_has_a_page(tmp_path):
    store = open_store(tmp_path / "store", create=True)
    put_failure(store, LogFailure("1" * 64, ("/logs/junk",), ("/logs/junk: is no log",), "0"))
    _, html, *_ = shown(store)
    assert "The store has no usable runs." in html
    assert "junk: is no log" in html
    with pytest.raises(UsageError, match="is no dataset or store"):
        report(tmp_path)
    with pytest.raises(UsageError, match="no such file or directory, and no such run in"):
        report("gone", store=store.root)


def test_a_run_that_cannot_be_read_is_named_and_costs_no_other_page(tmp_path):
    store = open_store(tmp_path / "store", create=True)
    for number, run_id in enumerate("abc"):
        add(store, run_id, number)
    runs = {run.run_id: run for run in store.runs()}
    flip(runs["b"].file("track.parquet"))
    flip(manifest(runs["c"]))
    documents._DECODED.clear()  # another process
    with pytest.raises(StoreError, match=r"track\.parquet"):
        report(store.root)
    _, html, _, rows = shown(store)
    assert {row["run"]: row["href"] != "" for row in rows} == {"a": True, "b": False}
    assert runs["c"].document in html.replace("<wbr>", "")  # named as damaged
    shutil.rmtree(runs["b"].folder.where())
    assert {row["run"]: row["state"] for row in shown(store)[3]} == {"a": "current", "b": "tables missing"}


def test_a_page_is_rendered_again_only_where_its_inputs_have_changed(tmp_path, monkeypatch):
    store = open_world(tmp_path)
    for number, run_id in enumerate("ab"):
        add(store, run_id, number)
    rendered = []
    render = report_module.run_report
    monkeypatch.setattr(
        report_module, "run_report", lambda run, *a, **k: rendered.append(run.run_id) or render(run, *a, **k)
    )

    def list_rendered():
        rendered.clear()
        changed = [Path(page.path).parent.name for page in report(store.root)[1:] if page.changed]
        assert changed == [runs[run_id].facts.blob for run_id in rendered]
        return rendered

    runs = {run.run_id: run for run in store.runs()}
    assert list_rendered() == ["a", "b"]
    assert list_rendered() == []
    tag_run(store, "b", {"site": "quarry"})
    assert list_rendered() == ["b"]
    flip(Path(runs["a"].folder.where("report.html")))
    assert list_rendered() == ["a"]
    store.put(store.scan(), "maps", make_key("other"), StoredMap("other", DATA_MODEL_VERSION, "0" * 16, {}))
    assert list_rendered() == ["a", "b"]
    assert list_rendered() == []
    monkeypatch.setattr(report_module, "__version__", "another")
    assert list_rendered() == ["a", "b"]


def test_the_page_of_few_runs_begins_with_their_tracks_and_the_table(tmp_path, monkeypatch):
    store = open_world(tmp_path)
    for number, run_id in enumerate(("a", "b")):
        table = segments(run_id, *lanes(np.array([float(number)]), -10.0, 10.0), start_ns=10**18 + number * 10**14)
        add_run(store, run_id, table, track=driven(table), energy_joule=36_000.0, distance_by_reason_m={"kept": 500.0})
    _, html, _, rows = shown(store)
    titles = [part.partition("</h2>")[0] for part in html.split("<h2>")[1:]]
    assert titles[:2] == ["Tracks", "All runs"]
    assert [(row["energy"], row["wh_per_km"]) for row in rows] == [(10.0, 20.0)] * 2
    assert "<td>10.0</td>" in html.replace(' class="number"', "")
    monkeypatch.setattr(report_module, "_FEW_RUNS", 2)
    html = shown(store)[1]
    assert "<h2>Tracks</h2>" not in html
    (run, _) = store.runs()
    assert ">20.0 Wh/km<" in run.facts._repr_html_()
