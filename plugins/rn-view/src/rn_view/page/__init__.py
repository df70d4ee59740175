"""One browser page: its layout, its updates, the emergency stop and the strip below it."""
