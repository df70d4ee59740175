"""The same skill as a flow policy in the layout of pi0: network, training, export."""
