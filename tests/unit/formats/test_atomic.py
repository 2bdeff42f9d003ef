"""Outputs appear whole or not at all."""

import errno
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tcpipe.errors import StoreError
from tcpipe.formats.atomic import (
    clear_beside,
    find_leftovers,
    make_scratch_directory,
    write_atomic_directory,
    write_atomic_file,
)


class _Cut(Exception):  # noqa: N818
    pass


def test_a_failed_file_leaves_the_old_one_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_text("old")
    with pytest.raises(_Cut), write_atomic_file(path) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise _Cut
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_directory_leaves_the_old_one_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "d"
    for content in ("first", "second"):
        with write_atomic_directory(path) as temporary:
            (temporary / "f").write_text(content)
            (temporary / content).touch()
    with pytest.raises(_Cut), write_atomic_directory(path) as temporary:  # noqa: PT012
        (temporary / "f").write_text("half")
        raise _Cut
    assert (path / "f").read_text() == "second"
    assert sorted(p.name for p in path.iterdir()) == ["f", "second"]
    assert list(tmp_path.iterdir()) == [path]


def test_what_another_process_is_writing_stays(tmp_path: Path) -> None:
    with write_atomic_directory(tmp_path / "d") as slow:
        (slow / "slow").touch()
        shutil.rmtree(slow)  # as zarr does with a directory that it is given
        slow.mkdir()
        (slow / "slow").touch()
        with write_atomic_directory(tmp_path / "d") as fast:
            (fast / "fast").touch()
        assert slow.is_dir()
    assert [p.name for p in (tmp_path / "d").iterdir()] == ["slow"]
    assert [p.name for p in tmp_path.iterdir()] == ["d"]


@pytest.mark.parametrize("write", [write_atomic_file, write_atomic_directory])
def test_a_place_that_cannot_be_is_told_by_its_own_name(tmp_path: Path, write: Callable[..., Any]) -> None:
    (tmp_path / "file").touch()
    path = tmp_path / "file" / "below" / "it"
    with (
        pytest.raises(StoreError, match=f"^{re.escape(str(path))}: cannot be written .*/file is a file, expected"),
        write(path),
    ):
        pass


@pytest.mark.parametrize("write", [write_atomic_file, write_atomic_directory])
@pytest.mark.parametrize("number", [errno.EACCES, errno.ENOSPC, errno.ESTALE])
@pytest.mark.parametrize("named", [None, "temporary", "place", "parent"])
def test_whatever_fails_in_writing_names_the_place(
    tmp_path: Path, write: Callable[..., Any], number: int, named: str | None
) -> None:
    path = tmp_path / "new" / "it"
    wanted = f"{path}: cannot be written ({os.strerror(number)})"
    of = {"place": os.fsencode(path), "parent": str(path.parent), None: None}
    with pytest.raises(StoreError, match=f"^{re.escape(wanted)}$"), write(path) as temporary:
        raise OSError(number, "what a library says", {**of, "temporary": str(temporary)}[named])
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("failing", ["fsync", "rename"])
@pytest.mark.parametrize("write", [write_atomic_file, write_atomic_directory])
def test_a_disk_that_fails_at_the_end_names_the_place(
    tmp_path: Path, write: Callable[..., Any], failing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    for name in ("replace", "rename", "_exchange_directories") if failing == "rename" else ("fsync",):
        target: object = f"tcpipe.formats.atomic.{name}" if name == "_exchange_directories" else f"os.{name}"
        monkeypatch.setattr(target, fail)
    path = tmp_path / "it"
    with (
        pytest.raises(StoreError, match=f"^{re.escape(str(path))}: cannot be written .Input/output error.$"),
        write(path) as temporary,
    ):
        (temporary / "a" if temporary.is_dir() else temporary).write_text("new")
    monkeypatch.undo()
    assert not any(tmp_path.iterdir())


def test_an_unreadable_source_is_not_told_as_an_unwritable_place(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), write_atomic_file(tmp_path / "f"):
        (tmp_path / "source").read_text()
    with pytest.raises(PermissionError, match="source"), write_atomic_file(tmp_path / "f"):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "source"))
    with pytest.raises(StoreError, match=r"^source is damaged$"), write_atomic_file(tmp_path / "f"):
        raise StoreError("source is damaged")
    with pytest.raises(BrokenPipeError), write_atomic_file(tmp_path / "f"):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")


def test_a_link_to_a_directory_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with write_atomic_directory(tmp_path / "link") as directory:
        (directory / "f").touch()
    assert (tmp_path / "link").is_symlink()
    assert [p.name for p in (tmp_path / "real").iterdir()] == ["f"]


_KILLED_EVERYWHERE = """
import os, sys
from pathlib import Path
from tcpipe.formats import atomic

parent, kind, swap = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
place = parent / "place"
if swap == "in two steps":
    atomic._exchange_directories = lambda *_: False

def write(text):
    if kind == "directory":
        with atomic.write_atomic_directory(place) as directory:
            (directory / "f").write_text(text)
    else:
        with atomic.write_atomic_file(place) as path:
            path.write_text(text)

def read():
    return ((place / "f") if kind == "directory" else place).read_text()

def killed_at(step):
    def hook(*_):
        nonlocal step
        step -= 1
        if step < 0:
            os._exit(9)
    child = os.fork()
    if not child:
        sys.addaudithook(hook)
        write("new")
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9

write("old")
step, left, seen = 0, 0, set()
while killed_at(step):
    step += 1
    there = os.listdir(parent)
    left += len(there) > 1
    assert len(atomic.find_leftovers(place)) == len(there) - place.exists(), there
    atomic.clear_beside(place)  # as a command does that finds nothing to do
    assert os.listdir(parent) == ["place"], os.listdir(parent)
    seen.add(read())
    write("old")
assert seen == {"old", "new"} and left > 5 and step > 10, (seen, left, step)
assert read() == "new" and os.listdir(parent) == ["place"]
"""


@pytest.mark.parametrize(
    ("kind", "swap"), [("file", "in one step"), ("directory", "in one step"), ("directory", "in two steps")]
)
def test_killed_at_any_step_a_place_is_old_or_new_and_what_is_left_goes_with_the_next_look(
    tmp_path: Path, kind: str, swap: str
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _KILLED_EVERYWHERE, tmp_path, kind, swap], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_clearing_leaves_what_lives_and_what_is_not_ours(tmp_path: Path) -> None:
    (tmp_path / ".tmp-mine").mkdir()
    with write_atomic_directory(tmp_path / "d-e") as slow:
        clear_beside(tmp_path / "d")
        assert slow.is_dir()
        assert find_leftovers(tmp_path / "d-e") == []
    assert sorted(path.name for path in tmp_path.iterdir()) == [".tmp-mine", "d-e"]
    clear_beside(tmp_path / "nowhere" / "x")


def test_scratch_of_the_killed_goes_and_of_the_living_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    left = tmp_path / f"tcpipe-{os.getuid()}-0123abcd"
    left.mkdir()
    (left / "copy.mcap").touch()
    (tmp_path / "tcpipe-cache").mkdir()
    with make_scratch_directory() as one, make_scratch_directory() as other:
        assert {path.name for path in tmp_path.iterdir()} == {one.parent.name, other.parent.name, "tcpipe-cache"}
        assert one.parent.stat().st_mode & 0o077 == 0
        with write_atomic_directory(one / "a") as directory:  # waits for no lock of its own process
            (directory / "b").touch()
    assert [path.name for path in tmp_path.iterdir()] == ["tcpipe-cache"]
