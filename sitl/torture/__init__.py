"""Hostile peers: mutated payloads through everything that a peer's bytes pass in a daemon."""
