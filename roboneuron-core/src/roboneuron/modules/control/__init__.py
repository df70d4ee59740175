"""Control modules: from actions and measured joints to joint commands within the limits."""
