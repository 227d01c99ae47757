"""Height-field terrain: tiles by hand; surface, rays, spawns and obstacles against mj_ray; refused settings."""

import math
from functools import partial

import mujoco
import numpy as np
import pytest
import torch
from mj_rays import assert_rays_are_those_of_mj_ray, ray_scene

from omniperception.scene import TerrainCurriculumConfig, TiledTerrainConfig, build_world
from omniperception.scene.tiles import Rough, Slope, Stairs, Stones, TileGrid

HEIGHTS = "+observations.groups.privileged.terms.heights={}"
SMALL = ("terrain=mixed", "terrain.levels=3", "terrain.border=3.0", "terrain.curriculum=null")
"""A terrain of 30 x 86 m on which every episode starts anywhere."""
FREE = (*SMALL, "obstacles=none")
ALL_KINDS = {
    "rough": Rough([0.02, 0.1]),
    "slope": Slope([5.0, 25.0]),
    "pit": Slope([5.0, 25.0], rises=False),
    "stairs": Stairs([0.05, 0.17]),
    "stones": Stones([0.05, 0.15]),
}
GRID = TileGrid(half=8, platform=2, cell=0.1)
TERRAIN = partial(TiledTerrainConfig, tiles=ALL_KINDS)


def looking_down(env, env_id, xy):
    """mj_ray's height (m) of the ground below points (P, 2) of one environment, the robot out of the way."""
    model, data = env.world.model, mujoco.MjData(env.world.model)
    data.qpos[:] = env.sim.qpos[env_id]
    data.qpos[2] += 1000.0
    data.mocap_pos[0] = env.sim.ground_pos[env_id]
    data.mocap_pos[1:, 2] = -1000.0
    mujoco.mj_forward(model, data)
    geom, start, down = np.zeros(1, np.int32), np.array([0.0, 0.0, 10.0]), np.array([0.0, 0.0, -1.0])
    heights = []
    for start[:2] in np.asarray(xy, np.float64):
        heights.append(10.0 - mujoco.mj_ray(model, data, start, down, None, 1, -1, geom))
        assert model.geom(int(geom[0])).name == "ground"
    return np.array(heights)


class TestTiles:
    def test_stairs_by_hand(self):
        """0.8 m from edge to middle, platform of 0.2 m to each side, two cells to a step: three steps of 0.1 m."""
        up = Stairs([0.0, 0.1], tread=0.2).heights(GRID, 1.0, None)
        expected = np.array([0, 0, 1, 1, 2, 2, 3, 3, 3, 3, 3, 2, 2, 1, 1, 0, 0]) * 0.1
        np.testing.assert_allclose(up[8], expected)
        np.testing.assert_allclose(up, up.T)
        np.testing.assert_allclose(up[3], np.minimum(expected, 0.1))
        np.testing.assert_allclose(Stairs([0.0, 0.1], tread=0.2, rises=False).heights(GRID, 0.5, None), -0.5 * up)

    def test_slopes_by_hand(self):
        pit = Slope([0.0, 45.0], rises=False).heights(GRID, 1.0, None)
        np.testing.assert_allclose(
            pit[8], [-0.0, *(-0.1 * np.arange(1, 6)), *[-0.6] * 5, *(-0.1 * np.arange(5, -1, -1))]
        )
        easy = Slope([10.0, 30.0]).heights(GRID, 0.25, None)
        assert easy[8, 1] == pytest.approx(0.1 * math.tan(math.radians(15)))

    @pytest.mark.parametrize(
        ("tile", "lowest", "highest"), [(Rough([0.0, 0.1]), -0.05, 0.05), (Stones([0.0, 0.15], count=3.0), -0.15, 0.15)]
    )
    def test_noise_and_stones_keep_their_heights(self, tile, lowest, highest):
        grid = TileGrid(40, 10, 0.1)
        heights = tile.heights(grid, 1.0, np.random.default_rng(0))
        assert lowest <= heights.min() < 0.9 * lowest and 0.9 * highest < heights.max() <= highest
        half = tile.heights(grid, 0.5, np.random.default_rng(0))
        np.testing.assert_allclose(half, heights / 2)

    @pytest.mark.parametrize("name", ALL_KINDS)
    def test_edges_lie_at_0_and_the_platform_is_flat(self, name):
        heights = ALL_KINDS[name].heights(TileGrid(40, 10, 0.1), 1.0, np.random.default_rng(0))
        inner = np.pad(np.ones((79, 79), dtype=bool), 1)
        assert (heights[~inner] == 0).all() and np.ptp(heights[30:51, 30:51]) == 0 and np.ptp(heights) > 0.05


class TestLayout:
    def test_the_seed_decides_the_terrain(self):
        first, again, other = (TiledTerrainConfig(ALL_KINDS, levels=2, seed=seed).height_map() for seed in (0, 0, 1))
        assert (first == again).all() and (first != other).any()

    def test_levels_get_harder_along_x_and_kinds_follow_their_shares_along_y(self):
        tiles = {"stairs": Stairs([0.1, 0.2], share=3.0), "slope": Slope([10.0, 20.0])}
        terrain = TiledTerrainConfig(tiles, levels=3, columns=4, border=2.0, difficulty=[0.0, 0.5])
        assert terrain.column_kinds() == ("stairs", "stairs", "stairs", "slope")
        heights = terrain.height_map()
        assert heights.shape == (4 * 80 + 41, 3 * 80 + 41)
        middles = heights[60::80, 60::80][:4, :3]
        np.testing.assert_allclose(middles[2], np.array([0.1, 0.125, 0.15]) * 10)  # ten steps of 3 cells in 3 m
        np.testing.assert_allclose(middles[3], 3 * np.tan(np.radians([10.0, 12.5, 15.0])))
        assert (heights[:20] == 0).all() and (heights[:, -20:] == 0).all()

    @pytest.mark.parametrize(
        ("make", "settings", "named"),
        [
            (TERRAIN, {"cell": 0.3}, "terrain.tile_size=8.0 must be an even number of cells"),
            (TERRAIN, {"columns": 4}, "terrain.columns=4 leaves none to"),
            (TERRAIN, {"curriculum": TerrainCurriculumConfig(10)}, "curriculum.start_level=10 must be below"),
            (TerrainCurriculumConfig, {"down_share": 0.9}, "terrain.curriculum.down_share=0.9"),
            (Slope, {"angle_deg": [5.0, 70.0]}, "angle_deg=[5.0, 70.0]"),
        ],
    )
    def test_wrong_settings_are_refused_in_one_line(self, make, settings, named):
        with pytest.raises(ValueError) as error:
            make(**settings)
        assert named in str(error.value) and "\n" not in str(error.value)


@pytest.fixture(scope="module")
def env(make_env):
    """Twenty environments, two on each column, on levels of their own."""
    env = make_env(*FREE, num_envs=20, blind=True)
    assert len(env.ground.level.unique()) == 3 and len(env.ground.column.unique()) == 10
    return env


class TestSurface:
    def test_collisions_divide_cells_along_the_diagonal_that_rays_do(self):
        """A cell with corners 0, 1, 1, 0: a valley along the diagonal from (0, 0) to (1, 1), or a ridge across it."""
        spec = mujoco.MjSpec()
        spec.add_hfield(name="saddle", size=[0.5, 0.5, 1.0, 0.1], nrow=2, ncol=2, userdata=[0.0, 1.0, 1.0, 0.0])
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="saddle")
        ball = spec.worldbody.add_body()
        ball.add_freejoint()
        ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.05, 0, 0])
        model = spec.compile()
        data, geom = mujoco.MjData(model), np.zeros(1, np.int32)
        for z, touches in ((0.3, False), (0.07, True)):  # the valley's sides are 0.07 sqrt(1/3) = 0.04 m away
            data.qpos[2] = z
            mujoco.mj_forward(model, data)
            assert (data.ncon > 0) == touches
        down = mujoco.mj_ray(model, data, np.array([0.0, 0.0, 2.0]), np.array([0.0, 0.0, -1.0]), None, 1, 1, geom)
        assert down == pytest.approx(2.0)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_heights_are_those_that_mj_ray_hits(self, env, dtype):
        generator = torch.Generator().manual_seed(0)
        xy = (torch.rand(20, 200, 2, generator=generator, dtype=dtype) - 0.5) * 12.0
        xy[:, 0] = 0.0
        heights = env.ground.height(xy)
        assert (heights[:, 0] == 0).all() and heights.abs().max() > 1.0
        env_ids = torch.tensor([7, 3])
        assert torch.equal(env.ground.height(xy[env_ids], env_ids), heights[env_ids])
        outside = 0
        for i in range(20):
            on_terrain = ((xy[i].double() - env.sim.ground_pos[i, :2]).abs() < env.ground._half).all(-1)
            outside += int((~on_terrain).sum())
            expected = looking_down(env, i, xy[i][on_terrain])
            np.testing.assert_allclose(heights[i][on_terrain], expected, atol=2e-5)
        assert outside < 400

    def test_heights_are_those_of_two_triangles_to_a_cell_in_float64(self, env):
        """A plane through the three corners, solved for each point, also beyond the edge, where the edge goes on."""
        rng = np.random.default_rng(2)
        xy = rng.uniform(-60.0, 60.0, (20, 100, 2))
        data = env.world.model.hfield_data.astype(np.float64).reshape(env.ground._rows, env.ground._cols)
        geom = env.world.model.geom("ground")
        z = (data * env.world.model.hfield_size[0, 2] + geom.pos[2]).astype(np.float32)
        half, cell = env.world.model.hfield_size[0, :2], env.config.terrain.cell
        heights, expected = env.ground.height(torch.tensor(xy)).numpy(), np.zeros((20, 100))
        for i, origin in enumerate(env.sim.ground_pos.numpy()):
            for k, (x, y) in enumerate((xy[i] - origin[:2] + half) / cell):
                x, y = np.clip(x, 0, z.shape[1] - 1), np.clip(y, 0, z.shape[0] - 1)
                a, b = min(int(x), z.shape[1] - 2), min(int(y), z.shape[0] - 2)
                third = (a + 1, b) if x - a >= y - b else (a, b + 1)
                corners = np.array([(a, b), (a + 1, b + 1), third])
                lines = np.column_stack((corners, np.ones(3)))
                expected[i, k] = np.linalg.solve(lines, z[corners[:, 1], corners[:, 0]]) @ (x, y, 1) + origin[2]
        np.testing.assert_allclose(heights, expected, atol=1e-6)  # the cells of 0.1 m are not those of linspace
        assert (np.abs(xy) > 45).any() and np.ptp(expected) > 1.0

    def test_points_that_are_no_numbers_do_no_harm(self, env):
        xy = torch.tensor([[math.nan, 0.0], [math.inf, -math.inf], [1e30, -1e30]]).expand(20, 3, 2)
        assert env.ground.height(xy)[:, 1:].isfinite().all()
        assert env.ground.height(xy[:, :0]).shape == (20, 0) and env.ground.height(xy[:0]).shape == (0, 3)

    def test_the_height_grid_is_the_robots_view_of_them(self, make_env):
        env = make_env(*FREE, "commands.spawn.x=[2.5,2.5]", HEIGHTS, num_envs=10, blind=True)
        env.step(0.3 * torch.ones(10, 12))
        k = env.state.kinematics
        for i in range(10):
            yaw = float(k.yaw[i])
            points = [(0.1 * (a - 8), 0.1 * (b - 5)) for a in range(17) for b in range(11)]
            turned = [(math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y) for x, y in points]
            below = looking_down(env, i, np.array(turned) + k.base_pos_w[i, :2].numpy())
            expected = np.clip(float(k.base_pos_w[i, 2]) - below, -1, 1)
            np.testing.assert_allclose(env.state.heights[i], expected, atol=5e-5)
        assert (env.state.heights.amax(1) - env.state.heights.amin(1)).max() > 0.02

    def test_rays_hit_the_surface_that_mj_ray_hits(self, make_config):
        run = make_config(*SMALL, "obstacles=mixed", "obstacles.groups.walker.count=1")
        world = build_world(run.env.robot, run.env.terrain, run.env.obstacles)
        data, rng = mujoco.MjData(world.model), np.random.default_rng(0)
        data.qpos[:3] = 0.0, 0.0, 0.3
        data.mocap_pos[:] = rng.uniform([-3, -3, 0], [3, 3, 1], (world.model.nmocap, 3))
        data.mocap_pos[0] = 8.0, -27.0, -0.2
        mujoco.mj_forward(world.model, data)
        origins = rng.uniform([-4, -4, 1.2], [4, 4, 2.5], (2000, 3))
        directions = rng.normal(size=(2000, 3)) * [1, 1, 0.3]
        geoms = assert_rays_are_those_of_mj_ray(world, data, origins, directions)
        assert (geoms == world.model.geom("ground").id).sum() > 500

    def test_seams_between_tiles_have_no_gap(self, make_config):
        """Rays straight down on the lines where tiles meet, and around them, all end at the ground near height 0."""
        run = make_config(*SMALL)
        world = build_world(run.env.robot, run.env.terrain, run.env.obstacles)
        data = mujoco.MjData(world.model)
        data.qpos[2], data.mocap_pos[:, 2], data.mocap_pos[world.ground_mocap] = -50.0, -50.0, 0.0
        mujoco.mj_kinematics(world.model, data)
        scene = ray_scene(world, data)
        along = np.linspace(-11.9, 11.9, 500)
        points = [(x, y) for x in along for y in (-32.0, -8.0, 0.0, 24.0)]
        points += [(x, 3 * y) for x in (-12.0, -4.0, 4.0, 12.0) for y in along]
        origins = torch.tensor([(x, y, 5.0) for x, y in points])[None]
        hits = scene.cast(origins, torch.tensor([0.0, 0.0, -1.0]).expand_as(origins))
        torch.testing.assert_close(hits.ranges, torch.full_like(hits.ranges, 5.0), atol=2e-5, rtol=0)
        aslant = torch.tensor([0.3, 0.2, -1.0]).expand_as(origins)
        assert scene.cast(origins - 4.0 * aslant, aslant).ranges.isfinite().all()

    def test_the_base_is_as_high_as_it_is_above_the_ground(self, env):
        """On a slope, base z in the environment's frame says nothing; a low base falls wherever it is."""
        column = env.ground.kinds.index("slope_up")
        i = int((env.ground.column == column).nonzero()[0])
        at = torch.tensor([2.5, 0.0])
        height = looking_down(env, i, at[None])[0]
        assert height < -0.05
        before = env.sim.qpos.clone()
        for above, falls in ((0.30, False), (0.10, True)):
            env.sim.qpos[i, :2], env.sim.qpos[i, 2] = at.double(), height + above
            env.sim.qvel[i] = 0.0
            env.state.invalidate()
            assert env.state.base_height[i].item() == pytest.approx(above, abs=1e-3)
            env._terminate()
            assert bool(env.done[i]) == falls
        env.sim.qpos.copy_(before)
        env.state.invalidate()

    def test_feet_are_as_high_as_they_are_above_the_ground_below_each(self, env):
        before = env.sim.qpos.clone()
        env.sim.qpos[:, 0] += 2.5  # off the middle of the tile, where it is level
        env.state.invalidate()
        height, feet = env.state.foot_height, env.state.foot_pos_w
        for i in range(0, env.num_envs, 3):
            below = torch.tensor(looking_down(env, i, feet[i, :, :2]), dtype=torch.float32)
            torch.testing.assert_close(height[i], feet[i, :, 2] - below, atol=1e-4, rtol=0)
        assert (feet[..., 2] - height).abs().max() > 0.05
        env.sim.qpos[:] = before
        env.state.invalidate()

    def test_heights_far_from_the_middle_are_not_rounded(self, env):
        """Every environment counts from its own tile: float32 leaves 1e-6 m at 4 m, however far off the tile lies."""
        assert env.sim.ground_pos[:, 1].abs().max() > 30.0
        xy = torch.rand(20, 500, 2, generator=torch.Generator().manual_seed(1)) * 8 - 4
        assert (env.ground.height(xy) - env.ground.height(xy.double())).abs().max() < 5e-6


class TestSupervision:
    def test_heights_are_those_of_the_newest_frame(self, make_env):
        """The base's height at the LiDAR's ticks, held until the next; where a term reads them, of the moment."""
        for terms, fresh in (((), False), ((HEIGHTS,), True)):
            env = make_env(*SMALL, "obstacles=mixed", "perception=proximity_gru", *terms, num_envs=3)
            env.obstacles.level = 1.0
            at_tick = None
            for step in range(1, 13):
                height = env.step(0.5 * torch.ones(3, 12))[0]["height_target"]
                if step % env.sensing.period_steps == 0:
                    at_tick = env.state.heights
                if at_tick is not None:
                    expected = env.state.heights if fresh else at_tick
                    assert torch.equal(height, expected), (step, fresh)
            assert not torch.equal(env.state.heights, at_tick) and env.episode_length_buf.min() == 12


class TestRobots:
    @pytest.mark.parametrize("spread", [0.0, 3.0])
    def test_start_on_the_surface(self, make_env, spread):
        """On the platform the feet start 0 to 2 cm above it; nowhere does anything touch the ground."""
        spawn = [f"commands.spawn.{axis}=[{-spread},{spread}]" for axis in "xy"]
        env = make_env(*FREE, *spawn, num_envs=40, blind=True)
        model, data = env.world.model, mujoco.MjData(env.world.model)
        feet = [model.geom(name).id for name in env.robot.foot_geoms]
        radius = model.geom_size[feet[0], 0]
        for i in range(40):
            data.qpos[:], data.mocap_pos[0] = env.sim.qpos[i], env.sim.ground_pos[i]
            mujoco.mj_forward(model, data)
            assert data.ncon == 0
            below = env.ground.height(torch.tensor(data.geom_xpos[feet, :2])[None], torch.tensor([i]))[0].numpy()
            gap = data.geom_xpos[feet, 2] - radius - below
            assert gap.min() >= 0 and (spread > 0 or gap.max() < 0.02)

    def test_stand_on_it(self, make_env):
        env = make_env(*FREE, num_envs=10, blind=True)
        flat = make_env("obstacles=none", num_envs=1, blind=True)
        for _ in range(50):
            env.step(torch.zeros(10, 12))
            flat.step(torch.zeros(1, 12))
        torch.testing.assert_close(env.state.base_height, flat.state.base_height.expand(10), atol=5e-3, rtol=0)

    def test_at_the_outer_border_the_episode_times_out(self, make_env):
        env = make_env(*FREE, num_envs=4, blind=True)
        to_edge = float(env.ground._half[0] + env.sim.ground_pos[1, 0])
        for i, gap in ((1, 0.9), (2, 1.1)):
            env.sim.qpos[i, :2] = torch.tensor([env.ground._half[0] + env.sim.ground_pos[i, 0] - gap, 0.0])
            env.sim.qpos[i, 2] += env.ground.height(env.sim.qpos[:, None, :2])[i, 0]
        assert to_edge > 6.0
        _, _, done, extras = env.step(torch.zeros(4, 12))
        assert done.tolist() == [0, 1, 0, 0] and extras["time_outs"].tolist() == [0, 1, 0, 0]
        assert env.sim.qpos[1, :2].abs().max() < 0.1


class TestObstacles:
    @pytest.mark.parametrize("preset", ["mixed", "moving", "static", "corridor"])
    def test_stand_on_the_ground_where_they_are_and_not_on_the_robot(self, make_env, preset):
        env = make_env(*SMALL, f"obstacles={preset}", num_envs=10, blind=True)
        field = env.obstacles
        groups = [own.group for own in field.config.obstacles()]  # each has one part
        half, bottom = field.half_height, torch.tensor([group.bottom[0] for group in groups])
        off = field.pos_w[..., :2] - env.sim.qpos[:, None, :2]
        placed = [k for k, group in enumerate(groups) if group.poses is None]
        assert (off.norm(dim=-1) - field.radius)[:, placed].min() >= field.config.clearance - 1e-6
        for _ in range(2):
            for i in range(10):
                inside = ((field.pos_w[i, :, :2] - env.sim.ground_pos[i, :2]).abs() < env.ground._half).all(-1)
                ground = looking_down(env, i, field.pos_w[i, inside, :2])
                np.testing.assert_allclose(
                    field.pos_w[i, inside, 2] - half[i, inside] - bottom[inside], ground, atol=1e-5
                )
            before = env.sim.ground_pos.clone()
            for _ in range(25):
                env.step(torch.zeros(10, 12))
        assert torch.equal(env.sim.ground_pos, before)
        assert (field.bottom_above_ground() - bottom).abs().max() < 1e-6

    def test_follow_the_ground_at_every_physics_step(self, make_env):
        env = make_env(*SMALL, "obstacles=moving", num_envs=4, blind=True)
        field = env.obstacles
        half = field.half_height
        before = field.pos_w[..., :2].clone()
        path, turn = field.travel(0.05, 6, env.sim.qpos[:, :2])
        assert (
            torch.equal(path[:, -1], field.pos_w)
            and field.travel(0.05, 6, env.sim.qpos[:, :2])[0] is path
            and turn is None
        )
        assert path.shape == (4, 6, field.pos_w.shape[1], 3) and (field.pos_w[..., :2] - before).abs().max() > 0.5
        for i in range(4):
            for step in range(6):
                inside = ((path[i, step, :, :2] - env.sim.ground_pos[i, :2]).abs() < env.ground._half).all(-1)
                ground = looking_down(env, i, path[i, step, inside, :2])
                np.testing.assert_allclose(path[i, step, inside, 2] - half[i, inside], ground, atol=1e-5)
        field.level = 0.0  # parked ones stay below the ground
        env._reset(torch.arange(4))
        env.step(torch.zeros(4, 12))
        assert (field.pos_w[..., 2] == -100.0).all()
