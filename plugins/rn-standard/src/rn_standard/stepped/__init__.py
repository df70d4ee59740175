"""Stepped time: what modules and tools do where a simulated robot waits for commands."""
