"""Maps that are merged: in one world, as good as they say, or refused with a reason."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from tests.checks import nees
from tests.mapping.rendered import panels, rendered_view
from tests.mapping.test_update import FIRST, MOUNTING, NOISE_PX, OPTIONS, at, first_map, flight
from tests.mapping.views import descriptors_of, world_from_scene
from tests.scenes import Scene
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3, matrix_from_euler
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.mapping.agreement import contradiction
from vcl_companion.mapping.aligning import Aligned, Side, aligned
from vcl_companion.mapping.common_landmarks import (
    Common,
    common_landmarks,
    common_where_expected,
)
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.extension import ImageFeatures
from vcl_companion.mapping.known_features import KeyframeLibrary, of_keyframes
from vcl_companion.mapping.landmark_map import JoinedMap, LandmarkMap
from vcl_companion.mapping.merging import merged
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.reconstruction import reconstruct
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.mapping.update import extend_map, extended
from vcl_companion.vision.features import Detector, Features
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of

# Three drones farther down the street; they see a good part of what the first ones see.
OTHERS = (at(-1.5, 5.0, 0.3, 2.0), at(-1.0, 7.2, -0.5, -3.0), at(-2.0, 3.5, 0.6, 4.0))
# The leader of the others has its own idea of where north is.
NORTH = matrix_from_euler(0.0, 0.0, 0.7)


def features_in(views: list[DroneView]) -> ImageFeatures:
    def features_of(image_bytes: bytes, camera: Camera, detector: Detector) -> Features:
        return next(v for v in views if v.image_bytes == image_bytes).features[0]

    return features_of


@dataclass(frozen=True, eq=False)
class Two:
    """Two maps of one street, and what is true of them."""

    scene: Scene
    views: list[DroneView]
    senior: LandmarkMap
    junior: LandmarkMap
    senior_from_junior: Similarity

    def merged(self, options: MapOptions = OPTIONS) -> LandmarkMap | NoMap:
        return merged(
            self.senior, b"senior  ", self.junior, b"junior  ", features_in(self.views), options
        )

    def common(self) -> Common:
        features_of = of_keyframes(features_in(self.views), OPTIONS.detectors)
        one, other = (KeyframeLibrary(m, features_of) for m in (self.senior, self.junior))
        return common_landmarks(self.senior, self.junior, one, other)

    def aligned(self, common: Common, options: MapOptions = OPTIONS) -> Aligned | NoMap:
        one, other = (Side(m, map_uncertainty(m)) for m in (self.senior, self.junior))
        return aligned(one, other, common, options, 0, one_world=False)


OURS = b"ours    "


def two(
    seed: int,
    others: tuple[Pose, ...] = OTHERS,
    errors_m: tuple[float, float] | None = None,
    noise_px: float = NOISE_PX,
) -> Two:
    """Return two first maps of two groups, each with a leader, a world and a distance of its own.

    Args:
        seed: of the scene and its noise.
        others: where the second group is.
        errors_m: of the distances that the groups were told; None draws them by their sigma.
        noise_px: of the features.
    """
    rng = np.random.default_rng(seed)
    scene, views = flight(rng, FIRST + others, [1, 2, 3, 4, 5, 6], noise_px)
    upset = [
        replace(v, ned_from_body=NORTH @ v.ned_from_body)
        for v in views[3:]
        if v.ned_from_body is not None
    ]
    views = [*views[:3], *upset]
    off = OPTIONS.distance_sigma_m * rng.standard_normal(2) if errors_m is None else errors_m
    maps = [
        reconstruct(group, a, [(a, a + 1, scene.baseline_m(a - 1, a) + e)], OPTIONS)
        for group, a, e in ((views[:3], 1, off[0]), (views[3:], 4, off[1]))
    ]
    senior, junior = maps
    assert isinstance(senior, LandmarkMap), senior
    assert isinstance(junior, LandmarkMap), junior
    assert upset[0].ned_from_body is not None
    scene_from_junior = scene.bodies[3] @ Pose(upset[0].ned_from_body, np.zeros(3)).inverse()
    there = world_from_scene() @ scene_from_junior
    return Two(scene, views, senior, junior, Similarity(there.rotation, there.translation))


def reason(found: object) -> str:
    assert isinstance(found, NoMap), found
    return found.reason


def assert_right(found: LandmarkMap, scene: Scene, views: list[DroneView], within_m: float) -> None:
    """Assert that every keyframe is where its view was, within what the map says of itself."""
    covariance = map_uncertainty(found).keyframe_covariance
    for i, keyframe in enumerate(found.keyframes[1:], start=1):
        k = next(n for n, v in enumerate(views) if v.image_bytes == keyframe.image_bytes)
        error = (world_from_scene() @ scene.bodies[k]).local(keyframe.world_from_body)
        own = covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        # 99.99 % of chi-square with 6 degrees of freedom.
        assert error @ np.linalg.solve(own, error) < 27.9, (k, error)
        assert np.linalg.norm(error[:3]) < within_m


def assert_no_jump(found: LandmarkMap, old: LandmarkMap) -> None:
    """Assert that who flies on the old map takes this one, and what moves moves by its sigma."""
    sure = map_uncertainty(old)
    assert contradiction(old, sure, found) == ""
    for i, before in enumerate(old.keyframes):
        after = [k for k in found.keyframes if k.image_bytes == before.image_bytes]
        if not after:
            continue
        moved = before.world_from_body.local(after[0].world_from_body)
        own = sure.keyframe_covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        if own.any():
            assert moved @ np.linalg.solve(own, moved) < 27.9
        else:
            np.testing.assert_allclose(moved, np.zeros(6), atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_two_worlds_become_the_seniors(seed: int) -> None:
    """Its own distance is 1 % off, and its world is turned and somewhere else."""
    given = two(seed, errors_m=(0.0, 0.02 if seed else -0.02))
    found = given.merged()
    assert isinstance(found, LandmarkMap), found
    assert [k.drone_id for k in found.keyframes] == [1, 2, 3, 4, 5, 6]
    assert found.parent == found.world == b"senior  "
    assert len(found.distances) == 2
    n_common = len(given.senior.points_world) + len(given.junior.points_world)
    n_common -= len(found.points_world)
    assert n_common > 200
    assert found.pixel_noise_px == pytest.approx(NOISE_PX, rel=0.15)
    assert_right(found, given.scene, given.views, within_m=0.15)
    assert_no_jump(found, given.senior)
    (joined,) = found.joined
    assert (joined.revision, joined.world) == (b"junior  ", b"junior  ")
    # It takes the junior's own keyframes to where they are now.
    for before in given.junior.keyframes:
        now = next(k for k in found.keyframes if k.image_bytes == before.image_bytes)
        step = joined.world_from_other.of_pose(before.world_from_body).local(now.world_from_body)
        assert np.linalg.norm(step[:3]) < 0.05
        assert np.linalg.norm(step[3:]) < 0.005
    data = encode_map(found)
    assert encode_map(decode_map(data)) == data


def test_without_noise_the_merged_map_is_exact() -> None:
    given = two(3, errors_m=(0.0, 0.0), noise_px=0.0)
    found = given.merged()
    assert isinstance(found, LandmarkMap), found
    for keyframe, body in zip(found.keyframes, given.scene.bodies, strict=True):
        error = (world_from_scene() @ body).local(keyframe.world_from_body)
        assert np.linalg.norm(error) < 1e-3
    off = given.senior_from_junior.difference(found.joined[0].world_from_other)
    assert np.abs(off).max() < 1e-3


def test_a_similarity_is_as_uncertain_as_it_says() -> None:
    errors, covariances = [], []
    for seed in range(20, 30):
        given = two(seed)
        found = given.aligned(given.common())
        assert isinstance(found, Aligned), found
        errors.append(found.senior_from_junior.difference(given.senior_from_junior))
        covariances.append(found.covariance)
    # The mean of ten of 7 dimensions is below 11.2 with 99.9 %. Pixels of synthetic features
    # have no error in common, and show the same spot exactly: a map counts on both.
    values = nees(errors, np.array(covariances))
    assert 7.0 / 3.0 < values.mean() < 11.2
    assert values.max() < 24.3  # 99.9 %
    assert np.std([e[6] for e in errors]) > 0.002


def test_branches_of_one_map_are_merged_by_what_both_had() -> None:
    rng = np.random.default_rng(4)
    later = (
        at(-1.5, 5.0, 0.3, 2.0), at(-1.0, 7.5, -0.5, -3.0),
        at(-2.0, -4.5, 0.6, 4.0), at(-1.0, -6.0, 0.1, -2.0),
    )  # fmt: skip
    scene, views = flight(rng, FIRST + later, [1, 2, 3, 1, 2, 3, 3])
    first = decode_map(encode_map(first_map(scene, views)))
    parent = revision_of(encode_map(first))
    branches = []
    for new in (views[3:5], views[5:]):
        grown = extended(first, parent, new, features_in(views), OPTIONS)
        assert isinstance(grown, LandmarkMap), grown
        branches.append(decode_map(encode_map(grown)))
    senior, junior = branches
    assert senior.world == junior.world == parent
    found = merged(senior, b"senior  ", junior, b"junior  ", features_in(views), OPTIONS)
    assert isinstance(found, LandmarkMap), found
    names = sorted(k.image_bytes for k in found.keyframes)
    assert names == sorted(v.image_bytes for v in views)
    assert found.distances == senior.distances
    assert found.world == parent
    # What both had is there once.
    whole = {px.tobytes() for px in found.observed_px[np.isfinite(found.observed_px[:, 0, 0]), 0]}
    assert len(whole) == found.seen[:, 0].sum()
    assert len(found.points_world) > max(len(m.points_world) for m in branches)
    assert_right(found, scene, views, within_m=0.15)
    assert_no_jump(found, senior)
    (joined,) = found.joined
    assert joined.world == parent
    assert np.abs(Similarity.identity().difference(joined.world_from_other)).max() < 0.05


def test_in_one_world_only_those_are_compared_that_show_the_same() -> None:
    """What they find is what all would; who looks elsewhere is not even looked at."""
    given = two(2)
    there, junior = given.senior_from_junior, given.junior
    here = replace(
        junior,
        keyframes=tuple(
            replace(k, world_from_body=there.of_pose(k.world_from_body)) for k in junior.keyframes
        ),
        points_world=there.apply(junior.points_world),
    )
    first = given.senior.keyframes[0]
    away = replace(first, world_from_body=at(-1.0, 60.0), captured_at_ns=9, image_bytes=b"away")
    blind = np.full((len(given.senior.points_world), 1, 2), np.nan)
    senior = replace(
        given.senior,
        keyframes=(*given.senior.keyframes, away),
        observed_px=np.concatenate([given.senior.observed_px, blind], axis=1),
    )
    looked_at: list[bytes] = []

    def features_of(image_bytes: bytes, camera: Camera, detector: Detector) -> Features:
        looked_at.append(image_bytes)
        return features_in(given.views)(image_bytes, camera, detector)

    found_by = of_keyframes(features_of, OPTIONS.detectors)
    one, other = KeyframeLibrary(senior, found_by), KeyframeLibrary(here, found_by)
    few, everything = common_where_expected(senior, here, one, other), given.common()
    assert looked_at
    assert b"away" not in looked_at
    told = set(zip(everything.senior, everything.junior, strict=True))
    assert set(zip(few.senior, few.junior, strict=True)) <= told
    assert len(few.senior) > 0.7 * len(everything.senior) > 100


def test_a_map_that_is_not_where_its_world_says_is_compared_with_all() -> None:
    given = two(0)
    claims = replace(given.junior, parent=b"parent  ", world=b"senior  ")
    found = merged(
        given.senior, b"senior  ", claims, b"junior  ", features_in(given.views), OPTIONS
    )
    assert isinstance(found, LandmarkMap), found
    assert_right(found, given.scene, given.views, within_m=0.15)


def test_maps_of_different_places_are_not_merged() -> None:
    away = tuple(
        replace(pose, translation=pose.translation + np.array([0.0, 32.0, 0.0])) for pose in OTHERS
    )
    given = two(5, away)
    assert "landmarks in common, 20 needed" in reason(given.merged())


def test_landmarks_that_resemble_each_other_by_chance_are_no_place() -> None:
    given = two(6)
    common = given.common()
    mixed = replace(common, senior=np.random.default_rng(0).permutation(common.senior))
    assert "no place of the other map agrees with 20 of" in reason(given.aligned(mixed))


@pytest.mark.parametrize("wrong", [0.3, 0.7])
def test_wrong_pairs_among_the_right_ones_are_left_out(wrong: float) -> None:
    given = two(7)
    common = given.common()
    rng = np.random.default_rng(1)
    is_wrong = rng.random(len(common.senior)) < wrong
    shuffled = common.senior.copy()
    shuffled[is_wrong] = rng.permutation(len(given.senior.points_world))[: is_wrong.sum()]
    found = given.aligned(replace(common, senior=shuffled))
    assert isinstance(found, Aligned), found
    assert len(found.common.senior) < 1.1 * (~is_wrong).sum()
    error = found.senior_from_junior.difference(given.senior_from_junior)
    assert float(nees(error, found.covariance)[0]) < 24.3


def scaled(landmark_map: LandmarkMap, factor: float, sigma_m: float) -> LandmarkMap:
    return replace(
        landmark_map,
        keyframes=tuple(
            replace(
                k,
                world_from_body=Pose(
                    k.world_from_body.rotation, factor * k.world_from_body.translation
                ),
            )
            for k in landmark_map.keyframes
        ),
        points_world=factor * landmark_map.points_world,
        distances=tuple(
            replace(d, distance_m=factor * d.distance_m, sigma_m=sigma_m)
            for d in landmark_map.distances
        ),
    )


@pytest.mark.parametrize("sigma_m", [1e-4, 0.01, 0.15])
def test_a_map_of_another_scale_is_refused_however_sure_it_claims_to_be(sigma_m: float) -> None:
    given = two(8)
    hostile = replace(given, junior=scaled(given.junior, 1.3, sigma_m))
    assert "the scales contradict" in reason(hostile.merged())


def test_a_vague_scale_is_no_scale() -> None:
    given = two(8)
    hostile = replace(given, junior=scaled(given.junior, 1.3, 1.0))
    assert "tell the scale to" in reason(hostile.merged())


def test_a_tilted_world_is_refused() -> None:
    given = two(9)
    tilt = Pose(exp_so3(np.deg2rad([0.0, 40.0, 0.0])), np.zeros(3))
    keyframes = tuple(
        replace(k, world_from_body=tilt @ k.world_from_body) for k in given.junior.keyframes
    )
    points = tilt.apply(given.junior.points_world)
    tilted = replace(given.junior, keyframes=keyframes, points_world=points)
    assert "the verticals" in reason(replace(given, junior=tilted).merged())


def test_common_landmarks_along_a_line_tell_too_little() -> None:
    """A lamp post: how the maps are turned about it nothing says."""
    given = two(10)
    common = given.common()
    points, there = given.junior.points_world, given.senior_from_junior
    beside = (points - np.median(points, axis=0)) * [1.0, 1.0, 0.0]
    post = replace(given.junior, points_world=points - 0.95 * beside)
    ours = given.senior.points_world.copy()
    # What the senior's landmarks are off by they stay off by.
    moved = there.apply(post.points_world) - there.apply(points)
    ours[common.senior] += moved[common.junior]
    given = replace(given, senior=replace(given.senior, points_world=ours), junior=post)
    told = reason(given.aligned(common.of(np.arange(60))))
    assert "too close together or in a line" in told
    assert "common landmarks" in told


def test_the_same_thing_seen_in_two_places_is_no_place() -> None:
    """As many landmarks say that the other map is 6 m farther down the street."""
    given = two(11)
    common = given.common()
    senior = given.senior
    step = world_from_scene().rotation @ np.array([0.0, 6.0, 0.0])
    n = len(senior.points_world)
    double = replace(
        senior,
        points_world=np.concatenate([senior.points_world, senior.points_world + step]),
        observed_px=np.concatenate([senior.observed_px, senior.observed_px]),
    )
    both = Common(
        np.concatenate([common.senior, n + common.senior]),
        np.concatenate([common.junior, common.junior]),
        np.zeros(2 * len(common.senior), dtype=bool),
    )
    sure = map_uncertainty(senior)
    twice = replace(
        sure,
        landmark_covariance=np.concatenate([sure.landmark_covariance] * 2),
        landmark_lever=np.concatenate([sure.landmark_lever] * 2),
    )
    junior = Side(given.junior, map_uncertainty(given.junior))
    found = aligned(Side(double, twice), junior, both, OPTIONS, 0, one_world=False)
    assert "explain the landmarks alike" in reason(found)


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_a_map_stays_where_more_than_its_observations_has_put_it(seed: int) -> None:
    """Keyframes that are gone have made it: by what is left alone it would move by centimetres."""
    given = two(seed)
    rng = np.random.default_rng(seed)
    left = given.senior.observed_px + rng.normal(0.0, 0.5, given.senior.observed_px.shape)
    noise_px = float(np.hypot(given.senior.pixel_noise_px, 0.5))
    known = replace(given.senior, observed_px=left, pixel_noise_px=noise_px)
    found = replace(given, senior=known).merged()
    as_it_was = given.merged()
    assert isinstance(found, LandmarkMap), found
    assert isinstance(as_it_was, LandmarkMap), as_it_was
    for one, other in zip(found.keyframes[:3], as_it_was.keyframes[:3], strict=True):
        assert one.image_bytes == other.image_bytes
        apart = one.world_from_body.translation - other.world_from_body.translation
        assert np.linalg.norm(apart) < 0.003


def test_a_map_out_of_shape_does_not_bend_ours() -> None:
    given = two(12)
    y = given.junior.points_world @ given.junior.keyframes[0].world_from_body.rotation[:, 1]
    bent = given.junior.points_world.copy()
    bent += 0.03 * (y[:, None] ** 2) * given.junior.keyframes[0].world_from_body.rotation[:, 0]
    found = replace(given, junior=replace(given.junior, points_world=bent)).merged()
    if isinstance(found, LandmarkMap):  # adjusted together, it may have come right
        assert_no_jump(found, given.senior)
        assert_right(found, given.scene, given.views, within_m=0.2)


def test_features_that_are_none_of_theirs_are_refused() -> None:
    given = two(13)
    rng = np.random.default_rng(2)
    unknown = [
        replace(v, features=(Features(v.features[0].pixels, descriptors_of(rng, len(v.pixels))),))
        for v in given.views[3:]
    ]
    found = replace(given, views=[*given.views[:3], *unknown]).merged()
    assert "landmarks in common, 20 needed" in reason(found)


def test_what_needs_no_merging_is_told() -> None:
    given = two(14)
    features_of = features_in(given.views)
    itself = merged(given.senior, b"1" * 8, given.senior, b"1" * 8, features_of, OPTIONS)
    assert "not merged with itself" in reason(itself)
    large = replace(given.junior.keyframes[0].camera, width_px=8000, height_px=4000)
    wide = replace(
        given.junior, keyframes=tuple(replace(k, camera=large) for k in given.junior.keyframes)
    )
    pixels = merged(given.senior, b"1" * 8, wide, b"2" * 8, features_of, OPTIONS)
    assert "96000000 pixels, at most 80000000" in reason(pixels)
    many = replace(
        given.junior,
        keyframes=given.junior.keyframes * 13,
        observed_px=np.tile(given.junior.observed_px, (1, 13, 1)),
    )
    crowd = merged(given.senior, b"1" * 8, many, b"2" * 8, features_of, OPTIONS)
    assert "39 keyframes, at most 36" in reason(crowd)
    loose = replace(given.junior, distances=())
    unfixed = merged(given.senior, b"1" * 8, loose, b"2" * 8, features_of, OPTIONS)
    assert "the other map: the map's observations do not fix it" in reason(unfixed)


def test_what_the_other_map_says_is_in_it_is_not_carried_on() -> None:
    """Nothing shows it, of whatever world; who is named so would not be merged any more."""
    given = two(15, errors_m=(0.0, 0.0))
    wrong = Similarity(NORTH, np.array([50.0, 0.0, 0.0]), 2.0)
    known = Similarity(NORTH, np.array([1.0, 2.0, 3.0]), 1.02)
    junior = replace(
        given.junior,
        parent=b"someone ",
        world=b"theirs  ",
        joined=tuple(
            JoinedMap(b"of %b" % world[:5], world, wrong)
            for world in (b"strange ", b"known   ", OURS, b"theirs  ")
        ),
    )
    old = [JoinedMap(b"older %02d" % n, b"known   ", known) for n in range(16)]
    senior = replace(given.senior, parent=b"parent  ", world=OURS, joined=tuple(old))
    found = replace(given, senior=senior, junior=junior).merged()
    assert isinstance(found, LandmarkMap), found
    assert found.world == OURS
    assert [j.revision for j in found.joined] == [j.revision for j in old[1:]] + [b"junior  "]
    assert found.joined[-1].world == b"theirs  "
    joined = found.joined_with(b"known   ")
    assert joined is not None
    np.testing.assert_allclose(joined.world_from_other.difference(known), 0.0, atol=1e-9)


def test_who_flies_on_a_map_that_a_third_one_brought_is_named_when_it_offers_that() -> None:
    """All its keyframes are in ours already: nothing is new but where its world is."""
    given = two(15)
    both = given.merged()
    assert isinstance(both, LandmarkMap), both
    features_of = features_in([])  # none are needed: what both show at one pixel is the same
    brought = replace(both, joined=())
    found = merged(brought, b"brought ", given.junior, b"junior  ", features_of, OPTIONS)
    assert isinstance(found, LandmarkMap), found
    assert (found.parent, found.world) == (b"brought ", b"senior  ")
    assert found.keyframes == both.keyframes
    np.testing.assert_array_equal(found.points_world, both.points_world)
    (joined,) = found.joined
    assert (joined.revision, joined.world) == (b"junior  ", b"junior  ")
    off = joined.world_from_other.difference(both.joined[0].world_from_other)
    assert np.abs(off).max() < 0.02
    again = merged(found, b"named   ", given.junior, b"junior  ", features_of, OPTIONS)
    assert "in this one already" in reason(again)


def test_the_number_of_keyframes_is_bounded_and_the_newest_stay() -> None:
    given = two(16)
    found = given.merged(replace(OPTIONS, max_keyframes=4))
    assert isinstance(found, LandmarkMap), found
    assert len(found.keyframes) == 4
    assert {5, 6} <= {k.drone_id for k in found.keyframes}
    assert_right(found, given.scene, given.views, within_m=0.3)


def test_rendered_maps_of_two_pairs_are_tied_by_their_patches() -> None:
    options = MapOptions(detectors=("akaze",))
    scene = panels(np.random.default_rng(3))
    bodies = [at(0.0, 0.0), at(0.2, 1.5, -0.3), at(-0.6, 2.5, 0.2, 3.0), at(-1.2, 4.0, -0.2, -2.0)]
    views = [
        rendered_view(scene, 1 + k, 0, body, MOUNTING, options) for k, body in enumerate(bodies)
    ]
    maps = []
    for a in (0, 2):
        known = float(np.linalg.norm(bodies[a].translation - bodies[a + 1].translation))
        made = reconstruct(views[a : a + 2], a + 1, [(a + 1, a + 2, known)], options)
        assert isinstance(made, LandmarkMap), made
        maps.append(decode_map(encode_map(made)))
    found = merged(maps[0], b"senior  ", maps[1], b"junior  ", features_in(views), options)
    assert isinstance(found, LandmarkMap), found
    assert found.pixel_noise_px < 0.2
    covariance = map_uncertainty(found).keyframe_covariance
    for k, body in enumerate(bodies[1:], start=1):
        error = body.local(found.keyframes[k].world_from_body)
        own = covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        assert error @ np.linalg.solve(own, error) < 27.9, (k, error)
        assert np.linalg.norm(error[:3]) < 0.05
    assert (found.seen[:, :2].any(axis=1) & found.seen[:, 2:].any(axis=1)).sum() > 60
    assert_no_jump(found, maps[0])
    # It goes on like any other map.
    ahead = rendered_view(scene, 1, 9, at(-1.0, 3.2, 0.1), MOUNTING, options)
    grown = extend_map(found, b"merged  ", [ahead], options)
    assert isinstance(grown, LandmarkMap), grown
    assert grown.world == b"senior  "
    assert [j.revision for j in grown.joined] == [b"junior  "]
