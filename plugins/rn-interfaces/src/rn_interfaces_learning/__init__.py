"""The command `roboneuron ros`, and the node with which it asks others."""
