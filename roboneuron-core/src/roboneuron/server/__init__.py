"""The MCP server: typed tools over the supervisor and the plugin registry."""
