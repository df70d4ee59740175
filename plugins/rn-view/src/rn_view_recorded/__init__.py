"""Source of a view that plays a recorded run: `roboneuron view --run RUN`. Needs rn-recorder."""
