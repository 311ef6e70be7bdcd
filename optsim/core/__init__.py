"""Lowest room: values that cross rooms, errors, configuration, units, files, cache, progress. No physics."""
