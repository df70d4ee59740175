"""Previews: calls that move the arm, carried out in a simulated twin of the cell."""
