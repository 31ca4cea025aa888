"""What a first map is built of when some of what has come cannot be used."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.daemon import demo
from vcl_companion.daemon.feature_memory import FeatureMemory
from vcl_companion.daemon.map_building import build_map
from vcl_companion.geometry.camera import Camera
from vcl_companion.mapping.keyframe_image import encode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.reconstruction import NoMap
from vcl_companion.wire.frame_codec import FrameAnswer

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
