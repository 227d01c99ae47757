"""Motion that changes its mind, numbers that take part, layouts, meshes: counts, tables and MuJoCo's own geometry."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
import torch
from fields import make_field

from omniperception.scene import MotionConfig, ObstacleGroup, ObstaclesConfig
from omniperception.scene.meshes import MESHES, mesh_points
from omniperception.scene.obstacle_field import PARKED_HEIGHT
from omniperception.scene.poses import LAYOUT_SEEDS

POST = [[0.1, 0.1], [0.5, 0.5]]


def field_of(groups, num_envs=400, seed=0, robot=(50.0, 50.0), **settings):
    config = ObstaclesConfig(groups, **{"area": (-1e6, 1e6, -1e6, 1e6), **settings})
    field = make_field(config, num_envs, seed)
    field.reset(torch.arange(num_envs), torch.tensor(robot).expand(num_envs, 2))
    return field


def walkers(speed=(1.0, 2.5), **motion):
    return {"walker": ObstacleGroup("cylinder", 2, POST, speed, motion=MotionConfig(**motion))}


def steps(field, num, robot=(50.0, 50.0)):
    """Velocities (num + 1, num_envs, O, 2) before and after control steps of 0.1 s."""
    velocities = [field.velocity_w.clone()]
    for _ in range(num):
        field.travel(0.025, 4, torch.tensor(robot).expand(len(field.pos_w), 2))
        velocities.append(field.velocity_w.clone())
    return torch.stack(velocities)


def headings(velocity):
    return torch.rad2deg(torch.atan2(velocity[..., 1], velocity[..., 0]))


class TestMotion:
    def test_times_between_choices_fill_their_range(self):
        velocity = steps(field_of(walkers(every_s=[0.5, 1.0], turn_deg=180.0)), 12)
        first = (velocity[1:] != velocity[:-1]).any(-1).int().argmax(0) + 1  # control steps until the first choice
        assert first.min() == 6 and first.max() == 10
        assert first.float().mean().item() == pytest.approx(8.0, abs=0.15)  # 6 to 10, each as often

    def test_turns_are_uniform_up_to_the_angle_and_keep_the_speed(self):
        field = field_of(walkers(every_s=[0.1, 0.1], turn_deg=40.0))
        velocity = steps(field, 1)
        turn = torch.remainder(headings(velocity[1]) - headings(velocity[0]) + 180, 360) - 180
        assert 39 < turn.max() <= 40 + 1e-6 and -40 - 1e-6 <= turn.min() < -39
        assert turn.std().item() == pytest.approx(80 / math.sqrt(12), rel=0.05)
        speed = velocity.norm(dim=-1)
        torch.testing.assert_close(speed[1], speed[0])
        assert speed.max() > 2.4

    def test_shares_of_those_that_stand_head_for_the_robot_and_turn(self):
        field = field_of(walkers(every_s=[0.1, 0.1], stop=0.2, home=0.3), 2000)
        where = field.pos_w[..., :2].clone()
        velocity = steps(field, 1, robot=(3.0, -2.0))[1]
        stands = velocity.norm(dim=-1) == 0
        to_robot = torch.tensor([3.0, -2.0]) - where
        homes = (headings(velocity) - headings(to_robot)).abs() < 1e-6
        assert stands.double().mean().item() == pytest.approx(0.2, abs=0.03)
        assert (homes & ~stands).double().mean().item() == pytest.approx(0.3, abs=0.03)

    def test_who_has_stood_goes_on_as_it_went_before_at_its_speed(self):
        field = field_of(walkers(every_s=[0.1, 0.1], stop=0.5))
        velocity = steps(field, 30)
        moving = velocity.norm(dim=-1) > 0
        assert 0.4 < moving[1:].double().mean() < 0.6
        same = torch.where(moving[..., None], velocity, velocity[0])
        torch.testing.assert_close(same, velocity[0].expand_as(same))  # no turns here, but stops

    def test_the_area_still_holds_them(self):
        field = field_of(walkers(every_s=[0.2, 0.4], turn_deg=90.0, home=0.2), 50, area=(-2.0, 2.0, -1.0, 1.0))
        for _ in range(100):
            steps(field, 1)
            assert (field.pos_w[..., :2].abs() <= torch.tensor([2.0, 1.0])).all()

    def test_one_environments_choices_do_not_change_anothers(self):
        one, other = (field_of(walkers(every_s=[0.3, 0.9], turn_deg=90.0), 3) for _ in range(2))
        steps(one, 4), steps(other, 4)
        other.reset(torch.tensor([1]), torch.full((1, 2), 50.0))
        assert torch.equal(steps(one, 20)[:, [0, 2]], steps(other, 20)[:, [0, 2]])

    def test_a_loaded_state_goes_on_bit_identically(self):
        one, other = (field_of(walkers(every_s=[0.3, 0.9], turn_deg=90.0, stop=0.3), 3) for _ in range(2))
        steps(one, 13)
        other.load_state_dict(one.state_dict())
        other.pos_w.copy_(one.pos_w)
        other._random.load_state_dict(one._random.state_dict())
        assert torch.equal(steps(one, 30), steps(other, 30))


class TestPresent:
    def test_numbers_are_uniform_and_everyone_takes_part_as_often(self):
        groups = {"always": ObstacleGroup("sphere", 1, [[0.1, 0.1]])}
        groups["some"] = ObstacleGroup("cylinder", 4, POST, present=[1, 3])
        field = field_of(groups, 8000)
        some = field.active[:, 1:]
        counts = some.sum(1).bincount(minlength=5)
        assert counts[0] == counts[4] == 0 and counts[1:4].min() > 2500
        assert field.active[:, 0].all() and (some.double().mean(0) - 0.5).abs().max() < 0.03
        assert (field.pos_w[:, 1:, 2][~some] == PARKED_HEIGHT).all() and (field.velocity_w[~field.active] == 0).all()

    def test_who_is_not_there_takes_no_room(self):
        """Two posts fit into the area with the spacing, never three."""
        posts = {"post": ObstacleGroup("cylinder", 12, [[0.4, 0.4], [0.5, 0.5]], present=[2, 2])}
        field = field_of(posts, area=(-1.0, 1.0, -0.2, 0.2), spacing=0.3)
        assert (field.active.sum(1) == 2).double().mean() > 0.5


@dataclass(frozen=True)
class Rows:
    """Two boxes in eight worlds; the second is missing in odd ones. Numbers tell seed and world."""

    worlds: int = 8
    count: int = 2

    def table(self, seed, num_worlds):
        world = np.arange(num_worlds)[:, None, None]
        row = np.array([[5.0, 1.0, 0.5, 0.3, 0.2, 1.0], [7.0, -1.0, -0.5, 0.1, 0.4, 0.6]]) + 0.01 * world + 0.001 * seed
        row[1::2, 1] = np.nan
        return row


class TestLayouts:
    groups = {
        "post": ObstacleGroup("cylinder", 1, POST, [1.0, 1.0]),
        "block": ObstacleGroup("box", 2, layout=Rows(), bottom=[-0.25, -0.25]),
    }

    @pytest.mark.parametrize("split", ["dev", "test"])
    def test_poses_and_sizes_are_those_of_a_world_of_the_table(self, split):
        field = field_of(self.groups, 500, split=split)
        table = torch.from_numpy(Rows().table(LAYOUT_SEEDS[split], 8))
        world = ((field.pos_w[:, 1, 0] - table[0, 0, 0]) / 0.01).round().long()
        assert world.bincount().min() > 30 and world.max() == 7
        expected, there = table[world], field.active[:, 1:]
        assert torch.equal(there[:, 1], world % 2 == 0) and there[:, 0].all()
        torch.testing.assert_close(field.pos_w[:, 1:, :2][there], expected[..., :2][there])
        torch.testing.assert_close(field.yaw[:, 1:][there], expected[..., 2][there])
        torch.testing.assert_close(field.size[:, 1:][there], expected[..., 3:][there])
        torch.testing.assert_close(field.pos_w[:, 1:, 2][there], expected[..., 5][there] - 0.25)
        assert (field.pos_w[:, 2, 2][~there[:, 1]] == PARKED_HEIGHT).all() and field.size.isfinite().all()
        assert field.varying == (1, 2)


class TestMeshes:
    def compiled(self, *groups):
        config = ObstaclesConfig({f"g{k}": group for k, group in enumerate(groups)})
        spec = mujoco.MjSpec()
        config.add_to(spec)
        return config, spec.compile()

    @pytest.mark.parametrize("file", MESHES)
    def test_packaged_ones_are_convex_and_fill_their_boxes(self, file):
        _, model = self.compiled(ObstacleGroup("mesh", 1, [[0.2, 0.2], [0.3, 0.3], [0.5, 0.5]], file=file))
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        geom = model.geom("obstacle_g0_0")
        vertices = model.mesh_vert @ data.geom(geom.id).xmat.reshape(3, 3).T + data.geom(geom.id).xpos
        np.testing.assert_allclose(np.abs(vertices).max(0), [0.2, 0.3, 0.5], atol=1e-6)
        np.testing.assert_allclose(vertices.max(0), -vertices.min(0), atol=1e-6)
        corners = vertices[model.mesh_face]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        outside = ((vertices[None] - corners[:, :1]) * normal[:, None]).sum(-1)
        assert outside.max() < 1e-6  # no vertex lies beyond any face
        used = np.unique(model.mesh_face)
        assert len(used) >= 6 and model.mesh_graphadr[0] >= 0

    def test_a_groups_meshes_divide_the_range_of_sizes(self):
        group = ObstacleGroup("mesh", 3, [[0.1, 0.3], [0.2, 0.2], [0.4, 0.5]], file="rock")
        field = field_of({"rock": group}, 2)
        assert field.size[0].tolist() == [
            pytest.approx(s) for s in ([0.1, 0.2, 0.4], [0.2, 0.2, 0.45], [0.3, 0.2, 0.5])
        ]
        assert torch.equal(field.size[0], field.size[1]) and field.varying == ()
        assert field.pos_w[0, :, 2].tolist() == pytest.approx([0.4, 0.45, 0.5])
        assert field.outline[0, 1].tolist() == pytest.approx([0.2, 0.2])

    def test_of_a_file_the_hull_counts_in_its_own_size(self, tmp_path):
        """A cube of 0.4 x 0.6 x 0.8 m, off its origin, with a dent in its top."""
        corners = [(x, y, z) for x in (1.0, 1.4) for y in (0.0, 0.6) for z in (0.0, 0.8)] + [(1.2, 0.3, 0.5)]
        faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 9", "6 8 9", "8 4 9", "4 2 9"]
        path = tmp_path / "dented.obj"
        path.write_text("\n".join([f"v {x} {y} {z}" for x, y, z in corners] + [f"f {face}" for face in faces]))
        config, model = self.compiled(ObstacleGroup("mesh", 1, file=str(path)))
        assert config.parts()[0].size == tuple((pytest.approx(half),) * 2 for half in (0.2, 0.3, 0.4))
        data, geom = mujoco.MjData(model), np.zeros(1, np.int32)
        mujoco.mj_forward(model, data)
        down = mujoco.mj_ray(model, data, [0.01, 0.02, 5.0], [0.0, 0.0, -1.0], None, 1, -1, geom)
        assert down == pytest.approx(5.0 - 0.4)  # the dent is filled


def test_a_plane_is_refused_however_it_lies(tmp_path):
    path = tmp_path / "slanted.obj"
    path.write_text("v 0 0 0\nv 1 0 1\nv 0 1 1\nv 1 1 2\nf 1 2 4\nf 1 4 3\n")
    with pytest.raises(ValueError, match=r"slanted.obj is flat; a mesh needs a volume"):
        mesh_points(str(path))
