"""What goes wrong with peers' images and numbers: a reason, never the end of the flight."""

from __future__ import annotations

import logging
from collections.abc import Awaitable
from typing import TypeVar

from vcl_companion.errors import WireError
from vcl_companion.mapping.options import NoMap

_log = logging.getLogger(__name__)

_Made = TypeVar("_Made")


async def made_or_no_map(making: Awaitable[_Made], cannot: str, failed: str) -> _Made | NoMap:
    """Wait for what is made of a map that peers' images and numbers went into.

    Args:
        making: does it.
        cannot: what the log says of an error that nobody has foreseen.
        failed: what the reason of such an error begins with.

    Returns:
        What was made, or why nothing was. A ``WireError`` or ``ValueError`` says that itself.
    """
    try:
        return await making
    except (WireError, ValueError) as error:
        return NoMap(str(error))
    except Exception as error:
        _log.exception(cannot)
        return NoMap(f"{failed}: {type(error).__name__}")
