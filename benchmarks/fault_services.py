"""The object store and the cluster of a fault campaign: real ones, as processes that can be stopped, killed and started again."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import fault_workers
from fault_children import in_child

from tcpipe.formats.place import open_place

if TYPE_CHECKING:
    from dask_cluster import DaskCluster

BUCKET = "faults"
PROGRAM = "TCPIPE_TEST_OBJECT_STORAGE"
"""Names the program that starts the gateway; see tests/object_gateway.py."""

OUTAGES_S = {"gateway stands still": 2.0, "gateway is killed": 1.0, "gateway is gone": 12.0}
"""Faults of the gateway and their durations; a fault does not wait for the end of the one before."""


VICTIMS = ("worker", "scheduler")
"""Faults of a cluster and their durations."""


class Services:
    """A gateway and a cluster, each started when it is first wanted, both gone in the end."""

    def __init__(self) -> None:
        self._directory = Path(tempfile.gettempdir(), f"fault-services-{os.getpid()}")
        self._stack, self._cluster_stack = ExitStack(), ExitStack()
        self._gateway: Path | None = None
        self._cluster: DaskCluster | None = None
        self._outage: subprocess.Popen[bytes] | None = None
        self._is_watched = False

    def start(self, *, gateway: bool, cluster: bool, watched: bool) -> None:
        """Have what is wanted running, and lead there by the environment; ``watched``: workers count their requests."""
        self._directory.mkdir(exist_ok=True)
        if gateway and self._gateway is None:
            self._start_gateway()
        if watched != self._is_watched:
            self._cluster_stack.close()
            self._cluster, self._is_watched = None, watched
            if watched:
                self._cluster_stack.enter_context(fault_workers.lead_workers(self._directory / "steps"))
        if cluster and self._cluster is None:
            self._start_cluster()
        os.environ.pop("TCPIPE_CLUSTER", None)
        if cluster:
            os.environ["TCPIPE_CLUSTER"] = self._cluster.address

    def strike(self, victim: str) -> None:
        """Apply a fault to the gateway or the cluster."""
        if victim == "worker":
            for worker in self._cluster.workers[:1]:  # its nanny starts another
                for child in Path(f"/proc/{worker.pid}/task/{worker.pid}/children").read_text().split():
                    if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text():
                        os.kill(int(child), 9)
        elif victim == "scheduler":
            self._cluster.scheduler.kill()
        else:
            again = "env CEPH_CONF=ceph.conf radosgw -n client.rgw -f >>rgw.out 2>&1 </dev/null & echo $! >rgw.pid"
            how = "kill -STOP {0}; sleep {1}; kill -CONT {0}" if "still" in victim else "kill -9 {0}; sleep {1}; {2}"
            command = how.format("$(cat rgw.pid)", OUTAGES_S[victim], again)
            self._outage = subprocess.Popen(["sh", "-c", command], cwd=self._gateway, start_new_session=True)

    def mend(self) -> None:
        """Have everything running again."""
        if self._outage is not None:
            self._outage.wait()
            self._outage = None
            self._await_gateway()
        if self._cluster is not None and self._cluster.scheduler.poll() is not None:
            self._cluster_stack.close()
            self._start_cluster()
            os.environ["TCPIPE_CLUSTER"] = self._cluster.address

    def close(self) -> None:
        """End both."""
        self.mend()
        self._cluster_stack.close()
        self._stack.close()
        shutil.rmtree(self._directory, ignore_errors=True)

    def _start_gateway(self) -> None:
        self._gateway = self._directory / "gateway"
        program = os.environ[PROGRAM]
        subprocess.run([program, "start", self._gateway], check=True, stdout=subprocess.DEVNULL)
        self._stack.callback(subprocess.run, [program, "stop", self._gateway], check=False)
        environment = dict(re.findall(r"export (\w+)=(.*)", (self._gateway / "env").read_text()))
        os.environ.update(environment, TCPIPE_CACHE=str(self._directory / "cache"))
        in_child(_make_bucket)

    def _await_gateway(self) -> None:
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        for _ in range(600):
            with suppress(OSError):
                opener.open(os.environ["AWS_ENDPOINT_URL"], timeout=5)
                return
            time.sleep(0.1)
        raise TimeoutError("the gateway does not come back")

    def _start_cluster(self) -> None:
        from dask_cluster import dask_cluster  # of an extra

        number = len(list(self._directory.glob("cluster-*")))
        directory = self._directory / f"cluster-{number}"
        directory.mkdir()
        self._cluster = self._cluster_stack.enter_context(dask_cluster(directory, workers=1))


def _make_bucket() -> None:
    from object_gateway import make_bucket

    make_bucket(BUCKET, dict(os.environ))


def get_objects(url: str) -> dict[str, bytes]:
    """Return the objects below a URL by name; none if there is no URL."""

    def get() -> dict[str, bytes]:
        place = open_place(url)
        return {entry.name: place.read(entry.name) for entry in place.entries()}

    return in_child(get) if url else {}


def put_objects(url: str, objects: dict[str, bytes]) -> None:
    """Have these objects below a URL, and no others."""

    def put() -> None:
        place = open_place(url)
        for entry in place.entries():
            place.delete(entry.name)
        for name, data in objects.items():
            place.put(name, data)

    if url:
        in_child(put)
