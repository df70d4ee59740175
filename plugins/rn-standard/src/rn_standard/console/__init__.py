"""Commands for users at a terminal: run an instruction, status, logs and shell completion."""
