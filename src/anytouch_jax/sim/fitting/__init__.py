"""Your own sensor: its look, fitted to a few pictures, and tokens from simulated touches."""
