"""FastV: drop the visual tokens that the decoder hardly looks at."""
