"""Repair of Fast DDS shared memory after a process was killed."""
