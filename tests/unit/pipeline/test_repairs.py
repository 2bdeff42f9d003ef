"""What `verify` says is to be done about damage: done, everything is as it was written."""

import shutil
from dataclasses import replace

import pytest
from synthetic_store import WORLD
from tcpipe.formats.commits import Entries, LogSnapshot
from wheel_drives import drive_at

from tcpipe.errors import StoreError
from tcpipe.formats import commit_log
from tcpipe.pipeline.calls import open_log
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.maps import add_map
from tcpipe.pipeline.problems import acknowledge
from tcpipe.pipeline.prune import prune
from tcpipe.pipeline.report import report
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store

KINDS = (
    "runs/*/run-1.json",
    "runs/*/tags-1.json",
    "runs/*/*/manifest-1.json",
    "runs/*/streams/*/wheel_odometry.parquet",
    "runs/*/*/*/track.parquet",
    "maps/site-1.json",
    "maps/site/*/site.zarr/zarr.json",
    "maps/site/*/site.zarr/height/c/0/0",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A log, rasters, and a store of both."""
    here = tmp_path_factory.mktemp("repairs")
    drive_at(here / "run.mcap")
    store, again = here / "store", {"store": here / "store", "recipe": Recipe()}
    ingest([here / "run.mcap"], **again)
    ingest([here / "run.mcap"], tags={"weather": "dry"}, **again)
    add_map("site", height=WORLD.write(here, 0.2)["height"], store=store)
    assert verify(store).problems == ()
    return here


def change(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("how", ["removed", "changed"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_to_be_done_about_a_damaged_file_makes_the_store_whole(made, tmp_path, kind, how):
    store = shutil.copytree(made / "store", tmp_path / "store")
    (path,) = store.glob(kind)
    path.unlink() if how == "removed" else change(path)
    found = verify(store)
    told = "; ".join((*found.problems, *found.notes))
    if how == "changed" and path.suffix == ".json" and "site.zarr" not in kind:
        assert "remove .json files that have changed" in told
        path.unlink()
    if kind.startswith("runs/"):
        assert "ingest its log again" in told or "ingest the log again" in told
        ingest([made / "run.mcap"], store=store, recipe=Recipe(), force=True)
    else:
        assert "add the map again with --force" in told or "'tcpipe prune' removes it" in told
        add_map("site", height=made / "height.tif", store=store, force=True)
    assert verify(store).problems == ()


@pytest.mark.parametrize("how", ["empty", "changed"])
def test_the_mark_of_a_store_is_copied_from_any_other(made, tmp_path, how):
    store = shutil.copytree(made / "store", tmp_path / "store")
    change(store / "store.json") if how == "changed" else (store / "store.json").write_bytes(b"")
    text = r"store\.json: has changed .*; copy it from any store of data model .*: it is the same in all of them"
    with pytest.raises(StoreError, match=text):
        prune(store=store, recipe=Recipe())
    assert any("copy it from any store" in note for note in verify(store).notes)
    shutil.copy(open_store(tmp_path / "new", create=True).root / "store.json", store)
    assert verify(store) == replace(verify(made / "store"), path=str(store))
    assert prune(store=store, recipe=Recipe()).removed == ()


def test_the_last_commit_is_missed_where_a_snapshot_is_there_that_has_it(made, tmp_path, monkeypatch):
    store = shutil.copytree(made / "store", tmp_path / "store")
    monkeypatch.setattr(commit_log, "_EVERY", 1)
    open_log(Store(store)).commit("seen", Entries(seen=(LogSnapshot(("/a.mcap",), ((1, 2),), "f" * 64),)))
    last = max((store / "log").glob("0*.json"))
    last.unlink()
    found = verify(store / "log")
    assert (found.kind, found.problems) == ("store", (f"{last}: is missing",))
    assert found.notes[0].startswith(f"{store / 'log'}: copy the store again, or ingest all logs again")
    (snapshot,) = (store / "log").glob("snapshot-*")
    change(snapshot)
    assert f"{snapshot}: remove it; the commits say the same" in verify(store / "log").notes


def test_commands_that_find_nothing_to_do_remove_what_a_killed_one_left(made, tmp_path):
    store, left = shutil.copytree(made / "store", tmp_path / "store"), tmp_path / "store" / ".tmp-new-0123abcd"
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((made / "run.mcap").read_bytes()[:-40_000])
    ingest([cut], store=store, recipe=Recipe())
    for act in (lambda: acknowledge([str(cut)], store=store), lambda: report(store)):
        act()
        left.mkdir()
        act()
        assert not left.exists()
