"""What a signature may leave unsaid. Both limits only ever go down: lower them when a change allows it."""

import ast
from pathlib import Path

import pytest
from untyped_signatures import UNTYPED_LIBRARIES, facts_in_the_open, read_package, signatures, untyped

MOST_UNTYPED = 0.056
"""Share of functions whose signature says nothing of a value."""

STILL_OPEN = Path(__file__).with_name("facts_in_the_open.txt")
"""Public places that still pass on a mapping of facts."""

TREES = read_package()


def test_few_signatures_say_nothing_of_a_value():
    found, total = untyped(TREES)
    left = sorted(each.key for each in found if each.key not in UNTYPED_LIBRARIES)
    assert len(left) <= MOST_UNTYPED * total, left


def test_what_is_excepted_for_a_library_is_there_and_untyped():
    assert set(UNTYPED_LIBRARIES) <= {each.key for each in untyped(TREES)[0]}


def test_no_public_function_passes_on_a_mapping_of_facts():
    still_open = set(STILL_OPEN.read_text().split())
    new = facts_in_the_open(TREES) - still_open
    assert not new, f"give these a dataclass: {sorted(new)}"
    typed = still_open & {each.key for each in signatures(TREES)} - facts_in_the_open(TREES)
    assert not typed, f"these are typed now, take them from {STILL_OPEN.name}: {sorted(typed)}"


@pytest.mark.parametrize(
    ("annotation", "says_nothing", "is_facts"),
    [
        ("dict[str, Any]", True, True),
        ("Mapping[str, object]", True, True),
        ("list[dict[str, typing.Any]]", True, True),
        ("'dict[str, Any] | None'", True, True),
        ("Facts", True, True),
        ("list[Any]", True, False),
        ("Callable[[Any], int]", True, False),
        ("Mapping[str, NDArray[Any]]", True, False),
        ("Iterable[object]", True, False),
        ("object", False, False),
        ("Mapping[str, float]", False, False),
        ("Anything", False, False),
    ],
)
def test_the_counter_sees_what_it_counts(annotation, says_nothing, is_facts):
    aliased = ast.parse("Facts = dict[str, Any] | None")
    shown = ast.parse(
        f"from tcpipe.named import Facts\nclass Shown:\n    def told(self, *, of: {annotation}) -> None: ..."
    )
    trees = {"named.py": aliased, "shown.py": shown}
    found, total = untyped(trees)
    assert [each.key for each in found] == ["shown.py:Shown.told"] * says_nothing
    assert total == 1
    assert facts_in_the_open(trees) == ({"shown.py:Shown.told"} if is_facts else set())


def test_fields_pass_facts_on_and_private_functions_do_not():
    tree = ast.parse("class Shown:\n    told: dict[str, Any]\n    def _hidden(self) -> dict[str, Any]: ...")
    assert facts_in_the_open({"shown.py": tree}) == {"shown.py:Shown.told"}
