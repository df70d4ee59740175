"""The standard features and commands, each a plugin in a separate package."""
