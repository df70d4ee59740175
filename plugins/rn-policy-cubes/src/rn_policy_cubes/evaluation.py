"""Success rate of a checkpoint, by `roboneuron eval run` in its own process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rn_policy_cubes.checkpoint import BACKEND, CONFIGURATION_FILE
from roboneuron import PluginError

# 1 is PR_SET_PDEATHSIG of prctl(2), 9 is SIGKILL: an evaluation that outlived its parent would keep
# its ledger locked
_CHILD = """
import ctypes, runpy, sys
ctypes.CDLL(None).prctl(1, 9)
runpy.run_module("roboneuron.cli.main", run_name="__main__", alter_sys=True)
"""


def evaluate(
    checkpoint: Path,
    out: Path,
    *,
    first_seed: int,
    count: int,
    time_limit_s: float,
    suite_options: Sequence[str] = (),
) -> dict[int, bool]:
    """Evaluate a checkpoint with `roboneuron eval run`, in its own process that resumes an
    interrupted run; returns success by seed. `suite_options` are further ones, NAME=VALUE.

    Raises:
        PluginError: it has failed, or an episode has crashed.
    """
    words = ["eval", "run", "-q", "--backend", BACKEND, "--checkpoint", str(checkpoint)]
    words += ["--config", str(checkpoint / CONFIGURATION_FILE), "--out", str(out)]
    words += ["--episodes", str(count), "--seed", str(first_seed), "--strips", "none"]
    words += ["--suite-option", f"time_limit_s={time_limit_s}", "--retry-errors"]
    words += [word for option in suite_options for word in ("--suite-option", option)]
    done = subprocess.run([sys.executable, "-P", "-c", _CHILD, *words], check=False)
    ledger = out / "episodes.jsonl"
    lines = ledger.read_text(encoding="utf-8").splitlines() if ledger.exists() else []
    # the last line counts for an episode that was retried
    status: dict[int, str] = {}
    for line in lines:
        entry: dict[str, Any] = json.loads(line)
        status[int(entry["key"]["seed"])] = str(entry["outcome"]["status"])
    missing = [
        seed
        for seed in range(first_seed, first_seed + count)
        if status.get(seed) not in ("success", "failure")
    ]
    if missing:
        raise PluginError(
            f"The evaluation in {out} ended with status {done.returncode}; {len(missing)} of "
            f"{count} scenes have no verdict.",
            hint="Its message is above; run the same command again to resume.",
        )
    return {seed: word == "success" for seed, word in status.items()}
