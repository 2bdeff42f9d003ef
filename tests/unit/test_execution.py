"""Tasks side by side: order does not matter, and a killed worker costs only its own task."""

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tcpipe.execution import run_all
from tcpipe.progress import STEP, set_task, step, step_of


def _square(value: int) -> int:
    return value * value


def _die_on_three(value: int) -> int:
    if value == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return value


@pytest.mark.parametrize("jobs", [1, 3])
def test_every_task_has_its_result_whatever_the_number_of_workers(jobs: int) -> None:
    outcomes = sorted(run_all(_square, list(range(7)), jobs=jobs), key=lambda o: o.index)
    assert [o.result for o in outcomes] == [n * n for n in range(7)]
    assert not any(o.died for o in outcomes)


def test_a_killed_worker_costs_only_its_own_task() -> None:
    outcomes = {o.index: o for o in run_all(_die_on_three, list(range(6)), jobs=2)}
    assert set(outcomes) == set(range(6))
    assert [index for index, o in outcomes.items() if o.died] == [3]
    assert all(o.result == index for index, o in outcomes.items() if index != 3)


def _say(value: int) -> int:
    with set_task("/long" * 100):
        step("reading", value, 10)
    logging.getLogger("tcpipe").info("task %d", value)
    return os.getpid()


def test_what_workers_log_is_said_here(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(STEP, "tcpipe"):
        outcomes = list(run_all(_say, [1, 2, 3], jobs=2))
    assert sorted(of.done for of in map(step_of, caplog.records) if of) == [1, 2, 3]
    assert sorted(of.getMessage() for of in caplog.records if not step_of(of)) == ["task 1", "task 2", "task 3"]
    assert os.getpid() not in {outcome.result for outcome in outcomes}


def _sleep(path: Path) -> None:
    path.write_text(str(os.getpid()))
    time.sleep(60)


def _gone(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def _wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def _workers(paths: list[Path]) -> list[int]:
    _wait_for(lambda: all(path.exists() and path.read_text() for path in paths))
    return [int(path.read_text()) for path in paths]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_their_parent(tmp_path: Path, number: signal.Signals) -> None:
    """Interrupted, nobody wants their results; killed, nobody can have them."""
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from pathlib import Path; from test_execution import _sleep, run_all\n"
        "if __name__ == '__main__': list(run_all(_sleep, [Path(path) for path in sys.argv[2:]], jobs=2))\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(program)
    paths = [tmp_path / "1", tmp_path / "2"]
    with subprocess.Popen([sys.executable, script, Path(__file__).parent, *paths], stderr=subprocess.PIPE) as parent:
        workers = _workers(paths)
        parent.send_signal(number)
        parent.communicate(timeout=20)
    assert parent.returncode != 0
    _wait_for(lambda: all(_gone(worker) for worker in workers))


def test_a_script_without_a_main_guard_is_told_in_one_line(tmp_path: Path) -> None:
    """Each worker imports the script, which would begin workers of its own."""
    script, store = tmp_path / "script.py", tmp_path / "store"
    script.write_text(f"import tcpipe\ntcpipe.ingest([{str(tmp_path)!r}], store={str(store)!r}, jobs=2)\n")
    for name in "ab":
        (tmp_path / f"{name}.mcap").write_bytes(name.encode() * ord(name))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    said = done.stdout + done.stderr
    assert said.count("Traceback") == 1
    assert "main guard" in done.stderr.splitlines()[-1]
    assert done.stderr.splitlines()[-1].startswith("tcpipe.errors.UsageError")
