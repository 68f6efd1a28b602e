"""Your own sensor: the fit of its look from a few pictures, and tokens trained on simulated touches
of it.
"""
