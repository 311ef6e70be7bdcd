"""Dictionaries and mixtures: training them, and the files that hold them."""
