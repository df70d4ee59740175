"""What the sessions of noxfile.py do, and the environments that they need."""
