"""Obstacles by sector against rays through outlines, by hand and by search, and what the task makes of them."""

import math

import pytest
import torch

from omniperception.avoidance.sector_motion import encode
from omniperception.avoidance.true_sectors import TrueSectors
from omniperception.common.random import EnvRandom
from omniperception.env.env import OmniEnv
from omniperception.scene import ObstacleField, ObstacleGroup, ObstaclesConfig
from omniperception.scene.rays import ray_shapes

POST = ObstacleGroup("cylinder", 1, [[0.5, 0.5], [0.5, 0.5]])
SOUTH_EAST, EAST, NORTH = 1, 2, 3  # of four sectors that begin at -180, -90, 0 and 90 degrees: EAST is 0 to 90 degrees
CPU = torch.device("cpu")


class Scene:
    """Robots at a pose and obstacles that a test places."""

    def __init__(self, groups, base=(0.0, 0.0), yaw=0.0, num_envs=1):
        self.config, self.num_envs = ObstaclesConfig(groups), num_envs
        count = len(self.config.parts())
        pos, quat = (torch.zeros(num_envs, count, n, dtype=torch.float64) for n in (3, 4))
        self.field = ObstacleField(self.config, pos, quat, EnvRandom(0, num_envs))
        self.field.reset(torch.arange(num_envs), torch.full((num_envs, 2), 100.0))
        place = torch.tensor([[*base, 0.3]]).expand(num_envs, 3)
        self.base_pos_w, self.yaw = place, torch.full((num_envs,), yaw)

    def measure(self, num_sectors, known=None):
        sectors = TrueSectors(num_sectors, self.config, self.field, self.num_envs, CPU)
        return sectors.measure(self.base_pos_w, self.yaw, known)


def test_a_circle_by_hand():
    scene = Scene({"post": POST}, base=(1.0, 1.0))
    scene.field.pos_w[0, 0] = torch.tensor([4.0, 5.0, 0.5])  # 3 m and 4 m off: 5 m away, its edge at 4.5 m
    distance = scene.measure(4)[0, :, 0]
    assert distance[EAST].item() == pytest.approx(4.5) and distance.isinf().tolist() == [True, True, False, True]


def test_sectors_and_velocities_turn_with_the_robot():
    scene = Scene({"post": POST}, yaw=-math.pi / 2)
    scene.field.pos_w[0, 0] = torch.tensor([3.0, 4.0, 0.5])
    scene.field.velocity_w[0, 0] = torch.tensor([0.0, 1.5])  # in the world; backwards for a robot turned by -90 degrees
    assert scene.measure(4)[0, NORTH].tolist() == pytest.approx([4.5, -1.5, 0.0], abs=1e-6)


def test_a_wall_is_as_far_as_along_the_sectors_middle_and_its_nearest_point_counts():
    wall = ObstacleGroup("box", 1, [[0.1, 0.1], [3.0, 3.0], [0.5, 0.5]], poses=[[2.1, 0.0, 0.0]])
    distance = Scene({"wall": wall}).measure(8)[0, :, 0]  # its face at x = 2, y from -3 to 3
    along = 2.0 / math.cos(math.radians(22.5))
    assert distance[3:5].tolist() == pytest.approx([along, 2.0])  # the nearest point is at 0 degrees
    assert distance[[0, 1, 2, 5, 6, 7]].isinf().all()  # middles at 67.5 degrees and more pass it


@pytest.mark.parametrize(
    ("radius", "distance", "bearing_deg", "sectors"),
    [
        (0.4, math.hypot(2.0, 0.3), math.degrees(math.atan2(0.3, 2.0)), [18, 19]),  # reaches beside the middle of 17
        (0.01, 3.0, 9.0, [18]),  # a pole between two middles is in its sector
    ],
)
def test_an_obstacle_is_in_sectors_whose_middle_it_covers_and_in_that_of_its_nearest_point(
    radius, distance, bearing_deg, sectors
):
    scene = Scene({"post": ObstacleGroup("cylinder", 1, [[radius, radius], [0.5, 0.5]])})
    bearing = math.radians(bearing_deg)
    scene.field.pos_w[0, 0] = torch.tensor([distance * math.cos(bearing), distance * math.sin(bearing), 0.5])
    measured = scene.measure(36)[0, :, 0]
    assert measured.isfinite().nonzero().flatten().tolist() == sectors
    assert measured[18].item() == pytest.approx(distance - radius, rel=1e-2)


@pytest.mark.parametrize(("bearing_deg", "seen"), [(0, True), (110, True), (-110, True), (117, False), (180, False)])
def test_an_obstacle_is_in_view_where_its_circle_reaches_into_it(bearing_deg, seen):
    scene = Scene({"post": POST}, base=(1.0, 1.0), yaw=0.5)  # radius 0.5 at 3.5 m: 8.2 degrees to either side
    bearing = math.radians(bearing_deg) + 0.5
    scene.field.pos_w[0, 0] = torch.tensor([1.0 + 3.5 * math.cos(bearing), 1.0 + 3.5 * math.sin(bearing), 0.5])
    sectors = TrueSectors(36, scene.config, scene.field, 1, CPU)
    assert sectors.in_view(scene.base_pos_w, scene.yaw, math.radians(108.0)).tolist() == [[seen]]
    scene.field.pos_w[0, 0] = torch.tensor([0.7, 1.0, 0.5])  # around the robot
    assert sectors.in_view(scene.base_pos_w, scene.yaw, math.radians(45.0)).tolist() == [[True]]


def test_what_hangs_overhead_is_parked_or_unknown_does_not_count():
    wall = ObstacleGroup("box", 1, [[3.0, 3.0], [0.1, 0.1], [0.5, 0.5]], poses=[[0.0, -2.0, 0.0]])
    scene = Scene({"post": POST, "wall": wall})
    scene.field.pos_w[0, 0] = torch.tensor([2.0, 2.0, 0.5 + 0.44])
    distance = scene.measure(4)[0, :, 0]
    assert distance[EAST].item() == pytest.approx(math.sqrt(8) - 0.5)
    assert distance[SOUTH_EAST].item() == pytest.approx(1.9)
    known = torch.tensor([[False, True]])
    assert scene.measure(4, known)[0, EAST, 0].isinf() and scene.measure(4, known)[0, SOUTH_EAST, 0].isfinite()
    scene.field.pos_w[0, 0, 2] = 0.5 + 0.46
    assert scene.measure(4)[0, EAST, 0].isinf()
    scene.field.pos_w[0, 0, 2], scene.field.active[0, 0] = 0.5, False
    assert scene.measure(4)[0, EAST, 0].isinf()


def test_against_points_all_over_the_outlines():
    n, generator = 40, torch.Generator().manual_seed(2)
    groups = {
        "post": ObstacleGroup("cylinder", 3, [[0.1, 0.6], [0.5, 0.5]]),
        "crate": ObstacleGroup("box", 3, [[0.1, 0.7], [0.1, 0.7], [0.5, 0.5]]),
    }
    scene = Scene(groups, base=(0.3, -0.2), yaw=0.7, num_envs=n)
    field = scene.field
    angle = 2 * math.pi * torch.rand(n, 6, generator=generator, dtype=torch.float64)
    distance = 1.2 + 3 * torch.rand(n, 6, generator=generator, dtype=torch.float64)
    field.pos_w[..., :2] = torch.stack((angle.cos(), angle.sin()), -1) * distance[..., None]
    field.pos_w[..., 2] = 0.5
    field.quat_w[..., 0], field.quat_w[..., 3] = (angle / 2).cos(), (angle / 2).sin()
    got = scene.measure(36)[..., 0].double()
    expected = torch.full((n, 36), torch.inf, dtype=torch.float64)
    middles = -math.pi + (torch.arange(36, dtype=torch.float64) + 0.5) * math.pi / 18
    for k, part in enumerate(scene.config.parts()):
        s = torch.linspace(0, 1, 8001, dtype=torch.float64)
        size = field.size[:, k, None, :2]  # of each environment's own
        if part.kind == "box":
            corners = torch.tensor([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]], dtype=torch.float64)
            outline = torch.cat([corners[i] + s[:, None] * (corners[i + 1] - corners[i]) for i in range(4)]) * size
        else:
            outline = size[..., :1] * torch.stack(((2 * math.pi * s).cos(), (2 * math.pi * s).sin()), -1)
        cos, sin = angle[:, k, None].cos(), angle[:, k, None].sin()
        x = field.pos_w[:, k, :1] + cos * outline[..., 0] - sin * outline[..., 1] - 0.3
        y = field.pos_w[:, k, 1:2] + sin * outline[..., 0] + cos * outline[..., 1] + 0.2
        bearing = torch.remainder(torch.atan2(y, x) - 0.7 + math.pi, 2 * math.pi) - math.pi
        reach = torch.hypot(x, y)
        off = (bearing[:, None] - middles[:, None]).abs()  # (n, 36, points)
        at_middle = torch.where(off < 4e-4, reach[:, None], torch.inf).amin(-1)
        expected = torch.minimum(expected, at_middle)
        near = reach.argmin(1, keepdim=True)
        own = ((bearing.gather(1, near) + math.pi) / (2 * math.pi) * 36).long().clamp(0, 35)
        expected.scatter_reduce_(1, own, reach.gather(1, near), "amin")
    both = expected.isfinite() & got.isfinite()
    assert (expected.isfinite() != got.isfinite()).float().mean() < 0.005  # grazed outlines
    assert ((got - expected)[both].abs() > 5e-3).float().mean() < 0.02 and both.sum() > 300


@pytest.fixture
def risky_env(make_config):
    def build(*overrides):
        run = make_config("rewards=velocity_risk", "perception=none", "num_envs=5", *overrides)
        return OmniEnv(run.env)

    return build


def test_risk_is_of_what_a_ray_has_hit_alone(risky_env):
    """A scene with a step after its newest frame: what is held is of the frame, not of now."""
    env = risky_env("scenario=moving")
    for _ in range(10):
        env.step(torch.zeros(5, 12))
    assert env.sensing.due(env.step_count)
    avoidance, kinematics = env.avoidance, env.state.kinematics
    known = env.sensing.consumers["Sightings"].unseen < env.config.remembered_frames
    assert known.any() and not known.all()  # the mount is blind behind

    def measured(known):
        return avoidance.true_sectors.measure(kinematics.base_pos_w, kinematics.yaw, known)

    held = avoidance.motion
    assert torch.equal(held, measured(known)) and not torch.equal(held, measured(None))
    hit = env.sensing.frame.shape_id
    names = ray_shapes(env.world, env.sensing.config.exclude_geoms).geom_names
    for env_id in range(5):
        seen = {names[k] for k in hit[env_id].unique().tolist() if k >= 0}
        for o, name in enumerate(avoidance.true_sectors.names):
            assert (env.sensing.consumers["Sightings"].unseen[env_id, o] == 0) == (name in seen)
    env.step(torch.zeros(5, 12))
    kinematics = env.state.kinematics
    assert torch.equal(avoidance.motion, held) and not torch.equal(held, measured(known))


def test_without_obstacles_there_is_no_risk(risky_env):
    env = risky_env("obstacles=none")
    env.step(torch.zeros(5, 12))
    avoidance = env.avoidance
    assert avoidance.motion[..., 0].isinf().all() and not avoidance.risk.any() and not avoidance.velocity.any()


def test_a_reset_forgets_one_environment_alone(risky_env):
    env = risky_env("scenario=corridor")
    avoidance = env.avoidance
    avoidance.risk, avoidance.motion = torch.rand_like(avoidance.risk), torch.rand_like(avoidance.motion)
    before = avoidance.risk.clone()
    env._reset(torch.tensor([2]))
    assert not avoidance.risk[2].any() and not avoidance.velocity[2].any() and not encode(avoidance.motion)[2].any()
    assert torch.equal(avoidance.risk[[0, 1, 3, 4]], before[[0, 1, 3, 4]])
    assert (env.sensing.consumers["Sightings"].unseen[2] > 1000).all()


def test_only_what_is_read_exists(make_config):
    """V_avoid of the paper has no risk; perception alone needs no risk and no sectors; walking needs none of it."""
    paper = OmniEnv(make_config("rewards=default", "num_envs=2").env)
    assert paper.avoidance.motion is None and paper.avoidance.risk is None and paper.sensing.seen_within(1) is None
    perceived = OmniEnv(make_config("experiment=avoid", "init=unread", "num_envs=2").env).avoidance
    assert perceived.motion is not None and perceived.risk is None and perceived.sector_distance is None
    assert OmniEnv(make_config("experiment=walk", "num_envs=2").env).avoidance is None


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["rewards=default"], r"perception\.motion_weight needs rewards\.avoidance\.risk; use rewards=veloc"),
        (["perception.avoidance_weight=1.0"], r"avoidance_weight=1\.0 and motion_weight=10\.0 would both change the"),
    ],
)
def test_motion_needs_its_avoidance_controller(make_config, overrides, message):
    with pytest.raises(ValueError, match=message):
        make_config("experiment=avoid", "init=unread", *overrides)
