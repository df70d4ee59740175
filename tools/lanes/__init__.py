"""Sessions of noxfile.py, and their environments."""
