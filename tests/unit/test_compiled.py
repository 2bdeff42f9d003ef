"""Compiling kernels: where numba finds no place for its cache, and what makes a cached one stale."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tcpipe.compiled import _cache_directory

PROGRAM = """
import numba
from tcpipe import compiled
real = numba.njit
def homeless(*arguments, **options):
    if options.get("cache") and not numba.config.CACHE_DIR:
        def refuse(function):
            raise RuntimeError("cannot cache function: no locator available")
        return refuse
    return real(*arguments, **options)
numba.njit = homeless
def double(x):
    return 2.0 * x
print(compiled.compile_kernel(double)(21.0), numba.config.CACHE_DIR)
"""

CALLED = {
    "numbers_": "STEP, SCALE = 1.0, (1.0, 2.0)\n",
    "inner": "from tcpipe.compiled import compile_kernel\n\n@compile_kernel\ndef more(x):\n    return x + 1.0\n",
    "fields": "from typing import NamedTuple\n\nclass Pair(NamedTuple):\n    a: float\n    b: float\n",
    "outer": """
from fields import Pair
from inner import more
from numbers_ import SCALE, STEP
from tcpipe.compiled import compile_kernel

@compile_kernel
def between(x):
    return more(x) * STEP

@compile_kernel
def outermost(x, pair):
    return between(x) * SCALE[1] + pair.a
""",
}


@pytest.fixture
def run_again(tmp_path, monkeypatch):
    """Change a module, import all of them anew and return what the kernel computes and how often it came from the cache."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    for name, text in CALLED.items():
        (tmp_path / f"{name}.py").write_text(text)

    def run(module="outer", old="", new=""):
        path = tmp_path / f"{module}.py"
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))
        for name in CALLED:
            sys.modules.pop(name, None)
        outer = importlib.import_module("outer")
        found = outer.outermost(2.0, outer.Pair(10.0, 20.0))
        return found, sum(outer.outermost.stats.cache_hits.values())

    yield run
    for name in CALLED:
        sys.modules.pop(name, None)


def test_a_cached_kernel_is_used_until_something_that_it_is_made_of_changes_in_whatever_module(run_again):
    assert run_again() == (16.0, 0)  # (2 + 1) 1 2 + 10
    assert run_again() == (16.0, 1)
    assert run_again("inner", "1.0", "2.0") == (18.0, 0)  # two kernels away
    assert run_again("numbers_", "STEP, SCALE = 1.0", "STEP, SCALE = 3.0") == (34.0, 0)
    assert run_again("fields", "a: float\n    b", "b: float\n    a") == (44.0, 0)
    assert run_again() == (44.0, 1)


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def test_falls_back_to_a_temporary_cache(tmp_path):
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    done = subprocess.run([sys.executable, str(program)], capture_output=True, text=True, check=True, env=environment)
    cache = tmp_path / f"tcpipe-kernels-{os.getuid()}"
    assert done.stdout.split() == ["42.0", str(cache)]
    assert list(cache.rglob("*.nbi"))


def test_the_cache_directory_is_its_owners_alone_and_kept(temporary):
    first = _cache_directory()
    assert Path(first).stat().st_mode & 0o777 == 0o700
    assert _cache_directory() == first


def test_a_directory_that_others_can_write_to_and_a_link_are_not_trusted(temporary):
    planted = temporary / f"tcpipe-kernels-{os.getuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    assert _cache_directory() != str(planted)
    planted.rename(temporary / "elsewhere")
    planted.symlink_to(temporary / "elsewhere")
    assert _cache_directory() != str(planted)


def test_what_was_compiled_into_a_directory_that_cannot_be_written_to_is_taken_along(temporary, tmp_path):
    (tmp_path / "image" / "deep").mkdir(parents=True)
    (tmp_path / "image" / "deep" / "kernel.nbi").write_bytes(b"compiled")
    (tmp_path / "image").chmod(0o555)
    first = Path(_cache_directory(str(tmp_path / "image")))
    assert (first / "deep" / "kernel.nbi").read_bytes() == b"compiled"
    assert first.stat().st_mode & 0o777 == 0o700
