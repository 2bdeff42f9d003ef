"""``store.json``, which says that a place is a store and of which layout; also what proves that a bucket keeps two writers apart."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tcpipe.errors import StoreError
from tcpipe.formats.integrity import seal_document, verify_document
from tcpipe.formats.json_files import parse_typed, to_json
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.place import Place
from tcpipe.formats.run_documents import StoreDocument
from tcpipe.tables.levels import DATA_MODEL_VERSION

MARK = "store.json"
"""Is written first where a store is new, and last where one is brought over."""
SPOOL = "spool"
"""Where pixels wait until a dataset is written, in its directory or, for a cluster, in the store; they go in the end."""


def is_outdated(place: Place) -> bool:
    """Tell whether runs or maps lie here, but not the mark of a store."""
    if place.size(MARK) is not None:
        return False
    return any(name.endswith(".zarr") for name in place.folders("maps")) or any(
        name.startswith("run") and name.endswith(".json")
        for run_id in place.folders("runs")[:10]
        for name in place.files(f"runs/{run_id}")
    )


def read_layout(place: Place) -> str | None:
    """Return the data model of a store, None where there is none; `StoreError` where its mark is not as it was written."""
    where, data = place.where(MARK), place.read(MARK)
    return None if data is None else parse_typed(verify_document(data, where), StoreDocument, where).data_model_version


def mark_store(place: Place, *, found: bool = False) -> None:
    """Make a place a store; `StoreError` where it cannot be written, or does not keep what is there from being overwritten."""
    data = to_json(seal_document(StoreDocument(DATA_MODEL_VERSION))).encode()
    try:
        new = place.put_new(MARK, data)
        keeps = not (new and (found or place.put_new(MARK, data)))
    except StoreError as error:
        raise StoreError(f"{error.problems[0]}; name another with --store") from None
    if not keeps:
        raise StoreError(
            f"{place.where()}: this object store overwrites what is there although asked not to (put-if-absent), so that two writers "
            "would mix; name another with --store"
        )


@contextmanager
def remove_if_empty(place: str | Path) -> Iterator[None]:
    """Remove what was made for a store on this machine when no run or map came into it, what is remembered of failures too."""
    if is_url(place):
        yield
        return
    store = Path(place)
    made = [path for path in (store, *store.absolute().parents) if not path.exists()]
    try:
        yield
    finally:
        if made and not any(store.glob("runs/*")) and not any(store.glob("maps/*-*.json")):
            for own in ("log", "index"):
                shutil.rmtree(store / own, ignore_errors=True)
            (store / MARK).unlink(missing_ok=True)
            for path in (store / "runs", store / "maps", *made):
                with suppress(OSError):
                    path.rmdir()
