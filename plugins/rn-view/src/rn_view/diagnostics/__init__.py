"""Health of modules, alarms, limits that act on the commands, and the list of events."""
