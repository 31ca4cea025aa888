"""What options of all kinds are held to."""

from __future__ import annotations


def require_positive(options: object, *names: str) -> None:
    """Refuse options of which one is not above zero; not a number is none.

    Args:
        options: any object.
        names: of its attributes.

    Raises:
        ValueError: which, and what it is.
    """
    for name in names:
        value = getattr(options, name)
        if not value > 0:
            raise ValueError(f"{name} must be positive, got {value}")
