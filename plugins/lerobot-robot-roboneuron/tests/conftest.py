"""A server with a simulated arm, a leader that is a program, and lerobot's own commands, in
lerobot's environment.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from anyio.from_thread import start_blocking_portal
from lerobot_lane import CONFIG, JOINTS, ROOT, Lerobot, Served, Watch

from roboneuron.command import environment


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if (ROOT / ".venv-lerobot" / ".ready").exists():
        return
    skip = pytest.mark.skip(reason="lerobot's environment is not there: make test-lerobot-robots")
    here = str(Path(__file__).parent)
    for item in items:
        if str(item.path).startswith(here):
            item.add_marker(skip)


@pytest.fixture
def lerobot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lerobot]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    environment.prepare_environment()
    lane = Lerobot(tmp_path)
    yield lane
    lane.close()


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "so101.toml"
    path.write_text(CONFIG.read_text(encoding="utf-8"), encoding="utf-8")
    return path


@pytest.fixture
def served(lerobot: Lerobot, config: Path, tmp_path: Path) -> Iterator[Served]:
    with start_blocking_portal() as portal:
        server = Served(portal, config, tmp_path / "server.log")
        try:
            for module in ("robot", "perception", "control"):
                server.call(f"start_{module}")
            yield server
        finally:
            server.close()


@pytest.fixture
def watch(lerobot: Lerobot) -> Iterator[Watch]:
    watch = Watch("so101", JOINTS)
    yield watch
    watch.close()
