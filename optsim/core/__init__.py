"""Values that cross rooms, errors, configuration and units, files, cache, progress; no physics."""
