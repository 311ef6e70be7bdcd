"""Experiments: their definition, runs, run folders, evidence and records."""
