"""Autopilots for flights in software, each a process of its own."""
