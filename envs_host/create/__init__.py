"""CREATE: physics puzzles solved by placing tools (spec create). NumPy and pymunk, no jax."""
