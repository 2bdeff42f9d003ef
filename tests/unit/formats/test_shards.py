"""Shards against zarr itself: what one writes, the other reads."""

import json

import google_crc32c
import numcodecs
import numpy as np
import pytest
import zarr

from tcpipe.errors import StoreError
from tcpipe.formats.zarr_arrays import add_array, create_group, open_sharded

RNG = np.random.default_rng(0)


def array(directory, dtype, *, compression="zstd", shape=(70, 9, 8), fill_value=0):
    """An empty array of chunks of 8 rows, shards of 32."""
    group = create_group(directory / "a.zarr")
    return add_array(
        group,
        "x",
        shape=shape,
        dtype=dtype,
        chunks=(8, 9, 8),
        shards=(32, 9, 8),
        dimensions=("a", "b", "c"),
        fill_value=fill_value,
        compression=compression,
    )


def form(theirs):
    """Return the facts of an array that a card holds."""
    return {
        "shape": theirs.shape,
        "chunk_shape": theirs.chunks,
        "shard_shape": theirs.shards,
        "dtype": theirs.dtype,
        "fill": float(theirs.fill_value),
    }


def opened(path, theirs, **more):
    return open_sharded(path, **form(theirs), **more)


def values(dtype, shape=(70, 9, 8)):
    return RNG.integers(0, 200, shape).cumsum(axis=0).astype(dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_zarr_reads_what_is_written_and_the_other_way_round(tmp_path, dtype, compression):
    theirs, data = array(tmp_path, dtype, compression=compression), values(dtype)
    ours = opened(tmp_path / "a.zarr" / "x", theirs)
    for number in range(3):
        shard = ours.path / ours.shard_name((number, 0, 0))
        shard.parent.mkdir(parents=True)
        rows = data[32 * number : 32 * number + 32]
        shard.write_bytes(ours.encoded_shard(rows, threads=3))
        assert shard.read_bytes() == ours.encoded_shard(rows, threads=1)
    np.testing.assert_array_equal(theirs[:], data)
    theirs[:] = data[::-1]
    again = opened(tmp_path / "a.zarr" / "x", theirs)
    read = np.concatenate([again.chunk((number, 0, 0)) for number in range(9)])
    np.testing.assert_array_equal(read[:70], data[::-1])
    assert (read[70:] == 0).all()


def test_what_zarr_leaves_out_is_fill_value(tmp_path):
    theirs = array(tmp_path, np.float32, fill_value=float("nan"))
    theirs[8:16] = 1.0
    ours = opened(tmp_path / "a.zarr" / "x", theirs, sparse=True)
    assert np.isnan(ours.chunk((0, 0, 0))).all()  # a chunk that is not in its shard
    assert (ours.chunk((1, 0, 0)) == 1.0).all()
    assert np.isnan(ours.chunk((5, 0, 0))).all()  # a shard without a file
    with pytest.raises(StoreError, match="is missing"):
        opened(tmp_path / "a.zarr" / "x", theirs).chunk((5, 0, 0))


@pytest.mark.parametrize("where", ["chunk", "index", "end"])
def test_a_changed_byte_is_an_error_never_a_number(tmp_path, where):
    theirs = array(tmp_path, np.uint16)
    theirs[:] = values(np.uint16)
    file = tmp_path / "a.zarr" / "x" / "c" / "0" / "0" / "0"
    data = bytearray(file.read_bytes())
    if where == "end":
        data = data[: len(data) // 2]
    else:
        data[20 if where == "chunk" else -30] ^= 1
    file.write_bytes(data)
    with pytest.raises(StoreError, match=r"chunk \(0, 0, 0\) is damaged"):
        opened(tmp_path / "a.zarr" / "x", theirs).chunk((0, 0, 0))


def test_arrays_of_others_are_refused_in_a_line(tmp_path):
    plain = zarr.create_array(tmp_path / "plain.zarr", shape=(4, 4), chunks=(2, 2), dtype="u1")
    wanted = {**form(plain), "shard_shape": (4, 4)}
    with pytest.raises(StoreError, match=r"plain.zarr/zarr.json: its chunks are not in shards"):
        open_sharded(tmp_path / "plain.zarr", **wanted)
    with pytest.raises(StoreError, match="is missing"):
        open_sharded(tmp_path / "nothing", **wanted)


@pytest.mark.parametrize("value", [0, "a", 1e30, None, [], {}, [[]], -1, [1e30], 10**300, "\x1b[31m"])
def test_a_description_with_other_codecs_is_refused_in_a_line(tmp_path, value):
    theirs = array(tmp_path, np.uint16, fill_value=3)
    path = tmp_path / "a.zarr" / "x" / "zarr.json"
    described = json.loads(path.read_text())
    inner = described["codecs"][0]["configuration"]
    for codecs in (value, [value], [{"configuration": value}], [{"configuration": {**inner, "codecs": [0, value]}}]):
        path.write_text(json.dumps({**described, "codecs": codecs}))
        with pytest.raises(StoreError, match=r"zarr.json: its chunks are not in shards") as caught:
            opened(tmp_path / "a.zarr" / "x", theirs)
        assert len(caught.value.problems) == 1


def sealed_shard(pieces):
    """A shard of four chunks, of which each is given with its offset and size in the index, None: as it lies."""
    body, index = b"", []
    for data, offset, size in pieces:
        whole = data + crc(data)
        index += [len(body) if offset is None else offset, len(whole) if size is None else size]
        body += whole
    table = np.array(index, "<u8").tobytes()
    return body + table + crc(table)


def crc(data):
    return google_crc32c.value(data).to_bytes(4, "little")


@pytest.mark.parametrize("codec", [numcodecs.Blosc(cname="zstd"), numcodecs.Zstd()])
@pytest.mark.parametrize(
    ("length", "place", "wanted"),
    [
        (10, (None, None), "it contains 10 bytes, expected 576"),
        (50_000_000, (None, None), "it contains 50000000 bytes, expected 576"),
        (576, (2**63, 100), "its index points outside the file"),
        (576, (0, 2**62), "its index points outside the file"),
        (576, (0, 3), "its index points outside the file"),
        (576, (2**64 - 2, 2**63), "its index points outside the file"),
    ],
)
def test_a_sealed_shard_that_claims_too_much_or_too_little_is_damage(tmp_path, codec, length, place, wanted):
    """Unwritten memory was read as pixels where a chunk held less."""
    group = create_group(tmp_path / "a.zarr")
    theirs = add_array(
        group, "x", shape=(32, 9, 8), dtype=np.uint8, chunks=(8, 9, 8), shards=(32, 9, 8), dimensions=("a", "b", "c"),
        compression="zstd" if isinstance(codec, numcodecs.Zstd) else "lz4",
    )  # fmt: skip
    shard = tmp_path / "a.zarr" / "x" / "c" / "0" / "0" / "0"
    shard.parent.mkdir(parents=True)
    shard.write_bytes(
        sealed_shard([(codec.encode(np.zeros(length, np.uint8)), *place), *[(b"", 2**64 - 1, 2**64 - 1)] * 3])
    )
    with pytest.raises(StoreError, match=wanted):
        opened(tmp_path / "a.zarr" / "x", theirs).chunk((0, 0, 0))
