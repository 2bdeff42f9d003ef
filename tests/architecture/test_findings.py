"""Findings are data: each code stands in the catalogue and is made, and nothing decides on a finished sentence."""

import ast
from functools import cache
from typing import get_args

from package_source import read_nodes

from tcpipe.formats.finding_lines import describe_finding
from tcpipe.tables.bits import Quality, flag_name
from tcpipe.tables.findings import AFFECTED, SEVERITIES, Action, Finding, Subject, read_catalogue

LONGEST = 100
LINES = "tcpipe.formats.finding_lines"

MAKERS = {"make_finding": 0, "Damage": 0, "DamageError": 0, "threshold": 0, "select_findings": 1}
"""Functions that take codes, and the argument from which on these stand."""

PRINTERS = {
    "tcpipe/formats/dataset_card.py",
    "tcpipe/formats/logs/log_file.py",
    "tcpipe/learning/evaluation_files.py",
    "tcpipe/pipeline/dataset/build.py",
    "tcpipe/pipeline/dataset/content.py",
    "tcpipe/pipeline/diff.py",
    "tcpipe/pipeline/maps.py",
    "tcpipe/pipeline/plan.py",
    "tcpipe/pipeline/proposals.py",
    "tcpipe/pipeline/preflight.py",
    "tcpipe/pipeline/status.py",
    "tcpipe/planning/drives.py",
    "tcpipe/planning/path_files.py",
    "tcpipe/planning/route_graph.py",
}
"""Modules beside cli/ and report/ that print an answer, or group findings for a page."""


@cache
def list_texts():
    """Return every string of the package."""
    nodes = (node for of in read_nodes().values() for node in of)
    return {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def calls(*names):
    """Yield path and node of each call of a function by its plain name."""
    for path, nodes in read_nodes().items():
        for node in nodes:
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in names:
                yield path, node


def example_finding(code):
    """Return a finding with typical values: numbers by their suffix, names by their key."""
    entry = read_catalogue()[code]
    numbers = {
        name: next((value for suffix, value in _NUMBERS.items() if name.endswith(suffix)), None)
        for name in entry.fields
    }
    names = {name: _NAMES.get(name, name.replace("_", " ")) for name in entry.fields if numbers[name] is None}
    role = next((role for role in _ROLES if code.startswith(role.split("_")[0])), "gnss")
    known = {name: value for name, value in numbers.items() if value is not None}
    return Finding(code, entry.severity, Subject("role", role), entry.action, (312.0, 318.0), known, names)


_ROLES = ("imu", "power", "odometry", "pose", "velocity")
_NUMBERS = {
    "wanted_hz": 20.0, "at_20_hz_fraction": 0.041, "length_s": 30.0, "driven_m": 84.0, "limit_mps": 1.0,
    "_count": 12.0, "_fraction": 0.123, "_ratio": 1.05, "_rad": 0.0524, "_hz": 9.87, "_mps2": 9.81, "_mps": 0.95, "_m2": 12.3,
    "_std": 0.004,
    "_volt": 25.6, "_amp": 12.3, "_watt": 123.0, "_s": 0.123, "_m": 1.23, "before": 84.1, "after": 96.2, "scale": 1.053,
}  # fmt: skip
_NAMES = {
    "subject": "gnss", "topic": "/gps/fix", "topics": "/left/current, /battery/voltage", "reason": "gap", "reference": "wheel_odometry",
    "role": "imu", "frame": "gps_link", "quantity": "current", "rail": "battery", "map": "site", "robot": "husky", "unit": "W",
    "error": "LogError", "type": "sensor_msgs/msg/Imu", "span": "312 to 318 s",
}  # fmt: skip


def test_every_code_that_is_named_stands_in_the_catalogue():
    unknown = [
        f"{path}:{node.lineno}: {argument.value}"
        for path, node in calls(*MAKERS)
        for argument in node.args[MAKERS[node.func.id] :][: None if node.func.id == "select_findings" else 1]
        if isinstance(argument, ast.Constant) and argument.value not in read_catalogue()
    ]
    assert not unknown


def test_every_threshold_that_is_named_stands_in_the_catalogue():
    read = [
        tuple(argument.value for argument in node.args if isinstance(argument, ast.Constant))
        for _, node in calls("threshold")
    ]
    known = {(code, name) for code, entry in read_catalogue().items() for name in entry.thresholds}
    assert not {pair for pair in read if len(pair) == 2 and pair not in known}


def is_computed(code):
    """Tell whether an f-string makes a code, as ``lost-{reason}``."""
    joined = (node.values for nodes in read_nodes().values() for node in nodes if isinstance(node, ast.JoinedStr))
    ends = [(values[0], values[-1]) for values in joined if len(values) == 2]
    begin = (of.value for of, _ in ends if isinstance(of, ast.Constant) and of.value.endswith("-"))
    finish = (of.value for _, of in ends if isinstance(of, ast.Constant) and of.value.startswith("-"))
    return code.startswith(tuple(begin)) or code.endswith(tuple(finish))


def test_every_code_of_the_catalogue_is_made_somewhere():
    named = list_texts()
    assert not {code for code in read_catalogue() if code not in named and not is_computed(code)}


def test_every_remedy_of_the_catalogue_is_used():
    named = list_texts()
    assert not {
        (code, name) for code, entry in read_catalogue().items() for name in entry.remedies if name not in named
    }


def test_entries_are_whole():
    bits = {flag_name(bit) for bit in Quality}
    for code, entry in read_catalogue().items():
        assert not entry.flag or entry.flag in bits, code
        assert entry.severity in SEVERITIES, code
        assert entry.action in get_args(Action), code
        assert set(entry.affects) <= set(AFFECTED), code
        assert entry.title, code
        assert entry.cause, code


def test_every_line_is_short_with_typical_values():
    lines = {code: describe_finding(example_finding(code)) for code in read_catalogue()}
    assert not {code: line for code, line in lines.items() if len(line) > LONGEST}
    assert not {code: line for code, line in lines.items() if "?" in line}


def test_nothing_but_what_prints_makes_sentences():
    importers = {
        f"tcpipe/{path}"
        for path, nodes in read_nodes().items()
        for node in nodes
        if isinstance(node, ast.ImportFrom) and node.module == LINES
    }
    others = {path for path in importers if not path.startswith(("tcpipe/cli/", "tcpipe/report/"))}
    assert others == PRINTERS


def test_nothing_decides_on_a_finished_sentence():
    """Nobody compares, splits or searches what `finding_lines` returns, or a field that holds finished sentences."""
    makers = {
        node.name
        for node in read_nodes()["formats/finding_lines.py"]
        if isinstance(node, ast.FunctionDef) and node.name.startswith(("format_", "describe_", "list_"))
    }

    def is_sentence(node):
        node = node.value if isinstance(node, ast.Subscript) else node
        is_field = isinstance(node, ast.Attribute) and node.attr in {"cause", "notes", "problems"}
        return is_field or (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in makers)

    searches = {"startswith", "endswith", "split", "partition", "search", "match", "fullmatch", "sub"}
    for path, nodes in read_nodes().items():
        for node in nodes if path != "formats/finding_lines.py" else ():
            looked_at = [node.left, *node.comparators] if isinstance(node, ast.Compare) else []
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in searches:
                looked_at = [node.func.value, *node.args]
            assert not any(map(is_sentence, looked_at)), f"{path}:{node.lineno}"
