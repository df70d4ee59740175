"""Servers of one state directory know of each other, also when one was killed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from rn_standard.ops.other_servers import FOLDER, ServerPresence

HOLD = """
import sys
from pathlib import Path
from rn_standard.ops.other_servers import ServerPresence
held = ServerPresence(Path(sys.argv[1]))
held.open()
print("held", flush=True)
sys.stdin.read()
"""


def test_another_server_is_named_until_it_has_ended_however(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        presence = ServerPresence(tmp_path)
        assert presence.open() == [other.pid]
        presence.close()
        other.kill()
        other.wait()
    again = ServerPresence(tmp_path)
    assert again.open() == []
    assert [path.name for path in (tmp_path / FOLDER).iterdir()] == [str(os.getpid())]
    again.close()
    again.close()
    assert list((tmp_path / FOLDER).iterdir()) == []


def test_a_directory_that_cannot_be_written_costs_nothing_else(tmp_path: Path) -> None:
    (tmp_path / FOLDER).write_text("a file")
    presence = ServerPresence(tmp_path)
    assert presence.open() == []
    presence.close()
