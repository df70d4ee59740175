"""LeRobot's arms: the SO-101, simulated and real, and a driver for any robot of LeRobot."""
