"""A learned monitor of progress and success for the suite "cubes"."""
