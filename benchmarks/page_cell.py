"""A served cell with the page and an agent, for scripted persons at the page."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from anyio.from_thread import start_blocking_portal

from rn_standard.console.client import spawned_server
from rn_testing.agent import BlockingAgent
from rn_testing.domain import free_ros_domain
from rn_testing.waiting import wait_until


class PageCell(BlockingAgent):
    """A server whose modules run.

    Args:
        folder: for its configuration and log.
        config: TOML text that enables the view.
        stack: ends the server.
        modules: those to start.

    Attributes:
        url: of the page.
    """

    def __init__(
        self,
        folder: Path,
        config: str,
        stack: ExitStack,
        modules: Sequence[str] = ("robot", "perception", "control"),
    ) -> None:
        path, log = folder / "roboneuron.toml", folder / "log.txt"
        path.write_text(config)
        portal = stack.enter_context(start_blocking_portal())
        server = spawned_server(["--config", str(path)], log)
        client = stack.enter_context(portal.wrap_async_context_manager(server))
        super().__init__(client, portal)
        for module in modules:
            self.do(f"start_{module}")
        pattern = r"live view is at (http://[\d.]+:\d+)"
        wait_until(lambda: bool(re.search(pattern, log.read_text())), 60.0, poll_s=0.1)
        self.url = re.findall(pattern, log.read_text())[0]


C = TypeVar("C", bound=PageCell)


@contextmanager
def served(folder: Path, make: Callable[[ExitStack], C]) -> Iterator[C]:
    """A cell on its own ROS domain, with its files in a new folder."""
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    folder.mkdir()
    with ExitStack() as stack:
        cell = make(stack)
        try:
            yield cell
        finally:
            with suppress(RuntimeError):
                cell.do("take_over")
                cell.do("stop_all")
