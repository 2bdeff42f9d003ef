"""The repairs that `verify` prints restore a damaged store."""

import shutil

import pytest
from synthetic_store import WORLD
from wheel_drives import ask_status, drive_at

from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.maps import add_map
from tcpipe.pipeline.problems import acknowledge
from tcpipe.pipeline.prune import prune
from tcpipe.pipeline.report import report
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe

KINDS = (
    "runs/*.json",
    "tags/*.json",
    "seen/*.json",
    "calls/*.2.*.json",
    "maps/*.json",
    "blobs/*/streams/wheel_odometry.parquet",
    "blobs/*/track.parquet",
    "blobs/*/site.zarr/zarr.json",
    "blobs/*/site.zarr/height/c/0/0",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A log, rasters, and a store of both."""
    here = tmp_path_factory.mktemp("repairs")
    drive_at(here / "run.mcap")
    store, again = here / "store", {"store": here / "store", "recipe": Recipe()}
    ingest([here / "run.mcap"], **again)
    ingest([here / "run.mcap"], tag={"weather": "dry"}, **again)
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
    path = min(store.glob(kind))
    path.unlink() if how == "removed" else change(path)
    found = verify(store)
    told = "; ".join((*found.problems, *found.notes))
    is_document = path.suffix == ".json" and "site.zarr" not in kind
    if is_document and how == "removed":
        assert all("'tcpipe prune' removes it" in problem for problem in found.problems), "no document is missed"
    else:
        assert str(path) in told
    if is_document and how == "changed":
        assert "remove it" in told
        path.unlink()
    if kind.startswith(("runs/", "tags/")) or kind.endswith(".parquet"):
        assert is_document or "ingest the log again with --force" in told
        ingest([made / "run.mcap"], store=store, recipe=Recipe(), force=True, tag={"weather": "dry"})
    elif "site" in kind or kind.startswith("maps/"):
        assert is_document or "add the map again with --force" in told
        add_map("site", height=made / "height.tif", store=store, force=True)
    prune(store=store, recipe=Recipe())
    assert verify(store).problems == ()
    assert ask_status(store).problems == ()


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
