"""The feature: notifications for clients, and questions to their users."""

from __future__ import annotations

from mcp import types
from mcp.server import NotificationOptions
from mcp.server.context import HandlerResult, ServerRequestContext
from mcp.server.subscriptions import ListenHandler

from rn_standard.ops.asking import Questions
from rn_standard.ops.notices import ToolNotices
from roboneuron import Feature, Host


class Clients(Feature[None]):
    """Announces changes of tools and resources to the clients of one server, and asks their
    users.
    """

    def __init__(self, options: None) -> None:
        super().__init__(options)
        self._notices = ToolNotices()
        self._questions = Questions()

    def attach(self, host: Host) -> None:
        """Register the subscriptions, since all resources are known from here on."""
        host.events.tools.listen(self._notices.tools_changed)
        host.events.resource.listen(self._notices.resource_updated)
        notices, server = self._notices, host.server

        listed = server.get_request_handler("tools/list")
        assert listed is not None

        async def list_tools(
            context: ServerRequestContext, params: types.PaginatedRequestParams
        ) -> HandlerResult:
            notices.remember(context)
            return await listed.handler(context, params)

        async def subscribe(
            context: ServerRequestContext, params: types.SubscribeRequestParams
        ) -> types.EmptyResult:
            host.server.find_resource(str(params.uri))
            notices.subscribe(context, str(params.uri))
            return types.EmptyResult()

        async def unsubscribe(
            context: ServerRequestContext, params: types.UnsubscribeRequestParams
        ) -> types.EmptyResult:
            notices.unsubscribe(context, str(params.uri))
            return types.EmptyResult()

        # this method only: a middleware would be passed by every request
        server.add_request_handler("tools/list", types.PaginatedRequestParams, list_tools)
        server.add_request_handler("resources/subscribe", types.SubscribeRequestParams, subscribe)
        server.add_request_handler(
            "resources/unsubscribe", types.UnsubscribeRequestParams, unsubscribe
        )
        listening = ListenHandler(notices.bus)
        server.add_request_handler(
            "subscriptions/listen", types.SubscriptionsListenRequestParams, listening
        )
        server.announced = NotificationOptions(tools_changed=True)
        server.ask = self._questions.ask
