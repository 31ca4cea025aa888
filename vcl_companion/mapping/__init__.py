"""The shared map: built, scaled, updated (IV-C, IV-G)."""
