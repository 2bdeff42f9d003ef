"""A process that is asked to end ends, whatever library holds its one thread."""

import os
import signal
import subprocess
import sys
import threading

import pytest

import tcpipe.cli
from tcpipe.cli import terminate_on_signal


@pytest.fixture
def ended(monkeypatch):
    """An event, and the exit codes by which the process would have ended."""
    event, codes = threading.Event(), []
    monkeypatch.setattr(tcpipe.cli, "_LATEST_S", 0.05)
    monkeypatch.setattr(os, "_exit", lambda code: (codes.append(code), event.set()))
    before = signal.signal(signal.SIGTERM, lambda *_: None)  # as a library that lets no exception through
    yield event, codes
    signal.signal(signal.SIGTERM, before)


def test_who_does_not_end_is_ended(ended, capfd):
    event, codes = ended
    with terminate_on_signal():
        signal.raise_signal(signal.SIGTERM)
        assert event.wait(60)
    assert codes == [128 + signal.SIGTERM]
    assert capfd.readouterr().err == ("tcpipe: ended by SIGTERM; no output is incomplete; run the same command again\n")


def test_who_ends_in_time_and_other_signals_are_left_alone(ended):
    event, codes = ended
    before = signal.signal(signal.SIGALRM, lambda *_: None)
    with terminate_on_signal():
        signal.raise_signal(signal.SIGALRM)
        assert not event.wait(0.2)
        signal.raise_signal(signal.SIGTERM)
    signal.signal(signal.SIGALRM, before)
    assert not event.wait(0.2)
    assert codes == []


def test_linear_algebra_has_one_thread_unless_the_environment_says_otherwise():
    told = "import os, sys, tcpipe.cli as c; c.prepare_process(); print(os.environ['OPENBLAS_NUM_THREADS'], 'numpy' in sys.modules)"
    for given, wanted in (({}, "1 False\n"), ({"OPENBLAS_NUM_THREADS": "3"}, "3 False\n")):
        environment = {key: value for key, value in os.environ.items() if key != "OPENBLAS_NUM_THREADS"} | given
        found = subprocess.run(
            [sys.executable, "-c", told], env=environment, capture_output=True, text=True, check=True
        )
        assert found.stdout == wanted


def test_a_signal_before_the_command_begins_is_one_line_too():
    """As soon as it is listened for."""
    program = (
        "import os, signal, tcpipe.cli as c; real = c.prepare_process\n"
        "c.prepare_process = lambda: (real(), os.kill(os.getpid(), signal.SIGTERM))\nc.main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (
        143,
        "tcpipe: ended by SIGTERM; no output is incomplete; run the same command again\n",
    )


def test_an_import_that_a_signal_breaks_is_no_internal_error():
    program = """
import os, signal, time
from tcpipe import cli

def load(**_):
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(10.0)
    except KeyboardInterrupt:
        raise ImportError("an extension is half loaded")

cli.cli.main = load
cli.main()
"""
    done = subprocess.run([sys.executable, "-c", program, "demo"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "tcpipe: ended by SIGINT; no output is incomplete; run the same command again\n"
