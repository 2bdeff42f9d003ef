"""Status predicts what ingest does, after any history: one plan, executed or shown."""

import hashlib
import os
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from synthetic_store import add_run, lanes, segments

from tcpipe.errors import UsageError
from tcpipe.formats.atomic import make_unique_name
from tcpipe.formats.recipe_toml import ingest_key, make_recipe_id
from tcpipe.formats.runs import LogOrigin, Run
from tcpipe.pipeline import ingest as ingest_module
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.ingest_run import Ingested
from tcpipe.pipeline.log_sources import find_damaged_log
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.plan import TO_DO, IngestResult, check_age, make_result
from tcpipe.pipeline.problems import acknowledge
from tcpipe.pipeline.status import find_log_states
from tcpipe.recipe import ReadConfig, Recipe
from tcpipe.store import Store, name_run, open_store
from tcpipe.tables.findings import Subject, make_finding

RECIPES = (Recipe(), replace(Recipe(), read=ReadConfig(ignore_topics=["/none"])))
KINDS = ("good", "damaged", "empty", "junk", "passing")


@pytest.fixture(scope="module")
def row(tmp_path_factory) -> Run:
    """The record of some run, of which others are made."""
    store = open_store(tmp_path_factory.mktemp("plan") / "store", create=True)
    add_run(store, "a", segments("a", *lanes(0.0, 0.0, 10.0)))
    (only,) = store.runs()
    return only.manifest


def make_row(row, task, sha256, kind):
    """Return the documents that an ingest of a log of this kind writes."""
    log = LogOrigin(task.source.origins, sha256)
    key, name = ingest_key(task.recipe), f"{task.source.stem}-{sha256[:8]}"
    asked = {"robot_requested": task.robot, "message_definitions": task.definitions, "ingest_key": key}
    made = replace(row, run_id=name, recipe_id=make_recipe_id(task.recipe, row.robot), log=log, **asked)
    subject = Subject("run", name)
    empty = make_finding("no-segments", subject, names={"reason": "gap"}, driven_m=80.0, lost_m=80.0)
    damage = (make_finding("file-cut", Subject("file", name)),)
    changes = {
        "damaged": {"damage": damage, "findings": find_damaged_log(damage, subject)},
        "empty": {"segments": 0, "distance_by_reason_m": {"gap": 80.0}, "findings": (empty,)},
    }
    return replace(made, **changes.get(kind, {}))


def worker(row, worked):
    """Return what stands for `ingest_one`: the first word of a log says what becomes of it."""

    def ingest_one(task):
        task = replace(task, source=task.source.now())
        worked.append(task.source.name)
        if (young := check_age(task)) is not None:
            return Ingested(task.source, young)
        data = task.source.paths[0].read_bytes()
        kind, sha256 = data.split()[0].decode(), hashlib.sha256(data).hexdigest()
        if kind in ("junk", "passing"):
            problems = (f"{task.source.name}: {kind}",)
            result = IngestResult(task.source.name, "failed", problems=problems, transient=kind == "passing")
            return Ingested(task.source, replace(result, sha256=sha256))
        store = Store(task.store)
        state = store.scan()
        made = make_row(row, task, sha256, kind)
        made = replace(made, run_id=name_run(state, task.source.stem, sha256), blob=make_unique_name(), tables={})
        known = [of for of in state.list_rows() if of.log.sha256 == sha256 and task.is_made_by(of)]
        if known and not task.force:
            return Ingested(task.source, make_result(task.source, "unchanged", known[0], sha256, same_as=None))
        store.place.put(f"blobs/{made.blob}/track.parquet", b"")
        store.put_run(state, made)
        (facts,) = [of for of in state.list_rows() if of.blob == made.blob]
        return Ingested(task.source, make_result(task.source, "done", facts, sha256, same_as=None))

    return ingest_one


ACTIONS = st.one_of(
    st.tuples(st.just("write"), st.integers(0, 3), st.sampled_from(KINDS), st.integers(0, 1), st.booleans()),
    st.tuples(st.just("acknowledge"), st.integers(0, 3)),
    st.tuples(
        st.just("ingest"), st.sampled_from(RECIPES), st.sampled_from(({}, {"force": True}, {"retry_failed": True}))
    ),
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30, deadline=None)
@given(st.lists(ACTIONS, min_size=3, max_size=12))
def test_what_status_predicts_is_what_ingest_does(row, actions):
    with TemporaryDirectory() as directory, pytest.MonkeyPatch.context() as patch:
        root, worked = Path(directory), list[str]()
        logs, store = root / "logs", root / "store"
        logs.mkdir()
        patch.setattr(ingest_module, "ingest_one", worker(row, worked))
        for action, *rest in (("write", 0, "good", 0, False), *actions, ("ingest", RECIPES[0], {})):
            if action == "write":
                number, kind, content, is_young = rest
                path = logs / f"log{number}.mcap"
                path.write_text(f"{kind} {content}")
                os.utime(path, ns=(4 * 10**18,) * 2 if is_young else (10**18 + content,) * 2)
            elif action == "acknowledge":
                with suppress(UsageError):
                    acknowledge([str(logs / f"log{rest[0]}.mcap")], store=store)
            else:
                recipe, how = rest
                compare(logs, store, worked, recipe=recipe, min_age=60.0, **how)


def compare(logs, store, worked, **how):
    predicted = {
        name: group.state
        for group in find_log_states(
            IngestOptions([logs], store=store, **{"min_age": 600.0, **how}), create=True
        ).groups
        for name in group.logs
    }
    before, worked[:] = Store(store).scan(), []
    results = {result.log: result for result in ingest([logs], store=store, **how).results}
    after = Store(store).scan()
    assert set(worked) == {name for name, standing in predicted.items() if standing in TO_DO}
    for name, standing in predicted.items():
        result = results[name]
        if standing in ("done", "partial", "empty", "superseded"):
            assert result.status == "unchanged"
            assert not result.is_new_problem
        elif standing in ("failed_permanent", "quarantined"):
            assert (result.status, result.known, result.acknowledged) == ("failed", True, standing == "quarantined")
        elif standing == "growing":
            assert result.status == "waiting"
    if not worked:
        names = {name for (kind, _), name in after.names.items() if kind != "calls"}
        assert names == {name for (kind, _), name in before.names.items() if kind != "calls"}, "nothing but its record"
