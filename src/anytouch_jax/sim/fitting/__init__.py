"""Your own sensor: its look, fitted to a few images, and tokens from simulated touches."""
