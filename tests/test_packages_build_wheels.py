"""Each package of the workspace builds a complete wheel that works without its sources, together
with core.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = [
    ROOT / "roboneuron-core",
    *sorted(p.parent for p in (ROOT / "plugins").glob("rn-*/pyproject.toml")),
]

pytest.importorskip("hatchling", reason="wheels are built with hatchling")
pytestmark = pytest.mark.release

WHEELS = os.environ.get("RELEASE_WHEELS", "")
GLIBC = re.compile(r"manylinux_(\d+)_(\d+)_")
PROBE = """
import json, sys, importlib
from roboneuron.plugins.discovery import discover
records = [p for p in discover().plugins if p.distribution == sys.argv[1]]
print(json.dumps([[p.name, p.status, p.reason, importlib.import_module(p.module).__file__] for p in records]))
"""  # noqa: E501
PROBE_OF_A_LIBRARY = """
import json, sys, importlib, pkgutil
package = importlib.import_module(sys.argv[1].replace("-", "_"))
names = [m.name for m in pkgutil.walk_packages(package.__path__, package.__name__ + ".")]
files = {importlib.import_module(name).__file__ for name in names}
print(json.dumps([[sys.argv[1], "ready", f"{len(files)} modules", package.__file__]]))
"""


@pytest.fixture(scope="module", params=PACKAGES, ids=lambda path: path.name)
def wheel(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
    """A package's folder and the wheel built from it, or that of `make release`."""
    if WHEELS:
        (built,) = Path(WHEELS).glob(f"{request.param.name.replace('-', '_')}-*.whl")
        return request.param, built
    out = tmp_path_factory.mktemp("wheel")
    done = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)],
        cwd=request.param,
        capture_output=True,
        text=True,
        timeout=600,
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
    metadata = (
        zipfile.ZipFile(built)
        .read(next(n for n in names if n.endswith("dist-info/METADATA")))
        .decode()
    )
    for line in (
        f"License-Expression: {facts['license']}",
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


def test_compiled_code_is_as_old_as_the_wheel_says(wheel):
    """Checked by auditwheel from the symbols; ROS libraries are those of the ROS wheels."""
    pytest.importorskip("auditwheel", reason="it judges symbols")
    _, built = wheel
    if built.stem.endswith("-none-any"):
        return
    command = [sys.executable, "-m", "auditwheel", "show", "--json", str(built)]
    judged = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    facts = json.loads(judged.stdout)
    said = GLIBC.search(built.stem)
    needed = GLIBC.search(facts["sym_tag"])
    assert said is not None, f"an index does not take {built.name}"
    assert needed is not None, facts
    assert tuple(map(int, needed.groups())) <= tuple(map(int, said.groups()))
    if built.name.startswith("rn_interfaces"):
        assert not facts["external_libs"]


def test_a_plugin_works_from_its_wheel(wheel, tmp_path):
    package, built = wheel
    if package.name == "roboneuron-core":
        pytest.skip("core is no plugin")
    zipfile.ZipFile(built).extractall(tmp_path)
    offers = tomllib.loads((package / "pyproject.toml").read_text())["project"].get(
        "entry-points", {}
    )
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
    found = json.loads(done.stdout)
    assert [name for name, *_ in found] == sorted(offers.get("roboneuron", [package.name]))
    for _, status, reason, file in found:
        assert status in ("ready", "unavailable"), reason
        assert Path(file).is_relative_to(tmp_path)


def test_the_wheel_of_the_whole_holds_names_only(tmp_path):
    words = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(words, cwd=ROOT, check=True, capture_output=True, timeout=600)
    (built,) = tmp_path.glob("*.whl")
    archive = zipfile.ZipFile(built)
    assert not [name for name in archive.namelist() if ".dist-info/" not in name]
    metadata = archive.read(next(n for n in archive.namelist() if n.endswith("METADATA"))).decode()
    assert "Name: roboneuron\n" in metadata
    assert "Requires-Dist: rn-standard<0.2,>=0.1" in metadata
