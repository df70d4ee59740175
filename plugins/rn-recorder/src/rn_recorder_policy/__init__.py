"""Comparison of a deployed policy with recorded actions: the command `roboneuron policy check`."""
