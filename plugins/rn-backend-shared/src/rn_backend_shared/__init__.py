"""One loaded model for the backends of several robots on a machine."""
