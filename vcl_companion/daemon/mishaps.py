"""What goes wrong with peers' images and numbers: a reason, never the end of the flight."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from vcl_companion.errors import WireError
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.mapping.options import NoMap
from vcl_companion.wire.header import VersionMismatchError

_log = logging.getLogger(__name__)

_Made = TypeVar("_Made")
# What has been said of errors that nobody has foreseen: with every frame it would fill the journal.
_said: set[str] = set()
_MOST_SAID = 64


@dataclass(frozen=True)
class BadBytes(NoMap):
    """Nothing can be made of bytes that no drone sends, and why."""


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
    except VersionMismatchError as error:
        return NoMap(str(error))
    except WireError as error:
        return BadBytes(str(error))
    except ValueError as error:
        return NoMap(str(error))
    except Exception as error:
        _log.exception(cannot)
        return NoMap(f"{failed}: {type(error).__name__}")


async def fix_or_none(looking: Awaitable[Localized | NotLocalized]) -> Localized | NotLocalized:
    """Wait for what a frame gives on a map that came from peers; an error is no fix.

    The flight log tells it of each frame, the journal once of each kind.
    """
    try:
        return await looking
    except Exception as error:
        reason = f"looking at it failed: {type(error).__name__}"
        if reason not in _said and len(_said) < _MOST_SAID:
            _said.add(reason)
            _log.exception("a frame cannot be looked at")
        return NotLocalized(reason)


@contextmanager
def survived(what: str) -> Iterator[None]:
    """Say in the journal what has failed that nobody has foreseen, and go on."""
    try:
        yield
    except Exception:
        _log.exception("%s failed, and goes on", what)
