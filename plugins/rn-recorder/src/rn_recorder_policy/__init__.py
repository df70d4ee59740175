"""Comparison of a deployed policy with recorded actions: the command `roboneuron check-policy`."""
