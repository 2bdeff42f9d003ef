"""Which options of a build differ from those of the dataset that it would replace; compared as data, from that dataset's card."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.json_files import digest, to_plain
from tcpipe.pipeline.dataset.inputs import BuildOptions, Inputs
from tcpipe.pipeline.dataset.splitting import regions_to_json
from tcpipe.pipeline.explain import flatten_recipe

_LONGEST_VALUE = 80


def find_other_options(card: DatasetCard, options: BuildOptions, inputs: Inputs) -> list[str]:
    """Return each option that differs from those of a dataset, by its name, with both values; empty where none does.

    Parameters
    ----------
    card : of the dataset that is there, of any data model.
    options : of the build that would replace it.
    inputs : what that build chose: its maps, its runs and their robot, its tables of covariates.
    """
    if card.redaction is not None or options.redact:
        if bool(card.redaction) != options.redact:
            return [_format_difference("--redact", bool(card.redaction), options.redact)]
        return [
            "--redact: a redacted dataset does not tell its maps, region, tags and recipe, so that nothing can be compared"
        ]
    return [
        _format_difference(name, was, now) for name, was, now in _iterate_options(card, options, inputs) if was != now
    ]


def _iterate_options(card: DatasetCard, options: BuildOptions, inputs: Inputs) -> Iterator[tuple[str, object, object]]:
    """Yield each option with its value in the card and its value now."""
    was, now = flatten_recipe(card.recipe), flatten_recipe(options.recipe)
    keys = sorted({*was, *now} - {"robot"})  # the robot of the runs counts, whoever named it
    yield from ((f"recipe {key}", was.get(key), now.get(key)) for key in keys)
    yield "--robot", card.robots, tuple(sorted({run.robot for run in inputs.sources})) if card.robots else ()
    yield "--tag", _find_chosen_tags(card, options.tags, inputs), dict(options.tags)
    yield "--map", tuple(entry.name for entry in card.maps), inputs.map_names
    regions = None if options.regions is None else regions_to_json(options.regions)
    yield "--split", _format_region(card.split.region), _format_region(regions)
    yield "--covariates", tuple(of.name for of in card.covariates), tuple(of.name for of in inputs.covariates)
    yield "--format", card.format, options.file_format
    if not options.keeps_own_split:
        yield "--keep-split", card.split.kept is not None, options.earlier is not None


def _find_chosen_tags(card: DatasetCard, wanted: Mapping[str, str], inputs: Inputs) -> dict[str, str]:
    """Return the tags that a dataset was chosen by.

    A card of before 0.9 does not tell: then those that all of its runs share, and that are wanted or not shared by the runs now.
    """
    if card.run_tags is not None:
        return dict(card.run_tags)
    shared = _find_shared(run.tags or {} for run in card.runs)
    still = _find_shared(run.tags or {} for run in inputs.sources)
    return {key: tag for key, tag in shared.items() if wanted.get(key) == tag or still.get(key) != tag}


def _find_shared(tags: Iterable[Mapping[str, str]]) -> dict[str, str]:
    every = [set(of.items()) for of in tags]
    return dict(sorted(set.intersection(*every))) if every else {}


def _format_region(region: Mapping[str, object] | None) -> str | None:
    """Return the kinds of a region's polygons and what tells them from others."""
    return None if region is None else f"{' and '.join(region)} ({digest(to_plain(region))[:8]})"


def _format_difference(name: str, was: object, now: object) -> str:
    return f"{name}: {_format_value(was)} in the dataset, {_format_value(now)} now"


def _format_value(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        value = [f"{key}={item}" for key, item in value.items()]
    if isinstance(value, list | tuple):
        value = ", ".join(map(str, value))
    text = "none" if value in (None, "") else str(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}… ({digest(text)[:8]})"
