"""The four LIBERO suites."""
