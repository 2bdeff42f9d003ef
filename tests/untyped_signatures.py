"""Counts the functions of tcpipe whose signature says nothing of a value: ``python tests/untyped_signatures.py`` prints them by room.

A signature counts when an annotation holds ``Any``, ``object`` in a container, or an alias of either: ``dict`` for ``Mapping`` or
``object`` for ``Any`` is no gain. ``UNTYPED_LIBRARIES`` lists those whose value is a library's that has no types.
"""

import ast
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "tcpipe"
Trees = dict[str, ast.Module]
MAPPINGS = {"dict", "Mapping", "MutableMapping"}

_BY_LIBRARY = {
    "lightgbm": """learning/table_model.py:read_forest learning/table_model.py:_make_forest
        learning/table_model.py:_make_forest.add_node
        learning/table_model.py:_load_lightgbm""",
    "torch": """dataset/torch_data.py:TorchBatches.__iter__ dataset/torch_data.py:_to_tensors
        learning/architecture.py:mean_loss
        learning/network.py:Normed.forward learning/network.py:BasicBlock.forward learning/network.py:ResNet18.forward
        learning/network.py:ResNet18._weights learning/network.py:find_device
        learning/network.py:move_to_device learning/network.py:_pad_images
        learning/network.py:_reorder_axes learning/network.py:Trainer._list_state""",
    "rasterio": """formats/maps/geotiff.py:RasterTiles._dataset formats/maps/geotiff.py:_read_grey formats/maps/geotiff.py:_open_as
        formats/maps/geotiff.py:_refuse_unplaced formats/maps/geotiff.py:_choose_bands formats/maps/geotiff.py:_read_scaling
        formats/maps/geotiff.py:_find_vertical_unit_m formats/maps/geotiff.py:_describe_as_vrt""",
    "zarr": """formats/maps/map_files.py:_put formats/maps/map_files.py:_place formats/maps/map_files.py:_add_layer
        formats/maps/map_files.py:_add_axis formats/maps/map_files.py:MapWriter._add_level formats/zarr_arrays.py:add_array""",
    "numcodecs": "formats/shards.py:_make_codec",
    "ruamel.yaml": """formats/logs/rosbag2.py:_find_files_by_metadata formats/logs/rosbag2.py:_read_topic_counts
        formats/logs/rosbag2.py:_read_bag_information""",
    "rosbags": """formats/logs/ros_types.py:_make_typestore formats/logs/ros_types.py:TypeLibrary._known
        formats/logs/ros_types.py:TypeLibrary._fallback
        formats/logs/ros_types.py:_Unfold.__init__ formats/logs/ros_types.py:_Unfold.wire_type formats/logs/ros_types.py:_parse_definitions
        formats/logs/ros_types.py:_parse_msg formats/logs/ros_types.py:_describe_field_type formats/logs/ros_types.py:_parse_idl
        formats/logs/ros_types.py:_load_rosbags_definitions
        formats/logs/ros_types.py:_load_own_definitions formats/logs/ros_types.py:_read_definitions
        formats/logs/ros_types.py:_read_definitions_of_directory formats/logs/ros_types.py:_to_plain formats/logs/writing.py:_make_message
        formats/logs/writing.py:_to_rosbags_value formats/logs/writing.py:_make_elements formats/logs/writing.py:_place""",
    "numba": """compiled.py:compile_kernel compiled.py:_Announce.on_start compiled.py:_Announce.on_end""",
    "click": "cli/options.py:Place.convert cli/options.py:FloatRange.convert",
}
UNTYPED_LIBRARIES = {key: library for library, keys in _BY_LIBRARY.items() for key in keys.split()}
"""Functions that take or return a value of a library without types (or whose types name no class for it), as ``path:function``."""


@dataclass(frozen=True)
class Signature:
    """One annotated function, method or field: where it stands and what its annotations are."""

    path: str
    name: str
    annotations: tuple[ast.expr, ...]
    is_function: bool

    @property
    def key(self) -> str:
        return f"{self.path}:{self.name}"

    @property
    def is_public(self) -> bool:
        return not any(part.startswith("_") for part in self.name.split("."))


def _parsed(annotation: ast.expr) -> ast.expr:
    quoted = isinstance(annotation, ast.Constant) and isinstance(annotation.value, str)
    return ast.parse(annotation.value, mode="eval").body if quoted else annotation


def _annotations(function: ast.FunctionDef | ast.AsyncFunctionDef) -> tuple[ast.expr, ...]:
    taken = function.args
    every = [*taken.posonlyargs, *taken.args, *taken.kwonlyargs, taken.vararg, taken.kwarg]
    found = [each.annotation for each in every if each is not None] + [function.returns]
    return tuple(_parsed(each) for each in found if each is not None)


def _signatures(path: str, node: ast.AST, above: str = "") -> Iterator[Signature]:
    for child in ast.iter_child_nodes(node):
        name = f"{above}{getattr(child, 'name', '')}"
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            yield Signature(path, name, _annotations(child), is_function=True)
            yield from _signatures(path, child, f"{name}.")
        elif isinstance(child, ast.ClassDef):
            yield from _signatures(path, child, f"{name}.")
        elif isinstance(child, ast.AnnAssign) and isinstance(node, ast.ClassDef) and isinstance(child.target, ast.Name):
            yield Signature(path, f"{above}{child.target.id}", (_parsed(child.annotation),), is_function=False)
        else:
            yield from _signatures(path, child, above)


def _names(annotation: ast.expr) -> Iterator[str]:
    for node in ast.walk(annotation):
        yield from (getattr(node, key) for key in ("id", "attr") if hasattr(node, key))


def says_nothing(annotation: ast.expr, aliases: frozenset[str] = frozenset()) -> bool:
    """Whether an annotation holds ``Any``, an alias that does, or a container of ``object``."""
    contained = (
        part for node in ast.walk(annotation) if isinstance(node, ast.Subscript) for part in _names(node.slice)
    )
    return not aliases.union({"Any"}).isdisjoint(_names(annotation)) or "object" in contained


def holds_facts(annotation: ast.expr, aliases: frozenset[str] = frozenset()) -> bool:
    """Whether an annotation holds a mapping by name of values that it says nothing of, or an alias of one."""
    if not aliases.isdisjoint(_names(annotation)):
        return True
    for node in ast.walk(annotation):
        if (
            isinstance(node, ast.Subscript)
            and isinstance(node.slice, ast.Tuple)
            and not MAPPINGS.isdisjoint(_names(node.value))
        ):
            key, values = node.slice.elts[0], set(_names(node.slice.elts[-1]))
            if set(_names(key)) == {"str"} and values & {"Any", "object"} and "NDArray" not in values:
                return True
    return False


def aliases_of(trees: Trees, wanted: Callable[[ast.expr, frozenset[str]], bool]) -> dict[str, frozenset[str]]:
    """By module, the names that stand there for a type that is ``wanted``: given at its head, or imported from where they are."""
    found = dict.fromkeys(trees, frozenset[str]())
    for _ in range(3):  # an alias of an alias, and the import of one
        for path, tree in trees.items():
            for node in tree.body:
                if isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript | ast.BinOp):
                    given = {target.id for target in node.targets if isinstance(target, ast.Name)}
                    found[path] |= given if wanted(node.value, found[path]) else set()
                elif isinstance(node, ast.ImportFrom) and node.module:
                    there = found.get(f"{node.module.removeprefix('tcpipe.').replace('.', '/')}.py", frozenset())
                    found[path] |= {alias.asname or alias.name for alias in node.names if alias.name in there}
    return found


def read_package(package: Path = PACKAGE) -> Trees:
    """Every module of the package, by its path."""
    return {path.relative_to(package).as_posix(): ast.parse(path.read_text()) for path in sorted(package.rglob("*.py"))}


def signatures(trees: Trees) -> list[Signature]:
    """All functions, methods and fields of the modules."""
    return [found for path, tree in trees.items() for found in _signatures(path, tree)]


def untyped(trees: Trees) -> tuple[list[Signature], int]:
    """The functions whose signature says nothing of a value, those of untyped libraries too, and how many functions there are."""
    aliases = aliases_of(trees, says_nothing)
    functions = [each for each in signatures(trees) if each.is_function]
    return [each for each in functions if any(says_nothing(one, aliases[each.path]) for one in each.annotations)], len(
        functions
    )


def facts_in_the_open(trees: Trees) -> set[str]:
    """Public functions, methods and fields that pass on a mapping of facts, which whoever reads them must know by string."""
    aliases = aliases_of(trees, holds_facts)
    return {
        each.key
        for each in signatures(trees)
        if each.is_public and any(holds_facts(one, aliases[each.path]) for one in each.annotations)
    }


def main() -> None:
    """Print the functions that say nothing of a value, by room, and their share."""
    trees = read_package()
    found, total = untyped(trees)
    rooms = Counter(each.path.split("/")[0] for each in found if each.key not in UNTYPED_LIBRARIES)
    left = sum(rooms.values())
    print(*(f"{count:5} {room}" for room, count in rooms.most_common()), sep="\n")  # noqa: T201
    print(  # noqa: T201
        f"{left:5} of {total} functions, {left / total:.1%}; {len(found) - left} more are of libraries without types\n"
        f"{len(facts_in_the_open(trees)):5} public places pass on a mapping of facts"
    )


if __name__ == "__main__":
    main()
