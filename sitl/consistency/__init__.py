"""Whether maps and poses err as much as they say, by many maps of each recording."""
