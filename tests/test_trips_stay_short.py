"""A call of an agent passes few functions and files until its message, a key of the configuration
until its use; tools/way_count.py counts them.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
MOST = {
    "once": {"functions": 70, "files": 32, "visits": 48, "returns": 17},
    "lasting": {"functions": 102, "files": 38, "visits": 75, "returns": 39},
}
"""A few more than counted, since a busy machine adds some: whoever needs more room shortens another
part of the way.
"""
MOST_OF_A_KEY = {"functions": 23, "files": 12}
"""As counted: docs/architecture.md names the files."""


def _counted(tool: str) -> dict[str, Any]:
    command = [sys.executable, str(ROOT / "tools" / tool), "--json"]
    done = subprocess.run(command, check=True, capture_output=True, timeout=200)
    counted: dict[str, Any] = json.loads(done.stdout)
    return counted


def test_a_call_of_publish_velocity_comes_to_its_message_on_a_short_way() -> None:
    counted = _counted("publish_way.py")
    assert counted.keys() == MOST.keys()
    for name, counts in counted.items():
        # an empty trace would be within every bound
        assert counts["functions"] > MOST[name]["functions"] / 2, counts
        longer = {what: count for what, count in counts.items() if count > MOST[name][what]}
        assert not longer, f"{name}: {longer}, at most {MOST[name]}"


@pytest.mark.ros
@pytest.mark.exhaustive
def test_a_key_of_the_configuration_comes_to_its_use_on_a_short_way() -> None:
    counts = _counted("key_way.py")
    # it fails itself if the way misses one of its stations
    longer = {what: count for what, count in counts.items() if count > MOST_OF_A_KEY[what]}
    assert not longer, f"{longer}, at most {MOST_OF_A_KEY}"
