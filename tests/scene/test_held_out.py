"""The test split: what no training scene has, in every preset, and no way for a training to see it."""

import pytest
import torch
from fields import make_field

from omniperception import build, config
from omniperception.commands import train
from omniperception.config import CONFIG_DIR, ConfigError
from omniperception.scene import ApproachConfig, ObstacleGroup, ObstaclesConfig, PartConfig
from omniperception.scene.held_out import VARIANTS, held_out

PRESETS = sorted(path.stem for path in (CONFIG_DIR / "obstacles").glob("*.yaml") if path.stem != "none")
EXPERIMENTS = sorted(path.stem for path in (CONFIG_DIR / "experiment").rglob("*.yaml"))
WALK = ("experiment=walk", "init=null")


def scene(preset, split="dev"):
    return build.assemble(config.compose([*WALK, f"obstacles={preset}", f"obstacles.split={split}"])).env.obstacles


@pytest.fixture(scope="module")
def trained_on():
    """(kind, ranges of sizes) of every obstacle that a training preset has."""
    return [(group.kind, group.size) for preset in PRESETS for group in scene(preset).groups.values()]


def drawn(obstacles, num_envs=200):
    """(kind, size, moves) of all parts that take part in some episodes, but those with fixed poses."""
    field = make_field(obstacles, num_envs, seed=3)
    field.reset(torch.arange(num_envs), torch.zeros(num_envs, 2))
    for k, part in enumerate(field.parts):
        if not obstacles.obstacles()[part.obstacle].group.has_poses:
            yield from ((part.kind, tuple(size), part) for size in field.size[field.active[:, k], k].tolist())


def within(size, ranges):
    return all(low <= value <= high for value, (low, high) in zip(size, ranges, strict=False))


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_of_training_has_other_kinds_and_sizes_in_the_test(preset, trained_on):
    """Half of what is drawn is of a kind that no preset has; the rest has no size of its own group's ranges."""
    new, seen, kinds = 0, 0, {kind for kind, _ in trained_on}
    ranges = {name: group.size for name, group in scene(preset).groups.items()}
    for kind, size, part in drawn(scene(preset, "test")):
        origin = max((name for name in ranges if part.name.startswith(f"obstacle_{name}_")), key=len)
        new, seen = new + (kind not in kinds), seen + 1
        if kind in kinds:
            margins = [value < low or value > high for value, (low, high) in zip(size, ranges[origin], strict=False)]
            assert all(margins[: len(ranges[origin])]) or _one_point(ranges[origin], size), part.name
    assert new >= 0.5 * seen > 0


def _one_point(ranges, size):
    return any(low == high for low, high in ranges) and not within(size, ranges)


@pytest.mark.parametrize("preset", PRESETS)
def test_as_many_take_part_and_move_as_in_the_scene_itself(preset):
    dev, test = scene(preset), scene(preset, "test")

    def numbers(obstacles):
        groups = obstacles.groups.values()
        return [sum((g.present or (g.count,))[0] for g in groups if g.moves == moves) for moves in (True, False)]

    assert numbers(dev) == numbers(test) and test.split == "test" and dev.split == "dev"
    assert {n: g for n, g in test.groups.items() if g.has_poses} == {n: g for n, g in dev.groups.items() if g.has_poses}
    for obstacles in (dev, test):
        assert {(g.speed, g.bottom, g.area) for g in obstacles.groups.values()} == {
            (g.speed, g.bottom, g.area) for g in dev.groups.values()
        }


def test_sizes_by_hand():
    groups = {
        "person": ObstacleGroup(
            "cylinder", 4, [[0.2, 0.3], [0.8, 0.9]], [1.0, 1.0], approach=ApproachConfig(0.1, [1.1, 3.0])
        ),
        "stump": ObstacleGroup("cylinder", 1, [[0.1, 0.2], [0.05, 0.1]]),
        "ball": ObstacleGroup("sphere", 2, [[0.1, 0.2]]),
        "table": ObstacleGroup("compound", 2, parts={"top": PartConfig("box", [0.6, 0.4, 0.02])}, scale=[0.8, 1.2]),
        "grass": ObstacleGroup("capsule", 10, [[0.01, 0.02], [0.3, 0.6]], present=[6, 10]),
    }
    found = held_out(ObstaclesConfig(groups, clearance=0.8)).groups
    assert list(found) == [
        *("person_larger_capsule", "person_smaller_capsule", "person_smaller_cylinder", "person_larger_cylinder"),
        *("stump_smaller_hexagon", "ball_larger_rock", "ball_smaller_sphere", "table_larger_compound"),
        *("table_smaller_compound", "grass_smaller_capsule", "grass_larger_capsule"),
    ]

    def sizes(name):
        return [pytest.approx(bounds) for bounds in found[name].size]

    assert sizes("person_larger_capsule") == [(0.3, 0.39), (0.6, 0.78)]  # of a height of 0.9 to 1.17 m, less its caps
    assert sizes("person_smaller_cylinder") == [(0.15, 0.2), (0.6, 0.8)]
    assert found["person_larger_cylinder"].approach.distance == pytest.approx((0.8 + 0.39, 3.0))
    assert sizes("stump_smaller_hexagon") == [(0.075, 0.1), (0.075, 0.1), (0.0375, 0.05)]
    assert sizes("ball_larger_rock") == [(0.2, 0.26)] * 3
    assert (found["ball_larger_rock"].count, found["ball_larger_rock"].present) == (VARIANTS, (1, 1))
    assert found["table_larger_compound"].scale == pytest.approx((1.2, 1.56))
    assert found["grass_larger_capsule"].count == 5 and found["grass_larger_capsule"].present == (3, 5)


@pytest.mark.parametrize(
    ("count", "present"), [(8, (2, 2)), (4, (2, 2)), (8, (1, 3)), (8, (1, 2)), (7, (0, 5)), (5, (5, 5))]
)
@pytest.mark.parametrize("kind", ["box", "cylinder", "capsule"])
def test_as_many_of_a_group_take_part_in_an_episode(kind, count, present):
    size = [[0.2, 0.3], [0.4, 0.5], [0.4, 0.5]][: 3 if kind == "box" else 2]
    obstacles = held_out(ObstaclesConfig({"thing": ObstacleGroup(kind, count, size, present=present)}))
    field = make_field(obstacles, 400, seed=3)
    field.reset(torch.arange(400), torch.full((400, 2), 50.0))
    drawn = field.root_active.sum(1)
    assert (drawn.min().item(), drawn.max().item()) == present
    assert drawn.float().mean().item() == pytest.approx(sum(present) / 2, abs=0.15)


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_no_recipe_sees_it(experiment):
    run = build.assemble(config.compose([f"experiment={experiment}", "init=null"]))
    assert run.env.obstacles.split == "dev"
    assert "split" not in (CONFIG_DIR / "experiment" / f"{experiment}.yaml").read_text()


@pytest.mark.parametrize("given", [["obstacles.split=test"], ["-m", "obstacles.split=test,dev"]])
def test_training_refuses_it_in_one_line(given, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"obstacles.split=test is for reports, .* use obstacles.split=dev") as error:
        train.main(train.Arguments(), [*WALK, "obstacles=static", *given])
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())


def test_going_on_with_a_run_refuses_it(tmp_path):
    run = build.assemble(config.compose([*WALK, "obstacles=static"]))
    config.save(run.composed, tmp_path)
    with pytest.raises(ConfigError, match="is for reports"):
        train.main(train.Arguments(run=str(tmp_path)), ["obstacles.split=test"])


def test_what_has_no_held_out_kind_is_one_line(tmp_path):
    """Through the whole configuration, as from a command line."""
    cabinet = tmp_path / "cabinet.xml"
    cabinet.write_text(
        '<mujoco><asset><mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset><worldbody><body>'
        '<geom name="a" type="mesh" mesh="wedge"/><geom name="b" type="box" size="0.1 0.1 0.1"/></body></worldbody>'
        "</mujoco>"
    )
    for group, message in (
        (f"kind:compound,count:1,file:'{cabinet}'", "c has a mesh among its parts, .* use split=dev"),
        ("kind:mesh,count:2,files:[rock,wedge]", "c has files=.*, of which there are no held-out ones; use split=dev"),
    ):
        given = ("experiment=quickstart", f"+obstacles.groups={{c:{{{group}}}}}", "obstacles.split=test")
        with pytest.raises(ConfigError, match=message):
            build.assemble(config.compose(given))
