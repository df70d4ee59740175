"""MCP resources: the status, and the logs of each module and of the server."""

from __future__ import annotations

from mcp import types
from mcp.shared.exceptions import MCPError

from roboneuron.server.loop import ClosedLoop
from roboneuron.server.observing import status
from roboneuron.server.records import SOURCES, log_file
from roboneuron.supervisor.logs import read_tail

STATUS_URI = "roboneuron://status"
LOG_URI = "roboneuron://logs/"
LOG_LINES = 500


class Resources:
    """Lists and reads them."""

    def __init__(self, loop: ClosedLoop, started_s: float) -> None:
        self._loop = loop
        self._started_s = started_s

    def listing(self) -> list[types.Resource]:
        """What `resources/list` answers."""
        return [
            types.Resource(
                name="status",
                title="Status of everything",
                uri=STATUS_URI,
                description="The answer of get_status.",
                mime_type="application/json",
            ),
            *(
                types.Resource(
                    name=f"log of {source}",
                    title=f"Log of {source}",
                    uri=f"{LOG_URI}{source}",
                    description=f"The last {LOG_LINES} lines that {source} has written.",
                    mime_type="text/plain",
                )
                for source in SOURCES
            ),
        ]

    def read(self, uri: str) -> types.TextResourceContents:
        """What `resources/read` answers.

        Raises:
            MCPError: there is no such resource.
        """
        if uri == STATUS_URI:
            text = status(self._loop, self._started_s).model_dump_json(indent=2)
            return types.TextResourceContents(uri=uri, mime_type="application/json", text=text)
        for source in SOURCES:
            if uri == f"{LOG_URI}{source}":
                lines = read_tail(log_file(self._loop, source), lines=LOG_LINES)
                return types.TextResourceContents(uri=uri, mime_type="text/plain", text="\n".join(lines))
        raise self._unknown(uri)

    def check(self, uri: str) -> None:
        """Raises MCPError when there is no such resource."""
        if uri not in [resource.uri for resource in self.listing()]:
            raise self._unknown(uri)

    def _unknown(self, uri: str) -> MCPError:
        known = ", ".join(resource.uri for resource in self.listing())
        return MCPError(types.INVALID_PARAMS, f"There is no resource {uri[:200]!r}; there are: {known}.")
