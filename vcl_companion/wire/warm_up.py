"""Every compiled kernel of wire and of what lies below it once."""

from __future__ import annotations

import numpy as np

from vcl_companion.mapping.warm_up import warm_up as warm_up_mapping
from vcl_companion.wire.landmark_coder import Rows, Stream


def warm_up() -> None:
    """Load, or the first time compile, all that frames, maps and their bytes need."""
    warm_up_mapping()
    zero, none = np.zeros(1, dtype=np.int64), np.zeros((0, 1), dtype=np.int64)
    stream = Stream.writing(64)
    stream.code_listed(zero)
    stream.code_seen(np.zeros((1, 2), dtype=np.int64))
    stream.code_known(Rows.blank(0, 1), none)
    stream.code_new(Rows.blank(0, 1), zero, np.zeros((1, 1), dtype=np.int64), zero)
    stream.written()
