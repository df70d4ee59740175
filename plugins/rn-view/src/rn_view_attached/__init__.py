"""The command `roboneuron view`: the same page in a process of its own, beside a server."""
