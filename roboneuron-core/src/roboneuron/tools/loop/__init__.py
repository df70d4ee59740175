"""Tools of the closed loop for agents: start its modules, give instructions, read the status."""
