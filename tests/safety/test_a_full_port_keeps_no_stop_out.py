"""Silent connections exhaust a port of a served robot with few file handles; a stop still gets
through.

benchmarks/bench_full_ports.py measures how soon, also with floods of new connections and for the
shared model's port.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from bench_full_ports import FLOOD, IDLE, measure, running

pytestmark = [pytest.mark.ros, pytest.mark.timing, pytest.mark.timeout(180)]
STOPS = 2


def test_idle_connections_keep_no_stop_out(tmp_path: Path) -> None:
    with running(tmp_path) as ports:
        http = int(ports["http"][1])
        for port in ("http", "metrics", "view"):
            command = [sys.executable, "-c", FLOOD, "idle", *ports[port], str(IDLE), "60"]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as flood:
                assert flood.stdout is not None
                flood.stdout.readline()
                times_s, latched = measure(tmp_path, http, STOPS)
                flood.kill()
            assert latched == STOPS, f"{port}: {times_s}"
            assert float("inf") not in times_s, f"{port}: a stop had no answer"
    assert "Traceback" not in (tmp_path / "server.log").read_text(encoding="utf-8")
