"""Helpers for the sessions."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import nox

JOBS = os.environ.get("JOBS", "2")
BIN = Path(sys.executable).parent
"""Programs of the environment of `make`, in which the sessions run."""


def lane(function: Callable[[nox.Session], None]) -> object:
    """Make a session that runs in the environment of `make`."""
    name = function.__name__.replace("_", "-")
    return nox.session(python=False, name=name)(function)


def pytest(session: nox.Session, *arguments: str, env: dict[str, str] | None = None) -> None:
    """Run tests; arguments after `--` on nox's command line come last."""
    session.run(sys.executable, "-m", "pytest", *arguments, *session.posargs, env=env)


def python(session: nox.Session, script: str, *arguments: str) -> None:
    """Run a script; arguments after `--` on nox's command line come last."""
    session.run(sys.executable, script, *arguments, *session.posargs)


def roboneuron(session: nox.Session, *arguments: str) -> None:
    """Run the command `roboneuron`."""
    session.run(sys.executable, "-m", "roboneuron.cli.main", *arguments)
