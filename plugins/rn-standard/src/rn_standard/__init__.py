"""The standard features and commands, each a plugin in a package of its own."""
