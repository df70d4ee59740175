"""How data is drawn: the 3-D scene, plots, and tables as HTML."""
