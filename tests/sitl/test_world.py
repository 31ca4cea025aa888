"""Rays, textures, boxes, shadows and towns."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.building import Building
from sitl.faces import Frame, Side, box
from sitl.street import Street
from sitl.sunlight import Sun, lit
from sitl.textures import Canvas, noise
from sitl.town import Clutter, Pavement, Town, build_town
from sitl.trees import Tree
from sitl.world import SKY, Surface, Texture, World
from vcl_companion.geometry.rotation import Array

GREY = Texture.from_image(np.full((4, 4), 128, dtype=np.uint8))
EAST, NORTH, DOWN = np.eye(3)[1], np.eye(3)[0], np.eye(3)[2]


def wall(
    north_m: float, left_m: float, size_m: float, holes: Array | None = None, name: str = ""
) -> Surface:
    """A square that faces south, its top left corner ``left_m`` east and ``size_m`` / 2 up."""
    corner = np.array([north_m, left_m, -size_m / 2])
    openings = np.zeros((0, 4)) if holes is None else holes
    return Surface(corner, EAST, DOWN, size_m, size_m, GREY, openings, name)


def plain(side: Side, width_m: float, height_m: float) -> Canvas:
    return np.full((max(2, round(8 * height_m)), max(2, round(8 * width_m))), 100.0, np.float32)


def test_a_ray_meets_the_nearest_surface_where_it_stands() -> None:
    world = World((wall(10.0, -5.0, 10.0), wall(6.0, 1.0, 2.0)), GREY)
    origin = np.array([0.0, 0.5, 0.0])
    rays = np.array([[1.0, 0.0, 0.0], [2.0, 0.3, 0.1], [1.0, 0.0, 3.0], [-1.0, 0.0, 0.0]])
    hits = world.intersect(origin, rays)
    assert hits.surface.tolist() == [0, 1, SKY, SKY]
    assert hits.distance[:2] == pytest.approx([10.0, 3.0])  # in lengths of the ray's direction
    assert np.all(np.isinf(hits.distance[2:]))
    assert hits.points_world[1] == pytest.approx([6.0, 1.4, 0.3])
    assert np.all(np.isnan(hits.points_world[2:]))


def test_a_hole_shows_what_is_behind_and_a_back_side_shows_nothing() -> None:
    hole = np.array([[4.0, 4.0, 6.0, 6.0]])
    world = World((wall(5.0, -5.0, 10.0, hole), wall(5.4, -5.0, 10.0)), GREY)
    rays = np.array([[1.0, 0.0, 0.0], [1.0, 0.19, 0.0], [1.0, 0.21, 0.0]])
    assert world.intersect(np.zeros(3), rays).surface.tolist() == [1, 1, 0]
    from_behind = world.intersect(np.array([9.0, 0.0, 0.0]), -rays)
    assert from_behind.surface.tolist() == [SKY, SKY, SKY]


def test_every_side_of_a_box_is_seen_from_its_own_side() -> None:
    """A viewer three metres from each side's middle meets that side, two metres off."""
    sides: tuple[Side, ...] = ("front", "left", "right", "top", "bottom", "back")
    front = Frame.facing(np.array([1.0, 2.0, -3.0]), np.deg2rad(145.0), 2.0, 2.0)
    surfaces = lit(box(front, (2.0, 2.0, 2.0), plain, "box", sides), Sun())
    world = World(surfaces, GREY)
    centre = front.point(1.0, 1.0, -1.0)
    out = {"front": -front.inward, "back": front.inward, "left": -front.right}
    out |= {"right": front.right, "top": -DOWN, "bottom": DOWN}
    for i, side in enumerate(sides):
        hits = world.intersect(centre + 3.0 * out[side], -out[side][None])
        assert hits.surface[0] == i, side
        assert surfaces[i].name == f"box {side}"
        assert hits.distance[0] == pytest.approx(2.0)
    assert front.right == pytest.approx(
        [np.sin(np.deg2rad(145.0)), -np.cos(np.deg2rad(145.0)), 0.0]
    )


def test_halved_textures_keep_their_mean_and_end_at_one_texel() -> None:
    image = np.random.default_rng(1).integers(0, 256, (37, 90)).astype(np.uint8)
    texture = Texture.from_image(image)
    assert texture.levels[0].shape == (37, 90)
    assert min(texture.levels[-1].shape) == 1
    for level in texture.levels[1:]:
        assert abs(float(level.mean()) - float(image.mean())) < 1.5
    with pytest.raises(ValueError, match="texels a side"):
        Texture.from_image(image[:1])
    with pytest.raises(ValueError, match="8-bit"):
        Texture.from_image(image.astype(np.float64))


def test_a_surface_refuses_axes_that_are_not_orthonormal() -> None:
    with pytest.raises(ValueError, match="orthonormal"):
        Surface(np.zeros(3), EAST, EAST + DOWN, 1.0, 1.0, GREY)
    with pytest.raises(ValueError, match="positive"):
        Surface(np.zeros(3), EAST, DOWN, 1.0, 0.0, GREY)


def test_noise_has_unit_spread_whatever_its_resolution() -> None:
    for texels_per_m in (8.0, 30.0, 64.0):
        drawn = noise(np.random.default_rng(3), (900, 700), texels_per_m, 2.0, 0.1)
        assert drawn.shape == (900, 700)
        assert abs(float(drawn.mean())) < 0.25
        assert 0.75 < float(drawn.std()) < 1.25


def test_a_shadow_falls_away_from_the_sun_and_is_as_long_as_it_must_be() -> None:
    """A pole 2 m high with the sun in the south at 45 degrees shades 2 m of ground north of it."""
    ground = Frame(np.array([5.0, -5.0, 0.0]), EAST, -NORTH)  # seen from above, north up
    floor = box(Frame(ground.origin, EAST, -NORTH), (10.0, 10.0, 1.0), plain, "floor", ("front",))
    pole = box(
        Frame.facing(np.zeros(3), np.pi, 0.5, 2.0),
        (0.5, 2.0, 0.5),
        plain,
        "pole",
        ("front", "left", "right", "top", "back"),
    )
    surface = lit([*floor, *pole], Sun(azimuth_deg=180.0, elevation_deg=45.0, strength=1.0))[0]
    image = surface.texture.levels[0].astype(float)
    sunlit, shaded = 105.0 * (1.0 + np.sqrt(0.5)), 105.0
    column = image[:, 40]  # due north and south of the pole, 8 texels a metre
    assert column[60:] == pytest.approx(sunlit, abs=1.5)  # south
    dark = np.flatnonzero(column < 0.5 * (sunlit + shaded))
    # The pole stands from 0 to 0.5 m north; its shadow ends 2 m beyond.
    assert 5.0 - dark.min() / 8.0 == pytest.approx(2.5, abs=0.2)
    assert column[dark.min() + 4 : dark.max() - 4] == pytest.approx(shaded, abs=1.5)
    assert image[:, 60] == pytest.approx(sunlit, abs=1.5)  # beside it


@pytest.mark.parametrize("bad", [{"elevation_deg": 0.0}, {"strength": -1.0}])
def test_a_sun_below_the_horizon_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="sun"):
        Sun(**bad)


SMALL = Town(
    seed=2,
    texels_per_m=16.0,
    ground_half_m=20.0,
    building=(
        Building(10.0, -4.0, 180.0, 6.0, height_m=7.0, style="ashlar", seed=5),
        Building(10.0, 4.0, 180.0, 6.0, height_m=7.0, style="ashlar", seed=5),
        Building(10.0, 14.0, 180.0, 6.0, height_m=7.0, style="ashlar"),
    ),
    pavement=(Pavement(7.0, 0.0, 4.0, 20.0),),
    clutter=(Clutter(6.0, 0.0, 2.0, 10.0, count=3),),
)


def test_a_town_is_the_same_every_time_and_another_with_another_seed() -> None:
    first, again = build_town(SMALL), build_town(SMALL)
    assert len(first.surfaces) == len(again.surfaces) > 100
    for a, b in zip(first.surfaces, again.surfaces, strict=True):
        assert np.array_equal(a.texture.levels[0], b.texture.levels[0])
        assert np.array_equal(a.corner, b.corner)
    other = build_town(Town(seed=3, texels_per_m=16.0, ground_half_m=20.0))
    assert not np.array_equal(
        first.surfaces[0].texture.levels[0], other.surfaces[0].texture.levels[0]
    )


def test_buildings_of_one_seed_repeat_and_others_do_not() -> None:
    town = Town(
        seed=2, texels_per_m=16.0, ground_half_m=20.0, building=SMALL.building, sun_strength=0.0
    )
    fronts = [s.texture.levels[0] for s in build_town(town).surfaces if s.name == "front"]
    assert np.array_equal(fronts[0], fronts[1])
    assert not np.array_equal(fronts[0], fronts[2])


def test_a_front_has_relief_in_front_of_and_behind_its_wall() -> None:
    world = build_town(SMALL)
    y, z = np.meshgrid(np.linspace(-6.9, -1.1, 80), np.linspace(-6.9, -0.2, 80))
    origin = np.array([-30.0, -4.0, -3.5])
    targets = np.stack([np.full(y.size, 10.0), y.ravel(), z.ravel()], axis=1)
    depth = world.intersect(origin, targets - origin).points_world[:, 0]
    behind = np.mean((depth > 10.1) & (depth < 10.6))
    before = np.mean(depth < 9.9)
    on_the_wall = np.mean(np.abs(depth - 10.0) < 1e-6)
    assert 0.05 < behind < 0.5
    assert 0.05 < before < 0.7
    assert 0.1 < on_the_wall < 0.8


def built_alone(building: Building) -> World:
    town = Town(
        seed=2, texels_per_m=12.0, ground_half_m=20.0, building=(building,), sun_strength=0.0
    )
    return build_town(town)


def test_a_gable_roof_closes_the_house_and_rises_to_its_ridge() -> None:
    """No ray from above or from beside passes between roof and gables into the house."""
    house = Building(10.0, 0.0, 180.0, 10.0, depth_m=8.0, height_m=6.0, roof="gable", roof_deg=45.0)
    world = built_alone(house)
    slopes = [s for s in world.surfaces if s.name in ("roof", "roof back")]
    for slope in slopes:
        assert slope.corner[2] == pytest.approx(-10.0)  # a ridge 4 m above the eaves
        assert slope.point(0.0, slope.height_m)[2] == pytest.approx(-6.0)
        assert slope.outward[2] == pytest.approx(-np.sqrt(0.5))
    # Whoever looks at a place just under the tiles or just inside a gable meets them first.
    x, y = np.meshgrid(np.linspace(10.2, 17.8, 40), np.linspace(-4.8, 4.8, 40))
    rise = np.minimum(x - 10.0, 18.0 - x)
    inside = np.stack([x.ravel(), y.ravel(), (-6.0 - rise + 0.15).ravel()], axis=1)
    for viewer in ([14.0, 0.0, -60.0], [-40.0, 0.0, -40.0], [14.0, 90.0, -20.0]):
        assert world.intersect(np.array(viewer), inside - viewer).distance.max() < 1.0
    x, up = np.meshgrid(np.linspace(10.2, 17.8, 40), np.linspace(0.1, 0.95, 30))
    for side in (-1.0, 1.0):
        height = 6.0 + up * np.minimum(x - 10.0, 18.0 - x)
        gable = np.stack([x, np.full_like(x, side * 4.95), -height], axis=-1).reshape(-1, 3)
        origin = np.array([14.0, side * 60.0, -8.0])
        assert world.intersect(origin, gable - origin).distance.max() < 1.0


def test_rich_sides_have_relief_and_plain_ones_do_not() -> None:
    rich = Building(10.0, 0.0, 180.0, 8.0, depth_m=8.0, height_m=8.0, rich_sides=("left",), seed=3)
    x, z = np.meshgrid(np.linspace(10.3, 17.7, 40), np.linspace(-7.5, -0.5, 40))
    spread = {}
    for name, side in (("left", -1.0), ("right", 1.0)):
        origin = np.array([14.0, side * 40.0, -4.0])
        targets = np.stack([x.ravel(), np.full(x.size, side * 4.0), z.ravel()], axis=1)
        met = built_alone(rich).intersect(origin, targets - origin).points_world[:, 1]
        spread[name] = float(np.mean(np.abs(np.abs(met) - 4.0) > 0.05))
    # The viewer of a front that looks south has west on the left.
    assert 0.2 < spread["left"] < 0.9
    assert spread["right"] < 0.02


def test_windows_that_are_alike_stand_evenly() -> None:
    """All openings of a block of flats are as wide as one another and as far apart."""
    holes = {}
    for alike in (0.0, 1.0):
        flats = Building(10.0, 0.0, 180.0, 16.0, height_m=8.0, alike=alike, bays=0, seed=3)
        front = next(s for s in built_alone(flats).surfaces if s.name == "front")
        holes[alike] = np.unique(np.round(front.holes[:, [0, 2]], 9), axis=0)
    widths = {alike: np.ptp(np.diff(h, axis=1)) for alike, h in holes.items()}
    steps = {alike: np.ptp(np.diff(h.mean(axis=1))) for alike, h in holes.items()}
    assert widths[1.0] == pytest.approx(0.0, abs=1e-6)
    assert steps[1.0] == pytest.approx(0.0, abs=1e-6)
    assert widths[0.0] > 0.1
    assert steps[0.0] > 0.1


def test_a_street_lies_between_its_kerbs_whichever_way_it_runs() -> None:
    for heading in np.deg2rad([0.0, 90.0, 215.0]):
        along = np.array([np.cos(heading), np.sin(heading), 0.0])
        right = np.array([-along[1], along[0], 0.0])
        start = np.array([2.0, -3.0, 0.0])
        end = start + 12.0 * along
        street = Street(
            start[0], start[1], end[0], end[1], road_m=6.0, parked=0.0, lamp_every_m=0.0
        )
        world = build_town(
            Town(texels_per_m=8.0, ground_half_m=30.0, sun_strength=0.0, street=(street,))
        )
        for out_m, height_m in ((0.0, 0.03), (2.9, 0.03), (3.1, 0.14), (5.4, 0.14), (5.6, 0.0)):
            for side in (-1.0, 1.0):
                above = start + 6.0 * along + side * out_m * right - np.array([0.0, 0.0, 5.0])
                met = world.intersect(above, DOWN[None]).points_world[0]
                assert -met[2] == pytest.approx(height_m, abs=1e-9)


def test_parked_cars_leave_crossings_free_and_a_tree_stands_where_it_was_planted() -> None:
    street = Street(0.0, 0.0, 40.0, 0.0, parked=1.0, lamp_every_m=0.0, crossings=(20.0,))
    tree = Tree(0.0, 20.0, height_m=7.0, crown_m=4.0)
    world = build_town(
        Town(texels_per_m=8.0, ground_half_m=45.0, sun_strength=0.0, street=(street,), tree=(tree,))
    )
    cars = [s for s in world.surfaces if s.name in ("car top", "van top")]
    middles = np.array([s.point(s.width_m / 2, s.height_m / 2)[:2] for s in cars])
    assert 8 <= len(cars) <= 10
    assert np.abs(middles[:, 0] - 20.0).min() > 3.5
    assert np.all((np.abs(middles[:, 1]) > 2.0) & (np.abs(middles[:, 1]) < 4.0))
    leaves = np.array(
        [s.point(s.width_m / 2, s.height_m / 2) for s in world.surfaces if s.name == "leaves"]
    )
    reach = np.linalg.norm(leaves - [0.0, 20.0, -5.0], axis=1)
    assert 0.9 < reach.min() < reach.max() <= 2.0 + 1e-9
