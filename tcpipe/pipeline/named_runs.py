"""Runs of a store that a command is given by their names."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from tcpipe.errors import UsageError
from tcpipe.formats.atomic import check_input_path
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.store import is_store, open_store


def is_path(name: Path | str) -> bool:
    """Return whether a name is a URL, or that of a file or directory; any other is looked up as a run."""
    if is_url(name):
        return True
    with suppress(UsageError):
        check_input_path(name)
        return True
    return False


def find_named_runs(name: Path | str, store: Path | str) -> list[StoredRun]:
    """Return the runs called RUN, under each recipe, or RUN/RECIPE; `UsageError` if the store has none."""
    if str(name) != str(store) and not is_store(store):
        raise UsageError(
            f"{name}: there is no such file or directory; if it is a run, name its store with --store: there is none at {store}"
        )
    found = open_store(store).find_runs(str(name))
    if not found:
        raise UsageError(
            f"{name}: there is no such file or directory, and no such run in {store}; "
            f"expected a path, a run or RUN/RECIPE; 'tcpipe inspect {store}' lists the runs"
        )
    return found


def find_named_run(name: Path | str, store: Path | str) -> StoredRun:
    """Return the run called RUN or RUN/RECIPE; `UsageError` if the store has none, or several of that name."""
    found = find_named_runs(name, store)
    if len(found) > 1:
        names = ", ".join(run.name for run in found)
        raise UsageError(f"{name}: was ingested under several recipes; expected one of {names}")
    return found[0]
