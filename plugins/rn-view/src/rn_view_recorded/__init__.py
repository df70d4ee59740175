"""A recorded run in the view: `roboneuron view --run RUN`. Needs rn-recorder."""
