"""Hypothesis strategies for whatever fits one TUNNEL payload."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from tests.wire.samples import random_pose
from vcl_companion.wire.chunks import CHUNK_DATA_BYTES, MAX_CHUNKS, Chunk, Reply, TransferStatus
from vcl_companion.wire.messages import FrameRequest, MapRefused, MapState
from vcl_companion.wire.pose_messages import PoseProposal, PoseRefused

_tags = st.integers(0, (1 << 32) - 1)
_asks = st.integers(1, 127)

chunks = st.builds(
    Chunk,
    tag=_tags,
    index=st.integers(0, MAX_CHUNKS - 1),
    ask=st.integers(0, 127),
    data=st.binary(min_size=1, max_size=CHUNK_DATA_BYTES),
)


@st.composite
def _windows(draw: st.DrawFn) -> TransferStatus:
    cuts = draw(
        st.lists(st.integers(0, MAX_CHUNKS), min_size=2, max_size=40, unique=True).map(sorted)
    )
    pairs = tuple(zip(cuts[1:-1:2], cuts[2:-1:2], strict=False))
    return TransferStatus(draw(_tags), Reply.RECEIVING, draw(_asks), cuts[0], cuts[-1], pairs[:18])


@st.composite
def _counts(draw: st.DrawFn) -> TransferStatus:
    first = draw(st.integers(0, 60))
    counts = tuple(draw(st.lists(st.integers(0, 1024), min_size=1, max_size=59)))
    end = first + len(counts)
    return TransferStatus(draw(_tags), Reply.LACKING, draw(_asks), first, end, counts=counts)


statuses = st.one_of(
    _windows(),
    _counts(),
    st.builds(
        TransferStatus,
        tag=_tags,
        reply=st.just(Reply.COMPLETE),
        ask=_asks,
        digest=st.binary(min_size=8, max_size=8),
    ),
    st.builds(
        TransferStatus,
        tag=_tags,
        reply=st.sampled_from([Reply.BUSY, Reply.TOO_LARGE, Reply.CORRUPT]),
        ask=_asks,
    ),
)

_request_ids = st.integers(0, (1 << 32) - 1)
_instants = st.integers(-(1 << 63), (1 << 63) - 1)
_revisions = st.one_of(st.just(b""), st.binary(min_size=8, max_size=8))


@st.composite
def proposals(draw: st.DrawFn) -> PoseProposal:
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    root = rng.normal(0.0, 1.0, (6, 6)) * (10.0 ** rng.uniform(-4, 0, 6))[:, None]
    return PoseProposal.of(
        draw(_request_ids),
        draw(st.binary(min_size=8, max_size=8)),
        random_pose(rng, draw(st.sampled_from([0.0, 50.0, 20_000.0]))),
        root @ root.T,
    )


messages = st.one_of(
    st.builds(FrameRequest, _request_ids, _instants, st.floats(0.0, 3600.0)),
    st.builds(
        MapState,
        _revisions,
        st.integers(0, 32_768),
        st.booleans(),
        st.integers(0, 65_535),
        st.booleans(),
        st.integers(0, 255),
        st.integers(0, (1 << 32) - 1),
        _revisions.filter(lambda world: world != bytes(8)),
        st.binary(max_size=48),
    ),
    st.builds(MapRefused.because, _request_ids, st.text()),
    proposals(),
    st.builds(PoseRefused.because, _request_ids, st.text()),
)

payload_values = st.one_of(chunks, statuses, messages)
