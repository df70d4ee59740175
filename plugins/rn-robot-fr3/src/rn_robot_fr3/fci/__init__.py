"""The driver `fci`: an FR3 over its own network protocol, the Franka Control Interface."""
