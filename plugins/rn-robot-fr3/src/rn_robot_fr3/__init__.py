"""Franka Research 3: its profile, its drivers, and simulations of it with cameras."""
