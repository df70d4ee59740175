"""Sessions beyond the commands of the README, which need another environment, a lot of time, or
root.

`make NAME ARGS="..."` sets up this project's environment and runs the session NAME in it. Packages
that conflict with it get their own environment, `.venv-NAME`. The code is in tools/lanes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import nox

sys.path.insert(0, str(Path(__file__).parent / "tools"))

from lanes import benchmarks, evaluations, releases, tests
from lanes.environments import ENVIRONMENTS, prepare
from lanes.lane import lane

nox.options.default_venv_backend = "none"
nox.options.sessions = []
__all__ = ["benchmarks", "environment", "evaluations", "releases", "tests"]


@lane
def environment(session: nox.Session) -> None:
    """set up environments of other projects: names such as fr3sim or lerobot"""
    for name in session.posargs or session.error(f"name one of {', '.join(ENVIRONMENTS)}"):
        prepare(session, name)
