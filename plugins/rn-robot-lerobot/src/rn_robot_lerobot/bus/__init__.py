"""The counterpart of the driver for LeRobot's arms: a simulated SO-101 behind a serial port, whose
motors speak the protocol of the real ones.
"""
