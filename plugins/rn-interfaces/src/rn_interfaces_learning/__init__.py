"""The command `roboneuron ros`, and its node for queries."""
