"""Installs from a checkout never ask an index for packages of the project, whose names anybody
could register there.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"
[project]
name = "{name}"
version = "0.1.0"
dependencies = {needs}
[tool.hatch.build.targets.wheel]
bypass-selection = true
"""


@pytest.fixture
def index() -> Iterator[tuple[str, list[str]]]:
    """An empty index on loopback, and the paths requested from it."""
    asked: list[str] = []

    class Nothing(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_error(404)

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Nothing)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/simple/", asked
    server.shutdown()
    thread.join()
    server.server_close()


ROOT = Path(__file__).parents[1]


def install(folder: Path, index: str, *names: str) -> str:
    """Output of pip for the folders or requirements files `names`, with `index` as its only
    index.
    """
    words = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--dry-run",
        "--no-build-isolation",
        "--retries",
        "0",
    ]
    done = subprocess.run(
        [*words, "--disable-pip-version-check", "--index-url", index, *words_of(names)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    return done.stdout + done.stderr


def words_of(names: Iterable[str]) -> list[str]:
    """Arguments for pip: requirements files with `-r`."""
    return [
        word
        for name in names
        for word in (["-r", name] if name.endswith(".txt") else [f"./{name}"])
    ]


@pytest.mark.release
def test_a_package_that_is_named_by_its_folder_is_not_looked_for(tmp_path, index) -> None:
    """The install lines of README and docs rely on this; otherwise the index would be asked."""
    url, asked = index
    for name, needs in (
        ("rn-one-of-ours", '["rn-two-of-ours>=0.1,<0.2"]'),
        ("rn-two-of-ours", "[]"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "pyproject.toml").write_text(PROJECT.format(name=name, needs=needs))
    assert "Would install" in install(tmp_path, url, "rn-one-of-ours", "rn-two-of-ours")
    assert asked == []
    assert "No matching distribution" in install(tmp_path, url, "rn-one-of-ours")
    assert asked == ["/simple/rn-two-of-ours/"]


def test_files_of_requirements_name_every_package_by_its_folder(tmp_path, index) -> None:
    """The form of requirements.txt: constraints next to it, folders relative to the working
    directory.
    """
    url, asked = index
    for name, needs in (
        ("rn-one-of-ours", '["rn-two-of-ours>=0.1,<0.2"]'),
        ("rn-two-of-ours", "[]"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "pyproject.toml").write_text(PROJECT.format(name=name, needs=needs))
    (tmp_path / "constraints.txt").write_text("numpy==1.0\n")
    (tmp_path / "whole.txt").write_text(
        "--constraint constraints.txt\n./rn-one-of-ours\n./rn-two-of-ours\n"
    )
    assert "Would install" in install(tmp_path, url, "whole.txt")
    assert asked == []


@pytest.mark.release
def test_a_package_beside_those_that_are_installed_is_not_looked_for(tmp_path, index) -> None:
    """`pip install -r requirements.txt` followed by another folder relies on this."""
    url, asked = index
    (tmp_path / "rn-one-of-ours").mkdir()
    needs = '["roboneuron-core>=0.1,<0.2", "rn-standard>=0.1,<0.2"]'
    (tmp_path / "rn-one-of-ours" / "pyproject.toml").write_text(
        PROJECT.format(name="rn-one-of-ours", needs=needs)
    )
    assert "Would install rn-one-of-ours" in install(tmp_path, url, "rn-one-of-ours")
    assert not [path for path in asked if "rn-" in path or "roboneuron" in path]


@pytest.mark.release
@pytest.mark.parametrize(
    "file", ["requirements.txt", pytest.param("requirements-vla.txt", marks=pytest.mark.slow)]
)
def test_no_package_of_the_project_is_asked_for_by_the_files_of_the_checkout(index, file) -> None:
    url, asked = index
    assert "Would install" in install(ROOT, url, file)
    assert not [path for path in asked if "/rn-" in path or "roboneuron" in path]
