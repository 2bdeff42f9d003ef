"""Test what faults leave behind and what hostile inputs cost; docs/internals/faults.md has the promises.

``python benchmarks/faults.py kills|signals|full-disk|services|together|faults|hostile|mutations|all``: every command
that writes is interrupted at its steps (`fault_children`), at random moments, and by full disks of several sizes; the
object store and the cluster that it uses are stopped and killed (`fault_services`); two commands run at once. Then all
outputs are checked, and the command is called again. Hostile inputs (`hostile_inputs`) and mutated logs are read. The
exit code is 1 if a promise is broken. ``--only``, ``--steps`` and ``--times`` make it shorter. Cases in a bucket and on
a cluster are left out if TCPIPE_TEST_OBJECT_STORAGE names no gateway.
"""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # forked children have one thread

from fault_cases import CASES, LOG, Case, make_inputs
from fault_children import (
    INPUTS,
    LATEST_S,
    STORES,
    Ended,
    Fault,
    Tree,
    call,
    calls_together,
    different,
    half_written,
    in_child,
    see_output,
    see_store,
    tree,
    without_unfinished,
)
from fault_services import OUTAGES_S, PROGRAM, VICTIMS, Services, get_objects, put_objects
from hostile_inputs import try_all

services = Services()

FULL = 0
_DISK_BYTES = 256 << 20
STRIKES = {
    "kills": (signal.SIGKILL,),
    "signals": (signal.SIGTERM, signal.SIGINT, signal.SIGHUP),
    "full-disk": (FULL,),
    "services": (),
    "together": (),
}
LEFT_OVER = "left by a killed command"
"""Message of `verify` about payload that no document names and that `prune` removes."""
PROMISES = """
false if: a final path is neither whole as before nor whole as after, at the moment of the fault or later; a reader sees damage then; the
next identical call does not complete, or leaves other bytes than an undisturbed one, or any temporary; a process outlives its command; a
command that is asked to end (SIGTERM, SIGINT, SIGHUP) takes more than 5 s, exits with another code than 128 + signal, or leaves a
temporary; a full disk, a gateway or a cluster that is gone is told in more than plain lines; a full disk leaves a temporary; verify finds
a problem after the next call."""


@dataclass(frozen=True)
class Undisturbed:
    """A case without a fault: what was before and after, how it ends, and how an identical second call does."""

    case: Case
    state: Path
    objects: dict[str, bytes]
    """Objects in its bucket before the call."""
    before: Tree
    after: Tree
    ended: Ended
    again: int
    size_bytes: int
    """Objects that it leaves."""


def undisturbed(case: Case, work: Path) -> Undisturbed:
    """Run a case twice from the same state: the same bytes, or no comparison means anything."""
    state = work.parent / "state"
    _clear(work)
    put_objects(case.url, {})
    for run in case.before:
        _assert_done(case, call(run, work))
    shutil.rmtree(state, ignore_errors=True)
    shutil.copytree(work, state, ignore=lambda at, _: {INPUTS} if at == str(work) else set())
    objects, before = get_objects(case.url), all_of(case, work)
    _assert_done(case, call(case.run, work))
    after = all_of(case, work)
    again = call(case.run, work)
    changed = different(after, all_of(case, work))
    assert not changed, f"{case.name}: a second call changes {changed}"
    _restore(state, work)
    put_objects(case.url, objects)
    ended = call(case.run, work, steps_in=case.steps_in)
    changed = different(after, all_of(case, work))
    assert not changed, f"{case.name}: not the same twice: {changed}"
    there = {path: work / path for path in after if before.get(path) != after[path]}
    size_bytes = sum(path.stat().st_size for path in there.values() if path.is_file())
    size_bytes += sum(map(len, get_objects(case.url).values()))
    return Undisturbed(case, state, objects, before, after, ended, again.code, size_bytes)


def all_of(case: Case, work: Path) -> Tree:
    """Return what is in the workplace, and below ``there/`` what is in its bucket."""
    there: Tree = {}
    if case.url:
        for name, see in (("tcpipe-store", see_store), ("dataset", see_output)):
            found = in_child(lambda name=name, see=see: see(f"{case.url}/{name}"))
            there |= {f"there/{name}/{path}": what for path, what in found.items()}
    return tree(work) | there


def _assert_done(case: Case, ended: Ended) -> None:
    assert ended.code in (0, 3), f"{case.name}: {ended.code}: {ended.said}"


def _clear(work: Path) -> None:
    for entry in work.iterdir():
        if entry.name != INPUTS:
            shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()
    (work / "tmp").mkdir()


def _restore(state: Path, work: Path) -> None:
    _clear(work)
    shutil.copytree(state, work, dirs_exist_ok=True, symlinks=True)


def struck(plain: Undisturbed, work: Path, fault: Fault) -> list[str]:
    """Apply a fault to a case, check, call it again and check; return the broken promises."""
    case = plain.case
    _restore(plain.state, work)
    put_objects(case.url, plain.objects)
    with _room(work, fault.room_bytes):
        ended = call(case.run, work, fault, steps_in=case.steps_in, strike=services.strike)
    services.mend()
    now = all_of(case, work)
    bad = half_written(plain.before, plain.after, now)
    bad += [f"half visible: {line}" for line in _find_problems(plain, work)]
    bad += ["processes outlive it"] if ended.left_running else []
    if fault.victim:
        bad += _not_plain(plain, ended)
    elif fault.signal != signal.SIGKILL:
        bad += _untrue(plain, fault, ended, now)
        left = [path for path in now.keys() - without_unfinished(now).keys() if ".tmp-" in path or "tmp/" in path]
        bad += [f"left: {path}" for path in sorted(left)]
    bad += _of_the_next_call(plain, work, plain.after)
    return [f"{case.name}, {fault}: {line}" for line in bad]


def together(plain: Undisturbed, work: Path, turn: int) -> list[str]:
    """Run a case and what is beside it at once, each again, and compare with one after the other."""
    case = plain.case
    runs = [case.run, case.extra_features or case.run]
    trees = []
    for at_once in (False, True):
        _restore(plain.state, work)
        put_objects(case.url, plain.objects)
        ended = calls_together(runs, work) if at_once else [call(run, work) for run in runs]
        for run in runs:
            call(run, work)
        trees.append(all_of(case, work))
    bad = [line for each in ended for line in _not_plain(plain, each)]
    bad += _of_the_next_call(plain, work, trees[0])
    return [f"{case.name}, two at once ({turn}): {line}" for line in bad]


def _not_plain(plain: Undisturbed, ended: Ended) -> Iterator[str]:
    """Yield what is wrong with the end of a call for which something else was in the way."""
    if ended.code not in (plain.ended.code, plain.again, 0, 1, 2, 3):
        yield f"ends with {ended.code}"
    if "internal error" in ended.said or "Traceback" in ended.said:
        yield f"not plain: {ended.said.strip()[-300:]}"


def _of_the_next_call(plain: Undisturbed, work: Path, wanted: Tree) -> Iterator[str]:
    """Call a case again; yield what is not as after an undisturbed call."""
    again = call(plain.case.run, work)
    if again.code not in (plain.ended.code, plain.again):
        yield f"the next call ends with {again.code}: {again.said.strip()[-300:]}"
    for path in different(wanted, all_of(plain.case, work))[:3]:
        yield f"the next call leaves other bytes: {path}"
    yield from _find_problems(plain, work)


def _find_problems(plain: Undisturbed, work: Path) -> Iterator[str]:
    """Yield what `verify` finds at the outputs that a reader would find now: store and dataset, on disk and in the bucket."""
    objects = get_objects(plain.case.url).keys() if plain.case.url else ()
    for name, mark in (("tcpipe-store", "calls/"), ("dataset", "current.")):
        if any(of.startswith(f"{name}/{mark}") for of in objects):
            yield from in_child(lambda name=name: _verify(f"{plain.case.url}/{name}"))
    for name, mark in (*((store, "calls") for store in STORES), ("dataset", "dataset.json")):
        if (work / name / mark).exists():
            yield from in_child(lambda name=name: _verify(work / name))


def _verify(path: str | Path) -> list[str]:
    """Return what is not as it was written at a place."""
    from tcpipe.pipeline.verify import verify

    return [f"verify: {problem}" for problem in verify(path).problems if LEFT_OVER not in problem]


@contextmanager
def _room(work: Path, size_bytes: int) -> Iterator[None]:
    """Leave so much room on the disk, for 0 all of it."""
    ballast = work.parent / "ballast"
    if size_bytes:
        free = os.statvfs(work)
        with ballast.open("wb") as stream:
            os.posix_fallocate(stream.fileno(), 0, max(1, free.f_bavail * free.f_bsize - size_bytes))
    try:
        yield
    finally:
        ballast.unlink(missing_ok=True)


def _untrue(plain: Undisturbed, fault: Fault, ended: Ended, now: Tree) -> Iterator[str]:
    """Yield what is wrong with how a command ended that was asked to, or met a full disk."""
    if ended.code == plain.ended.code and (fault.after_s or not fault.signal):  # it was done before
        if "No space left" not in ended.said:  # a run is done, and that its log was seen could not be remembered
            yield from ("said to be done, and is not" for _ in different(plain.after, now)[:1])
        return
    if "internal error" in ended.said:
        yield f"not plain: {ended.said.strip()[-300:]}"
    if fault.signal:
        if ended.late_s > LATEST_S and fault.after_s:
            yield f"took {ended.late_s:.1f} s to end"
        if ended.code != 128 + fault.signal:
            yield f"ends with {ended.code}, expected {128 + fault.signal}: {ended.said.strip()[-200:]}"
    elif ended.code not in (1, 3) or "No space left" not in ended.said:
        yield f"ends with {ended.code}: {ended.said.strip()[-200:]}"


def faults_of(plain: Undisturbed, campaign: str, options: argparse.Namespace) -> Iterator[Fault]:
    """Yield every step of a case, or ``--steps`` of them, and ``--times`` random moments."""
    strikes, count, rng = STRIKES[campaign], plain.ended.steps, random.Random(f"{options.seed} {plain.case.name}")
    every = max(1.0, count / options.steps) if options.steps else 1.0
    for at in range(int(count / every) if strikes and not (plain.case.url and campaign == "full-disk") else 0):
        yield Fault(strikes[at % len(strikes)], step=1 + int(at * every))
    if campaign == "services":
        victims = [*(OUTAGES_S if plain.case.url else ()), *(VICTIMS if "cluster" in plain.case.wants else ())]
        for at in range(options.times if victims else 0):
            after_s = rng.uniform(0.001, plain.ended.seconds)
            yield Fault(signal.SIGKILL, after_s=after_s, victim=victims[at % len(victims)])
    elif campaign != "full-disk":
        yield from (
            Fault(strikes[at % len(strikes)], after_s=rng.uniform(0.001, 1.05 * plain.ended.seconds))
            for at in range(options.times)
        )
    elif plain.state.parent.is_mount() and plain.size_bytes:
        yield from (Fault(FULL, room_bytes=1 + (at * plain.size_bytes) // options.times) for at in range(options.times))


@contextmanager
def workplace(wanted: set[str]) -> Iterator[Path]:
    """Yield a directory with inputs in it: a small disk of its own in memory, where this user can mount one."""
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # noqa: S108
    place = Path(tempfile.mkdtemp(dir=memory, prefix="faults-")).resolve()  # no finalizer: children would run it
    mount = ["mount", "-t", "tmpfs", "-o", f"size={_DISK_BYTES}", "tmpfs", place]
    mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    if not mounted:
        print("no disk of a chosen size can be mounted: full disks are played at steps alone")
    try:
        make_inputs(place / "work" / INPUTS, wanted)
        with closing(services):
            yield place / "work"
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", place], check=True)
        shutil.rmtree(place)


def run(campaigns: list[str], cases: list[Case], options: argparse.Namespace) -> bool:
    """Strike every case; print a line for each; return whether all is as promised."""
    print(
        f"{'':32} {'steps':>6} {'seconds':>8}" + "".join(f" {name:>10}" for name in campaigns) + "   findings",
        flush=True,
    )
    total = dict.fromkeys(campaigns, 0)
    findings = 0
    with workplace(set().union(*(case.wants for case in cases))) as work:
        inputs = without_unfinished(tree(work / INPUTS))
        for case in cases:
            services.start(gateway=bool(case.url), cluster="cluster" in case.wants, watched=case.has_workers)
            plain, wrong = undisturbed(case, work), []
            counts = dict.fromkeys(campaigns, 0)
            for name in campaigns:
                for fault in faults_of(plain, name, options) if name != "together" else range(1, 1 + options.twice):
                    counts[name] += 1
                    try_it = together if name == "together" else struck
                    wrong += [lines] if (lines := try_it(plain, work, fault)) else []
            columns = "".join(f" {count:10}" for count in counts.values())
            print(
                f"{case.name:32} {plain.ended.steps:6} {plain.ended.seconds:8.2f}{columns} {len(wrong):10}", flush=True
            )
            for line in [line for lines in wrong for line in lines][: options.shown]:
                print(f"    {line}", flush=True)
            total = {name: total[name] + counts[name] for name in campaigns}
            findings += len(wrong)
        changed = different(inputs, without_unfinished(tree(work / INPUTS)))
    print(f"{'together':32} {'':6} {'':8}" + "".join(f" {count:10}" for count in total.values()) + f" {findings:10}")
    print(*(f"an input was changed: {path}" for path in changed), PROMISES, sep="\n")
    return not findings and not changed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign", choices=[*STRIKES, "faults", "hostile", "mutations", "all"])
    parser.add_argument("--only", default="", help="these calls alone, by commas")
    parser.add_argument("--steps", type=int, default=0, help="at most so many steps of each call (0: every one)")
    parser.add_argument("--times", type=int, default=15, help="so many random moments of each call")
    parser.add_argument("--twice", type=int, default=3, help="so often two run at once")
    parser.add_argument("--seed", type=int, default=1, help="of the random moments")
    parser.add_argument("--mutations", type=int, default=10_000, help="so many mutated logs")
    parser.add_argument("--shown", type=int, default=5, help="findings shown of each call")
    options = parser.parse_args()
    fine = True
    if options.campaign in ("hostile", "all"):
        fine = hostile(options)
    if options.campaign in ("mutations", "all"):
        fine &= mutated(options)
    if options.campaign in (*STRIKES, "faults", "all"):
        fine &= faulted(options)
    return 0 if fine else 1


def faulted(options: argparse.Namespace) -> bool:
    """Break the commands, as options say."""
    only = options.only.split(",") if options.only else [case.name for case in CASES]
    cases = [case for case in CASES if case.name in only and (PROGRAM in os.environ or not case.url)]
    campaigns = [options.campaign] if options.campaign in STRIKES else list(STRIKES)
    return run(campaigns, cases, options)


def hostile(options: argparse.Namespace) -> bool:
    """Try hostile inputs; recipes are tried on a simulated log."""
    with workplace({"log"}) as work:
        return try_all(work / LOG, options.only)


def mutated(options: argparse.Namespace) -> bool:
    """Read mutated logs: each loss and each change must be reported."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "fuzz"))
    from mutated_logs import findings

    verdicts = Counter[str]()
    for finding in findings(options.mutations, options.seed):
        verdicts[finding.verdict] += 1
        if finding.verdict == "silent":
            print(f"{finding.kind}: {finding.what}")
    print(*(f"{verdict:32} {count:6}" for verdict, count in verdicts.items()), sep="\n")
    print("\nfalse if: a mutated log is read otherwise than the whole one, and nothing of it is told (silent)")
    return not verdicts["silent"]


if __name__ == "__main__":
    sys.exit(main())
