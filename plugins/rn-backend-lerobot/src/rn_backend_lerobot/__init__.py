"""Policies of LeRobot as a backend."""
