"""FastV: drop the visual tokens with little attention in the decoder."""
