"""`roboneuron demo`: an agent stand-in that uses nothing but MCP, and what a person sees of it."""
