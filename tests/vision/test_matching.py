import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.features import Features
from vcl_companion.vision.matching import (
    MatchOptions,
    match_guided,
    match_mutual,
    match_to_entries,
)

Bytes = NDArray[np.uint8]
N_BITS = 488
OPTIONS = MatchOptions()
NOBODY = Features(np.zeros((0, 2)), np.zeros((0, 61), np.uint8))


def akaze_like(rng: np.random.Generator, n: int) -> Bytes:
    return rng.integers(0, 256, (n, N_BITS // 8)).astype(np.uint8)


def flipped(rng: np.random.Generator, descriptors: Bytes, n_bits: int) -> Bytes:
    """Return descriptors of the same places, ``n_bits`` of each read differently."""
    bits = np.unpackbits(descriptors, axis=1)
    for row in bits:
        row[rng.choice(N_BITS, n_bits, replace=False)] ^= 1
    return np.packbits(bits, axis=1)


def features(descriptors: NDArray[np.generic], pixels: Array | None = None) -> Features:
    positions = np.zeros((len(descriptors), 2)) if pixels is None else pixels
    return Features(positions, descriptors)  # type: ignore[arg-type]


def sift_like(rng: np.random.Generator, n: int) -> NDArray[np.float32]:
    raw = np.abs(rng.standard_normal((n, 128))) + 1e-3
    return np.asarray(raw / np.linalg.norm(raw, axis=1, keepdims=True), dtype=np.float32)


def test_mutual_finds_every_place_seen_twice_and_no_other() -> None:
    rng = np.random.default_rng(1)
    places = akaze_like(rng, 60)
    shuffle = rng.permutation(40)
    a = features(np.vstack([places[:40], akaze_like(rng, 20)]))
    b = features(np.vstack([flipped(rng, places[:40], 30)[shuffle], akaze_like(rng, 25)]))
    i, k = match_mutual(a, b, OPTIONS)
    np.testing.assert_array_equal(np.sort(i), np.arange(40))
    np.testing.assert_array_equal(shuffle[k], i)


@given(st.integers(0, 2**32 - 1), st.integers(0, 30), st.integers(0, 30), st.floats(0.1, 1.0))
def test_mutual_is_one_to_one_and_keeps_its_rule(seed: int, n: int, m: int, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    # Few distinct bits, so that ties and near ties abound.
    a, b = (akaze_like(rng, k) & np.uint8(1) for k in (n, m))
    i, k = match_mutual(features(a), features(b), MatchOptions(ratio=ratio))
    assert len(set(i)) == len(i) == len(k) == len(set(k))
    distance = np.bitwise_count(a[:, None] ^ b[None]).sum(axis=2).astype(float)
    for one, other in zip(i, k, strict=True):
        assert distance[one, other] == distance[one].min() == distance[:, other].min()
        assert distance[one, other] < ratio * np.partition(distance[one], 1)[1]


def test_mutual_refuses_a_repeated_pattern() -> None:
    rng = np.random.default_rng(2)
    window = akaze_like(rng, 1)
    facade = features(np.vstack([flipped(rng, window.repeat(10, axis=0), 3), akaze_like(rng, 5)]))
    i, _ = match_mutual(features(np.vstack([window, akaze_like(rng, 5)])), facade, OPTIONS)
    assert 0 not in i


def test_floating_descriptors_match_by_euclidean_distance() -> None:
    rng = np.random.default_rng(3)
    places = sift_like(rng, 50)
    near = places + (0.01 * rng.standard_normal(places.shape)).astype(np.float32)
    for i, k in (
        match_mutual(features(places), features(near), OPTIONS),
        match_to_entries(features(places), features(near), np.arange(50), OPTIONS),
    ):
        np.testing.assert_array_equal(i, np.arange(50))
        np.testing.assert_array_equal(k, np.arange(50))


@pytest.mark.parametrize("n_entries", [1, 2, 3, 4, 5, 9])
def test_the_ratio_is_against_another_landmark(n_entries: int) -> None:
    # A landmark seen in many keyframes has many alike entries; they are not rivals.
    rng = np.random.default_rng(4)
    places = akaze_like(rng, 30)
    entries = np.vstack([flipped(rng, places, 20) for _ in range(n_entries)])
    found, landmarks = match_to_entries(
        features(flipped(rng, places, 20)), features(entries), np.tile(np.arange(30), n_entries),
        OPTIONS,
    )  # fmt: skip
    np.testing.assert_array_equal(found, np.arange(30))
    np.testing.assert_array_equal(landmarks, np.arange(30))


@pytest.mark.parametrize("n_entries", [1, 3])
def test_floats_are_compared_with_the_nearest_of_another_landmark(n_entries: int) -> None:
    rng = np.random.default_rng(6)
    places = sift_like(rng, 300)
    places[1] = places[0]  # two alike: both refused
    noise = 0.02 * rng.standard_normal((n_entries, *places.shape))
    entries = (places + noise).reshape(-1, places.shape[1]).astype(np.float32)
    order = rng.permutation(300)
    found, landmarks = match_to_entries(
        features(places[order]), features(entries), np.tile(np.arange(300), n_entries), OPTIONS
    )
    np.testing.assert_array_equal(order[found], landmarks)
    np.testing.assert_array_equal(np.sort(landmarks), np.arange(2, 300))


@pytest.mark.parametrize("n_entries", [1, 3, 4, 6])
def test_two_alike_landmarks_are_both_refused(n_entries: int) -> None:
    rng = np.random.default_rng(5)
    places = akaze_like(rng, 10)
    places[1] = flipped(rng, places[:1], 2)[0]
    entries = np.vstack([flipped(rng, places, 5) for _ in range(n_entries)])
    _, landmarks = match_to_entries(
        features(flipped(rng, places, 60)), features(entries), np.tile(np.arange(10), n_entries),
        OPTIONS,
    )  # fmt: skip
    np.testing.assert_array_equal(landmarks, np.arange(2, 10))


def test_of_several_features_the_closest_gets_the_landmark() -> None:
    rng = np.random.default_rng(6)
    places = akaze_like(rng, 8)
    image = np.vstack([flipped(rng, places[:1], 40), flipped(rng, places[:1], 10), places[1:]])
    found, landmarks = match_to_entries(features(image), features(places), np.arange(8), OPTIONS)
    assert len(set(landmarks)) == len(landmarks) == 8
    assert found[landmarks == 0] == 1


def test_a_map_of_one_landmark_needs_a_likeness() -> None:
    rng = np.random.default_rng(7)
    place = akaze_like(rng, 1)
    owner = np.zeros(3, np.intp)
    entries = features(flipped(rng, place.repeat(3, axis=0), 10))
    found, _ = match_to_entries(
        features(np.vstack([akaze_like(rng, 5), place])), entries, owner, OPTIONS
    )
    np.testing.assert_array_equal(found, [5])


def test_guided_looks_only_inside_its_radius() -> None:
    rng = np.random.default_rng(8)
    places = akaze_like(rng, 40)
    predicted = rng.uniform(0.0, 600.0, (40, 2))
    away = np.linspace(0.0, 20.0, 40)
    around = rng.uniform(0.0, 2.0 * np.pi, 40)
    pixels = predicted + away[:, None] * np.stack([np.cos(around), np.sin(around)], axis=1)
    found, landmarks = match_guided(
        features(places, pixels), features(places), np.arange(40), predicted, 10.0, OPTIONS
    )
    np.testing.assert_array_equal(found, np.flatnonzero(away <= 10.0))
    np.testing.assert_array_equal(found, landmarks)


def test_guided_takes_the_right_one_of_a_repeated_pattern() -> None:
    rng = np.random.default_rng(9)
    window = akaze_like(rng, 1)
    pixels = np.stack([np.arange(20) * 30.0, np.full(20, 100.0)], axis=1)
    image = features(flipped(rng, window.repeat(20, axis=0), 40), pixels)
    entries = features(flipped(rng, window.repeat(20, axis=0), 40))
    found, landmarks = match_guided(image, entries, np.arange(20), pixels + 3.0, 12.0, OPTIONS)
    np.testing.assert_array_equal(found, np.arange(20))
    np.testing.assert_array_equal(landmarks, np.arange(20))
    assert len(match_to_entries(image, entries, np.arange(20), OPTIONS)[0]) == 0


def test_guided_refuses_what_is_unlike_and_what_is_ambiguous() -> None:
    rng = np.random.default_rng(10)
    places = akaze_like(rng, 3)
    pixels = np.array([[0.0, 0.0], [100.0, 0.0], [102.0, 0.0]])
    image = features(
        np.vstack([akaze_like(rng, 1), flipped(rng, places[1:2].repeat(2, axis=0), 3)]), pixels
    )
    found, _ = match_guided(image, features(places[:2]), np.arange(2), pixels[:2], 8.0, OPTIONS)
    assert len(found) == 0


def test_guided_uses_every_entry_and_skips_what_cannot_be_seen() -> None:
    rng = np.random.default_rng(11)
    places = akaze_like(rng, 12)
    predicted = rng.uniform(0.0, 600.0, (12, 2))
    predicted[5] = np.nan
    entries = np.vstack([akaze_like(rng, 12), flipped(rng, places, 15)])  # the first ones changed
    pixels = np.nan_to_num(predicted)
    found, landmarks = match_guided(
        features(places, pixels), features(entries), np.tile(np.arange(12), 2), predicted, 6.0,
        OPTIONS,
    )  # fmt: skip
    np.testing.assert_array_equal(landmarks, np.delete(np.arange(12), 5))
    np.testing.assert_array_equal(found, landmarks)


@given(st.integers(0, 2**32 - 1), st.integers(1, 25), st.integers(1, 25))
def test_guided_and_whole_map_are_one_to_one(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    image = features(akaze_like(rng, n) & np.uint8(3), rng.uniform(0, 60, (n, 2)))
    entries = features(akaze_like(rng, m) & np.uint8(3))
    owner = rng.integers(0, 6, m).astype(np.intp)
    predicted = rng.uniform(0, 60, (6, 2))
    for found, landmarks in (
        match_guided(image, entries, owner, predicted, 30.0, MatchOptions(1.0, 1.0)),
        match_to_entries(image, entries, owner, MatchOptions(1.0, 1.0)),
    ):
        assert len(set(found)) == len(found) == len(landmarks) == len(set(landmarks))
        assert np.isin(landmarks, owner).all()


def test_nothing_matches_nothing() -> None:
    some = features(akaze_like(np.random.default_rng(12), 5), np.zeros((5, 2)))
    none = np.zeros(0, np.intp)
    blind = np.full((5, 2), np.nan)
    for i, k in (
        match_mutual(NOBODY, some, OPTIONS),
        match_mutual(some, NOBODY, OPTIONS),
        match_mutual(NOBODY, NOBODY, OPTIONS),
        match_to_entries(NOBODY, some, np.arange(5), OPTIONS),
        match_to_entries(some, NOBODY, none, OPTIONS),
        match_guided(NOBODY, some, np.arange(5), np.zeros((5, 2)), 9.0, OPTIONS),
        match_guided(some, NOBODY, none, np.zeros((5, 2)), 9.0, OPTIONS),
        match_guided(some, some, np.arange(5), blind, 9.0, OPTIONS),
        match_guided(some, some, np.arange(5), np.full((5, 2), 99.0), 9.0, OPTIONS),
    ):
        assert len(i) == len(k) == 0
        assert i.dtype == k.dtype == np.intp


@pytest.mark.parametrize("bad", [{"ratio": 0.0}, {"ratio": 1.1}, {"guided_ratio": float("nan")}])
def test_senseless_options_are_errors(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="match ratios"):
        MatchOptions(**bad)
