"""Write tests/data for the tests without LeRobot.

    .venv-lerobot-policies/bin/python plugins/rn-backend-lerobot/tests/policies/make_data.py

Configurations, processors and statistics as LeRobot writes them (weights left out, absolute paths
made relative), and values computed by LeRobot: a state, the chunk before the postprocessor and
after it.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from lerobot_cell import NAMES, RATE_HZ, observe

from rn_backend_lerobot.backend import LeRobotBackend
from rn_backend_lerobot.exchange import PolicyChunk
from rn_backend_lerobot.options import LeRobotOptions
from rn_backend_lerobot.tiny import make_tiny
from rn_backend_lerobot.tiny_language import BACKBONE

DATA = Path(__file__).parents[1] / "data"


def main() -> None:
    """Write all files again."""
    with tempfile.TemporaryDirectory() as folder:
        for policy in ("act", "smolvla"):
            source, target = Path(folder).resolve() / policy, DATA / policy
            make_tiny(source, policy)  # type: ignore[arg-type]
            shutil.rmtree(target, ignore_errors=True)
            target.mkdir(parents=True)
            for path in [*sorted(source.glob("policy_*")), source / "config.json"]:
                if path.suffix == ".json":
                    text = path.read_text(encoding="utf-8").replace(f"{source}/", "")
                    (target / path.name).write_text(text + "\n", encoding="utf-8")
                else:
                    shutil.copyfile(path, target / path.name)
        options = {
            "checkpoint": Path(folder) / "act",
            "rate_hz": RATE_HZ,
            "joints": NAMES,
            "joint_unit": "radians",
            "gripper_unit": "open_fraction",
            "device": "cpu",
        }
        backend = LeRobotBackend(LeRobotOptions.model_validate(options))
        backend.load()
        chunk = backend.predict(observe(0))
        answer = chunk.context
        assert isinstance(answer, PolicyChunk)
        np.savez(
            DATA / "act-chunk.npz",
            normalized=answer.normalized.numpy(),
            rows=answer.rows,
            actions=chunk.actions,
        )
    print(f"Wrote {DATA}; the folder {BACKBONE!r} of smolvla is made by the tests.")


if __name__ == "__main__":
    main()
