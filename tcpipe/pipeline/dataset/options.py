"""A user's choices for a dataset, read from files and checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tcpipe.errors import DatasetError, RecipeError, UsageError
from tcpipe.formats.atomic import Location
from tcpipe.formats.dataset_files import FileFormat
from tcpipe.formats.geojson import read_regions
from tcpipe.formats.recipe_toml import resolve_recipe
from tcpipe.pipeline.options import BuildDatasetOptions
from tcpipe.recipe import CovariateConfig, Recipe, TrainConfig
from tcpipe.splits.regions import Regions
from tcpipe.tables.levels import LABELS

if TYPE_CHECKING:
    from tcpipe.formats.covariates import CovariateTable


@dataclass(frozen=True, slots=True)
class BuildOptions:
    """A user's choices for a dataset, read and checked; ``recipe`` includes holdout and seed of the call."""

    recipe: Recipe
    robot: str | None
    tags: Mapping[str, str]
    map_names: tuple[str, ...]
    """In order of priority where maps overlap; none: the only one."""
    labels: tuple[str, ...]
    """Labels that every sample needs, names of `LABELS`; none: the default."""
    without_patches: bool
    regions: Regions | None
    covariates: tuple[CovariateTable, ...]
    file_format: FileFormat
    without_coordinates: bool


def read_build_options(options: BuildDatasetOptions, recipe: Recipe) -> BuildOptions:
    """Return a user's choices for a dataset, read and checked."""
    split, given_map = options.split, options.map
    if options.without_patches and given_map:
        raise UsageError("--map, --without-patches: samples without patches need no map; remove one of them")
    tables = [options.covariates] if isinstance(options.covariates, str | Path) else options.covariates
    return BuildOptions(
        recipe=recipe,
        robot=options.robot or recipe.robot,
        tags=options.tag or {},
        map_names=(given_map,) if isinstance(given_map, str) else tuple(given_map or ()),
        labels=parse_labels(options.labels),
        without_patches=options.without_patches,
        regions=None if split is None else read_regions(Path(split)),
        covariates=read_all_covariates([Path(path) for path in tables], recipe.covariates),
        file_format=options.format,
        without_coordinates=options.without_coordinates,
    )


def parse_labels(given: str | Sequence[str]) -> tuple[str, ...]:
    """Return the names of labels, each once, in the order of `LABELS`; `UsageError` for another name."""
    names = [name.strip() for name in (given.split(",") if isinstance(given, str) else given)]
    if unknown := [name for name in names if name not in LABELS]:
        raise UsageError(f"--labels {','.join(names)}: expected some of {', '.join(LABELS)}, got {', '.join(unknown)}")
    return tuple(name for name in LABELS if name in names)


def merge_recipe(recipe: Recipe | Location | None, *, holdout: str | None, seed: int | None) -> Recipe:
    """Return the recipe with the options ``--holdout`` and ``--seed`` in it."""
    recipe = resolve_recipe(recipe)
    kind, _, tag = (holdout or recipe.split.holdout).partition(":")
    rules = replace(
        recipe.split,
        holdout=kind,  # type: ignore[arg-type]  # the recipe checks it
        holdout_tag=recipe.split.holdout_tag if holdout is None else tag,
        seed=recipe.split.seed if seed is None else seed,
    )
    if rules.holdout == "tag" and not rules.holdout_tag:
        raise RecipeError(
            'recipe: split.holdout is "tag"; expected split.holdout_tag too, for example "season" (--holdout tag:season)'
        )
    return replace(recipe, split=rules, train=TrainConfig())  # how models are trained is no part of a dataset


def read_all_covariates(paths: Sequence[Path], config: CovariateConfig) -> tuple[CovariateTable, ...]:
    """Return the tables of the files; `DatasetError` if one cannot be used or two have one name."""
    if not paths:
        return ()
    from tcpipe.formats.covariates import read_covariates  # noqa: PLC0415  polars only where a table is given

    names = [path.stem for path in paths]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DatasetError(
            f"--covariates: {twice[0]} is given twice; columns are named after the file: give each its own name"
        )
    return tuple(read_covariates(path, time_column=config.time_column, time_unit=config.time_unit) for path in paths)
