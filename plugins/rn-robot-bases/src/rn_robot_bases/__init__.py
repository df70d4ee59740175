"""Three mobile bases in simulation, each with its own controller: velocities in, odometry out."""
