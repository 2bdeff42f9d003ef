"""What `tcpipe` exports: every name is there for people, editors and type checkers, and does what its command does."""

import ast
import inspect
import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import click
import numpy as np
import pyarrow.compute as pc
import pytest
from installed_command import tcpipe as command
from synthetic_store import add_run, box, lanes, lonlat, region_file, segments, small_store

import tcpipe
from tcpipe import api
from tcpipe.cli import cli
from tcpipe.errors import UsageError
from tcpipe.learning.evaluation import EvaluateConfig
from tcpipe.learning.fitting import FitConfig
from tcpipe.store import open_store

STUB = Path(tcpipe.__file__).with_suffix(".pyi")
FUNCTIONS = {"train": "train", "evaluate": "evaluate", "predict-path": "predict_path", "plan-path": "plan_path"}


def test_dir_lists_every_public_name_and_the_stub_says_where_each_is():
    homes = {
        (alias.asname or alias.name): (node.module, alias.name)
        for node in ast.parse(STUB.read_text()).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert dir(tcpipe) == sorted(tcpipe.__all__) == sorted([*homes, "__version__"])
    assert set(FUNCTIONS.values()) < set(homes)
    for name, (module, attribute) in homes.items():
        home = import_module(module)
        assert getattr(tcpipe, name) is getattr(home, attribute)
        assert getattr(tcpipe, name).__doc__


def test_looking_at_the_package_loads_none_of_it():
    program = "import sys, tcpipe; dir(tcpipe); print(*(name for name in sys.modules if name.startswith('tcpipe.')))"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert loaded == []


def _options(name):
    """Parameters of a command but those of its terminal, by the keyword of the function."""
    skipped = {"as_json", "quiet", "debug"}
    return {of.name: of for of in cli.commands[name].params if of.name not in skipped}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_option_is_a_keyword_with_the_same_default(name):
    parameters = inspect.signature(getattr(api, FUNCTIONS[name])).parameters
    options = _options(name)
    assert set(parameters) == set(options)
    for keyword, option in options.items():
        words = {flag.strip("-").replace("-", "_") for flag in option.opts}
        assert keyword in words, "a keyword is a word of the command line"
    for keyword, option in options.items():
        default = parameters[keyword].default
        if option.required:
            assert default is inspect.Parameter.empty
        elif option.multiple:
            assert default == ()
        elif default is None and name == "train" and keyword not in {"layers", "model", "predictor", "recipe"}:
            assert getattr(FitConfig(), keyword) == option.default
        else:
            assert default == option.to_info_dict()["default"]


RANGED = [
    (name, keyword, option.type)
    for name in FUNCTIONS
    for keyword, option in _options(name).items()
    if isinstance(option.type, click.IntRange | click.FloatRange) and keyword != "speed"
]


@pytest.mark.parametrize(("name", "keyword", "bounds"), RANGED, ids=str)
def test_a_function_refuses_what_its_command_refuses(name, keyword, bounds, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ends = {"plan-path": ((15.0, 47.0), (15.1, 47.0)), "evaluate": ("dataset",)}.get(name, ())
    for value in (bounds.min - (0 if bounds.min_open else 1), bounds.max + 1, float("nan"), "many"):
        with pytest.raises(UsageError, match=rf"{FUNCTIONS[name]}: {keyword} is .*; expected"):
            getattr(tcpipe, FUNCTIONS[name])("gone", *ends, **{keyword: value})
    for value in (bounds.max, bounds.min):
        if not (bounds.min_open and value == bounds.min):
            with pytest.raises(UsageError, match=r"gone|no store here"):
                getattr(tcpipe, FUNCTIONS[name])("gone", *ends, **{keyword: value})


@pytest.mark.parametrize(
    ("function", "word", "right"),
    [
        (tcpipe.build_dataset, "map_name", "map"),
        (tcpipe.build_dataset, "file_format", "format"),
        (tcpipe.ingest, "message_definitions", "msgdef"),
        (tcpipe.ingest, "tags", "tag"),
        (tcpipe.plan_path, "to", "goal"),
        (tcpipe.evaluate, "drives", "drive"),
    ],
)
def test_an_unknown_keyword_names_the_right_one(function, word, right):
    with pytest.raises(TypeError, match=rf"^{function.__name__}: no keyword '{word}'; did you mean '{right}'\?$"):
        function("x", **{word: "y"})


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A directory with a store of one map, a dataset of it, and a path."""
    here = tmp_path_factory.mktemp("public")
    store = small_store(here)
    region = region_file(here / "region.geojson", box(-18, -18, 6, 18))
    tcpipe.build_dataset(here / "dataset", store=store.root, split=region)
    line = {"type": "LineString", "coordinates": lonlat([(-12.0, -5.0), (-2.0, -4.0)]).tolist()}
    (here / "path.geojson").write_text(json.dumps(line))
    return here, str(store.root)


def _said(place, *arguments):
    done = command(*arguments, "--json", cwd=place)
    assert done.returncode in {0, 3}, done.stderr
    return json.loads(done.stdout)


def test_the_functions_give_what_the_commands_print(place, monkeypatch):
    here, store = place
    monkeypatch.chdir(here)
    trained = tcpipe.train("dataset", "model", model="physics")
    assert (trained.status, trained.path) == ("done", "model")
    assert _said(here, "train", "dataset", "model", "--model", "physics")["status"] == "unchanged"

    found = tcpipe.evaluate("model", "dataset", noise_draws=2)
    assert found.values.config == EvaluateConfig(noise_draws=2)
    said = _said(here, "evaluate", "model", "dataset", "again", "--noise-draws", "2", "--quiet")
    assert said["splits"]["test"]["errors"]["E"]["all"]["rmse"] == found.values.splits["test"].errors["E"]["all"].rmse
    drives = tcpipe.evaluate("model", "dataset", "drives", drive=["north"], map="site", store=store)
    (drive,) = drives.values.drives
    assert drive.run_id == "north"

    cost = tcpipe.predict_path("model", "path.geojson", store=store)
    said = _said(here, "predict-path", "model", "--path", "path.geojson", "--map", "site", "--store", store)
    assert (cost.energy_joule, cost.duration_s) == (said["energy_joule"], said["duration_s"])

    start, goal = ends = lonlat([(-12.0, -5.0), (-2.0, -4.0)]).round(9).tolist()
    plan = tcpipe.plan_path("model", start, goal, objective="time", allow_extrapolation=True, store=store)
    asked = (
        "--from",
        "{},{}".format(*start),
        "--to",
        "{},{}".format(*goal),
        "--objective",
        "time",
        "--allow-extrapolation",
        *("--map", "site", "--cell-size", "1"),
    )
    said = _said(here, "plan-path", "model", *asked, "--store", store, "--out", "again.geojson")
    assert plan.duration_s == pytest.approx(said["duration_s"])
    assert plan.lonlat_deg[[0, -1]] == pytest.approx(np.array(ends), abs=1e-8)
    assert tcpipe.predict_path("model", plan.out, store=store).length_m == pytest.approx(plan.length_m, abs=0.01)


def test_a_model_is_adapted_by_runs_of_the_store(place, monkeypatch):
    """A run of another robot takes 30 % more energy: the model learns that from it, and a path takes 30 % more."""
    here, store = place
    monkeypatch.chdir(here)
    tcpipe.train("dataset", "adaptable", model="physics")
    table = segments("heavy", *lanes(-15.5 + 2.0 * np.arange(8), -14.0, 14.0), start_ns=10**18, robot="jackal")
    for name in ("power_watt", "energy_joule"):
        at = table.schema.get_field_index(name)
        table = table.set_column(at, table.schema.field(at), pc.multiply(table.column(name), 1.3))
    add_run(open_store(store), "heavy", table)

    plain, adapted = (
        _said(here, "predict-path", "adaptable", "--path", "path.geojson", "--store", store, "--adapt", run)
        for run in ("south", "heavy")
    )
    assert (plain["adapted_by"], adapted["adapted_by"]) == ("south", "heavy")
    assert adapted["energy_joule"] / plain["energy_joule"] == pytest.approx(1.3, abs=0.05)
    assert adapted["duration_s"] == pytest.approx(plain["duration_s"], rel=0.05)
    low, high = adapted["energy_interval_joule"]
    assert low < adapted["energy_joule"] < high
