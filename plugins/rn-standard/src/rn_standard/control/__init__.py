"""Control modules: actions and measured joints in, joint commands within the limits out."""
