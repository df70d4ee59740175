"""One loaded model for the backends of several robots."""
