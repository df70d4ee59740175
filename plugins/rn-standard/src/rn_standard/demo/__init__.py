"""`roboneuron demo`: a scripted agent that uses MCP only, and its output."""
