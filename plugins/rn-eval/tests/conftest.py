"""A suite and policies that run in milliseconds, installed for this process and its children."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import pytest

from rn_eval.plan import EvalPlan
from roboneuron.config import load_config

HERE = Path(__file__).parent


@pytest.fixture(scope="session")
def toy_site(tmp_path_factory):
    """The folder of the installed toy plugin."""
    site = tmp_path_factory.mktemp("toy-site")
    info = site / "rn_toy-1.0.dist-info"
    info.mkdir()
    for module in ("toy_plugin", "toy_parts"):
        shutil.copy(HERE / f"{module}.py", site)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rn-toy\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[roboneuron]\nrn-toy = toy_plugin\n")
    return site


@pytest.fixture
def toy(toy_site, monkeypatch):
    """Install the toy plugin."""
    monkeypatch.syspath_prepend(str(toy_site))
    inherited = os.environ.get("PYTHONPATH", "")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in (str(toy_site), inherited) if p))
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    yield toy_site
    for name in ("toy_plugin", "toy_parts"):
        sys.modules.pop(name, None)


@pytest.fixture
def plan(toy):
    """Return a function that makes plans of the toy suite."""

    def make(**changes):
        values = {"suite": "toy", "backend": "steer", "episodes": 8} | changes
        return EvalPlan(config=load_config(None).model_dump(mode="json"), **values)

    return make
