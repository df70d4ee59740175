"""Reference agents: scripts that show what the tools allow and what they must prevent."""
