"""A deployed policy beside recorded actions: the command `roboneuron check-policy`."""
