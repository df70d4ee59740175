"""Teleoperation: a person leads the arm, takes over from a policy, and hands back."""
