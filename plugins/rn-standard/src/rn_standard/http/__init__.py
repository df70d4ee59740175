"""Streamable HTTP for several clients: tokens with roles, and one operator at a time."""
