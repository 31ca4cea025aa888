"""Commands whose expected failures are one line on standard error, never a traceback."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

import click

from vcl_companion.errors import DISK_IS_FULL, VclError, reason_of


def tell(speaker: str, text: str) -> None:
    """Say one line on standard error."""
    click.echo(f"{speaker}: {' '.join(text.split())}", err=True)


class OneLineGroup(click.Group):
    """A group of commands that says what it cannot use in one line.

    Exit status: 2 for bad input, 130 for an interrupt.

    Attributes:
        speaker: what its lines begin with.
    """

    speaker = "vcl"

    def status_of(self, error: VclError) -> int:
        """Return the exit status of a failure."""
        return 2

    def make_context(
        self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any
    ) -> click.Context:
        """Refuse options of the group itself in one line, too."""
        try:
            with self._output():  # of --help
                return super().make_context(info_name, args, parent, **extra)
        except click.UsageError as error:
            self._refuse(error)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command."""
        try:
            with self._output():
                return super().invoke(ctx)
        except click.UsageError as error:
            self._refuse(error)
        except VclError as error:
            tell(self.speaker, str(error))
            ctx.exit(self.status_of(error))
        except KeyboardInterrupt:
            tell(self.speaker, "interrupted")
            ctx.exit(130)

    @contextmanager
    def _output(self) -> Iterator[None]:
        """Say in one line that what was to be printed cannot be; who reads no more is no error."""
        try:
            yield
        except OSError as error:
            if error.errno not in DISK_IS_FULL or error.filename is not None:
                raise
            tell(self.speaker, f"standard output: {reason_of(error)}")
            # What is still to be written would fail again when the interpreter ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise click.exceptions.Exit(1) from None

    def _refuse(self, error: click.UsageError) -> NoReturn:
        if isinstance(error, click.exceptions.NoArgsIsHelpError):
            raise error  # it is the help
        of = f" (see {error.ctx.command_path} --help)" if error.ctx else ""
        tell(self.speaker, f"{error.format_message().rstrip('.')}{of}")
        raise click.exceptions.Exit(error.exit_code)
