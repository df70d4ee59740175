"""Several robots behind one MCP server."""
