"""Tasks for agents with the simulated FR3 and cubes on its table."""
