"""A real object store for tests: Ceph's gateway, started by the program that TCPIPE_TEST_OBJECT_STORAGE names, once a session."""

import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import obstore
import pytest
from obstore.store import from_url


@pytest.fixture(scope="session")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Start the gateway, make the bucket ``tests`` and yield the environment that leads there; skip where it is not to be had."""
    program = os.environ.get("TCPIPE_TEST_OBJECT_STORAGE")
    if not program:
        pytest.skip("TCPIPE_TEST_OBJECT_STORAGE names no object store (make test-object-storage)")
    directory = tmp_path_factory.mktemp("gateway") / "s3"
    subprocess.run([program, "start", directory], check=True, stdout=subprocess.DEVNULL)
    try:
        environment = dict(re.findall(r"export (\w+)=(.*)", (directory / "env").read_text()))
        make_bucket("tests", environment)
        yield environment
    finally:
        subprocess.run([program, "stop", directory], check=False)


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
