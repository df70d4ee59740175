"""A damaged checkpoint is refused with one clear error, quickly and with little memory; it never
yields another action.

The damages and the process that loads them are in `corruptions.py`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

RUNNER = Path(__file__).with_name("corruptions.py")
AGAINST_AN_OPTION = "config.json: text_config.max_position_embeddings = 100"
"""A valid checkpoint, which conflicts with the option max_prompt_tokens."""
MAX_MESSAGE = 2500
"""Twelve names of tensors with their shapes, in two shards."""
MAX_GROWTH_BYTES = 400e6
"""A JSON file of 8 MiB may take twenty times as much when parsed; the model itself has 3 MB."""
LAYOUTS = {"openvla": 440, "oft": 640, "pi0-lerobot": 720, "pi0-openpi": 440}
"""Layouts, with their minimum number of damages."""


STRIDE = 47
"""Stride of the tried damages; the slow test tries all."""


def _run(layouts: str, scratch: Path, stride: int) -> list[dict[str, Any]]:
    done = subprocess.run(
        [sys.executable, str(RUNNER), layouts, str(scratch), str(stride)],
        capture_output=True,
        text=True,
        timeout=900,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


def _check(rows: list[dict[str, Any]], least: int) -> None:
    assert len(rows) >= least
    refused = [row for row in rows if row["outcome"] == "CheckpointError"]
    others = [row for row in rows if row["outcome"] not in ("CheckpointError", "same action")]
    allowed = {"ConfigurationError"}
    assert not [
        row for row in others if row["case"] != AGAINST_AN_OPTION or row["outcome"] not in allowed
    ]
    assert len(refused) > 0.75 * len(rows)
    assert not [row for row in rows if row["executed"]]
    # the alarm may arrive inside a parser's guard
    assert not [row for row in rows if "took more than" in row["text"]]
    assert not [row for row in rows if row["length"] > MAX_MESSAGE]
    assert not [
        row for row in refused if "weights_only" in row["text"] or "Traceback" in row["text"]
    ]
    assert not [row for row in rows if row["grown_bytes"] > MAX_GROWTH_BYTES]


# two in one process, because loading PyTorch took most of the time
@pytest.mark.parametrize(
    "layouts",
    [pytest.param("openvla,oft", marks=pytest.mark.exhaustive), "pi0-lerobot,pi0-openpi"],
)
def test_a_sample_of_damaged_checkpoints_is_refused_or_acts_as_before(layouts, tmp_path):
    rows = _run(layouts, tmp_path, STRIDE)
    for layout in layouts.split(","):
        _check([row for row in rows if row["layout"] == layout], LAYOUTS[layout] // STRIDE)


@pytest.mark.slow
@pytest.mark.timeout(1000)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_damaged_checkpoint_is_refused_or_acts_as_before(layout, tmp_path):
    _check(_run(layout, tmp_path, 1), LAYOUTS[layout])
