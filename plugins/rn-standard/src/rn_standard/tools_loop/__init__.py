"""The closed loop for agents: its modules are started, instructed and looked at."""
