"""Simulated counterpart of LeRobot's arms for driver tests: an SO-101 behind a serial port, whose
motors use the protocol of the real ones.
"""
