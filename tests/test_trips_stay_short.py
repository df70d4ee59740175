"""A call of an agent passes few functions and files until its message; docs/architecture.md has the
counts and how they are taken.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST = {
    "once": {"functions": 65, "files": 33, "visits": 43, "returns": 11},
    "lasting": {"functions": 96, "files": 38, "visits": 72, "returns": 35},
}
"""A few more than counted, since a busy machine adds some: whoever needs more room shortens another
part of the way.
"""


def test_a_call_of_publish_velocity_comes_to_its_message_on_a_short_way() -> None:
    command = [sys.executable, str(ROOT / "tools" / "publish_way.py"), "--json"]
    counted = json.loads(
        subprocess.run(command, check=True, capture_output=True, timeout=200).stdout
    )
    assert counted.keys() == MOST.keys()
    for name, counts in counted.items():
        # an empty trace would be within every bound
        assert counts["functions"] > MOST[name]["functions"] / 2, counts
        longer = {what: count for what, count in counts.items() if count > MOST[name][what]}
        assert not longer, f"{name}: {longer}, at most {MOST[name]}"
