"""Franka Research 3: what is true of it (profile), and a PyBullet simulation of it with its
cameras.
"""
