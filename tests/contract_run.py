"""Runs the contract tests of a package created by a documentation page."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def contract_run(
    project: Path, case: str, *, options: Sequence[str] = (), timeout_s: float = 120.0
) -> str:
    """Run the tests of `case` in `project` as its author would, with further options of pytest.

    Returns:
        The output of pytest.
    """
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", case, *options],
        cwd=project,
        env={**os.environ, "PYTHONPATH": str(project / "src"), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
