"""Layers as JSON values, in a dataset's card and in a map; as CF attributes, by which xarray decodes patches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TypeAlias

from tcpipe.formats.json_files import parse_typed
from tcpipe.terrain.classes import ClassTable, TerrainClass
from tcpipe.terrain.layers import (
    PAPER_LAYERS,
    Kind,
    Layer,
    make_categorical_layer,
    make_continuous_layer,
    make_paper_layers,
)

Value: TypeAlias = str | int | float | Sequence[float | Mapping[str, str | int | bool]] | None
Description: TypeAlias = Mapping[str, Value]


@dataclass(frozen=True, slots=True)
class _LayerDescription:
    """What is read of a description; the paper's layers need none of it."""

    kind: Kind = "continuous"
    long_name: str = ""
    units: str = "1"
    actual_range: tuple[float, float] = (0.0, 1.0)
    classes: tuple[TerrainClass, ...] = ()


def make_cf_flags(classes: ClassTable | None) -> dict[str, Value]:
    """Return what CF says of classes: their ids, and their names without a space."""
    entries = () if classes is None else classes.classes
    names = " ".join(entry.name.replace(" ", "_") for entry in entries)
    return {"flag_values": [entry.id for entry in entries], "flag_meanings": names}


def make_cf_attributes(layer: Layer) -> dict[str, Value]:
    """Return the CF attributes of a layer of patches."""
    about: dict[str, Value] = {"long_name": layer.long_name, "units": layer.unit}
    if layer.kind == "categorical":
        return {**about, **make_cf_flags(layer.classes)}
    if layer.stack == "floats":
        return {**about, "actual_range": [layer.low, layer.high]}
    about |= {"scale_factor": layer.step, "add_offset": 0.0}
    return {**about, "missing_value": layer.nodata} if layer.kind == "relative" else about


def describe_layer(layer: Layer) -> Description:
    """Return a layer as JSON values; of one that its name alone does not tell, also its kind and its classes."""
    known = {"dtype": layer.stored.name, "nodata": layer.nodata, **make_cf_attributes(layer)}
    if layer.name in PAPER_LAYERS:
        return known
    table = () if layer.classes is None else layer.classes.classes
    return {**known, "kind": layer.kind, **({"classes": [asdict(entry) for entry in table]} if table else {})}


def read_layers(found: Mapping[str, Description], classes: Sequence[TerrainClass], path: Path) -> dict[str, Layer]:
    """Return the layers that `describe_layer` wrote into ``path``, by name; ``classes`` are those of terrain, if any."""
    layers: dict[str, Layer] = {}
    for name, description in found.items():
        told = parse_typed(description, _LayerDescription, path)
        if name in PAPER_LAYERS:
            known = make_paper_layers([name], ClassTable(tuple(classes))) if classes else PAPER_LAYERS
            layers[name] = replace(known[name], long_name=told.long_name or known[name].long_name)
        elif told.kind == "categorical":
            layers[name] = make_categorical_layer(name, ClassTable(told.classes))
        else:
            low, high = told.actual_range
            layers[name] = make_continuous_layer(name, unit=told.units, low=low, high=high)
    return layers
