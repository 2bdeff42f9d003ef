"""Whatever is changed in a dataset, opening it and reading samples gives what was written or one of our errors, nothing else."""

import json
import shutil

import numpy as np
import pytest
from synthetic_store import add_run, lanes, open_world, segments

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError, TcpipeError
from tcpipe.formats.integrity import SEAL
from tcpipe.formats.json_files import MOST_BYTES, digest, to_json
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe

FORMATS = ("zarr", "parquet")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Twelve samples in either format."""
    directory = tmp_path_factory.mktemp("damage")
    store = open_world(directory)
    add_run(store, "a", segments("a", *lanes(0.0, -6.0, 6.0)))
    for name in FORMATS:
        build_dataset(directory / name, store=store.root, recipe=Recipe(), holdout="sample", format=name)
    return directory


@pytest.fixture
def dataset(made, tmp_path):
    return lambda name: shutil.copytree(made / name, tmp_path / name)


def read(directory):
    """Everything a trainer sees, as one list of arrays."""
    found = open_dataset(directory)
    return [array for part in found.values() for array in (part.patches, part.labels, part.weights)]


def read_or_refused(directory, whole):
    """Whether it was read, and then is what was written; only our errors are caught."""
    try:
        found = read(directory)
    except TcpipeError:
        return False
    assert all(np.array_equal(*pair) for pair in zip(found, whole, strict=True))
    return True


def described(directory):
    """Its files, and in which of their bytes a flip is tried: those that no page's or chunk's checksum covers."""
    for path in sorted(directory.rglob("*")):
        size = path.stat().st_size
        if path.parent.name == "data":
            footer = int.from_bytes(path.read_bytes()[-8:-4], "little") + 8
            yield path, np.linspace(size - footer, size - 1, 30)
        elif path.name in {"zarr.json", "dataset.json", "samples.parquet"}:
            yield path, np.linspace(0, size - 1, 40 if path.name == "dataset.json" else 8)


@pytest.mark.parametrize("name", FORMATS)
def test_a_flipped_bit_is_told_or_changes_nothing(dataset, name):
    directory = dataset(name)
    whole, rng = read(directory), np.random.default_rng(0)
    for path, places in described(directory):
        data = path.read_bytes()
        for place in places.astype(int):
            flipped = bytearray(data)
            flipped[place] ^= 1 << int(rng.integers(8))
            path.write_bytes(flipped)
            was_read = read_or_refused(directory, whole)
            assert path.parent.name == "data" or not was_read, (path, place)
        path.write_bytes(data)
    assert read_or_refused(directory, whole)


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_that_is_cut_or_gone_is_told(dataset, name):
    directory = dataset(name)
    whole = read(directory)
    for path, _ in described(directory):
        data = path.read_bytes()
        for size in (0, 1, len(data) // 2, len(data) - 1):
            path.write_bytes(data[:size])
            assert not read_or_refused(directory, whole), (path, size)
        path.unlink()
        if path.parent.name != "patches.zarr":  # the group: its arrays describe themselves
            assert not read_or_refused(directory, whole), path
        path.write_bytes(data)


def seal(directory, card):
    """Write a card with a whole seal, as `write_sealed` without the disk's patience."""
    bare = {key: value for key, value in card.items() if key != SEAL}
    (directory / "dataset.json").write_text(to_json({**bare, SEAL: digest(bare)}))


OTHER = (None, -7, "x", [], [None], {})


@pytest.mark.parametrize("name", FORMATS)
def test_a_card_of_any_other_content_with_a_whole_seal_is_told_or_changes_nothing(dataset, name):
    directory = dataset(name)
    card, whole = json.loads((directory / "dataset.json").read_text()), read(directory)
    for number, key in enumerate(card):
        for value in OTHER[number % 2 :: 2]:
            seal(directory, {**card, key: value})
            read_or_refused(directory, whole)
        for at, inner in enumerate(card[key] if key in {"label", "layers", "splits", "tensor"} else ()):
            seal(directory, {**card, key: {**card[key], inner: OTHER[(number + at) % len(OTHER)]}})
            read_or_refused(directory, whole)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"samples": 10**18}, "10000000000000000"),
        ({"patch_px": 10**6}, "expected up to 10000000 of up to 1024 px"),
        ({"shards": [{"path": "data/x", "split": "train", "rows": -5}]}, "its shards hold -5 rows"),
        ({"made_from": {"file_format": "csv"}}, "zarr or parquet"),
        ({"layers": {}}, "in 0 layers"),
        ({"classes": []}, "a layer terrain, but no classes"),
        ({"label": {"columns": ["power_watt", "speed"], "velocity": "ground"}}, "no column 'speed'"),
    ],
)
def test_what_a_card_promises_has_bounds(dataset, change, said):
    directory = dataset("parquet")
    card = json.loads((directory / "dataset.json").read_text())
    made_from = card["made_from"] | change.get("made_from", {})
    seal(directory, {**card, **change, "made_from": made_from})
    with pytest.raises(DatasetError, match=said):
        read(directory)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 10**5, "not a readable JSON file"),
        ("{} " * (MOST_BYTES // 3 + 1), "larger than 32 MB"),
        ("7", "contains int"),
    ],
)
def test_a_card_that_is_no_card_is_one_line(dataset, text, said):
    directory = dataset("parquet")
    (directory / "dataset.json").write_text(text)
    with pytest.raises(DatasetError, match=rf"dataset\.json: .*{said}"):
        open_dataset(directory)
