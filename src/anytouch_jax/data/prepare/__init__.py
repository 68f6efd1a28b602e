"""Tools that prepare a manifest for training."""
