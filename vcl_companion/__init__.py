"""Collaborative visual localization for drones, as a MAVLink companion service."""
