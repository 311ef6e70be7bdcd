"""Dictionaries and mixtures: their training and their files."""
