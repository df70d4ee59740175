"""Simulated calls: what moves the arm, carried out in a simulated twin of the cell."""
