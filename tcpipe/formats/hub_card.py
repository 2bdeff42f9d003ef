"""Descriptions of a dataset for hubs: README.md for the Hugging Face Hub, croissant.json (Croissant 1.1 metadata, MLCommons).

By the README, ``datasets.load_dataset`` finds configurations and splits. Its YAML head is
https://github.com/huggingface/hub-docs/blob/main/datasetcard.md?plain=1.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import pyarrow as pa

from tcpipe.errors import clean_line
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import OVERVIEW, SAMPLES, SHARDS
from tcpipe.formats.finding_lines import list_verdict
from tcpipe.formats.integrity import Checksum
from tcpipe.formats.json_files import Json, to_json
from tcpipe.formats.maps.map_facts import read_layers

_LICENCES = {
    "apache-2.0", "mit", "bsd-3-clause", "cc0-1.0", "cc-by-2.0", "cc-by-3.0", "cc-by-4.0", "cc-by-sa-3.0", "cc-by-sa-4.0",
    "cc-by-nc-3.0", "cc-by-nc-4.0", "cc-by-nd-4.0", "cc-by-nc-nd-4.0", "cc-by-nc-sa-4.0", "odbl", "pddl", "odc-by", "gpl-3.0",
}  # fmt: skip
"""Names of licences that the Hub knows; others keep their own name."""
_SIZES = {10**3: "n<1K", 10**4: "1K<n<10K", 10**5: "10K<n<100K", 10**6: "100K<n<1M", 10**7: "1M<n<10M"}
_SHOWN_LAYERS = 12


def format_hub_card(card: DatasetCard) -> str:
    """Return the document: a YAML head (as JSON, which is YAML) and what a reader wants to know."""
    text = "\n".join(_iterate_lines(card))
    head = _make_head(card)
    yaml = "".join(f"{key}: {json.dumps(value, ensure_ascii=True)}\n" for key, value in head.items())
    return f"---\n{yaml}---\n\n{text}\n"


def _make_head(card: DatasetCard) -> dict[str, Json]:
    configs: list[Json] = [{"config_name": "samples", "data_files": [{"split": "full", "path": SAMPLES}]}]
    if card.shards:
        files: dict[str, list[str]] = {}
        for shard in card.shards:
            files.setdefault(shard.split, []).append(shard.path)
        data: list[Json] = [{"split": split, "path": list(paths)} for split, paths in files.items()]
        configs.insert(0, {"config_name": "patches", "default": True, "data_files": data})
    known = card.licence.lower() if card.licence.lower() in _LICENCES else "other" if card.licence else "unknown"
    return {
        "pretty_name": card.name,
        "license": known,
        **({"license_name": card.licence} if known == "other" else {}),
        "size_categories": [next((name for most, name in _SIZES.items() if card.samples < most), "n>10M")],
        "task_categories": ["tabular-regression", "robotics"],
        "tags": ["robotics", "terrain", "traversability", "energy", "geospatial", "tcpipe", "croissant"],
        "configs": configs,
    }


def _escape_markdown(value: str) -> str:
    """Return text as Markdown shows it, and nothing else: no HTML, no markup."""
    escaped = clean_line(value).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return "".join(f"\\{c}" if c in "\\`*_[]|#{}" else c for c in escaped)


def _iterate_lines(card: DatasetCard) -> Iterator[str]:
    """Yield the lines of what a reader wants to know."""
    splits = ", ".join(f"{count} {split}" for split, count in card.splits.items())
    side = f"{card.patch_px} × {card.patch_px} pixels of {card.patch_m:g} m × {card.patch_m:g} m"
    beside = f", beside a patch of the ground under it: {side}" if card.layers else ""
    labels = ", ".join(name for name in card.labels if name not in card.absent_labels)
    without = ", ".join(card.absent_labels)
    yield from (f"# {_escape_markdown(card.name)}", "")
    if card.description:
        yield from (_escape_markdown(card.description), "")
    yield (
        f"{card.samples} samples ({splits}) of what driving a metre of ground costs a robot "
        f"({', '.join(map(_escape_markdown, card.robots)) or 'none'}): {labels}, each with its standard deviation{beside}."
    )
    if without:
        yield f"It has no label {without}."
    if card.without_coordinates:
        text = "Positions are metres from an origin that is not published; times begin with the first sample."
        yield from ("", text)
    elif card.maps:
        yield from ("", f"![the maps from above]({OVERVIEW})")
    yield from ("", "## Labels, over train alone", "")
    yield from ("| label | mean | standard deviation | least | most |", "|---|---|---|---|---|")
    for name, statistics in card.label_statistics_of_train.items():
        figures = (statistics.mean, statistics.std, statistics.min, statistics.max)
        yield f"| `{name}` | " + " | ".join("–" if value is None else f"{value:.4g}" for value in figures) + " |"
    if card.layers:
        yield from ("", "## Layers of a patch", "", "| layer | stored as | unit |", "|---|---|---|")
    for name, layer in list(card.layers.items())[:_SHOWN_LAYERS]:
        yield f"| {_escape_markdown(name)} | {layer['dtype']} | {_escape_markdown(str(layer.get('units', '')))} |"
    yield from (
        "",
        "`dataset.json` describes the decoding.",
        "",
        "## Reading it",
        "",
        "```python",
        *_describe_reading(card),
        "```",
        "",
    )
    yield from ("## Splits", "", _format_splits(card), "")
    verdict = (f"- {line}" for line in list_verdict(card.verdict))
    yield from ("## Verdict", "", *verdict, "", "`dataset.json` has the findings.", "")
    yield from (
        "## Licence and citation",
        "",
        f"Licence: {_escape_markdown(card.licence) or 'not stated; ask before you use it'}.",
        "",
    )
    yield from ("```bibtex", *_format_bibtex(card), "```", "")
    yield f"Made with tcpipe {card.tcpipe_version}, data model {card.data_model_version}. `tcpipe verify` checks every file."


def _describe_reading(card: DatasetCard) -> Iterator[str]:
    if card.shards:
        yield from (
            "from datasets import load_dataset",
            'load_dataset("PATH")             # the patches with their samples, by split',
        )
    what = "patches  # float32 (N, px, px, layers), decoded" if card.layers else "samples  # a table, one row a sample"
    yield from ("import tcpipe", f'tcpipe.open_dataset("PATH")["train"].{what}')


def _format_splits(card: DatasetCard) -> str:
    rules = card.recipe.split
    return (
        f"`test` is drawn by {rules.holdout} ({100 * rules.test_fraction:g} % of the samples inside the region), `unseen` lies "
        f"outside of it, `buffer` within {card.split.buffer_m:.2f} m of its edge, and is in no other split; `train` has "
        f"{len(card.folds_of_train)} folds. "
        "`dataset.json` has the audit of overlaps."
    )


def _format_bibtex(card: DatasetCard) -> Iterator[str]:
    def braced(text: str) -> str:
        return "".join(c for c in clean_line(text) if c not in "{}\\`")

    yield f"@misc{{tcpipe-{card.inputs[:12]},"
    yield f"  title = {{{braced(card.name)}}},"
    if card.creator:
        yield f"  author = {{{braced(card.creator)}}},"
    yield f"  note = {{{card.samples} samples, version {_format_version(card)}}},"
    yield "}"


_TERMS = (
    *("annotation", "arrayShape", "citeAs", "column", "containedIn", "equivalentProperty", "excludes", "extract"),
    *("field", "fileObject", "fileProperty", "fileSet", "format", "includes", "isArray", "isLiveDataset", "jsonPath"),
    *("key", "md5", "parentField", "path", "readLines", "recordSet", "references", "regex", "repeated", "replace"),
    *("samplingRate", "sdVersion", "separator", "source", "subField", "transform", "unArchive", "value"),
)
_CONTEXT: Json = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "prov": "http://www.w3.org/ns/prov#",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "conformsTo": "dct:conformsTo",
    **{name: f"cr:{name}" for name in _TERMS},
}

_ENCODING_BY_SUFFIX = {
    ".json": "application/json",
    ".parquet": "application/x-parquet",
    ".html": "text/html",
    ".md": "text/markdown",
    ".png": "image/png",
    ".geojson": "application/geo+json",
}


def format_croissant(card: DatasetCard, samples: pa.Schema, files: Mapping[str, Checksum]) -> str:
    """Return the document as JSON-LD; ``samples`` is the schema of the table of samples, whose fields' metadata give their meanings."""
    source = {"fileObject": {"@id": SAMPLES}}
    records = [_describe_records("samples", "One record a sample, in the order of the patches.", samples, source)]
    sets = []
    if card.shards:
        kind = {"name": "shards", "encodingFormat": _ENCODING_BY_SUFFIX[".parquet"], "includes": f"{SHARDS}/*.parquet"}
        sets.append({"@type": "cr:FileSet", "@id": "shards", **kind})
        layers = read_layers(card.layers, card.classes, Path())
        patches = [
            _patch_field(layer.name, math.prod(layer.patch_shape(card.patch_px)), layer.stored.kind)
            for layer in layers.values()
        ]
        columns = pa.schema([samples.field("sample_id"), samples.field("split"), *patches])
        about = "One record a sample with its patch, split by split: rows of the patch one after another."
        records.append(_describe_records("patches", about, columns, {"fileSet": {"@id": "shards"}}))
    document = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": card.name,
        "description": card.description,
        "license": card.licence,
        "creator": {"@type": "sc:Person", "name": card.creator} if card.creator else None,
        "version": _format_version(card),
        "distribution": [*(_describe_file_object(path, files[path]) for path in sorted(files)), *sets],
        "recordSet": records,
    }
    return to_json({key: value for key, value in document.items() if value})


def _format_version(card: DatasetCard) -> str:
    return f"{card.data_model_version}.0+{card.inputs[:12]}"


def _describe_file_object(path: str, file: Checksum) -> Json:
    suffix = path[path.rfind(".") :] if "." in path.rsplit("/", 1)[-1] else ""
    return {
        "@type": "cr:FileObject",
        "@id": path,
        "name": path,
        "contentUrl": path,
        "contentSize": f"{file.size_bytes} B",
        "encodingFormat": _ENCODING_BY_SUFFIX.get(suffix, "application/octet-stream"),
        "sha256": file.sha256,
    }


def _describe_records(name: str, about: str, columns: pa.Schema, source: Mapping[str, Json]) -> Json:
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": about,
        "key": {"@id": f"{name}/sample_id"},
        # Croissant has no type for binary columns.
        "field": [_describe_field(name, field, source) for field in columns if not pa.types.is_binary(field.type)],
    }


def _patch_field(layer: str, values: int, kind: str) -> pa.Field:
    return pa.field(
        layer,
        pa.list_(pa.float32() if kind == "f" else pa.uint16(), values),
        metadata={"doc": f"layer {layer} as stored; dataset.json describes the decoding"},
    )


def _describe_field(records: str, field: pa.Field, source: Mapping[str, Json]) -> Json:
    metadata = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
    unit = f" [{metadata['unit']}]" if metadata.get("unit") else ""
    many = pa.types.is_fixed_size_list(field.type)
    return {
        "@type": "cr:Field",
        "@id": f"{records}/{field.name}",
        "name": field.name,
        "description": metadata.get("doc", "") + unit,
        "dataType": _find_data_type(field.type.value_type if many else field.type),
        **({"isArray": True, "arrayShape": str(field.type.list_size)} if many else {}),
        "source": {**source, "extract": {"column": field.name}},
    }


def _find_data_type(dtype: pa.DataType) -> str:
    if pa.types.is_integer(dtype):
        return "sc:Integer"
    return "sc:Float" if pa.types.is_floating(dtype) else "sc:Text"
