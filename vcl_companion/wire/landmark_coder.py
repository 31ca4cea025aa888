"""Landmarks as one stream of bits, each in as few as its likeliness asks for.

What is coded are integers, by models that learn of nothing but these: the bytes are the same
on every machine. The work is done in ``landmark_kernels``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from vcl_companion.compiled import writable
from vcl_companion.wire.landmark_kernels import (
    AT,
    CODE,
    FAILED,
    N_MODELS,
    RANGE,
    READS,
    Bytes,
    Integers,
    begin,
    code_known,
    code_listed,
    code_new,
    code_seen,
    end,
)


@dataclass(frozen=True, eq=False)
class Rows:
    """What is told of n landmarks in V keyframes; all integers.

    Attributes:
        state: (n, V) ``NOT_SEEN``, ``SEEN`` or ``AS_BEFORE``.
        away: (n,) 1 for those told by ``place``.
        place: (n, 3) x, y, z, of those only.
        aside: (n, 2) pixel of the others in their anchors, less what is expected.
        depth: (n,) inverse depth of the others there; less what is expected if they are known.
        residual: (n, V, 2) pixel where ``SEEN``, less what is expected; 0 if that is ``first``.
        first: (n, 2) pixel that the anchor saw; of new ones only.
    """

    state: Integers
    away: Integers
    place: Integers
    aside: Integers
    depth: Integers
    residual: Integers
    first: Integers

    def __post_init__(self) -> None:
        for field in fields(self):
            object.__setattr__(self, field.name, writable(getattr(self, field.name)))

    @classmethod
    def blank(cls, n: int, n_keyframes: int) -> Rows:
        """Return rows to be read."""
        shapes = ((n, n_keyframes), (n,), (n, 3), (n, 2), (n,), (n, n_keyframes, 2), (n, 2))
        return cls(*(np.zeros(shape, dtype=np.int64) for shape in shapes))


class Stream:
    """A stream of landmarks that is written, or read: each method codes the next part.

    Nothing is raised while it goes on: ``failed`` says whether it was too short for
    what was coded, and what was read is not to be used then.
    """

    def __init__(self, buffer: Bytes, reads: bool) -> None:
        self._coder = np.zeros(8, dtype=np.int64)
        self._coder[RANGE] = 0xFFFFFFFF
        self._coder[READS] = reads
        self._buffer = buffer
        self._models = np.zeros((N_MODELS, 2), dtype=np.int64)
        self._models[:, 0] = 1 << 15
        begin(self._coder, buffer)

    @classmethod
    def reading(cls, data: bytes) -> Stream:
        """Return one that reads."""
        return cls(np.frombuffer(data, dtype=np.uint8).copy(), reads=True)

    @classmethod
    def writing(cls, n_bytes: int) -> Stream:
        """Return one that writes into so much space."""
        return cls(np.zeros(n_bytes, dtype=np.uint8), reads=False)

    @classmethod
    def written_by(cls, write: Callable[[Stream], None], n_bytes: int) -> bytes:
        """Return what is written to one, in more space where so much is too little."""
        while True:
            stream = cls.writing(n_bytes)
            write(stream)
            data = stream.written()
            if not stream.failed:
                return data
            n_bytes *= 2

    @property
    def failed(self) -> bool:
        """Whether it was too short."""
        return bool(self._coder[FAILED])

    @property
    def is_all_read(self) -> bool:
        """Whether one that reads is at its end, and a writer of the same would have left it so."""
        # A writer's code is the very beginning of the last interval.
        is_at_end = int(self._coder[AT]) == len(self._buffer) and not self._coder[CODE]
        return is_at_end and not self.failed

    def code_listed(self, listed: Integers) -> None:
        """Code (n,) flags."""
        code_listed(self._coder, self._buffer, self._models, listed)

    def code_seen(self, aside: Integers) -> None:
        """Code (n, 2) where landmarks are seen, less what is expected."""
        code_seen(self._coder, self._buffer, self._models, aside)

    def code_known(self, rows: Rows, there: Integers) -> None:
        """Code landmarks that both sides know from an earlier map.

        Args:
            rows: the landmarks.
            there: (n, V) 1 where the earlier map saw them in that keyframe.
        """
        code_known(
            self._coder, self._buffer, self._models, there, rows.state, rows.away, rows.place,
            rows.aside, rows.depth, rows.residual,
        )  # fmt: skip

    def code_new(self, rows: Rows, counts: Integers, exponents: Integers, bits: Integers) -> None:
        """Code landmarks in the order of their anchors, and by v in these.

        Args:
            rows: the landmarks.
            counts: (V,) how many each keyframe is the anchor of; the rest have none.
            exponents: (V, V) see ``landmark_grid``.
            bits: (V,) that a pixel's u in the keyframe takes.
        """
        code_new(
            self._coder, self._buffer, self._models, counts, exponents, bits, rows.state, rows.away,
            rows.place, rows.aside, rows.depth, rows.residual, rows.first,
        )  # fmt: skip

    def written(self) -> bytes:
        """Return what was written."""
        end(self._coder, self._buffer)
        # The first byte is that before the code: always zero.
        return self._buffer[1 : self._coder[AT]].tobytes()
