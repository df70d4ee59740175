"""Connections to the socket of a model: of openpi's clients, and too many of them."""

from __future__ import annotations

import os
import resource
import socket
from contextlib import ExitStack
from pathlib import Path

import pytest
from policy_servers import SEEN, Robot
from websockets.sync.client import unix_connect

from rn_backend_openpi.messages import RESERVED, from_observation
from rn_backend_openpi.wire import pack, unpack

pytestmark = pytest.mark.timeout(200)


def socket_in(folder: Path) -> str:
    (path,) = (folder / "run").glob("*.sock")
    return str(path)


def test_a_client_that_knows_only_openpis_entries_is_answered_alike(
    served: Robot, tmp_path: Path
) -> None:
    expected = served().predict(SEEN)
    request = from_observation(SEEN)
    del request[RESERVED]
    with unix_connect(socket_in(tmp_path), "ws://localhost/", compression=None) as client:
        assert isinstance(unpack(client.recv(decode=False, timeout=30.0)), dict)
        for _ in range(2):
            client.send(pack(request))
            answer = unpack(client.recv(decode=False, timeout=30.0))
            assert isinstance(answer, dict)
            assert answer["actions"].tobytes() == expected.actions.tobytes()
            assert answer["step_s"] == expected.step_s
            assert answer["server_timing"]["infer_ms"] > 0.0


def test_a_server_without_handles_serves_again_when_it_has_some(
    served: Robot, tmp_path: Path
) -> None:
    one = served()
    path = socket_in(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with ExitStack() as stack:
        crowd = [stack.enter_context(socket.socket(socket.AF_UNIX)) for _ in range(5)]
        next_one = os.dup(0)
        os.close(next_one)
        resource.setrlimit(resource.RLIMIT_NOFILE, (next_one, before[1]))
        try:
            for refused in crowd:
                refused.connect(path)
            assert one.predict(SEEN).actions.size  # a connected robot is still served
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert served().predict(SEEN).actions.size
