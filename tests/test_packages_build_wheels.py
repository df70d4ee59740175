"""Each package of the workspace builds a wheel that holds what it needs and works from the wheel alone, beside core."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = [ROOT / "roboneuron-core", *sorted(p.parent for p in (ROOT / "plugins").glob("*/pyproject.toml"))]

pytest.importorskip("hatchling", reason="wheels are built with hatchling")

PROBE = """
import json, sys, importlib
from roboneuron.plugins.discovery import discover
registry = discover()
record = next(p for p in registry.plugins if p.distribution == sys.argv[1])
module = importlib.import_module(record.module)
print(json.dumps([record.status, record.reason, module.__file__]))
"""
PROBE_OF_A_LIBRARY = """
import json, sys, importlib, pkgutil
package = importlib.import_module(sys.argv[1].replace("-", "_"))
names = [m.name for m in pkgutil.walk_packages(package.__path__, package.__name__ + ".")]
files = {importlib.import_module(name).__file__ for name in names}
print(json.dumps(["ready", f"{len(files)} modules", package.__file__]))
"""


@pytest.fixture(scope="module", params=PACKAGES, ids=lambda path: path.name)
def wheel(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A package's folder and the wheel built from it."""
    out = tmp_path_factory.mktemp("wheel")
    done = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)],
        cwd=request.param,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (built,) = out.glob("*.whl")
    return request.param, built


def test_a_wheel_holds_code_types_licence_and_metadata(wheel):
    package, built = wheel
    facts = tomllib.loads((package / "pyproject.toml").read_text())["project"]
    names = zipfile.ZipFile(built).namelist()
    top = "roboneuron" if package.name == "roboneuron-core" else facts["name"].replace("-", "_")
    assert f"{top}/__init__.py" in names
    assert f"{top}/py.typed" in names
    assert any(name.endswith("/licenses/LICENSE") for name in names)
    assert not [name for name in names if name.startswith("tests/") or "__pycache__" in name]
    metadata = zipfile.ZipFile(built).read(next(n for n in names if n.endswith("dist-info/METADATA"))).decode()
    for line in (
        "License-Expression: Apache-2.0",
        "Requires-Python: >=3.11",
        "Description-Content-Type: text/markdown",
    ):
        assert line in metadata
    assert "Summary: " in metadata


def test_a_wheel_holds_the_files_that_are_no_python(wheel):
    package, built = wheel
    names = set(zipfile.ZipFile(built).namelist())
    tracked = subprocess.run(
        ["git", "ls-files", "src"], cwd=package, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    missing = [path for path in tracked if path.removeprefix("src/") not in names]
    assert missing == []


def test_a_plugin_works_from_its_wheel(wheel, tmp_path):
    package, built = wheel
    if package.name == "roboneuron-core":
        pytest.skip("core is no plugin")
    zipfile.ZipFile(built).extractall(tmp_path)
    offers = tomllib.loads((package / "pyproject.toml").read_text())["project"].get("entry-points", {})
    probe = PROBE if "roboneuron" in offers else PROBE_OF_A_LIBRARY
    done = subprocess.run(
        [sys.executable, "-c", probe, package.name],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    status, reason, file = json.loads(done.stdout)
    assert status in ("ready", "unavailable"), reason
    assert Path(file).is_relative_to(tmp_path)
