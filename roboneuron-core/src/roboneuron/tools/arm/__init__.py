"""Tools that move an arm: joint targets and deltas of the end effector."""
