"""The documentation holds: links lead somewhere, commands and options exist, snippets run."""

import contextlib
import os
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from synthetic_store import box, region_file, small_store

from tcpipe import __version__
from tcpipe.cli import cli
from tcpipe.formats.recipe_toml import parse_recipe
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    page
    for page in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"))
    if not any(part.startswith(".") for part in page.relative_to(ROOT).parts)
)
SNIPPETS = (ROOT / "README.md", ROOT / "docs/how-to/train.md")
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def _fences(page: Path, *kinds: str) -> list[str]:
    return [body for kind, body in _FENCE.findall(page.read_text(encoding="utf-8")) if kind in kinds]


def _anchor(heading: str) -> str:
    """Return the anchor that a renderer makes of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(_FENCE, "", page.read_text(encoding="utf-8"))
    lost = []
    for target in re.findall(r"(?:\]\(|src=\")([^)\"\s]+)[)\"]", text):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        if not there.exists():
            lost.append(target)
        elif anchor and there.suffix == ".md":
            headings = re.findall(r"^#+ (.*)$", there.read_text(encoding="utf-8"), re.MULTILINE)
            if anchor not in map(_anchor, headings):
                lost.append(target)
    assert not lost


def test_the_pages_stay_short() -> None:
    pages = list((ROOT / "docs").rglob("*.md"))
    assert len(pages) <= 65
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in pages) <= 50_000
    assert len((ROOT / "docs/how-to/run-unattended.md").read_text(encoding="utf-8").split()) <= 1_800
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 800


def test_each_answer_has_a_command_and_at_most_120_words() -> None:
    _, *answers = (ROOT / "docs/how-to/questions.md").read_text(encoding="utf-8").split("\n## ")
    assert len(answers) >= 14
    for answer in answers:
        assert re.search(r"^(\$|>>>) ", answer, re.MULTILINE), answer
        assert len(re.sub(_FENCE, "", answer).split()) <= 120, answer


def test_the_changelog_of_versions_before_2_has_at_most_60_lines() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert len(text[text.index("## 1.0.0") :].splitlines()) <= 60


def test_changelog_and_citation_are_of_this_version() -> None:
    texts = ((ROOT / name).read_text(encoding="utf-8") for name in ("CHANGELOG.md", "CITATION.cff"))
    assert [re.findall("^(?:##|version:) (.*)", text, re.MULTILINE)[0] for text in texts] == [__version__] * 2


def test_every_decision_stands_once_in_the_index() -> None:
    decisions = ROOT / "docs/adr"
    listed = re.findall(
        r"^- \[(\d+)\. (.+)\]\((.+)\)$", (decisions / "README.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    pages = {page.name: page.read_text(encoding="utf-8").splitlines()[0] for page in decisions.glob("[0-9]*.md")}
    assert sorted((name, f"# {number}. {title}") for number, title, name in listed) == sorted(pages.items())


def test_references_to_decisions_lead_somewhere() -> None:
    """Code and pages name a decision as ADR-n: its number exists, is the one that a link beside it leads to, and no older form is left."""
    numbers = {int(page.name[:4]) for page in (ROOT / "docs/adr").glob("[0-9]*.md")}
    assert len(numbers) <= 12
    parts = [ROOT / "tcpipe", ROOT / "tests", ROOT / "docs", ROOT / "schemas", ROOT / "benchmarks", ROOT / "pipelines"]
    files = [path for part in parts for path in part.rglob("*") if path.suffix in (".py", ".md", ".toml", ".json")]
    named, wrong = 0, []
    for path in (*files, *ROOT.glob("*.md")):
        text = path.read_text(encoding="utf-8")
        named += len(re.findall(r"\bADR-\d", text))
        wrong += [(path.name, hit) for hit in re.findall(r"\bADRs?\s+\d+|docs/adr, [A-Z]\w+", text)]
        wrong += [(path.name, hit) for hit in re.findall(r"\bADR-(\d+)", text) if int(hit) not in numbers]
        wrong += [(path.name, hit) for hit in re.findall(r"\[ADR-(\d+)\]\((?!(?:\S*/)?0*\1-)", text)]
    assert not wrong
    assert named > 10


def test_files_and_modules_that_pages_name_exist() -> None:
    wrong = []
    for page in PAGES:
        if page.name == "CHANGELOG.md":
            continue
        text = page.read_text(encoding="utf-8")
        paths = re.findall(r"\b((?:tcpipe|tests|benchmarks|pipelines)/[\w/.-]+\.(?:py|toml|md|sbatch))\b", text)
        wrong += [f"{page.name}: {path}" for path in paths if "NAME" not in path and not (ROOT / path).exists()]
        for dotted in re.findall(r"(?:`|from |import )(tcpipe(?:\.(?!toml)[a-z_]\w*)+)", text):
            parent, _, name = dotted.rpartition(".")
            places = [
                ROOT / dotted.replace(".", "/"),
                *(ROOT / f"{stem.replace('.', '/')}.py" for stem in (dotted, parent)),
            ]
            source = places[-1] if places[-1].exists() else ROOT / parent.replace(".", "/") / "__init__.py"
            if not any(place.exists() for place in places[:2]) and not (source.exists() and name in source.read_text()):
                wrong.append(f"{page.name}: {dotted}")
    assert not wrong


def test_names_in_the_table_of_changes_are_defined_where_it_says() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    places = re.findall(r"`(tcpipe/[\w/.]+): (\w+)`", text)
    assert len(places) >= 15
    wrong = []
    for file, name in places:
        defined = rf"^(def {name}\b|class {name}\b|{name}\b.* = )"
        if not re.search(defined, (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE):
            wrong.append(f"{file}: {name}")
    assert not wrong


def _command_lines(page: Path) -> Iterator[str]:
    """Yield every ``tcpipe …`` command in the page's plain and console blocks, and in its inline code."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    for kind, body in _FENCE.findall(text):
        if kind in ("", "console", "bash", "sh"):
            for line in body.splitlines():
                for part in re.split(r"\||&&|;|\(|\$\(", line.partition(" # ")[0]):
                    found = re.match(r"\s*(?:\$ )?(?:do |\d+ \d+ \* \* \*.*?bin/)?(tcpipe .*)", part)
                    if found:
                        yield found[1]
    inline = re.sub(_FENCE, "", text)
    yield from re.findall(r"`(tcpipe [a-z-]+ [^`]*--[^`]*)`", inline)


def _problem(line: str) -> str | None:
    """Return why a command line could not be meant: the command or one of its options does not exist."""
    words = shlex.split(re.split(r" (?:2>|>|<)", line)[0])[1:]
    if words[0].startswith("-") or words[0].isupper():
        return None
    if words[0] not in cli.commands:
        return f"{line}: there is no command {words[0]}"
    command = cli.commands[words[0]]
    known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    given = [word.partition("=")[0] for word in words[1:] if re.match(r"--?[a-z]", word)]
    unknown = [option for option in given if option not in known | {"--help"}]
    if unknown:
        return f"{line}: {words[0]} has no option {', '.join(unknown)}"
    with click.Context(command, info_name=words[0]) as context, contextlib.suppress(click.exceptions.Exit):
        try:
            command.make_parser(context).parse_args(list(words[1:]))
        except click.UsageError as error:
            return f"{line}: {error.format_message()}"
    return None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_options_exist(page: Path) -> None:
    if page.name in {"cli.md", "CHANGELOG.md"}:
        pytest.skip("generated from the commands themselves, or of commands of their time")
    assert not [problem for line in _command_lines(page) if (problem := _problem(line))]


def test_the_pages_hold_commands_to_check() -> None:
    lines = [line for page in PAGES for line in _command_lines(page)]
    assert len(lines) > 40
    assert _problem("tcpipe ingest run.bag --jbos 2") == "tcpipe ingest run.bag --jbos 2: ingest has no option --jbos"
    assert _problem("tcpipe injest run.bag") == "tcpipe injest run.bag: there is no command injest"


def _recipes() -> list[tuple[str, str]]:
    return [
        (f"{page.relative_to(ROOT)}:{number}", body)
        for page in (ROOT / "docs/how-to").glob("*.md")
        for number, body in enumerate(_fences(page, "toml"))
        if "[[class]]" not in body
    ]


@pytest.mark.parametrize(("where", "body"), _recipes(), ids=lambda value: value if ":" in value[:60] else "")
def test_recipe_lines_are_recipes(where: str, body: str) -> None:
    import tomllib

    values = tomllib.loads(body)
    assert parse_recipe(values, where=where) != Recipe()


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a small dataset in both formats."""
    here = tmp_path_factory.mktemp("docs")
    store = small_store(here)
    region = region_file(here / "region.geojson", box(-18, -18, 6, 18))
    for name, file_format in (("dataset", "zarr"), ("dataset-parquet", "parquet")):
        build_dataset(here / name, store=store.root, split=region, recipe=Recipe(), format=file_format)
    return here


@pytest.mark.parametrize(
    "snippet",
    [
        pytest.param(body, id=f"{page.name}:{number}")
        for page in SNIPPETS
        for number, body in enumerate(_fences(page, "python"))
    ],
)
@pytest.mark.filterwarnings("default")  # of other libraries
def test_snippets_run(snippet: str, datasets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(os.environ, "KERAS_BACKEND", "torch")
    for name in re.findall(r"^(?:import|from) (\w+)", snippet, re.MULTILINE):
        pytest.importorskip(name)
    for name in ("dataset", "dataset-parquet"):
        shutil.copytree(datasets / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(os.environ, "HF_HUB_OFFLINE", "1")
    monkeypatch.setitem(os.environ, "HF_HOME", str(tmp_path / "cache"))
    names: dict[str, object] = {}
    if "train" in snippet and "open_dataset" not in snippet and "polars" not in snippet:
        exec('import tcpipe; train = tcpipe.open_dataset("dataset")["train"]', names)  # noqa: S102  ours
    exec(compile(snippet, "snippet", "exec"), names)  # noqa: S102  ours
    if "patches" in names and "labels" in names:
        assert names["patches"].shape[1:] == (40, 40, 3)
        assert names["labels"].shape[1:] == (2,)


def test_nothing_of_one_machine_is_in_the_pages() -> None:
    """No absolute path of where the pages were written."""
    found = {page.name: re.findall(r"/(?:work|root|tmp|mnt)/\S*", page.read_text(encoding="utf-8")) for page in PAGES}
    assert {name: paths for name, paths in found.items() if paths} == {}
