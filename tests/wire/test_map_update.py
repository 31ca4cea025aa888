"""A map without its parent's images: the same bytes again, and nothing else, whoever sent them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.wire.golden import assert_golden
from tests.wire.samples import random_map, scene_map, small_map
from vcl_companion.errors import WireError
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.wire.header import (
    PROTOCOL_VERSION,
    BlobKind,
    VersionMismatchError,
    encode_header,
)
from vcl_companion.wire.map_codec import (
    MapHead,
    decode_map,
    encode_head,
    encode_map,
    parent_of,
    revision_of,
)
from vcl_companion.wire.map_delta import encode_changes
from vcl_companion.wire.map_update import (
    decode_map_update,
    encode_map_update,
    images_in_map,
    images_in_update,
    images_missing_in,
    name_of_image,
    names_of_update,
    needs_parent,
    with_images,
    without_images,
)

PARENT = decode_map(encode_map(small_map()))


def child() -> LandmarkMap:
    """The small map with its second keyframe first, a new one, and other landmarks."""
    first, second = PARENT.keyframes
    new = replace(first, captured_at_ns=5, image_bytes=b"a new image")
    return replace(
        PARENT,
        keyframes=(second, new, first),
        points_world=PARENT.points_world + 1.0,
        observed_px=np.stack(
            [PARENT.observed_px[:, 1], PARENT.observed_px[:, 0], PARENT.observed_px[:, 0]], axis=1
        ),
        parent=revision_of(encode_map(PARENT)),
    )


CHILD = encode_map(child())
NEW = name_of_image(b"a new image")


def test_golden_bytes() -> None:
    blob = encode_map_update(CHILD, PARENT)
    assert_golden("map_update", blob)
    assert decode_map_update(blob, PARENT, {}) == CHILD
    assert names_of_update(blob) == (revision_of(CHILD), parent_of(CHILD))
    assert names_of_update(blob[:48]) == names_of_update(blob)


def grown(rng: np.random.Generator, parent: LandmarkMap, n_new: int, n_views: int) -> LandmarkMap:
    """The parent as a round leaves it: some of it culled and moved, some of it new."""
    kept = np.sort(rng.permutation(len(parent.points_world))[: rng.integers(0, 40)])
    stay = np.flatnonzero(rng.uniform(size=len(parent.keyframes)) < 0.8)
    more = random_map(rng, len(kept) + n_new, len(stay) + max(n_views, 1 - len(stay)))
    keyframes = tuple(parent.keyframes[k] for k in stay) + tuple(
        replace(k, image_bytes=b"a new image" + k.image_bytes) for k in more.keyframes[len(stay) :]
    )
    sizes_px = np.array([(k.camera.width_px, k.camera.height_px) for k in keyframes])
    observed_px = np.minimum(more.observed_px, sizes_px - 1)
    old = parent.observed_px[np.ix_(kept, stay)].copy()
    old[rng.uniform(size=old.shape[:2]) < 0.1] = np.nan
    same = rng.uniform(size=old.shape[:2]) < 0.95
    observed_px[: len(kept), : len(stay)][same] = old[same]
    points = more.points_world.copy()
    points[: len(kept)] = parent.points_world[kept] + 0.01 * rng.standard_normal((len(kept), 3))
    return replace(
        more, keyframes=keyframes, points_world=points, observed_px=observed_px, distances=(),
        parent=revision_of(encode_map(parent)),
    )  # fmt: skip


@given(
    st.integers(0, 2**32).map(np.random.default_rng), st.integers(0, 40), st.integers(1, 5),
    st.integers(0, 10), st.integers(0, 3),
)  # fmt: skip
def test_what_comes_out_is_what_went_in(
    rng: np.random.Generator, n_landmarks: int, n_old: int, n_new: int, n_views: int
) -> None:
    parent = random_map(rng, n_landmarks, n_old)
    images = [rng.bytes(500) for _ in parent.keyframes]
    keyframes = tuple(
        replace(k, image_bytes=image) for k, image in zip(parent.keyframes, images, strict=True)
    )
    parent = decode_map(encode_map(replace(parent, keyframes=keyframes)))
    data = encode_map(grown(rng, parent, n_new, n_views))
    blob = encode_map_update(data, parent)
    assert decode_map_update(blob, parent, {}) == data
    carried = {name_of_image(k.image_bytes): k.image_bytes for k in decode_map(data).keyframes}
    bare = without_images(blob, carried)
    assert decode_map_update(bare, parent, carried) == data
    assert with_images(bare, carried) == blob
    assert with_images(blob, {}) == blob


def test_what_has_not_changed_costs_next_to_nothing() -> None:
    rng = np.random.default_rng(5)
    parent = decode_map(encode_map(scene_map(rng, 1000, 6)))
    moved = parent.points_world + 0.01 * rng.standard_normal((1000, 3))
    data = encode_map(replace(parent, points_world=moved, parent=b"12345678"))
    heads = len(
        encode_map(replace(parent, points_world=moved[:0], observed_px=parent.observed_px[:0]))
    )
    # 3 bits of each coordinate's step, and next to nothing of a sighting.
    assert len(encode_map_update(data, parent)) - heads < 1800
    assert len(data) - heads > 9_000


@given(st.integers(0, 2**32).map(np.random.default_rng), st.integers(1, 60), st.integers(0, 40))
def test_a_scene_goes_on(rng: np.random.Generator, n_parent: int, n_new: int) -> None:
    """A round later: its first keyframe is gone, there is a new one, landmarks have moved."""
    whole = scene_map(rng, n_parent + n_new, 5)
    parent = decode_map(encode_map(replace(
        whole, keyframes=whole.keyframes[:4], points_world=whole.points_world[:n_parent],
        observed_px=whole.observed_px[:n_parent, :4],
    )))  # fmt: skip
    moved = whole.points_world + 0.01 * rng.standard_normal(whole.points_world.shape)
    culled = rng.uniform(size=whole.seen.shape) < 0.05
    observed_px = np.where(culled[..., None], np.nan, whole.observed_px)
    data = encode_map(replace(
        whole, keyframes=whole.keyframes[1:], points_world=moved,
        observed_px=observed_px[:, 1:], parent=b"12345678",
    ))  # fmt: skip
    update = encode_map_update(data, parent)
    assert decode_map_update(update, parent, {}) == data
    assert len(update) < len(data) + 8 + 4 + 30


def test_golden_bytes_for_one_who_holds_the_new_image() -> None:
    blob = without_images(encode_map_update(CHILD, PARENT), {NEW})
    assert_golden("map_update_sent_ahead", blob)
    assert decode_map_update(blob, PARENT, {NEW: b"a new image"}) == CHILD
    assert names_of_update(blob) == (revision_of(CHILD), parent_of(CHILD))


def test_only_what_is_held_stays_at_home() -> None:
    update = encode_map_update(CHILD, PARENT)
    assert images_in_update(update) == {NEW}
    assert without_images(update, {name_of_image(b"another")}) == update
    # Its parent's images are not in it, whoever holds them as well.
    parents = {name_of_image(keyframe.image_bytes) for keyframe in PARENT.keyframes}
    assert without_images(update, parents) == update
    assert images_in_update(without_images(update, {NEW})) == set()
    assert images_missing_in(update) == set()
    assert images_missing_in(without_images(update, {NEW})) == {NEW}


def test_who_has_no_parent_takes_the_whole_but_for_images_that_it_has() -> None:
    standalone = encode_map_update(CHILD, None)
    names = images_in_map(CHILD)
    assert images_in_update(standalone) == names == images_in_map(CHILD + b"more")
    assert NEW in names
    assert len(names) == 3
    images = {name_of_image(k.image_bytes): k.image_bytes for k in child().keyframes}
    blob = without_images(standalone, names - {NEW})
    assert decode_map_update(blob, None, images) == CHILD
    assert images_missing_in(blob) == names - {NEW}
    assert not needs_parent(standalone)
    assert not needs_parent(blob)
    # It is none of its parent's for one who has that, nor what is its parent's for one who has not.
    with pytest.raises(WireError, match="parent is another"):
        decode_map_update(blob, PARENT, images)
    update = encode_map_update(CHILD, PARENT)
    assert needs_parent(update)
    with pytest.raises(WireError, match="no keyframe"):
        decode_map_update(update, None, images)
    for blob in (update[:-1][:40], CHILD, b""):
        with pytest.raises(WireError):
            needs_parent(blob)
    for blob in (CHILD[:40], b""):
        with pytest.raises(WireError):
            images_in_map(blob)


def test_an_image_that_is_not_here_is_told_of() -> None:
    blob = without_images(encode_map_update(CHILD, PARENT), {NEW})
    with pytest.raises(WireError, match="sent ahead is not here"):
        decode_map_update(blob, PARENT, {name_of_image(b"another"): b"another"})
    with pytest.raises(WireError, match="another map"):
        decode_map_update(blob, PARENT, {NEW: b"another"})
    with pytest.raises(WireError, match="sent ahead is not here"):
        with_images(blob, {})


def test_images_that_make_an_update_too_long_are_a_wire_error() -> None:
    blob = without_images(encode_map_update(CHILD, PARENT), {NEW})
    with pytest.raises(WireError, match="image"):
        with_images(blob, {NEW: bytes(9 * 1024 * 1024)})


def test_another_parent_is_refused() -> None:
    blob = encode_map_update(CHILD, PARENT)
    first, second = PARENT.keyframes
    other = replace(PARENT, keyframes=(first, replace(second, image_bytes=b"other")))
    with pytest.raises(WireError, match="another map"):
        decode_map_update(blob, other, {})
    fewer = replace(PARENT, keyframes=(first,), observed_px=PARENT.observed_px[:, :1], distances=())
    with pytest.raises(WireError, match="no keyframe 1"):
        decode_map_update(blob, fewer, {})


@pytest.mark.parametrize("image", [b"ab", b"abcdefgh"], ids=len)
def test_an_image_that_would_be_taken_for_a_reference_is_not_encoded(image: bytes) -> None:
    short = replace(child().keyframes[1], image_bytes=image)
    odd = replace(child(), keyframes=(child().keyframes[0], short, child().keyframes[2]))
    with pytest.raises(ValueError, match="bytes is none"):
        encode_map_update(encode_map(odd), PARENT)


@given(st.binary(max_size=200), st.sampled_from([b"", b"\x03", b"\x03\x44"]))
def test_any_bytes_are_a_wire_error(body: bytes, head: bytes) -> None:
    with pytest.raises(WireError):
        decode_map_update(head + body, PARENT, {})


@given(st.data())
def test_mutated_updates_are_a_wire_error(data: st.DataObject) -> None:
    blob = without_images(encode_map_update(CHILD, PARENT), data.draw(st.sampled_from([{NEW}, {}])))
    at = data.draw(st.integers(0, len(blob) - 1))
    mutated = blob[:at] + data.draw(st.binary(max_size=4)) + blob[at + 1 :]
    if mutated == blob:
        return
    with pytest.raises(WireError):
        decode_map_update(mutated, PARENT, {NEW: b"a new image"})


@pytest.mark.parametrize(
    "decode", [names_of_update, lambda blob: decode_map_update(blob, PARENT, {})]
)
def test_another_version_and_another_kind_are_recognised(decode: object) -> None:
    assert callable(decode)
    blob = encode_map_update(CHILD, PARENT)
    with pytest.raises(VersionMismatchError):
        decode(bytes([PROTOCOL_VERSION + 1]) + blob[1:])
    with pytest.raises(WireError, match="not a map update"):
        decode(CHILD)


def test_many_references_to_a_large_image_are_refused_before_they_are_joined() -> None:
    large = replace(PARENT.keyframes[0], image_bytes=bytes(1024 * 1024))
    parent = replace(PARENT, keyframes=(large, PARENT.keyframes[1]))
    many = tuple(replace(large, captured_at_ns=k, image_bytes=b"\0\0") for k in range(20))
    observed_px = np.full((3, 20, 2), np.nan)
    child = replace(PARENT, keyframes=many, observed_px=observed_px, distances=())
    blob = encode_header(BlobKind.MAP_UPDATE) + b"revision" + encode_head(MapHead.of(child))
    with pytest.raises(WireError, match="20971520 bytes of images"):
        decode_map_update(blob + encode_changes(child, parent, [0] * 20), parent, {})


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 4))
def test_a_first_map_comes_without_the_images_that_were_sent_ahead(
    seed: int, n_landmarks: int, n_keyframes: int
) -> None:
    made = random_map(np.random.default_rng(seed), n_landmarks, n_keyframes, 1.0)
    named = enumerate(made.keyframes)
    keyframes = tuple(replace(k, image_bytes=b"picture %d" % n) for n, k in named)
    data = encode_map(replace(made, keyframes=keyframes, parent=b"", world=b"", joined=()))
    update = encode_map_update(data, None)
    assert names_of_update(update) == (revision_of(data), b"")
    assert decode_map_update(update, None, {}) == data
    images = {name_of_image(k.image_bytes): k.image_bytes for k in decode_map(data).keyframes}
    without = without_images(update, images)
    assert images_missing_in(without) == frozenset(images)
    assert decode_map_update(without, None, images) == data
    with pytest.raises(WireError, match="sent ahead"):
        decode_map_update(without, None, {})


def test_one_without_a_map_cannot_be_told_what_its_parent_has() -> None:
    with pytest.raises(WireError, match="no keyframe"):
        decode_map_update(encode_map_update(CHILD, PARENT), None, {})
