"""A test counterpart, no part of the driver: a control box before franka-sim that is stricter than
franka-sim.
"""
