"""RoboNeuron suites: the four LIBERO suites."""
