"""The command `roboneuron limits`."""
