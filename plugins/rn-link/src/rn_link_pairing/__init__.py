"""The command `roboneuron link`: keys, certificates, and the pairing of two machines."""
