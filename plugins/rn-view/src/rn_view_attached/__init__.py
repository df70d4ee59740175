"""The command `roboneuron view`: the page in a process of its own, beside any server."""
