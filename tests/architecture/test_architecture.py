"""The house rules as tests: floors, homes, names, units, purity. ARCHITECTURE.md, pyproject.toml and the tree must say the same."""

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from graphlib import TopologicalSorter
from importlib.metadata import PackageNotFoundError, metadata
from itertools import pairwise
from pathlib import Path

import grimp
import pytest
from package_source import PACKAGE, read_nodes, read_trees
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tcpipe.recipe import Recipe
from tcpipe.tables import levels
from tcpipe.tables.columns import TableSchema

ROOT = PACKAGE.parent
PAGE = (ROOT / "ARCHITECTURE.md").read_text()
FLOORS = next(
    contract["layers"]
    for contract in tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    if contract["type"] == "layers"
)

VAGUE_NAMES = {"utils", "util", "helpers", "helper", "common", "misc", "core", "manager", "processor"}
ABOVE_PURITY = ("cli/", "pipeline/", "pipeline.py")
WALL_CLOCK = {
    "time.time",
    "time.time_ns",
    "time.localtime",
    "time.gmtime",
    "time.ctime",
    "time.strftime",
    "datetime.datetime.now",
    "datetime.datetime.utcnow",
    "datetime.datetime.today",
    "datetime.date.today",
}
SEEDED = {"numpy.random.Generator", "numpy.random.default_rng", "numpy.random.SeedSequence", "numpy.random.PCG64"}
TEMPORARY_NAMES = "formats/atomic.py"
"""Names what it writes, until it is complete, as no other process does; nothing of that name remains."""
UNSEEDED = ("random.", "numpy.random.", "secrets.", "os.urandom", "uuid.uuid1", "uuid.uuid4")
SUFFIX_OF_UNIT = {
    "m": "_m",
    "s": "_s",
    "ns": "_ns",
    "rad": "_rad",
    "deg": "_deg",
    "m/s": "_mps",
    "m/s2": "_mps2",
    "rad/s": "_radps",
    "rad/m": "_radpm",
    "px": "_px",
    "V": "_volt",
    "A": "_amp",
    "W": "_watt",
    "J": "_joule",
    "m2": "_m2",
    "m2/s2": "_m2ps2",
}
PLAIN_UNITS = {"", "1", "bits"}
HEAVY = {
    "numpy", "pyarrow", "polars", "numba", "scipy", "zarr", "rasterio", "pyproj", "shapely", "pydantic", "rosbags", "mcap",
    "bokeh", "matplotlib", "jinja2", "rich", "filterpy", "isal", "ruamel", "pandas", "torch", "lightgbm", "distributed",
}  # fmt: skip


def _table(heading):
    """First two cells of each row of the page's table under a heading."""
    section = re.split(r"^## ", PAGE, flags=re.MULTILINE)
    rows = next(text for text in section if text.startswith(heading)).splitlines()
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows if row.startswith("|")]
    return [(row[0], row[1]) for row in cells if not set(row[0]) <= {"-", " "}][1:]


def _imported(nodes):
    """Dotted names that a module imports, wherever in it."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _used(nodes):
    """Dotted names that a module uses, with its import aliases resolved, and whether each is called without arguments."""
    known = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            known |= {
                alias.asname or alias.name.split(".")[0]: alias.name if alias.asname else alias.name.split(".")[0]
                for alias in node.names
            }
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            known |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    bare = {id(node.func) for node in nodes if isinstance(node, ast.Call) and not node.args and not node.keywords}
    for node in nodes:
        parts, inner = [], node
        while isinstance(inner, ast.Attribute):
            parts.append(inner.attr)
            inner = inner.value
        if isinstance(inner, ast.Name) and inner.id in known:
            yield ".".join([known[inner.id], *reversed(parts)]), id(node) in bare, node.lineno


def list_bound_names(body: list[ast.stmt]) -> Iterator[str]:
    """Yield each name that statements of a module bind; one branch of an if or a try stands for all of its branches."""
    for each in body:
        match each:
            case ast.Assign(targets=targets):
                nodes = [node for target in targets for node in ast.walk(target)]
                yield from (node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
            case ast.AnnAssign(target=ast.Name(id=name)):
                yield name
            case ast.FunctionDef(name=name, decorator_list=[ast.Name(id="overload")]):
                pass
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.Import(names=names) | ast.ImportFrom(names=names):
                yield from (alias.asname or alias.name for alias in names)
            case ast.If() | ast.Try():
                branches = [each.body, each.orelse, *(handler.body for handler in getattr(each, "handlers", []))]
                yield from {name for branch in branches for name in list_bound_names(branch)}
            case ast.For() | ast.With():
                yield from list_bound_names(each.body)


def test_no_name_of_a_module_is_bound_twice():
    counts = {path: Counter(list_bound_names(tree.body)) for path, tree in read_trees().items()}
    assert {path: name for path, found in counts.items() for name, count in found.items() if count > 1} == {}
    twice = "_MOST = 1\nif True:\n    A = 1\nelse:\n    A = 2\n_MOST: int = 2"
    assert Counter(list_bound_names(ast.parse(twice).body)) == {"_MOST": 2, "A": 1}


def test_no_modules_import_each_other_in_a_circle():
    imports = grimp.build_graph("tcpipe", cache_dir=None)
    order = TopologicalSorter({module: imports.find_modules_directly_imported_by(module) for module in imports.modules})
    order.prepare()  # raises CycleError, which names them; imports for type checks and inside functions count too


def test_page_and_linter_show_the_same_floors():
    block = re.search(r"^```layers\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)
    assert block is not None
    assert block.group(1).splitlines() == FLOORS


def test_page_names_every_room():
    rooms = {path.name for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
    rooms = {name if name.endswith(".py") else f"{name}/" for name in rooms if name != "__init__.py"}
    assert {name.strip("`") for name, _ in _table("Layers")} == rooms


def test_each_file_format_has_the_home_that_the_page_gives():
    homes = {name: {f"{home}" for home in re.findall(r"`([\w/]+\.py)`", cell)} for name, cell in _table("Homes")}
    assert {"rosbags", "mcap", "rasterio", "zarr", "msgspec", "pyarrow.parquet", "numba", "torch"} <= set(homes)
    imports = {path: [f"{used}." for used in _imported(nodes)] for path, nodes in read_nodes().items()}
    importers = {
        name: {path for path, used in imports.items() if any(of.startswith(f"{name}.") for of in used)}
        for name in homes
    }
    assert importers == homes


def test_no_module_has_a_name_that_says_nothing():
    names = {part for path in read_trees() for part in Path(path).with_suffix("").parts}
    assert not {name for name in names if set(name.split("_")) & VAGUE_NAMES}


def test_stages_are_thin():
    lengths = {path.name: len(path.read_text().splitlines()) for path in (PACKAGE / "stages").glob("*.py")}
    assert lengths
    assert not {name: length for name, length in lengths.items() if length > 350}


def test_nothing_below_the_pipeline_reads_the_wall_clock_or_global_randomness():
    found = [
        f"{path}:{line} {name}"
        for path, nodes in read_nodes().items()
        if not path.startswith(ABOVE_PURITY)
        for name, bare, line in _used(nodes)
        if name in WALL_CLOCK
        or (
            name.startswith(UNSEEDED)
            and not name.startswith(tuple(SEEDED))
            and (path, name) != (TEMPORARY_NAMES, "uuid.uuid4")
        )
        or (name == "numpy.random.default_rng" and bare)
    ]
    assert not found


def test_the_purity_test_sees_what_it_forbids():
    source = """
import time, random
import numpy as np
from datetime import datetime
from numpy import random as chance
time.time(); datetime.now(); random.random(); np.random.rand(3); chance.seed(1); np.random.default_rng(); np.random.default_rng(4)
"""
    used = {(name, bare) for name, bare, _ in _used([*ast.walk(ast.parse(source))])}
    assert {
        ("time.time", True),
        ("datetime.datetime.now", True),
        ("random.random", True),
        ("numpy.random.rand", False),
        ("numpy.random.seed", False),
        ("numpy.random.default_rng", True),
        ("numpy.random.default_rng", False),
    } <= used


def _schemas():
    return {name: schema for name, schema in vars(levels).items() if isinstance(schema, TableSchema)}


@pytest.mark.parametrize("table", sorted(_schemas()))
def test_every_column_ends_in_its_unit(table):
    wrong = []
    for column in _schemas()[table].columns:
        suffix = SUFFIX_OF_UNIT.get(column.unit)
        claimed = next((unit for unit, end in SUFFIX_OF_UNIT.items() if column.name.endswith(end)), None)
        squared = column.name.endswith("_var") and column.unit.endswith(("2", "4"))
        named_right = column.name.endswith(suffix) if suffix else column.unit in PLAIN_UNITS or squared
        if not named_right or (claimed is not None and claimed != column.unit):
            wrong.append(f"{column.name} [{column.unit}]")
        assert column.field().metadata[b"unit"].decode() == column.unit
        assert column.doc
    assert not wrong


def test_everything_public_is_explained():
    silent = []
    for path, tree in read_trees().items():
        if ast.get_docstring(tree) is None and tree.body:
            silent.append(path)
        holders = [
            tree,
            *(node for node in tree.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")),
        ]
        for node in (node for holder in holders for node in holder.body):
            named = isinstance(node, ast.FunctionDef | ast.ClassDef)
            overloaded = named and any(ast.unparse(decorator) == "overload" for decorator in node.decorator_list)
            if named and not overloaded and not node.name.startswith("_") and ast.get_docstring(node) is None:
                silent.append(f"{path}:{node.lineno} {node.name}")
    assert not silent


def test_no_class_or_function_is_public_in_two_modules():
    """Commands and functions of the API have the names of the functions that they call."""
    modules: dict[str, set[str]] = {}
    for path, tree in read_trees().items():
        for node in tree.body:
            named = isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
            if named and not path.startswith(("cli/", "api.py")):
                modules.setdefault(node.name, set()).add(path)
    assert {name: paths for name, paths in modules.items() if len(paths) > 1} == {}


def list_stray_docstrings(nodes: list[ast.AST]) -> Iterator[int]:
    """Yield the line of each docstring that neither begins a module, class or function nor follows an assignment."""
    for node in nodes:
        body = getattr(node, "body", None)
        for before, statement in pairwise([node, *body] if isinstance(body, list) else []):
            match statement, before:
                case ast.Expr(value=ast.Constant(value=str())), ast.Assign() | ast.AnnAssign() | ast.AugAssign():
                    pass
                case ast.Expr(value=ast.Constant(value=str())), ast.Module() | ast.ClassDef() | ast.FunctionDef() if (
                    before is node
                ):
                    pass
                case ast.Expr(value=ast.Constant(value=str())), _:
                    yield statement.lineno


def test_every_docstring_belongs_to_a_name():
    assert {path: lines for path, nodes in read_nodes().items() if (lines := [*list_stray_docstrings(nodes)])} == {}
    source = '"""Module."""\nA = 1\n"""Quantity A."""\n"""Stray."""\nif A:\n    """Stray, too."""\n'
    assert [*list_stray_docstrings([*ast.walk(ast.parse(source))])] == [4, 6]


def test_help_imports_nothing_heavy():
    program = """
import sys
from click.testing import CliRunner
from tcpipe.cli import cli
for command in [[], *([name] for name in cli.commands)]:
    result = CliRunner().invoke(cli, [*command, "--help"])
    assert result.exit_code == 0 and "Usage" in result.output, result.output
print(*sorted({name.split(".")[0] for name in sys.modules}))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    assert not set(done.stdout.split()) & HEAVY


WRITES_RECIPES = {"recipe/suggestions.py", "formats/recipe_toml.py", "pipeline/inspect.py"}
"""Modules that write lines of recipes: what messages suggest, `tcpipe init`, and the tables of a folder."""
RECIPE_CALLS = {"suggest", "recipe_key", "RecipeFragment"}


def _mentions_of_recipe(nodes):
    """Lines whose texts name a table or key of the recipe by themselves; "recipe read.topics …" says which given value is wrong."""
    sections = {
        of.name: [key.name for key in fields(of.default_factory)]
        for of in fields(Recipe)
        if is_dataclass(of.default_factory)
    }
    keys = "|".join(f"{section}\\.({'|'.join(names)})" for section, names in sections.items())
    tables = "|".join([*sections, "robots", "power_sources", "tables"])
    named = re.compile(rf"(?<!recipe )\b({keys})\b( =|\)|\.[a-z]|;| or )|(?<!tcpipe)\[+({tables})[\].]")
    skipped = set()
    for node in nodes:
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            skipped.add(node.value)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in RECIPE_CALLS:
            skipped |= set(ast.walk(node))
    texts = (node for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str))
    return [node.lineno for node in texts if node not in skipped and named.search(node.value)]


def test_what_is_suggested_for_a_recipe_is_made_where_it_is_checked():
    source = "x = 'write [read.topics] imu = []', 'set mask.max_velocity_mps = 1'"
    assert _mentions_of_recipe([*ast.walk(ast.parse(source))]) == [1, 1]
    assert not {
        path: lines
        for path, nodes in read_nodes().items()
        if path not in WRITES_RECIPES and (lines := _mentions_of_recipe(nodes))
    }


def test_nouns_know_of_the_recipe_what_they_suggest_alone():
    nouns = ("logs/", "fusion/", "motion/", "path.py", "cost/", "terrain/", "splits/", "power/")
    known = {name for path, nodes in read_nodes().items() if path.startswith(nouns) for name in _imported(nodes)}
    assert {name for name in known if name.startswith("tcpipe.recipe") and ".suggestions." not in name} == set()


PRINTING = {
    "click.echo", "click.secho", "click.echo_via_pager", "click.style", "print", "sys.stdout.write", "sys.stderr.write", "rich.print",
    "sys.stdout.buffer.write", "sys.stderr.buffer.write", "os.write", "click.progressbar",
}  # fmt: skip


def test_only_one_module_prints_so_that_every_name_is_escaped():
    printing = {
        path
        for path, nodes in read_nodes().items()
        for node in nodes
        if isinstance(node, ast.Call) and ast.unparse(node.func) in PRINTING
    }
    assert printing == {"cli/output.py", "__main__.py"}  # the latter a constant text, before anything is loaded


def _tracked_files():
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout: which files belong to the project is not known here")
    listed = subprocess.run(["git", "ls-files", "-z"], capture_output=True, text=True, check=True, cwd=ROOT)
    return [ROOT / name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


def test_locks_hold_versions_within_the_bounds_of_pyproject():
    """Minor versions of rosbags 0.x have changed its interface: only the locked one is allowed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    bounds = {canonicalize_name(found.name): found.specifier for found in map(Requirement, project["dependencies"])}
    for lock in ("requirements.lock", "requirements-dev.lock"):
        locked = re.findall(r"^([\w.-]+)==([\w.]+)", (ROOT / lock).read_text(), re.MULTILINE)
        assert bounds.keys() <= {name for name, _ in locked}
        assert not [(name, version) for name, version in locked if name in bounds and version not in bounds[name]]
        major, minor, *_ = dict(locked)["rosbags"].split(".")
        assert major == "0"
        assert f"0.{int(minor) + 1}.0" not in bounds["rosbags"]


def test_no_registry_address_and_no_path_of_one_machine():
    needles = [
        "".join(parts)
        for parts in (
            ("py", "pi.", "org"),
            ("files.", "python", "hosted"),
            ("--index", "-url"),
            ("conda.", "anaconda", ".org"),
            ("/", "work", "/"),
            ("/", "root", "/"),
            ("/", "home", "/"),
            ("/", "Users", "/"),
        )
    ]
    machine_path = re.compile(
        rb"(?<![\w.~$}>])(?:" + b"|".join(re.escape(n.encode()) for n in needles if n.startswith("/")) + rb")\w"
    )
    addresses = [needle.encode() for needle in needles if not needle.startswith("/")]
    found = []
    for path in _tracked_files():
        data = path.read_bytes()
        if any(address in data for address in addresses) or machine_path.search(data):
            found.append(path.relative_to(ROOT).as_posix())
    assert not found


def test_notice_lists_the_licences_of_all_dependencies():
    """Those of packages that are installed are compared with their metadata; `dev` is not distributed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = {"": project["dependencies"], **project["optional-dependencies"]}
    wanted = {(Requirement(line).name, extra) for extra, lines in extras.items() if extra != "dev" for line in lines}
    table = (ROOT / "NOTICE").read_text().partition("package                  extra    licence\n")[2].splitlines()
    listed = {(line[:25].strip(), line[25:34].strip()): line[34:] for line in table}
    assert set(listed) == wanted
    for (name, extra), licence in listed.items():
        try:
            about = metadata(name)
        except PackageNotFoundError:
            assert extra, name
            continue
        stated = " ".join(
            (about.get("License-Expression") or "", about.get("License") or "", *about.get_all("Classifier", []))
        )
        stated = stated.replace("Python Software Foundation", "PSF")
        families = {re.split("[- ]", part)[0] for part in licence.split(" AND ")}
        assert {family for family in families if family not in stated} == set(), name
