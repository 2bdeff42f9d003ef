"""Passwords and signatures in URLs: a presigned URL is read like any other, and what it is signed with is in nothing written or printed."""

import re
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import cycle
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from installed_command import plain_lines, tcpipe, told
from written_bytes import written_bytes

from tcpipe.errors import LogError, TcpipeError, UsageError, hide_secrets
from tcpipe.formats.dataset_files import read_samples
from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.place import open_place
from tcpipe.store import Store

DRAWS_DATASET_PAGES = True

SECRET, OTHER = "5ecretS1gnature/+x", "an0therS1gnature"
SIGNED, AGAIN = (f"?X-Amz-Expires=900&X-Amz-Signature={name}" for name in (SECRET.replace("+", "%2B"), OTHER))


class _Presigned(BaseHTTPRequestHandler):
    """Gives a file to GET with a signature, and refuses whatever else with an answer that repeats the query."""

    def do_GET(self):
        address = urlsplit(self.path)
        path = self.server.root / Path(address.path).name
        signature = parse_qs(address.query).get("X-Amz-Signature", [""])[0]
        if signature not in (SECRET, OTHER):
            self._send(403, f"signature {signature} of {address.query} is wrong".encode())
        elif not path.is_file():
            self._send(404, f"nothing at {self.path}".encode())
        else:
            data = path.read_bytes()
            low, high = map(int, re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers["Range"]).groups())
            part = data[low : high + 1]
            self._send(206, part, f"bytes {low}-{low + len(part) - 1}/{len(data)}")

    def do_HEAD(self):
        self._send(403, b"")

    def _send(self, status, body, span=None):
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        if span:
            self.send_header("Content-Range", span)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


@contextmanager
def presigned(root):
    """Yield the address of a server of a directory's files."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Presigned)
    server.root = root
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/drives"
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture(autouse=True)
def no_proxy(monkeypatch):
    for name in ("HTTP_PROXY", "http_proxy", "HTTPS_PROXY", "https_proxy"):
        monkeypatch.delenv(name, raising=False)


def assert_hidden(texts, *secrets):
    for where, text in texts:
        for secret in secrets:
            assert secret.encode() not in text, (where, secret)


def test_a_signature_is_in_nothing_that_is_written_or_printed(tiny_site, tmp_path):
    printed = []

    def run(*arguments, codes=(0,)):
        done = tcpipe(*arguments, cwd=tmp_path, env={"TCPIPE_RETRY_MINUTES": "0"})
        assert done.returncode in codes, done.stderr
        printed.append((arguments, (done.stdout + done.stderr).encode()))
        return done

    layers = [item for role in ("height", "ortho", "terrain") for item in (f"--{role}", tiny_site.rasters[role])]
    layers += ["--classes", tiny_site.rasters["classes"]]
    name = tiny_site.logs[0].name
    with presigned(tiny_site.logs[0].parent) as server:
        url = f"{server}/{name}"
        gone, wrong = f"{server}/gone.mcap{SIGNED}", f"{url}?X-Amz-Signature=wr0ngS1gnature"
        for command in ("inspect", "preflight"):
            run(command, url + SIGNED, codes=(0, 3))
            run(command, url + SIGNED, "--json", codes=(0, 3))
        run("export", url + SIGNED, "exported")
        first = told(run("ingest", url + SIGNED, gone, wrong, "--json", codes=(3,)))["results"]
        again = told(run("ingest", url + AGAIN, "--json"))["results"]
        run("status", url + AGAIN, codes=(0, 3))
        run("--debug", "ingest", url + SIGNED, "--force", codes=(0, 3))
        run("ingest", url + SIGNED, "--dry-run", codes=(0, 3))
    run("ingest", url + SIGNED, "--force", codes=(1, 3))  # nobody answers any more
    run("status", "--json")
    run("add-map", "site", *layers)
    run("build-dataset", codes=(0, 3))
    sample = read_samples(tmp_path / "dataset").column("sample_id")[0].as_py()
    run("explain", sample, "--json", codes=(0, 1))
    for path in ("tcpipe-store", "dataset"):
        run("report", path)
        run("verify", path)
        run("inspect", path)
    assert [result["status"] for result in first] == ["failed", "failed", "done"]
    assert first[2]["log"] == url
    assert [(result["status"], result["run"]["run_id"]) for result in again] == [
        ("unchanged", first[2]["run"]["run_id"])
    ]
    assert len(Store(tmp_path / "tcpipe-store").runs()) == 1
    secrets = ("5ecretS1gnature", OTHER, "wr0ngS1gnature", "X-Amz-Signature")
    assert_hidden(printed, *secrets[:3])
    assert_hidden(written_bytes(tmp_path), *secrets)


CREDENTIALS = (
    "http://anna:s3cr3tWord@127.0.0.1:1/run.mcap",
    "https://s3cr3tWord@host/run.mcap?x=s3cr3tWord",
    "s3://AKIAKEY:s3cr3t/Word+s3cr3tWord@bucket/run.mcap",
    "s3://bucket/run.mcap?X-Amz-Signature=s3cr3tWord",
    "az://container/run.mcap?sv=2024&sig=s3cr3tWord",
    "gs://a:s3cr3tWord@bucket/run.mcap",
    "tcp://anna:s3cr3tWord@host:8786",
)


COMMANDS = (
    ("inspect", "{}"), ("preflight", "{}"), ("export", "{}", "out"), ("status", "--store", "{}"), ("verify", "{}"), ("report", "{}"),
    ("ingest", "none.bag", "--store", "{}"), ("ingest", "none.bag", "--cluster", "{}"), ("add-map", "site", "--height", "{}"),
    ("build-dataset", "--out", "{}"), ("explain", "x", "--dataset", "{}"), ("predict-path", "{}", "path.geojson"), ("train", "{}"),
    ("status", "one", "two", "{}", "--unknown={}"),
)  # fmt: skip


@pytest.mark.parametrize(
    ("url", "arguments"),
    [*((url, ("ingest", "{}")) for url in CREDENTIALS), *zip(cycle(CREDENTIALS), COMMANDS, strict=False)],
)
def test_a_url_with_credentials_is_refused_and_they_are_not_shown(url, arguments, tmp_path):
    done = tcpipe(*(argument.format(url) for argument in arguments), cwd=tmp_path)
    plain_lines(done, done.returncode)
    assert done.returncode in (1, 2)
    assert_hidden([(arguments, (done.stdout + done.stderr).encode()), *written_bytes(tmp_path)], "s3cr3t", "AKIAKEY")


@pytest.mark.parametrize("url", CREDENTIALS[:6])
def test_the_python_calls_refuse_credentials_too(url):
    for call in (open_log, open_place):
        with pytest.raises((UsageError, LogError)) as refused:
            call(url)
        assert isinstance(refused.value, UsageError) or url.startswith("http")
        assert "s3cr3t" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("s3://bucket/anna@robot/run.mcap", None),
        ("s3://bucket/what?.mcap", None),
        ("http://host:8000/anna@robot/run.mcap", None),
        ("http://[::1]:8000/anna@robot/run.mcap", None),
        ("file:///data/anna@robot/run.mcap", None),
        ("s3://bucket: cannot be read", None),
        ("see 'http://host/x?a=1&b=%2F==': no", "see 'http://host/x': no"),
        ("(http://host/x?token), http://a:b@c/d.", "(http://host/x), http://c/d."),
        ("/vsicurl/http://a:b@host/x.tif", "/vsicurl/http://host/x.tif"),
        ("s3:/KEY:pa/ss@bucket/x", "s3:/bucket/x"),
        ("HTTP://A:B@HOST/x#access_token=1", "HTTP://HOST/x"),
    ],
)
def test_how_a_url_is_shown(text, shown):
    assert hide_secrets(text) == (text if shown is None else shown)
    assert str(TcpipeError(text)) == (text if shown is None else shown)


@pytest.mark.parametrize(
    "text", ["a" * 10**6, "http://x?" + ")" * 10**6 + "a", "a://" + "@:" * 10**6, "s3://x?" * 10**5]
)
def test_hiding_takes_time_in_proportion_to_the_text(text):
    assert len(hide_secrets(text)) <= len(text)
