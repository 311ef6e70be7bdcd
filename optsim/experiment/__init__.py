"""Experiments: what is run, in which order, where it is kept, and what is said about it."""
