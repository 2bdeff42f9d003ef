"""Compiling kernels where numba finds no place for its cache."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tcpipe.compiled import _cache_directory, kernel

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
print(compiled.kernel(double)(21.0), numba.config.CACHE_DIR)
"""


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def test_a_kernel_computes():
    assert kernel(lambda x: x + 1.0)(2.0) == 3.0


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


def test_a_directory_that_others_can_write_to_is_not_trusted(temporary):
    planted = temporary / f"tcpipe-kernels-{os.getuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    assert _cache_directory() != str(planted)


def test_a_link_is_not_trusted(temporary):
    (temporary / "elsewhere").mkdir()
    (temporary / f"tcpipe-kernels-{os.getuid()}").symlink_to(temporary / "elsewhere")
    assert _cache_directory() != str(temporary / f"tcpipe-kernels-{os.getuid()}")
