"""Playing of recorded actions in a simulation by a separate server, through the gate and
control.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import anyio

from rn_recorder_runs.settings import PLAY, SWITCH
from rn_standard.console.client import spawned_server
from roboneuron import ConfigurationError, NotReadyError, RefusedError
from roboneuron.command import ERROR_META, load_config

if TYPE_CHECKING:
    from mcp import Client

_MOST_S = 24 * 3600.0


@dataclass(frozen=True, slots=True)
class PlayedRun:
    """Result of playing.

    Attributes:
        sent: number of actions.
        dropped: actions not executed by control, by reason.
        end_m: distance between the TCP's last recorded and last measured position, each from its
            own beginning [m].
        path_m: length of the recorded path [m].
    """

    sent: int
    dropped: dict[str, int]
    end_m: float | None
    path_m: float


def play(files: Sequence[Path], config_path: Path | None) -> PlayedRun:
    """Start a server with a simulated robot, play, and stop everything.

    Raises:
        ConfigurationError: the configured driver is not a simulation.
        RefusedError: the gate refused an action; nothing was sent then.
        NotReadyError: robot or control did not start, or the run holds no actions.
    """
    config = load_config(config_path)
    if config.robot.driver != "simulated":
        raise ConfigurationError(
            f"The configured driver is {config.robot.driver!r}: recorded actions are played into "
            "a simulation only.",
            hint='Give a configuration with driver = "simulated" in [robot].',
        )
    return anyio.run(_play, files, config_path)


async def _play(files: Sequence[Path], config_path: Path | None) -> PlayedRun:
    options = ["--config", str(config_path)] if config_path is not None else []
    before = os.environ.get(SWITCH)
    os.environ[SWITCH] = PLAY  # of the server, which inherits it
    try:
        with tempfile.TemporaryDirectory() as folder:
            async with spawned_server(
                [*options, "--log-level", "error"], Path(folder) / "server.log"
            ) as client:
                for tool in ("start_robot", "start_control"):
                    await _call(client, tool)
                answer = await _call(
                    client, "play_recording", {"files": [str(path.resolve()) for path in files]}
                )
                with suppress(NotReadyError):
                    await _call(client, "stop_all")
    finally:
        if before is None:
            del os.environ[SWITCH]
        else:
            os.environ[SWITCH] = before
    return PlayedRun(answer["sent"], answer["dropped"], answer["end_m"], answer["path_m"])


async def _call(
    client: Client, tool: str, arguments: Mapping[str, object] | None = None
) -> dict[str, Any]:
    answer = await client.call_tool(tool, dict(arguments or {}), read_timeout_seconds=_MOST_S)
    if answer.is_error:
        text = " ".join(getattr(block, "text", "") for block in answer.content)
        code = ((answer.meta or {}).get(ERROR_META) or {}).get("code")
        raise (RefusedError if code == RefusedError.code else NotReadyError)(f"{tool}: {text}")
    return dict(answer.structured_content or {})
