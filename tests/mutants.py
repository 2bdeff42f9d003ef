"""Mutants: the rooms of the numbers changed in one place at a time, and whether a test notices.

    make test-mutants MUTANTS="--rooms motion path"

cosmic-ray says how a file may be changed (`core/ReplaceComparisonOperator_Lt_LtE` and so on); this draws which changes are tried, and
tries each in a fork of one warm process: the changed source is what the import finds, no file is touched, and only the tests of that
room run, to the first that fails. numba compiles nothing meanwhile, but in `COMPILED`.

Tried are all comparisons and numbers of `THOROUGH`, and of what else can be changed as many as ``--draw`` says, by seed. What is no
change is left out: annotations, decorators, the bare ``*`` of a signature, and ``is`` for ``==``, which is a matter of the
interpreter. Exit status 1: less than nine tenths were noticed. What lives on, and why it may, stands in docs/internals/tests.md.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import importlib.machinery
import os
import random
import resource
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numba.core.config

ROOT = Path(__file__).resolve().parents[1]


def name_files(form: str, names: str) -> tuple[str, ...]:
    """Return the files of names."""
    return tuple(form.format(name) for name in names.split())


ROOMS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "motion": (("tcpipe/motion",), ("tests/unit/motion",)),
    "path": (("tcpipe/path.py",), ("tests/unit/test_path.py",)),
    "splits": (("tcpipe/splits",), ("tests/unit/splits", "tests/property/test_splits.py")),
    "power": (("tcpipe/power",), ("tests/unit/power",)),
    "cost": (("tcpipe/cost",), ("tests/unit/cost", "tests/unit/stages/test_label.py")),
    "terrain": (("tcpipe/terrain",), ("tests/unit/terrain", "tests/unit/stages/test_sample.py")),
    "findings": (
        name_files("tcpipe/{}.py", "tables/facts stages/read stages/fuse_findings stages/label_motion"),
        name_files("tests/unit/stages/test_{}.py", "read_findings fuse_findings label_quality"),
    ),
    "geometry": (("tcpipe/geometry",), ("tests/unit/geometry", "tests/property/geometry")),
    "logs": (
        name_files(
            "tcpipe/logs/{}.py",
            "clocks expressions extrinsics field_mapping fix_quality messages power_fields roles wire_types",
        ),
        ("tests/unit/logs", "tests/property/test_wire_decoding.py"),
    ),
    "fusion": (
        (
            *name_files(
                "tcpipe/fusion/{}.py",
                "attitude course densities initial level_motion measurements pair_residuals preparation process signals ticks",
            ),
            "tcpipe/fusion/checks",
        ),
        (
            *name_files(
                "tests/unit/fusion/test_{}.py",
                "signals attitude course preparation pose_increments initial ticks",
            ),
            "tests/unit/fusion/checks",
            "tests/unit/fusion/test_densities.py",
        ),
    ),
    "kernels": (
        name_files("tcpipe/fusion/{}.py", "state filter_kernel smoother_kernel"),
        ("tests/unit/fusion/test_filter_kernel.py",),
    ),
    "estimator": (
        name_files("tcpipe/fusion/{}.py", "error_state parameters ukf15"),
        name_files("tests/unit/fusion/test_{}.py", "parameters process error_state ukf15"),
    ),
    "verify": (("tcpipe/pipeline/verify.py",), ("tests/unit/pipeline/test_trust.py",)),
}
"""What is changed, and the tests that are to notice, the quick ones first."""
COMPILED = ("estimator",)
"""Rooms without kernels of their own, whose tests take minutes unless numba compiles those that they call."""
THOROUGH = ("motion", "path", "splits")
ENOUGH = 0.9
NOTICED = {1: "a test fails", 2: "it cannot be collected", -signal.SIGXCPU: "it goes on without end"}


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of one file: the operator of cosmic-ray, and which of the places it could change there."""

    room: str
    path: str
    operator: str
    occurrence: int
    line: int

    @property
    def is_boundary(self) -> bool:
        """A comparison or a number is changed."""
        return self.operator.startswith(("core/ReplaceComparison", "core/NumberReplacer"))

    def source(self) -> str:
        """Return the changed file."""
        from cosmic_ray.mutating import mutate_code
        from cosmic_ray.plugins import get_operator

        changed = mutate_code(
            (ROOT / self.path).read_text(encoding="utf-8"), get_operator(self.operator)(), self.occurrence
        )
        assert changed is not None
        return changed

    def told(self) -> str:
        """Return where it is and what it is."""
        before = (ROOT / self.path).read_text(encoding="utf-8").splitlines()[self.line - 1].strip()
        after = self.source().splitlines()[self.line - 1].strip()
        return f"{self.path}:{self.line} {self.operator.removeprefix('core/')}\n    {before}\n    {after}"


def untouched_lines(source: str) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield where annotations and decorators begin and end: a change there changes nothing that runs, or nothing but the compiling."""
    for node in ast.walk(ast.parse(source)):
        found: list[ast.expr | None] = []
        if isinstance(node, ast.arg | ast.AnnAssign):
            found.append(node.annotation)
        if isinstance(node, ast.FunctionDef):
            found += [node.returns, *node.decorator_list]
        if isinstance(node, ast.ClassDef):
            found += node.decorator_list
        for each in found:
            if each is not None:
                yield (each.lineno, each.col_offset), (each.end_lineno or 0, each.end_col_offset or 0)


def mutants_of(room: str) -> list[Mutant]:
    """Return all changes of a room."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

    found = []
    for place in ROOMS[room][0]:
        for path in sorted((ROOT / place).rglob("*.py")) if (ROOT / place).is_dir() else [ROOT / place]:
            source = path.read_text(encoding="utf-8")
            nodes, untouched = list(ast_nodes(get_ast(source))), list(untouched_lines(source))
            for name in operator_names():
                if get_operator(name).arguments() or name.endswith(("_Is", "_IsNot", "RemoveDecorator")):
                    continue
                operator = get_operator(name)()
                places = [start for node in nodes for start, _ in operator.mutation_positions(node)]
                found += [
                    Mutant(room, str(path.relative_to(ROOT)), name, occurrence, at[0])
                    for occurrence, at in enumerate(places)
                    if not any(start <= at < end for start, end in untouched)
                    and not source.splitlines()[at[0] - 1].startswith("*,", at[1])
                ]
    return found


def chosen(rooms: list[str], draw: int, seed: int, *, thorough: bool) -> list[Mutant]:
    """Return the changes to try: as many as are drawn of these rooms, and every comparison and number of those in `THOROUGH`."""
    every = [mutant for room in rooms for mutant in mutants_of(room)]
    drawn = random.Random(seed).sample(every, min(draw, len(every)))
    boundaries = [mutant for mutant in every if mutant.room in THOROUGH and mutant.is_boundary]
    return list(dict.fromkeys(drawn + boundaries if thorough else drawn))


def run_pytest(tests: tuple[str, ...]) -> int:
    """Run tests to the first that fails, without a word."""
    import pytest

    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    plugins = [
        argument for name in ("cacheprovider", "randomly", "xdist", "benchmark") for argument in ("-p", f"no:{name}")
    ]
    return int(pytest.main(["-x", "-q", "--assert=plain", *plugins, *tests]))


def run_tests(tests: tuple[str, ...], mutant: Mutant | None, cpu_s: int) -> int:
    """Run tests in a fork, with a file changed; return the exit status, or minus the signal that ended it."""
    source = mutant.source() if mutant else ""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 1))
    if mutant:
        path, unchanged = str(ROOT / mutant.path), importlib.machinery.SourceFileLoader.get_code

        def get_code(loader: importlib.machinery.SourceFileLoader, name: str) -> object:
            return compile(source, path, "exec", dont_inherit=True) if loader.path == path else unchanged(loader, name)

        importlib.machinery.SourceFileLoader.get_code = get_code
    status = 3
    with suppress(BaseException):
        status = run_pytest(tests)
    os._exit(status)


def warm_up(tests: tuple[str, ...]) -> float:
    """Import what these tests import of others, so that a fork need not; return the CPU seconds the tests take unchanged."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        status = run_pytest(tests)
        with os.fdopen(writing, "w") as pipe:
            pipe.write("\n".join(sys.modules))
        os._exit(status)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        names = pipe.read().split("\n")
    if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]):
        sys.exit(
            f"{' '.join(tests)}: a test fails with nothing changed (NUMBA_DISABLE_JIT={os.environ['NUMBA_DISABLE_JIT']})"
        )
    ours = {"tcpipe", "tests", "conftest", *(path.stem for path in (ROOT / "tests").glob("*.py"))}
    for name in names:
        if name.split(".")[0] not in ours:
            with suppress(Exception):
                importlib.import_module(name)
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    if run_tests(tests, None, 600):
        sys.exit(f"{' '.join(tests)}: in a warm process a test fails with nothing changed")
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=list(ROOMS), help="which rooms to change")
    parser.add_argument("--draw", type=int, default=400, help="how many are drawn of these rooms")
    parser.add_argument("--seed", type=int, default=11, help="of the draw")
    parser.add_argument("--only-drawn", action="store_true", help="leave out what is tried anyway")
    given = parser.parse_args()
    os.chdir(ROOT)
    os.nice(19 - os.nice(0))
    sys.path.insert(0, str(ROOT))
    began = time.monotonic()
    mutants = chosen(given.rooms, given.draw, given.seed, thorough=not given.only_drawn)
    lived = 0
    for room in given.rooms:
        mine, tests = [mutant for mutant in mutants if mutant.room == room], ROOMS[room][1]
        if not mine:
            continue
        os.environ["NUMBA_DISABLE_JIT"] = str(int(room not in COMPILED))
        numba.core.config.reload_config()
        cpu_s = 10 + int(4 * warm_up(tests))
        survivors = 0
        for mutant in mine:
            if run_tests(tests, mutant, cpu_s) not in NOTICED:
                survivors += 1
                print(f"  {mutant.told()}", flush=True)
        print(f"{room}: {len(mine) - survivors} of {len(mine)} noticed", flush=True)
        lived += survivors
    share = 1 - lived / max(len(mutants), 1)
    print(f"{share:.1%} of {len(mutants)} noticed, in {time.monotonic() - began:.0f} s")
    sys.exit(share < ENOUGH)


if __name__ == "__main__":
    main()
