"""Import path of the modules next to the tests."""
