"""Findings are data: each code stands in the catalogue and is made, and nothing decides on a finished sentence."""

import ast
import importlib.util
from pathlib import Path

import pytest

from tcpipe.formats.finding_lines import describe_finding
from tcpipe.tables.bits import Quality, name_of
from tcpipe.tables.catalogue import AFFECTED, SEVERITIES, catalogue_sections, read_catalogue

ROOT = Path(__file__).parents[2]
TREES = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text()) for path in (ROOT / "tcpipe").rglob("*.py")}
LONGEST = 100
LINES = "tcpipe.formats.finding_lines"

MAKERS = {"make_finding": 0, "threshold": 0, "select_findings": 1}
"""Functions that take codes, and the argument from which on these stand."""

PRINTERS = {
    "tcpipe/formats/dataset_card.py",
    "tcpipe/pipeline/dataset/build.py",
    "tcpipe/pipeline/maps.py",
    "tcpipe/pipeline/preflight.py",
    "tcpipe/pipeline/status.py",
    "tcpipe/pipeline/store_facts.py",
}
"""Modules beside cli/ and report/ that print an answer, or group findings for a page."""


def calls(*names):
    """Yield path and node of each call of a function by its plain name."""
    for path, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in names:
                yield path, node


def texts(tree):
    return {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}


@pytest.fixture(scope="module")
def generate():
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs/generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_code_that_is_named_stands_in_the_catalogue():
    unknown = [
        f"{path}:{node.lineno}: {argument.value}"
        for path, node in calls(*MAKERS)
        for argument in node.args[MAKERS[node.func.id] :][: None if node.func.id == "select_findings" else 1]
        if isinstance(argument, ast.Constant) and argument.value not in read_catalogue()
    ]
    assert not unknown


def test_every_threshold_that_is_read_stands_in_the_catalogue_and_every_one_there_is_read():
    read = {
        (node.args[0].value, node.args[1].value)
        for _, node in calls("threshold")
        if all(isinstance(argument, ast.Constant) for argument in node.args)
    }
    known = {(code, name) for code, entry in read_catalogue().items() for name in entry.thresholds}
    assert not read - known
    named = set().union(*map(texts, TREES.values()))
    computed = {"gnss_hz", "wheel_odometry_hz", "visual_odometry_hz"}
    assert not {(code, name) for code, name in known if name not in named | computed}


def test_every_code_of_the_catalogue_is_made_somewhere():
    named = set().union(*(texts(tree) for path, tree in TREES.items() if path != "tcpipe/tables/catalogue.py"))
    losses = {code for code in read_catalogue() if code.startswith("lost-")}  # named after entries of the breakdown
    assert not set(read_catalogue()) - named - losses


def test_every_remedy_of_the_catalogue_is_used():
    for code, entry in read_catalogue().items():
        makers = [tree for tree in TREES.values() if code in texts(tree)]
        named = set().union(*map(texts, makers)) if makers else set()
        assert not set(entry.remedies) - named, code


def test_entries_are_whole():
    bits = {name_of(bit) for bit in Quality}
    for code, entry in read_catalogue().items():
        assert not entry.flag or entry.flag in bits, code
        assert entry.severity in SEVERITIES, code
        assert set(entry.affects) <= set(AFFECTED), code
        assert entry.title, code
        assert entry.cause, code
    assert [code for codes in catalogue_sections().values() for code in codes] == list(read_catalogue())


def test_every_line_is_short_with_typical_values(generate):
    lines = {code: describe_finding(generate.example_finding(code)) for code in read_catalogue()}
    assert not {code: line for code, line in lines.items() if len(line) > LONGEST}
    assert not {code: line for code, line in lines.items() if "?" in line}


def test_nothing_but_what_prints_makes_sentences():
    importers = {
        path
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == LINES
    }
    others = {path for path in importers if not path.startswith(("tcpipe/cli/", "tcpipe/report/"))}
    assert others == PRINTERS


def test_nothing_decides_on_a_finished_sentence():
    """Nobody compares, splits or searches what `finding_lines` returns."""
    makers = {
        node.name
        for node in ast.walk(TREES["tcpipe/formats/finding_lines.py"])
        if isinstance(node, ast.FunctionDef) and node.name.startswith(("format_", "describe_", "list_"))
    }

    def is_sentence(node):
        return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in makers

    for path, tree in TREES.items():
        if path == "tcpipe/formats/finding_lines.py":
            continue
        for node in ast.walk(tree):
            compared = [node.left, *node.comparators] if isinstance(node, ast.Compare) else []
            called = [node.func.value, *node.args] if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) else []
            searched = called if called and node.func.attr in {"startswith", "endswith", "split", "partition", "search", "match", "sub"} else []
            assert not any(map(is_sentence, [*compared, *searched])), f"{path}:{node.lineno}"
