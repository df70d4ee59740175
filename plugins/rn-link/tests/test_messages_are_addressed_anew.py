"""On another machine, announcements get addresses of the relay; everything else stays unchanged."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rn_link.rtps import domain_of, read_announcement, with_places

HEADER = b"RTPS\x02\x03\x01\x0fa participan"
SPDP, SEDP, USER = (bytes.fromhex(text) for text in ("000100c2", "000003c2", "00001203"))
THERE = bytes((127, 90, 1, 2))
PLACES = dict.fromkeys(range(2**16), (THERE, 40000))
HERE = bytes((127, 0, 0, 1))


def locator(pid: int, port: int, address: bytes = HERE, kind: int = 1) -> bytes:
    return struct.pack("<HHiI12x4s", pid, 24, kind, port, address)


def data(writer: bytes, payload: bytes, kind: int = 0x15) -> bytes:
    body = struct.pack("<HH4s4sq", 0, 16, bytes(4), writer, 1) + b"\0\3\0\0" + payload
    return struct.pack("<BBH", kind, 5, len(body)) + body


def stamped(*submessages: bytes) -> bytes:
    return HEADER + struct.pack("<BBHq", 0x09, 1, 8, 0) + b"".join(submessages)


def test_a_participants_ports_are_read_and_its_address_changed() -> None:
    message = stamped(
        data(SPDP, locator(0x32, 7412) + locator(0x31, 7413) + locator(0x33, 7400)),
        data(SEDP, locator(0x2F, 7413)),
    )
    found = read_announcement(message)
    assert found.ports == {7412, 7413}
    assert found.metatraffic == {7412}
    assert found.domains == {0}
    assert found.participant == b"a participan"
    moved = with_places(message, {7412: (THERE, 40001), 7413: (THERE, 40002)})
    assert len(moved) == len(message)
    assert moved.count(THERE) == 3
    assert moved.count((40002).to_bytes(2, "little")) == 2
    assert with_places(moved, PLACES) == moved
    assert moved.count(HERE) == 1, "that of multicast"
    assert read_announcement(moved).ports == set()


@pytest.mark.parametrize(
    "message",
    [
        stamped(data(USER, locator(0x32, 7412))),
        stamped(data(SPDP, b"", kind=0x16)),
        stamped(data(SPDP, locator(0x32, 7412, kind=16))),
        stamped(data(SPDP, locator(0x31, 7413, bytes((10, 0, 0, 1))))),
    ],
    ids=["data of users", "fragment", "shared memory", "another address"],
)
def test_everything_else_stays_as_it_is(message: bytes) -> None:
    assert with_places(message, PLACES) == message
    assert not read_announcement(message).ports


def test_the_last_part_of_a_message_may_have_no_length() -> None:
    part = data(SPDP, locator(0x32, 7662))
    assert read_announcement(stamped(part[:2] + b"\0\0" + part[4:])).domains == {1}
    assert [domain_of(port) for port in (7410, 7649, 7650, 65410)] == [0, 0, 1, 232]


@given(st.binary(max_size=300), st.integers(0, 300))
def test_no_bytes_break_it(noise: bytes, at: int) -> None:
    message = bytearray(stamped(data(SPDP, locator(0x32, 7412)), data(SEDP, locator(0x2F, 7413))))
    message[at : at + len(noise)] = noise
    for one in (bytes(message), HEADER + noise, noise):
        assert len(with_places(one, PLACES)) == len(one)
        read_announcement(one)
