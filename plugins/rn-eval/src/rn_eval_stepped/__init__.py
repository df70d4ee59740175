"""Stepped time: what a server and its modules do where a simulated robot waits for commands."""
