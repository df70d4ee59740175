"""MCP resources: the status, and the logs of each module."""

from __future__ import annotations

from collections.abc import Iterable

from mcp import types
from mcp.shared.exceptions import MCPError

from roboneuron.modules.settings import MODULE_KINDS
from roboneuron.server.feature import Resource
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.observing import status
from roboneuron.supervisor.process import read_tail

STATUS_URI = "roboneuron://status"
LOG_URI = "roboneuron://logs/"
LOG_LINES = 500


class Resources:
    """Lists and reads them: the server's own, and those that features offer."""

    def __init__(self, loop: ClosedLoop, started_s: float, offered: Iterable[Resource] = ()) -> None:
        self._loop = loop
        self._started_s = started_s
        self._offered = {resource.uri: resource for resource in offered}

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
                for source in MODULE_KINDS
            ),
            *(
                types.Resource(
                    name=offered.name,
                    title=offered.title,
                    uri=offered.uri,
                    description=offered.description,
                    mime_type=offered.mime_type,
                )
                for offered in self._offered.values()
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
        for source in MODULE_KINDS:
            if uri == f"{LOG_URI}{source}":
                lines = read_tail(self._loop.supervisor.log_path(source), lines=LOG_LINES)
                return types.TextResourceContents(uri=uri, mime_type="text/plain", text="\n".join(lines))
        offered = self._offered.get(uri)
        if offered is not None:
            return types.TextResourceContents(uri=uri, mime_type=offered.mime_type, text=offered.read())
        raise self._unknown(uri)

    def check(self, uri: str) -> None:
        """Raises MCPError when there is no such resource."""
        if uri not in [resource.uri for resource in self.listing()]:
            raise self._unknown(uri)

    def _unknown(self, uri: str) -> MCPError:
        known = ", ".join(resource.uri for resource in self.listing())
        return MCPError(types.INVALID_PARAMS, f"There is no resource {uri[:200]!r}; there are: {known}.")
