"""An encrypted, authenticated link between machines, used by every process of a machine."""
