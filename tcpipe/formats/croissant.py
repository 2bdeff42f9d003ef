"""Croissant 1.1 metadata of a dataset (MLCommons)."""

from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa

from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import SAMPLES, SHARDS
from tcpipe.formats.integrity import Checksum, FileChecksums
from tcpipe.formats.json_files import Json, to_json
from tcpipe.formats.maps.map_facts import read_layers

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
    ".png": "image/png",
    ".geojson": "application/geo+json",
}


def format_croissant(card: DatasetCard, samples: pa.Schema, files: FileChecksums) -> str:
    """Return the document as JSON-LD; the metadata of ``samples``, the schema of the samples, gives their meanings."""
    source = {"fileObject": {"@id": SAMPLES}}
    records = [_describe_records("samples", "One record a sample, in the order of the patches.", samples, source)]
    sets = []
    if card.shards:
        kind = {"name": "shards", "encodingFormat": _ENCODING_BY_SUFFIX[".parquet"], "includes": f"{SHARDS}/*.parquet"}
        sets.append({"@type": "cr:FileSet", "@id": "shards", **kind})
        layers = read_layers(card.layers, card.classes, Path())
        patches = [
            pa.field(
                layer.name,
                pa.list_(pa.float32() if layer.stored.kind == "f" else pa.uint16(), card.patch_px**2),
                metadata={"doc": f"layer {layer.name} as stored; dataset.json describes the decoding"},
            )
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
        "version": f"{card.data_model_version}.0+{card.inputs[:12]}",
        "distribution": [*(_describe_file_object(path, files[path]) for path in sorted(files)), *sets],
        "recordSet": records,
    }
    return to_json({key: value for key, value in document.items() if value})


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
