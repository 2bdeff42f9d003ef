"""Table "Where do I change" of ARCHITECTURE.md: each place exists, and a small change there, in a copy of the package, has its effect."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROWS = [
    [cell.strip() for cell in line.strip("|").split(" | ")]
    for line in (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").splitlines()
    if re.match(r"\| .*\*\*", line)
]
PLACES = {
    re.findall(r"\*\*(.+?)\*\*", row[0])[0]: re.findall(r"`(tcpipe/[\w/.]+)(?:: (\w+))?`", row[2]) for row in ROWS
}
NEW = {"tcpipe/robots/NAME.toml"}

FIRST, LAST, REPLACE, APPEND, CREATE = "first statement", "last statement", "replace", "append", "create"
COLUMN = "dataclasses.replace({0}, columns=(*{0}.columns, Column('mine', pa.float64(), 'm', 'mine')))"
CHANGES = {
    "threshold": ("FuseConfig", REPLACE, "= 0.999\n", "= 0.99\n"),
    "outlier gate": ("filter_ticks", FIRST, "return 'mine'"),
    "check of a sensor": ("check_sensors", FIRST, "return 'mine'"),
    "mask": ("mask_track", FIRST, "return 'mine'"),
    "w, v, T, E and their σ": ("compute_labels", FIRST, "displacement_std_m = 2 * displacement_std_m"),
    "column of segments": (
        "LABELLED_SEGMENTS",
        APPEND,
        f"\nimport dataclasses\nLABELLED_SEGMENTS = {COLUMN.format('LABELLED_SEGMENTS')}\n",
    ),
    "column of samples": ("SAMPLES", APPEND, f"\nSAMPLES = {COLUMN.format('SAMPLES')}\n"),
    "label flag": ("Quality", LAST, "MINE = 1 << 30"),
    "split's buffer": ("classify_footprints", FIRST, "buffer_m = 3.0"),
    "layer": ("LAYERS", APPEND, "\nLAYERS = (*LAYERS, 'mine')\n"),
    "robot": ("tcpipe/robots/NAME.toml", CREATE, "[robots.mine]\nmax_velocity_mps = 3.0\n"),
    "power message": (
        "tcpipe/robots/power_sources.toml",
        APPEND,
        '\n[[power_sources]]\ntype = "my_msgs/msg/Battery"\nvoltage = "volts"\ncurrent = "amps"\n',
    ),
    "log container": ("open_part", FIRST, "raise LogError('mine')"),
    "finding": (
        "tcpipe/tables/catalogue.toml",
        APPEND,
        '\n[mine]\ntitle = "Mine"\ntemplate = "{subject}: mine"\nseverity = "note"\ncause = "A test."\n',
    ),
    "command": ("_COMMANDS", APPEND, "\n_COMMANDS['mine'] = ('mine', 'My command')\n"),
    "command option": ("IngestOptions", LAST, "mine: bool = option(False, Option('Mine.'))"),
    "plot of the page of a run": ("time_plots", FIRST, "return 'mine'"),
}
"""By row: the name (or file) that is changed, and how."""

IMPORTS = "".join(
    f"from {file.removesuffix('.py').replace('/', '.')} import {name}\n"
    for places in PLACES.values()
    for file, name in places
    if name
)
EFFECTS = """
import inspect, json
from pathlib import Path
import numpy as np, shapely
from click.testing import CliRunner
import tcpipe
from tcpipe.cli import cli
from tcpipe.errors import LogError
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.recipe import Recipe
from tcpipe.splits.regions import Regions, Side
from tcpipe.tables.bits import flag_names
from tcpipe.tables.findings import read_catalogue


def call(function):
    parameters = inspect.signature(function).parameters.values()
    required = [parameter for parameter in parameters if parameter.default is parameter.empty]
    return function(*[None for p in required if p.kind != p.KEYWORD_ONLY], **{p.name: None for p in required if p.kind == p.KEYWORD_ONLY})


one = np.ones(1)
labels = compute_labels(
    chord_m=one, duration_s=one, energy_joule=one, end_velocity_mps=one, end_power_watt=one, displacement_std_m=one, energy_noise_joule=one
)
square = np.array([[[2.0, 2.0], [3.0, 2.0], [3.0, 3.0], [2.0, 3.0]]])
Path("a.mcap").write_bytes(b"\\x89MCAP0\\r\\n" + bytes(100))
try:
    tcpipe.read_log("a.mcap")
except LogError as error:
    read = str(error)
profiles = load_shipped_profiles()
print(json.dumps({
    "threshold": Recipe().fuse.gate_probability == 0.99,
    "outlier gate": call(filter_ticks) == "mine",
    "check of a sensor": call(check_sensors) == "mine",
    "mask": call(mask_track) == "mine",
    "w, v, T, E and their σ": bool(labels.duration_std_s[0] == 2.0),
    "column of segments": "mine" in LABELLED_SEGMENTS.names(),
    "column of samples": "mine" in SAMPLES.names(),
    "label flag": flag_names(1 << 30, Quality) == ("mine",),
    "split's buffer": int(classify_footprints(square, Regions(shapely.box(0, 0, 50, 50)), buffer_m=1.0)[0]) == int(Side.BUFFER),
    "layer": "mine" in LAYERS,
    "robot": profiles.robots["mine"].max_velocity_mps == 3.0,
    "power message": profiles.power_sources[-1].type == "my_msgs/msg/Battery",
    "log container": read == "mine",
    "finding": read_catalogue()["mine"].title == "Mine",
    "command": CliRunner().invoke(cli, ["mine"]).output == "mine\\n",
    "command option": "--mine" in CliRunner().invoke(cli, ["ingest", "--help"]).output,
    "plot of the page of a run": call(time_plots) == "mine",
}))
"""


def _edit(file: Path, name: str, kind: str, *texts: str) -> None:
    """Make one change in a file of the copy."""
    text = file.read_text(encoding="utf-8") if kind != CREATE else ""
    if kind in (FIRST, LAST):
        (definition,) = (
            node
            for node in ast.walk(ast.parse(text))
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name
        )
        lines, body = text.splitlines(keepends=True), definition.body
        first = body[1] if ast.get_docstring(definition) else body[0]
        number = first.lineno - 1 if kind == FIRST else body[-1].end_lineno
        lines.insert(number, f"{' ' * first.col_offset}{texts[0]}\n")
        text = "".join(lines)
    elif kind == REPLACE:
        assert text.count(texts[0]) == 1, f"{file}: {texts[0]!r} is there {text.count(texts[0])} times"
        text = text.replace(*texts)
    else:
        text += texts[0]
    file.write_text(text, encoding="utf-8")


@pytest.fixture(scope="module")
def effects(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bool]:
    """What a changed copy of the package does, by row."""
    directory = tmp_path_factory.mktemp("changed")
    shutil.copytree(ROOT / "tcpipe", directory / "tcpipe", ignore=shutil.ignore_patterns("__pycache__"))
    for row, (name, kind, *texts) in CHANGES.items():
        file = next(file for file, known in PLACES[row] if name in (file, known))
        _edit(directory / file.replace("NAME", "mine"), name, kind, *texts)
    command = "import click\n\n\n@click.command()\ndef mine():\n    click.echo('mine')\n"
    _edit(directory / "tcpipe/cli/mine.py", "", CREATE, command)
    environment = os.environ | {"PYTHONPATH": str(directory), "NUMBA_DISABLE_JIT": "1"}
    run = subprocess.run(
        [sys.executable, "-c", IMPORTS + EFFECTS],
        cwd=directory,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    printed: dict[str, bool] = json.loads(run.stdout)
    return printed


@pytest.mark.parametrize("row", PLACES)
def test_row_names_files_that_exist(row: str) -> None:
    """And in them what the changed copy imports by its name."""
    assert PLACES[row]
    assert not [file for file, _ in PLACES[row] if file not in NEW and not (ROOT / file).exists()]


@pytest.mark.parametrize("row", PLACES)
def test_change_of_a_row_has_its_effect(row: str, effects: dict[str, bool]) -> None:
    assert effects[row]


def test_tests_of_the_rows_exist() -> None:
    named = [path for row in ROWS for path in re.findall(r"`(tests/[\w/.]+)`", row[3])]
    assert len(named) >= len(ROWS)
    assert not [path for path in named if not (ROOT / path).exists()]
