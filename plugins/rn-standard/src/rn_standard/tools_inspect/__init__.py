"""Tools that inspect: what is installed, and what the cameras show."""
