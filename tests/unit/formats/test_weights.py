"""Weights are read when their headers agree with the file and with the model, and not before."""

import io
import zipfile

import numpy as np
import pytest

from tcpipe.errors import ModelError
from tcpipe.formats.weights import check_arrays, read_arrays, write_arrays

FORMS = {"a": ("float64", ("n", 2)), "b": ("uint32", ("n",))}


def good():
    return {"a": np.zeros((3, 2)), "b": np.zeros(3, np.uint32)}


def test_what_is_written_is_read(tmp_path):
    write_arrays(tmp_path / "w.npz", good())
    found = read_arrays(tmp_path / "w.npz")
    assert found.keys() == {"a", "b"}
    check_arrays(found, FORMS)
    with pytest.raises(ModelError, match="b is missing"):
        check_arrays({"a": found["a"]}, FORMS)


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({"a": np.zeros((3, 2), np.float32)}, r"a is \(3, 2\) of float32, expected \(3, 2\) of float64"),
        ({"b": np.zeros(4, np.uint32)}, r"b is \(4,\) of uint32, expected \(3,\)"),
        ({"b": np.zeros((), np.uint32)}, r"b is \(\) of uint32"),
        ({"c": np.zeros(3)}, "'c' is not of it"),
    ],
)
def test_arrays_of_another_type_or_length_are_refused(change, wanted):
    with pytest.raises(ModelError, match=f"contains the weights of another model: {wanted}"):
        check_arrays({**good(), **change}, FORMS)


def member(shape, values=b""):
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return buffer.getvalue() + values


@pytest.mark.parametrize("shape", [(125_000_000_000,), (2**62, 2**62), (-1,)])
def test_a_header_that_claims_a_terabyte_is_damage(tmp_path, shape):
    with zipfile.ZipFile(tmp_path / "w.npz", "w") as archive:
        archive.writestr("a.npy", member(shape, bytes(48)))
    with pytest.raises(ModelError, match=r"w\.npz: truncated or damaged"):
        read_arrays(tmp_path / "w.npz")


def test_an_archive_that_unfolds_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "w.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", member((10_000_000,), bytes(80_000_000)))
    with pytest.raises(ModelError, match="compressed, or larger than the file"):
        read_arrays(tmp_path / "w.npz")
