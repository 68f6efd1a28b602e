"""Training: the optimiser, the step, devices, and the loop with all its side effects."""
