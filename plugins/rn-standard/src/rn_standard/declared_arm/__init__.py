"""Arms from their URDF: what it says, and robots that roboneuron.toml declares by it."""
