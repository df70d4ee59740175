"""The C functions of a type support: that they let through what Python decodes and nothing else."""

from __future__ import annotations

import ctypes
import random
from collections.abc import Callable
from pathlib import Path

import pytest
from made_messages import filled
from test_damaged_bytes_are_refused import damaged
from test_every_compiled_type_agrees import classes, compiled

from rn_interfaces import native
from rn_interfaces.cdr_fields import CdrError
from rn_interfaces.codec import codec
from rn_interfaces.program import program
from rn_interfaces.store import DefinitionStore
from rn_interfaces.structures import LayoutError

IS_VALID = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, ctypes.c_char_p, ctypes.c_size_t)


@pytest.fixture
def is_valid(user: Path) -> Callable[[int, bytes, int], bool]:
    """The check of native.c."""
    return IS_VALID(native.entries()["is_valid"])


def decodes(cls: type, data: bytes) -> bool:
    """Whether Python takes it."""
    try:
        codec(cls).decode(data)
    except CdrError:
        return False
    return True


def test_damaged_bytes_pass_where_python_decodes_them(
    is_valid: Callable[[int, bytes, int], bool], store: DefinitionStore
) -> None:
    from weld_msgs.msg import Path as Welds

    rng = random.Random(7)
    passed = 0
    for _ in range(3000):
        data = damaged(bytes(codec(Welds).encode(filled(Welds, rng))), rng)
        good = is_valid(ctypes.addressof(program(Welds)), data, len(data))
        assert good == decodes(Welds, data), data.hex()
        passed += good
    assert 100 < passed < 2900


def test_bytes_of_every_compiled_type_pass_and_their_cuts_do_not(
    is_valid: Callable[[int, bytes, int], bool],
) -> None:
    rng = random.Random(8)
    for name in compiled():
        for cls in classes(name):
            data = bytes(codec(cls).encode(filled(cls, rng)))
            words = ctypes.addressof(program(cls))
            assert is_valid(words, data, len(data)), cls
            cut = data[: rng.randrange(len(data))]
            assert is_valid(words, cut, len(cut)) == decodes(cls, cut), cls
            changed = damaged(data, rng)
            assert is_valid(words, changed, len(changed)) == decodes(cls, changed), cls


@pytest.mark.parametrize("text", ["é".encode() * 16, b"\xff" * 16, b"\x80" * 20, b"a" * 17])
def test_a_bound_counts_characters(
    text: bytes, is_valid: Callable[[int, bytes, int], bool], store: DefinitionStore
) -> None:
    from weld_msgs.msg import Seam

    plain = bytes(codec(Seam).encode(Seam(tool="x" * 16)))
    count = (len(text) + 1).to_bytes(4, "little")
    data = plain.replace((17).to_bytes(4, "little") + b"x" * 16, count + text + bytes(16))
    assert is_valid(ctypes.addressof(program(Seam)), data, len(data)) == decodes(Seam, data)
    assert decodes(Seam, data) == (text != b"a" * 17)


def test_a_fast_cdr_of_another_layout_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The check at start reads and writes through Fast CDR itself."""
    native.check.__wrapped__()
    found = native.functions()
    wrong = native.Functions.from_buffer_copy(found)
    wrong.begin = wrong.place  # as if its buffer began elsewhere
    monkeypatch.setattr(native, "functions", lambda: wrong)
    with pytest.raises(LayoutError, match="Install the ros-jazzy wheels"):
        native.check.__wrapped__()
