"""Posteriors of patches under a Gaussian mixture."""
