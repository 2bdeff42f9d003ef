"""No regular expression of the package takes more than linear time on the strings that its own parse tree says are worst.

Each pattern that the package compiles, and each literal that it hands to a function of `re`, is asked for strings of what comes before a
repeat, the repeat's body very often, and something that fits nothing: where two repeats can share characters, or a repeat holds another,
backtracking tries all ways to share them out. Each try may take `MOST_CPU_S`, some thousand times what a linear one needs.

What it cannot see: patterns built in functions from names or files (they are of escaped text), and ambiguities that show only in a mixture
of bodies that no single rule of choosing characters makes.
"""

import ast
import importlib
import re
import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from re import _constants as c
from re import _parser
from typing import Any

import pytest
from package_source import read_nodes

PUMPED = 50_000
"""Characters of a repeat: what is quadratic takes 10^9 steps."""
MOST_CPU_S = 1.0
BOUNDED = 1000
"""Times that a repeat may go on which counts as bounded."""
METHODS = ("match", "fullmatch", "search", "sub", "subn", "split", "findall", "finditer")
ALPHABET = "a0 _.\n"
SINGLE = (c.LITERAL, c.NOT_LITERAL, c.ANY, c.IN)
REPEATS = (c.MAX_REPEAT, c.MIN_REPEAT, c.POSSESSIVE_REPEAT)


class TooSlowError(Exception):
    """A pattern took longer than any linear one does."""


def test_every_pattern_is_linear_in_its_worst_strings():
    slow = [
        f"{where}: {pattern.pattern!r}" for where, pattern, methods in patterns() if not is_linear(pattern, methods)
    ]
    assert not slow, "make the repeats possessive, or bound them:\n" + "\n".join(slow)


@pytest.mark.parametrize(
    "pattern",
    [
        r"\s*(?:<\?[^>]*\?>\s*|<!--.*?-->\s*)*<([A-Za-z_][\w:.-]*)",  # of 0.8.0: 268 bytes took it for ever
        r"(a+)+b",
        r"(a|aa)*b",
        r"\s*\s*x",
        r"\d+\.?\d*x",
    ],
)
def test_it_finds_patterns_that_backtrack(pattern):
    assert not is_linear(re.compile(pattern, re.DOTALL), {"match"}, most_cpu_s=0.1)


def test_it_lets_possessive_ones_pass():
    assert is_linear(re.compile(r"(a++)+b"), {"match"})
    assert is_linear(re.compile(r"\d++\.?\d*x"), {"match"})


def patterns() -> Iterator[tuple[str, re.Pattern, set[str]]]:
    """Yield where a pattern stands, itself, and the methods that are called of it."""
    for path, nodes in read_nodes().items():
        if not any(isinstance(node, ast.Import) and node.names[0].name == "re" for node in nodes):
            continue
        name = ".".join(("tcpipe", *Path(path).with_suffix("").parts))
        module = importlib.import_module(name)
        calls = [node for node in nodes if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)]
        for call in calls:
            first = call.args[0] if call.args else None
            if isinstance(first, ast.Constant) and name_document(call) == "re" and call.func.attr in METHODS:
                yield f"{name}:{call.lineno}", re.compile(first.value), {call.func.attr}
        for held, value in vars(module).items():
            if isinstance(value, re.Pattern):
                used = {call.func.attr for call in calls if name_document(call) == held}
                yield f"{name}.{held}", value, used & set(METHODS) or {"search"}


def name_document(call: ast.Call) -> str | None:
    return call.func.value.id if isinstance(call.func.value, ast.Name) else None


def is_linear(pattern: re.Pattern, methods: set[str], most_cpu_s: float = MOST_CPU_S) -> bool:
    anywhere = methods - {"match", "fullmatch"}
    asked = [pattern.search] if anywhere else [getattr(pattern, method) for method in methods]
    try:
        for attack in attacks(pattern):
            text = attack.encode("latin-1", "replace") if isinstance(pattern.pattern, bytes) else attack
            for ask in asked:
                with cpu_limit(most_cpu_s):
                    ask(text)
    except TooSlowError:
        return False
    return True


@contextmanager
def cpu_limit(seconds: float) -> Iterator[None]:
    def stop(*_):
        raise TooSlowError

    before = signal.signal(signal.SIGPROF, stop)  # regular expressions look for signals while they run
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@dataclass(frozen=True)
class Choice:
    """How a text is made where a pattern leaves it open: the character that is liked, and which branch is taken."""

    liked: str
    branch: int


def attacks(pattern: re.Pattern) -> set[str]:
    """Return texts of what comes before a repeat, its body pumped, and a character that fits nothing."""
    text = pattern.pattern if isinstance(pattern.pattern, str) else pattern.pattern.decode("latin-1")
    liked = sorted({*ALPHABET, *filter(str.isprintable, text)})
    tree = _parser.parse(pattern.pattern, pattern.flags)
    made = set()
    for char, branch in product(liked, range(branches(tree))):
        for before, body in repeats(tree, "", Choice(char, branch)):
            made.add(before + body * (PUMPED // len(body)) + "\0")
    return made


def branches(nodes: Iterable) -> int:
    """Return into how many branches a repeat's body parts at most."""
    most = 1
    for op, value in nodes:
        inner = [value[2]] if op in REPEATS else insides(op, value)
        if op in REPEATS and value[1] > BOUNDED:
            most = max(most, *(len(of[1]) for kind, of in walk(value[2]) if kind is c.BRANCH), 1)
        most = max([most, *map(branches, inner)])
    return most


def walk(nodes: Iterable) -> Iterator[tuple]:
    for op, value in nodes:
        yield op, value
        for inner in [value[2]] if op in REPEATS else insides(op, value):
            yield from walk(inner)


def repeats(nodes: Iterable, before: str, choice: Choice) -> Iterator[tuple[str, str]]:
    """Yield of each repeat without a small bound a short text before it, and texts of its body."""
    for op, value in nodes:
        if op in REPEATS:
            _, most, body = value
            text = sample(body, choice)
            if most > BOUNDED and text:
                yield before, text
                yield before, text + sample(body, replace(choice, liked="a"))
            yield from repeats(body, before, choice)
        for inner in insides(op, value):
            yield from repeats(inner, before, choice)
        before += sample([(op, value)], choice)


def insides(op: object, value: Any) -> list[Iterable]:
    if op is c.BRANCH:
        return list(value[1])
    return [value[3]] if op is c.SUBPATTERN else [value] if op is c.ATOMIC_GROUP else []


def sample(nodes: Iterable, choice: Choice) -> str:
    """Return a shortest text that the nodes match, but for what looks ahead or behind."""
    return "".join(_sample_of(op, value, choice) for op, value in nodes)


def _sample_of(op: object, value: Any, choice: Choice) -> str:
    if op in SINGLE:
        fits = re.compile(_source(op, value), re.DOTALL).fullmatch
        return next((char for char in (choice.liked, *map(chr, range(32, 127))) if fits(char)), "")
    if op in REPEATS:
        return sample(value[2], choice) * min(value[0], BOUNDED)
    inner = insides(op, value)
    return sample(inner[choice.branch % len(inner)], choice) if inner else ""


_CATEGORIES = {
    c.CATEGORY_DIGIT: r"\d", c.CATEGORY_NOT_DIGIT: r"\D", c.CATEGORY_SPACE: r"\s",
    c.CATEGORY_NOT_SPACE: r"\S", c.CATEGORY_WORD: r"\w", c.CATEGORY_NOT_WORD: r"\W",
}  # fmt: skip


def _source(op: object, value: Any) -> str:
    """Return a pattern of one character again."""
    if op is c.LITERAL:
        return re.escape(chr(value))
    if op is c.NOT_LITERAL:
        return f"[^{re.escape(chr(value))}]"
    if op is c.ANY:
        return "."
    text = ""
    for kind, of in value:
        if kind is c.NEGATE:
            text += "^"
        elif kind is c.LITERAL:
            text += re.escape(chr(of))
        elif kind is c.RANGE:
            text += f"{re.escape(chr(of[0]))}-{re.escape(chr(of[1]))}"
        else:
            text += _CATEGORIES[of]
    return f"[{text}]"
