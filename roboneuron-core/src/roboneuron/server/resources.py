"""The MCP resources of a server."""

from __future__ import annotations

from collections.abc import Iterable

from mcp import types
from mcp.shared.exceptions import MCPError

from roboneuron.server.feature import Resource


class Resources:
    """Lists and reads those that features offer."""

    def __init__(self, offered: Iterable[Resource] = ()) -> None:
        self._offered: dict[str, Resource] = {}
        for resource in offered:
            self._offered.setdefault(resource.uri, resource)

    def listing(self) -> list[types.Resource]:
        """What `resources/list` answers."""
        return [
            types.Resource(
                name=r.name,
                title=r.title,
                uri=r.uri,
                description=r.description,
                mime_type=r.mime_type,
            )
            for r in self._offered.values()
        ]

    def read(self, uri: str) -> types.TextResourceContents:
        """What `resources/read` answers. Raises as `check`."""
        self.check(uri)
        found = self._offered[uri]
        return types.TextResourceContents(uri=uri, mime_type=found.mime_type, text=found.read())

    def check(self, uri: str) -> None:
        """Raises MCPError when there is no such resource."""
        if uri not in self._offered:
            known = ", ".join(self._offered)
            raise MCPError(
                types.INVALID_PARAMS, f"There is no resource {uri[:200]!r}; there are: {known}."
            )
