"""Terrain from files: heights by hand, rays and physics against mj_ray, places to start, files that are none."""

import mujoco
import numpy as np
import pytest
import torch
from mj_rays import assert_rays_are_those_of_mj_ray
from PIL import Image

from omniperception.scene.map_terrain import (
    FloorPlanConfig,
    HeightMapConfig,
    PlaceConfig,
    StartsConfig,
    connected,
    free_places,
    read_image,
)
from omnirobot.common.errors import ConfigError

CELL = 0.1
BORDER = 10
"""Cells by which a map goes on around the file's."""
BLIND = ("perception=none", "lidar=none", "rewards=walk", "observations=walk", "obstacles=none")


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A working directory in which a test writes its files."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def slab(x, y, z):
    """Lines of OBJ of a box between corners, numbered from `first` on."""
    corners = [(a, b, c) for c in z for a, b in ((x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1]))]
    return corners, ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


def write_obj(path, *slabs, turn=lambda x, y, z: (x, y, z)):
    lines, first = [], 1
    for corners, sides in slabs:
        lines += ["v {} {} {}".format(*turn(*corner)) for corner in corners]
        lines += ["f " + " ".join(str(first + k) for k in side) for side in sides]
        first += len(corners)
    path.write_text("\n".join(lines) + "\n")


ROOM = (
    slab((1.0, 7.0), (2.0, 6.0), (-0.2, 0.0)),  # floor
    slab((1.0, 1.35), (2.0, 6.0), (0.0, 2.5)),  # a wall that goes on above the ceiling of the test
    slab((5.0, 6.0), (4.0, 4.5), (0.7, 0.75)),  # a table
    slab((1.0, 7.0), (2.0, 6.0), (2.5, 2.6)),  # a ceiling
)


def at(terrain, x, y):
    """Height (m) of the map at a point of the file's frame."""
    (heights, first), cell = terrain._map, terrain.cell
    return heights[round((y - first[1]) / cell), round((x - first[0]) / cell)]


def test_a_picture_lies_as_it_is_seen(files):
    pixels = np.full((41, 61), 255, np.uint8)
    pixels[0:3] = 0  # the top
    pixels[30:33, 50:53] = 0  # below the middle, to the right
    Image.fromarray(pixels).save("plan.png")
    plan = FloorPlanConfig("plan.png", CELL, wall_height=1.2)
    assert plan.height_map().shape == (41 + 2 * BORDER, 61 + 2 * BORDER)
    assert at(plan, 0.0, 2.0) == at(plan, 2.1, -1.1) == 1.2
    assert at(plan, 0.0, -2.0) == at(plan, -2.1, -1.1) == at(plan, 2.1, 1.1) == 0.0
    drawn = np.zeros((41, 61, 4), np.uint8)
    drawn[..., 3] = 255 - pixels  # black where there is wall, elsewhere nothing at all
    Image.fromarray(drawn).save("drawn.png")
    np.testing.assert_array_equal(FloorPlanConfig("drawn.png", CELL, wall_height=1.2).height_map(), plan.height_map())
    thick = np.pad(pixels, 60)  # more wall than floor
    Image.fromarray(thick).save("thick.png")
    walled = FloorPlanConfig("thick.png", CELL)
    assert all(walled.height_map()[row, col] == 0 for col, row in walled.places)
    Image.fromarray((np.arange(41 * 61).reshape(41, 61) * 20).astype(np.uint16)).save("grey.png")
    grey = HeightMapConfig("grey.png", CELL, heights=[-0.5, 1.5])
    assert at(grey, -3.0, 2.0) == pytest.approx(-0.5)
    assert at(grey, 3.0, -2.0) == pytest.approx(-0.5 + 2.0 * 2500 * 20 / 65535)
    rows = np.zeros((30, 40))
    rows[3, 35] = 0.3  # low y, high x
    np.save("rows.npy", rows)
    assert at(HeightMapConfig("rows.npy", CELL), (35 - 19.5) * CELL, (3 - 14.5) * CELL) == 0.3


@pytest.mark.parametrize("up", ["z", "y"])
def test_a_place_is_seen_from_above(files, up):
    turns = {"z": lambda x, y, z: (x, y, z), "y": lambda x, y, z: (x, z, -y)}
    write_obj(files / "room.obj", *ROOM, turn=turns[up])
    below = PlaceConfig("room.obj", 0.05, ceiling=2.0, up=up, outside=-0.4)
    assert at(below, 3.0, 3.0) == pytest.approx(0.0, abs=1e-6)
    assert at(below, 5.5, 4.2) == pytest.approx(0.75)
    assert at(below, 1.2, 4.0) == pytest.approx(2.0)  # within the wall, at the height where it is cut
    assert at(PlaceConfig("room.obj", 0.05, up=up), 3.0, 3.0) == pytest.approx(2.6)  # the roof
    larger = PlaceConfig("room.obj", 0.05, ceiling=4.0, scale=2.0, up=up)
    assert at(larger, 11.0, 8.4) == pytest.approx(1.5)


@pytest.mark.parametrize("inward", [True, False])
def test_a_room_of_single_faces_has_no_slab_for_a_ceiling(files, inward):
    """As scans have them: floor, walls and ceiling of one face each, and a table."""
    corners, sides = slab((0.0, 8.0), (0.0, 6.0), (0.0, 2.5))
    table = slab((5.0, 6.0), (4.0, 4.5), (0.0, 0.75))
    write_obj(files / "room.obj", (corners, [side[::-1] for side in sides] if inward else sides), table)
    room = PlaceConfig("room.obj", 0.05, ceiling=2.0)
    if not inward:  # a solid block, as it is written
        with pytest.raises(ValueError, match="no place"):
            room.places  # noqa: B018
        return
    assert at(room, 3.0, 3.0) == pytest.approx(0.0, abs=1e-6) and at(room, 5.5, 4.2) == pytest.approx(0.75)
    heights = room.height_map()
    assert all(heights[row, col] < 0.1 for col, row in room.places)


def test_a_place_on_its_side_is_refused(files):
    hall = slab((0.0, 8.0), (0.0, 6.0), (-0.1, 0.0)), slab((0.0, 0.1), (0.0, 6.0), (0.0, 2.6))
    write_obj(files / "stands.obj", *hall)
    write_obj(files / "lies.obj", *hall, turn=lambda x, y, z: (x, z, -y))
    with pytest.raises(ValueError, match=r"8\.0 x 2\.7 m and 6\.0 m high with its z up.*terrain\.up=y or"):
        PlaceConfig("lies.obj", 0.05).height_map()
    stands = PlaceConfig("stands.obj", 0.05).height_map()
    np.testing.assert_allclose(PlaceConfig("lies.obj", 0.05, up="y").height_map(), stands, atol=1e-6)
    assert PlaceConfig("lies.obj", 0.05, up="z").height_map().shape[0] < stands.shape[0]  # meant so
    trimesh = pytest.importorskip("trimesh")
    trimesh.load("lies.obj").export("lies.glb")  # as the format wants it
    trimesh.load("stands.obj").export("stands.glb")
    np.testing.assert_allclose(PlaceConfig("lies.glb", 0.05).height_map(), stands, atol=1e-6)
    with pytest.raises(ValueError, match=r"with its y up.*terrain\.up=z or"):
        PlaceConfig("stands.glb", 0.05).height_map()


def test_places_to_start_are_free(files):
    heights = np.zeros((60, 80))
    heights[:, 30:32] = 1.0  # a wall between a small room and a large one
    heights[40:56, 50:70] = 0.6  # a block with a top as level as the floor
    heights[10, 60] = 0.1  # a bump
    config = StartsConfig(num=10_000, radius=0.3, step=0.05, climb=0.2)
    col, row = free_places(heights, CELL, config).T
    expected = {
        (x, y)
        for y in range(13, 47)
        for x in range(13, 67)
        if np.ptp(heights[y - 3 : y + 4, x - 3 : x + 4]) == 0 and heights[y, x] == 0 and x > 31
    }
    assert set(zip(col.tolist(), row.tolist(), strict=True)) == expected
    col, _ = free_places(heights, CELL, config, near=(5, 5)).T
    assert len(col) and (col < 30).all()
    assert not len(free_places(heights, CELL, StartsConfig(radius=4.0)))
    assert len(np.unique(connected(heights, 0.2))) == 4  # two rooms, the wall's top and the block's
    assert len(np.unique(connected(heights, 2.0))) == 1


def flooded(heights, climb):
    """`connected`, point by point: each ground has the number of its first point, row by row."""
    number = np.full(heights.shape, -1)
    for start in np.ndindex(heights.shape):
        front = [start] if number[start] < 0 else []
        while front:
            at = front.pop()
            number[at] = start[0] * heights.shape[1] + start[1]
            beside = [(at[0] + dy, at[1] + dx) for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0))]
            inside = [to for to in beside if 0 <= to[0] < heights.shape[0] and 0 <= to[1] < heights.shape[1]]
            front += [to for to in inside if number[to] < 0 and abs(heights[to] - heights[at]) <= climb]
    return number


@pytest.mark.parametrize("climb", [0.0, 0.2, 0.45, 0.7, 1.0])
def test_ground_that_hangs_together_is_what_a_flood_reaches(climb):
    random = np.random.default_rng(0)
    for shape in ((1, 1), (1, 9), (9, 1), (2, 2), (17, 23), (30, 30)):
        heights = random.random(shape)
        assert np.array_equal(connected(heights, climb), flooded(heights, climb))


def test_rays_physics_and_heights_are_the_files(files, make_env):
    """A terrace on one side alone: whatever is turned, flipped or shifted is another place."""
    write_obj(files / "room.obj", *ROOM, slab((3.0, 5.0), (2.0, 3.0), (0.0, 0.1)))
    env = make_env("terrain=place", "terrain.file=room.obj", *BLIND, num_envs=3)
    assert len({tuple(pos) for pos in env.sim.ground_pos[:, :2].tolist()}) == 3  # each has its own place
    env.step(torch.zeros(3, 12))
    terrain, ground = env.config.terrain, env.ground
    first, middle = terrain._map[1], terrain.places[ground.level.numpy()]
    for k in range(3):
        origin = np.asarray(first) + terrain.cell * middle[k]  # of the environment, in the file's frame
        points = {(5.5, 4.2): 0.75, (4.0, 2.5): 0.1, (4.0, 4.0): 0.0, (1.2, 4.0): 2.0}
        away = torch.tensor(np.array(list(points)) - origin, dtype=torch.float32)
        level = float(at(terrain, *origin))
        expected = torch.tensor(list(points.values())) - level
        torch.testing.assert_close(ground.height(away[None], torch.tensor([k]))[0], expected, atol=1e-5, rtol=0)
    model, data = env.world.model, mujoco.MjData(env.world.model)
    data.qpos[2], data.mocap_pos[0] = 50.0, env.sim.ground_pos[0].numpy()
    mujoco.mj_forward(model, data)
    rng = np.random.default_rng(0)
    origins = np.array([0.0, 0.0, 1.0]) + rng.uniform(-0.2, 0.2, (2000, 3))
    geoms = assert_rays_are_those_of_mj_ray(env.world, data, origins, rng.normal(size=(2000, 3)) * [1, 1, 0.4])
    assert (geoms == model.geom("ground").id).sum() > 700
    down, geom = np.array([0.0, 0.0, -1.0]), np.zeros(1, np.int32)
    table = np.subtract((5.5, 4.2), np.asarray(first) + terrain.cell * middle[0])
    top = 5.0 - mujoco.mj_ray(model, data, np.array([*table, 5.0]), down, None, 1, -1, geom)
    assert top == pytest.approx(0.75 - float(at(terrain, *(np.asarray(first) + terrain.cell * middle[0]))), abs=1e-5)


@pytest.mark.parametrize("preset", ["plan", "heights", "place"])
def test_robots_stand_at_every_example_and_start_elsewhere(make_env, preset):
    env = make_env(f"terrain={preset}", "terminations.episode_length_s=0.1", *BLIND, num_envs=4)
    before = env.sim.ground_pos[:, :2].clone()
    for _ in range(5):
        env.step(torch.zeros(4, 12))
    assert not (env.sim.ground_pos[:, :2] == before).all()
    for _ in range(4):
        env.step(torch.zeros(4, 12))
    clearance = env.state.base_height
    assert (clearance > 0.2).all() and (clearance < 0.5).all()


PLAN, PLACE = ("terrain=plan",), ("terrain=place",)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ((*PLAN, "terrain.file=text.png"), "terrain.file=text.png is no picture that can be read"),
        (("terrain=heights", "terrain.file=empty.npy", "terrain.heights=null"), "empty.npy is no NumPy array"),
        ((*PLAN, "terrain.file=small.png"), "has 5 x 5 points 0.1 m apart; 11 x 11"),
        (
            (*PLAN, "terrain.file=black.png", "terrain.start.inside=[0.1,0.1]"),
            r"around terrain.start.inside=\[0.1, 0.1\], .* m high, nowhere is .* \(its heights: .*; name another point",
        ),
        ((*PLAN, "terrain.start.radius=0.4"), "robot.footing=0.35 .* give terrain.start.radius=0.5"),
        ((*PLAN, "commands.spawn.y=[-0.3,0.1]"), "spawn up to 0.3 m away.* give terrain.start.radius=0.8"),
        (("terrain=heights", "terrain.file=cube.npy", "terrain.heights=null"), r"holds \(2, 3, 4\); \(rows, cols\)"),
        ((*PLACE, "terrain.file=text.obj"), "terrain.file=text.obj|text.obj (cannot be read|holds no triangles)"),
        ((*PLACE, "terrain.scale=10000"), "too large for terrain.cell"),
        ((*PLACE, "terrain.start.inside=[90,0]"), r"terrain.start.inside=\[90.0, 0.0\] lies beside the map"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_in_one_line(files, make_env, overrides, message):
    root = __file__.rpartition("/tests/")[0]
    examples = {"plan": "example_plan.png", "heights": "example_heights.png", "place": "example_place.obj"}
    for name in ("text.png", "text.obj", "plan.jpg"):
        (files / name).write_text("no such thing")
    Image.fromarray(np.full((5, 5), 255, np.uint8)).save("small.png")
    Image.fromarray(np.full((60, 60), 0, np.uint8)).save("black.png")
    Image.new("1", (20_000, 20_000)).save("huge.png")
    (files / "empty.npy").write_bytes(b"")
    np.save("cube.npy", np.zeros((2, 3, 4)))
    preset = overrides[0].partition("=")[2]
    given = (overrides[0], f"terrain.file={root}/conf/terrain/{examples[preset]}", *overrides[1:])
    with pytest.raises((ConfigError, ValueError), match=message) as error:
        make_env(*given, *BLIND, num_envs=1)
    assert "\n" not in str(error.value)


def test_what_is_transparent_is_white_at_16_bits_too(tmp_path):
    values = np.full((4, 4), 30_000, np.uint16)
    values[0] = 0
    Image.fromarray(values).save(tmp_path / "deep.png", transparency=0)
    brightness = read_image(str(tmp_path / "deep.png"))
    assert (brightness[-1] == 1.0).all() and np.allclose(brightness[:-1], 30_000 / 65_535)
