"""What a first map is built of when some of what has come cannot be used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.daemon import demo
from vcl_companion.daemon.feature_memory import FeatureMemory
from vcl_companion.daemon.map_building import build_map, update_map
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.geometry.camera import Camera
from vcl_companion.localization.fix import Prior
from vcl_companion.localization.seen_by_patches import seen_by_patches
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.mapping.keyframe_image import encode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.reconstruction import NoMap
from vcl_companion.mapping.seen_landmarks import SeenLandmarks
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.map_codec import encode_map, revision_of

PAIR = demo.encoded_map(1, 2)
DISTANCES = demo.known_distances(1, 2)


def built(*frames: FrameAnswer) -> LandmarkMap | NoMap:
    return build_map(
        list(frames), demo.LEADER, DISTANCES, demo.MAP_OPTIONS, FeatureMemory(demo.FEATURES)
    )


def reason(result: LandmarkMap | NoMap) -> str:
    assert isinstance(result, NoMap)
    return result.reason


UNUSABLE = {
    "no image": b"no image",
    "cut": demo.answer(3).image_bytes[:200],
    "of another size": encode_image(demo.shot(3).image[:100], 80),
    "a header only": demo.answer(3).image_bytes[:30],
}


@pytest.mark.parametrize("image_bytes", UNUSABLE.values(), ids=UNUSABLE)
def test_a_frame_that_cannot_be_used_is_left_out(image_bytes: bytes) -> None:
    result = built(demo.answer(2), demo.answer(1), replace(demo.answer(3), image_bytes=image_bytes))
    assert isinstance(result, LandmarkMap)
    assert [keyframe.drone_id for keyframe in result.keyframes] == [1, 2]


def test_unless_it_is_the_leaders() -> None:
    result = built(replace(demo.answer(1), image_bytes=b"no image"), demo.answer(2))
    assert reason(result).startswith("the leader's frame: ")


def test_the_order_of_arrival_does_not_matter() -> None:
    there, back = built(demo.answer(1), demo.answer(2)), built(demo.answer(2), demo.answer(1))
    assert isinstance(there, LandmarkMap)
    assert isinstance(back, LandmarkMap)
    assert (there.points_world == back.points_world).all()


def test_what_is_missing_is_named() -> None:
    assert "drone 1, has sent no image" in reason(built(demo.answer(2), demo.answer(3)))
    assert "the images of two drones" in reason(built(demo.answer(1)))
    lost = replace(demo.answer(1), ned_from_body=None)
    assert "sends no attitude" in reason(built(lost, demo.answer(2)))
    blank = replace(demo.answer(2), image_bytes=encode_image(demo.blank(2), 80))
    assert "drones 1 and 2 see too little" in reason(built(demo.answer(1), blank))
    strangers = build_map(
        [demo.answer(1), demo.answer(2)],
        1,
        ((1, 3, 2.0),),
        demo.MAP_OPTIONS,
        FeatureMemory(demo.FEATURES),
    )
    assert "the scale is unknown" in reason(strangers)


@pytest.mark.parametrize("side_px", [1, 2, 9])
def test_a_picture_of_a_few_pixels_ends_in_a_reason(side_px: int) -> None:
    camera = Camera(side_px, side_px, side_px, side_px, 0.0, 0.0)
    image = encode_image(demo.shot(2).image[:side_px, :side_px].copy(), 80)
    tiny = replace(demo.answer(2), camera=camera, image_bytes=image)
    assert "see too little in common" in reason(built(demo.answer(1), tiny))


def test_only_what_is_told_of_the_very_map_counts() -> None:
    """And it does count: the same frames make another map, if only by a little."""
    stored = StoredMap(revision_of(PAIR), PAIR, demo.map_index(1, 2))
    frames = [
        replace(demo.answer(drone, 6), world_from_body=demo.world_from_body(drone, 6))
        for drone in (1, 2)
    ]

    def updated(revision: bytes) -> bytes:
        told = [replace(frame, seen=_seen(frame, revision)) for frame in frames]
        made = update_map(
            stored, told, demo.MAP_OPTIONS, FeatureMemory(demo.FEATURES), at_once=True
        )
        assert isinstance(made, LandmarkMap), made
        return encode_map(made)

    nothing = update_map(
        stored, frames, demo.MAP_OPTIONS, FeatureMemory(demo.FEATURES), at_once=True
    )
    assert isinstance(nothing, LandmarkMap), nothing
    assert updated(b"another!") == encode_map(nothing)
    assert updated(stored.revision) != encode_map(nothing)


def _seen(frame: FrameAnswer, revision: bytes) -> SeenLandmarks:
    where = Prior(
        demo.world_from_body(frame.drone_id, 6), np.diag(np.repeat([0.02, 0.002], 3) ** 2)
    )
    seen = seen_by_patches(
        demo.shot(frame.drone_id, 6).image, frame.camera, frame.body_from_cam,
        demo.templates(1, 2), revision, where, TrackingOptions(), 500,
    )  # fmt: skip
    assert seen is not None
    return seen
