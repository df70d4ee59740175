"""Bytes on the wire: equal to openpi's format, and safe against anything else."""

from __future__ import annotations

from contextlib import suppress

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from rn_backend_openpi.wire import MOST_DEPTH, MOST_ITEMS, MOST_TEXT, pack, unpack
from roboneuron.errors import InvalidInputError

DTYPES = st.sampled_from(["|u1", "<f4", "<f8", "<i8", "|b1", ">f4", "<f2"])


def test_an_array_is_a_map_with_byte_keys() -> None:
    raw = msgpack.unpackb(pack({"a": np.array([[1, 2]], dtype=np.uint8), "p": "go"}))
    assert raw == {
        "a": {b"__ndarray__": True, b"data": b"\x01\x02", b"dtype": "|u1", b"shape": [1, 2]},
        "p": "go",
    }


def test_a_scalar_is_a_map_with_byte_keys() -> None:
    raw = msgpack.unpackb(pack({"a": np.float32(1.5)}))
    assert raw == {"a": {b"__npgeneric__": True, b"data": 1.5, b"dtype": "<f4"}}


@settings(max_examples=50, deadline=None)
@given(
    DTYPES.flatmap(lambda d: arrays(np.dtype(d), array_shapes(min_dims=0, max_dims=4, min_side=0)))
)
def test_arrays_survive_there_and_back(array: np.ndarray) -> None:
    again = unpack(pack({"x": array}))["x"]
    assert (again.dtype, again.shape, again.tobytes()) == (
        array.dtype,
        array.shape,
        array.tobytes(),
    )


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=64))
def test_any_bytes_are_a_map_or_a_clear_refusal(data: bytes) -> None:
    with suppress(InvalidInputError):
        assert isinstance(unpack(data), dict)


@pytest.mark.parametrize(
    "dtype", ["|O", "|V8", "<c16", "<U4", "|S3", "<M8[s]", "nonsense", ",f8", None, 5]
)
def test_objects_and_other_types_are_never_decoded(dtype: object) -> None:
    data = msgpack.packb(
        {"x": {b"__ndarray__": True, b"data": b"\0" * 16, b"dtype": dtype, b"shape": [1]}}
    )
    with pytest.raises(InvalidInputError):
        unpack(data)


@pytest.mark.parametrize("shape", [[3], [-1], [2**40], ["1"], [1] * 20, None, 8])
def test_a_shape_that_does_not_fit_its_bytes_is_refused(shape: object) -> None:
    data = msgpack.packb(
        {"x": {b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": "<f8", b"shape": shape}}
    )
    with pytest.raises(InvalidInputError):
        unpack(data)


def test_what_cannot_travel_is_refused_when_sending() -> None:
    for value in (object(), np.array([object()]), np.array([1j])):
        with pytest.raises(TypeError):
            pack({"x": value})  # type: ignore[dict-item]


def _nested(depth: int) -> object:
    value: object = 1
    for _ in range(depth):
        value = {"x": value}
    return value


@pytest.mark.parametrize(
    "value",
    [
        _nested(MOST_DEPTH + 1),
        _nested(300),
        {"x": [0] * (MOST_ITEMS + 1)},
        {str(i): 0 for i in range(MOST_ITEMS + 1)},
        {"x": "y" * (MOST_TEXT + 1)},
        {"x": msgpack.ExtType(5, b"y")},
        {"x": msgpack.Timestamp(1)},
        {"x": {b"__npgeneric__": True, b"data": [1], b"dtype": "<f8"}},
        {"x": {b"__npgeneric__": True, b"data": 300, b"dtype": "|i1"}},
        {"x": {b"__npgeneric__": True, b"data": "1", b"dtype": "<f8"}},
        {"x": {b"__ndarray__": True, b"data": b"", b"dtype": "<f8", b"shape": [0, 2**31]}},
        {"x": {b"__ndarray__": True, b"data": b"1", b"dtype": "|u1", b"shape": [True]}},
        {"x": {b"__ndarray__": True, b"data": b"1" * 8, b"dtype": "xf8", b"shape": [1]}},
    ],
)
def test_what_is_out_of_bounds_is_refused(value: object) -> None:
    with pytest.raises(InvalidInputError):
        unpack(msgpack.packb(value))


def test_what_is_just_within_bounds_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    for value in (_nested(MOST_DEPTH), {"x": [0] * MOST_ITEMS}, {"x": "y" * MOST_TEXT}):
        assert unpack(msgpack.packb(value)) == value
    data = msgpack.packb({"x": 1})
    monkeypatch.setattr("rn_backend_openpi.wire.MOST_BYTES", len(data))
    assert unpack(data) == {"x": 1}
    with pytest.raises(InvalidInputError, match="at most 4 are read"):
        unpack(data + b"0")


def test_an_array_alone_is_a_message() -> None:
    again = unpack(pack(np.arange(6.0).reshape(2, 3)))
    assert isinstance(again, np.ndarray)
    assert again.tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    assert again.flags.writeable
