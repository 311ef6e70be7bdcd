"""Sparse codes of patches: orthogonal matching pursuit."""
