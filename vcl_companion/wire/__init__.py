"""Bytes to values and back: what peers say to each other; no socket, no clock."""
