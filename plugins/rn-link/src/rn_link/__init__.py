"""An encrypted, authenticated link between machines: what every process of a machine uses."""
