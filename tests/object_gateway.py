"""A real object store for tests: Ceph's gateway, started by the program that TCPIPE_TEST_OBJECT_STORAGE names, once a session."""

import contextlib
import os
import re
import signal
import subprocess
import uuid
from collections.abc import Iterator
from pathlib import Path

import obstore
import pytest
from obstore.store import from_url
from storage_server import Fetched, object_store

from tcpipe.formats import object_storage

# Where a monitor of Ceph comes up at all it does so in seconds; where it does not, its client asks for five minutes.
ATTEMPTS, SECONDS_EACH = 3, 90


@pytest.fixture(scope="session")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Start the gateway, make the bucket ``tests`` and yield the environment that leads there; skip where it is not to be had."""
    program = os.environ.get("TCPIPE_TEST_OBJECT_STORAGE")
    if not program:
        pytest.skip("TCPIPE_TEST_OBJECT_STORAGE names no object store (make test-object-storage)")
    failures = []
    for _ in range(ATTEMPTS):
        directory = tmp_path_factory.mktemp("gateway") / "s3"
        failure = failure_to_start(program, directory)
        if failure is None:
            break
        failures.append(failure)
    else:
        pytest.skip(f"{program} did not start an object store in {ATTEMPTS} attempts: {'; '.join(failures)}")
    try:
        environment = dict(re.findall(r"export (\w+)=(.*)", (directory / "env").read_text()))
        make_bucket("tests", environment)
        yield environment
    finally:
        subprocess.run([program, "stop", directory], check=False)


def failure_to_start(program: str, directory: Path, seconds: float = SECONDS_EACH) -> str | None:
    """Start an object store below a directory; None once it answers, else why it does not, with all that was started ended."""
    said = directory.parent / "start.err"
    with said.open("w") as errors:
        starting = subprocess.Popen(
            [program, "start", directory], stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True
        )
    try:
        if starting.wait(seconds) == 0:
            return None
        reason = f"exit status {starting.returncode}"
    except subprocess.TimeoutExpired:
        reason = f"no answer in {seconds:g} s"
    with contextlib.suppress(ProcessLookupError):
        os.killpg(starting.pid, signal.SIGKILL)
    starting.wait()
    logs = [said, *sorted(directory.glob("*.out"))]
    return " | ".join(
        [
            reason,
            *(
                f"{path.name}: {path.read_text(errors='replace')[-300:].strip()}"
                for path in logs
                if path.stat().st_size
            ),
        ]
    )


def make_bucket(name: str, environment: dict[str, str]) -> None:
    """Make a bucket: an object of its name in a store whose own name is not part of the address."""
    options = {key.removeprefix("AWS_").lower(): value for key, value in environment.items() if key.startswith("AWS_")}
    keys = {key: options[key] for key in ("access_key_id", "secret_access_key", "region")}
    root = from_url(
        "s3://any",
        endpoint=options["endpoint_url"],
        virtual_hosted_style_request=True,
        client_options={"allow_http": True},
        **keys,
    )
    with pytest.raises(obstore.exceptions.GenericError, match="ETag"):  # made, and no object
        obstore.put(root, name, b"")


def in_environment(patch: pytest.MonkeyPatch, environment: dict[str, str], cache: Path) -> None:
    """Lead to a store, and cache below a directory."""
    for name in ("HTTP_PROXY", "http_proxy"):
        patch.delenv(name, raising=False)
    for name, value in {**environment, "TCPIPE_CACHE": str(cache)}.items():
        patch.setenv(name, value)


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fetched]:
    """Lead to a bucket ``tests`` that a server of this process has in ``served/tests``, and yield what was asked of it so far."""
    (tmp_path / "served" / "tests").mkdir(parents=True)
    with object_store(tmp_path / "served") as (environment, fetched):
        in_environment(monkeypatch, environment, tmp_path / "cache")
        # An earlier server of this process may have had the same port: this one has not answered yet.
        monkeypatch.setattr(object_storage, "_has_answered", {})
        yield fetched


def open_bucket(kind: str, request: pytest.FixtureRequest, patch: pytest.MonkeyPatch, directory: Path) -> str:
    """Return the URL of an empty place in the bucket ``tests`` of the ``gateway``, or of a server as `served`."""
    if kind != "gateway":
        request.getfixturevalue("served")
        return "s3://tests"
    in_environment(patch, request.getfixturevalue("gateway"), directory / "cache")
    return f"s3://tests/{uuid.uuid4().hex}"
