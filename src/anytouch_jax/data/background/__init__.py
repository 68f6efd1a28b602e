"""Background images: the rule that finds one for each frame, estimates, contact filter and dots."""
