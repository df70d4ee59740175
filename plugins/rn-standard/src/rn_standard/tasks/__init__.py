"""Tasks with outcomes, a feature of RoboNeuron."""
