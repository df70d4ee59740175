"""Past tasks: their history, pictures of start and end, and success rates."""
