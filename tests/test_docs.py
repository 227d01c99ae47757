"""The guide's code runs as it stands, its blocks stay short, and every page links to what exists."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from omnilidar import Lidar, vlp16
from omniperception.build import assemble, build_runner
from omniperception.config import compose

ROOT = Path(__file__).resolve().parents[1]
GUIDE = ROOT / "docs" / "guide"
LIDAR = GUIDE / "lidar.md"
PAGES = sorted((*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/**/*.md")))
MAX_LINES = 15

ROBOT = """
<mujoco>
  <asset>
    <mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1  1 0 1"/>
    <hfield name="hills" nrow="3" ncol="4" size="1 2 0.5 0.1" elevation="0 1 0 2  1 0 3 0  0 1 2 0"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <geom name="terrain" type="hfield" hfield="hills" pos="-4 0 0"/>
    <geom name="rock" type="mesh" mesh="wedge" pos="4 0 0"/>
    <geom name="post" type="cylinder" size="0.1 1" pos="0 3 1"/>
    <geom name="ball" type="sphere" size="0.3" pos="2 2 0.5"/>
    <body name="trunk" pos="0 0 0.6">
      <freejoint/>
      <geom name="hull" type="ellipsoid" size="0.3 0.2 0.1"/>
      <geom name="pack" type="box" size="0.1 0.1 0.05" pos="0 0 0.1"/>
      <body name="leg" pos="0.3 0 0">
        <joint type="hinge"/>
        <geom name="thigh" type="capsule" size="0.05 0.2" pos="0 0 -0.2"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
TETRAHEDRON = np.array([[-300.0, -300.0, 0.0], [300.0, -300.0, 0.0], [0.0, 400.0, 0.0], [0.0, 0.0, 500.0]])
FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3))


def blocks() -> dict[str, str]:
    """The blocks of Python of the pages of the LiDAR and of simulators, by what is in and out of them."""
    found = dict[str, str]()
    for page, names in (
        (LIDAR, ("numpy", "torch", "mesh", "sizes", "table", "files")),
        (GUIDE / "simulators.md", ("mujoco", "mujoco_warp", "newton", "genesis", "tensors")),
    ):
        codes = re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)
        found |= dict(zip(names, codes, strict=True))
    return found


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Executes a block where the files that it names are, and gives its names."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.xml").write_text(ROBOT)
    facets = ""
    for face in FACES:
        corners = "".join(f"vertex {x} {y} {z}\n" for x, y, z in TETRAHEDRON[[*face]])
        facets += f"facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n"
    (tmp_path / "rock.stl").write_text(f"solid rock\n{facets}endsolid rock\n")
    turns = np.arange(3000) * 0.36
    np.savetxt(tmp_path / "my_scan.csv", np.stack([turns % 360.0, np.full(3000, -30.0)], 1), delimiter=",")

    def execute(name: str) -> dict:
        names: dict = {}
        exec(compile(blocks()[name], f"block {name}", "exec"), names)
        return names

    return execute


def test_blocks_are_short():
    for name, code in blocks().items():
        assert len(code.splitlines()) <= MAX_LINES, name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_links_to_and_runs_exists(page):
    text = page.read_text()
    links = [page.parent / path for path in re.findall(r"\]\((?!http)([^)#]+)", text)]
    scripts = [ROOT / path for path in re.findall(r"python (\S+\.py)", text)]
    assert [str(path) for path in (*links, *scripts) if not path.exists()] == []


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.name)
def test_files_and_presets_that_a_page_names_exist(page):
    text = page.read_text()
    files = {name for name in re.findall(r"`([\w./]*\w+\.(?:py|h))`", text) if not list(ROOT.glob(f"[!.]*/**/{name}"))}
    assert not {name for name in files if not (ROOT / name).exists()}
    groups = "|".join(folder.name for folder in (ROOT / "conf").iterdir() if folder.is_dir())
    presets = {tuple(found) for found in re.findall(rf"(?<![\w./])({groups})=([a-z]\w*)", text)}
    assert not {
        f"{group}={name}"
        for group, name in presets
        if name not in ("mine", "watched", "all", "null") and not (ROOT / "conf" / group / f"{name}.yaml").exists()
    }


def test_every_page_is_reached_from_the_readme():
    reached, left = set[Path](), [ROOT / "README.md"]
    while left:
        page = left.pop()
        if page.suffix == ".md" and page not in reached:
            reached.add(page)
            left += [(page.parent / path).resolve() for path in re.findall(r"\]\((?!http)([^)#]+)", page.read_text())]
    assert [
        str(page.relative_to(ROOT)) for page in PAGES if ROOT / "docs" in page.parents and page not in reached
    ] == []


def test_what_the_architecture_names_exists():
    named = re.findall(r"`([A-Za-z_][\w.]*)`", (ROOT / "docs" / "guide" / "architecture.md").read_text())
    sources = [*ROOT.glob("omniperception/**/*.py"), *ROOT.glob("conf/**/*.yaml")]
    known = set(re.findall(r"\w+", " ".join(path.read_text() for path in sources)))
    known |= {path.stem for path in ROOT.glob("omniperception/**/*.py")} | {"py", "yaml"}
    known |= {path.name for path in (ROOT / "omniperception").iterdir()}
    assert len(named) > 50 and [name for name in named if not set(name.split(".")) <= known] == []


@pytest.fixture(scope="module")
def own_project(tmp_path_factory):
    """A folder that holds the files which the guide's blocks name in their first line."""
    folder = tmp_path_factory.mktemp("guide")
    for page in (ROOT / "docs" / "guide").glob("new_*.md"):
        for code in re.findall(r"```(?:yaml|python)\n(.*?)```", page.read_text(), flags=re.DOTALL):
            named = re.match(r"(?:# @package _global_\n)?# ((?:conf|own_project)/\S+)\n", code)
            if named and not (ROOT / named[1]).exists():
                path = folder / named[1]
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(code)
    return folder


def forget(package):
    """Lets the next import find another package of that name."""
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        del sys.modules[name]


@pytest.mark.parametrize(
    "overrides",
    [
        ("rewards=mine",),
        ("lidar=os0_32", "lidar.mount=back"),
        ("lidar=mine", "condition=robot"),
        ("lidar=watched", "observations=watched"),
        ("terrain=mine",),
        ("obstacles=mine",),
        ("scenario=mine",),
        ("perception=mine",),
        ("ppo=mine",),
    ],
    ids=lambda overrides: overrides[0],
)
def test_what_the_guide_adds_trains(own_project, overrides, monkeypatch):
    monkeypatch.syspath_prepend(own_project)
    forget("own_project")
    added = (f"hydra.searchpath=['file://{own_project / 'conf'}']",)
    small = ("num_envs=4", "obstacles.curriculum=null", "ppo.num_mini_batches=1", "lidar.num_rays=200")
    runner = build_runner(assemble(compose((*added, *overrides, *small))), None)
    losses, update = {}, runner.alg.update
    runner.alg.update = lambda: losses.update(update()) or losses
    runner.learn(1)
    assert ("smooth" in losses) == ("smooth_optimizer_state_dict" in runner.alg.save()) == ("ppo=mine" in overrides)
    forget("own_project")


def test_numpy(run):
    names = run("numpy")
    ranges, shape, directions = names["ranges"], names["shape"], names["directions"][0]
    towards = directions[180] / np.linalg.norm(directions[180])  # azimuth 0
    across = towards @ np.array([3.0, 0.0, 0.0])
    expected = across - np.sqrt(0.25 - (9.0 - across**2))
    assert shape[0, 180] == 1 and shape[0, 0] == 0
    np.testing.assert_allclose(ranges[0, 180], expected, rtol=1e-5)
    np.testing.assert_allclose(ranges[0, 0], 0.5 * np.sqrt(1.01) / 0.1, rtol=1e-5)


def test_torch(run):
    names = run("torch")
    cloud = names["cloud"]
    assert cloud.points_w.shape == (64, 2000, 3)
    floor, box = (cloud.points_w[cloud.class_id == k] for k in (0, 1))
    assert len(box) > 1000 and floor[:, 2].abs().max() < 0.1  # five sigma of the noise
    assert (box[:, :2].median(0).values - torch.tensor([2.0, 1.0])).abs().max() < 0.4


def test_a_batch_of_mujoco_warp(run):
    pytest.importorskip("mujoco_warp")
    names = run("mujoco_warp")
    assert names["ranges"].shape == (16, 2000)
    start = names["model"].qpos0[2]  # kinematics of the reference configuration
    assert np.allclose(names["scene"].body_pos[:, names["trunk"], 2], start)
    assert 0.05 < float(names["ranges"].isfinite().float().mean()) < 0.9


def test_a_genesis_scene(run):
    gs = pytest.importorskip("genesis")
    if gs._initialized:  # by another test of this process
        gs.destroy()
    names = run("genesis")
    below = names["ranges"].isfinite().float().mean(1)  # the ground, under scans that begin elsewhere
    assert names["ranges"].shape == (4, 2000) and float(below.min()) > 0.02 and float(below.max()) < 0.4, below


def test_a_newton_model(run):
    pytest.importorskip("newton")
    names = run("newton")
    scene, ranges = names["scene"], names["ranges"]
    assert scene.num_envs == 16 and ranges.shape == (16, 2000)
    below = ranges.isfinite().float().mean(1)  # the ground, under scans that begin elsewhere
    assert float(below.min()) > 0.02 and float(below.max()) < 0.4, below


def test_a_compiled_mujoco_model(run):
    names = run("mujoco")
    mujoco, model, data, scene = (names[key] for key in ("mujoco", "model", "data", "scene"))
    assert {model.geom(k).name for k in scene.geom_ids} == set(re.findall(r'<geom name="(\w+)"', ROBOT))
    housing = scene.shapes_of(names["trunk"])
    assert {model.geom(scene.geom_ids[k]).name for k in housing} == {"hull", "pack"}
    outputs = ("ranges", "directions_s")
    frame = Lidar(names["config"], vlp16(), scene, names["trunk"], housing, outputs=outputs).cast(data.time)
    assert torch.equal(frame.ranges, names["frame"].ranges)
    trunk = data.body("trunk")
    turn = trunk.xmat.reshape(3, 3)
    origin, directions = trunk.xpos + turn @ [0.0, 0.0, 0.2], frame.directions_s[0].double().numpy() @ turn.T
    geom, agreed = np.array([-1], np.int32), 0
    for k in range(0, 4000, 10):
        truth = mujoco.mj_ray(model, data, origin, directions[k], None, 1, trunk.id, geom)
        expected = np.inf if geom[0] < 0 or not 0.1 <= truth <= 40.0 else truth
        agreed += np.isclose(float(frame.ranges[0, k]), expected, rtol=2e-5, atol=2e-5)
        shape = int(names["frame"].shape_id[0, k])
        assert shape < 0 or expected == np.inf or scene.geom_ids[shape] == geom[0]
    assert agreed >= 399


def test_pose_tensors_of_a_simulator(run):
    names = run("tensors")
    time_s = torch.full((8,), 0.1, dtype=torch.float64)
    names["link_pos_w"][:, 0, 2] += 3.0  # the sensor, which must not be inside of a leg
    names["link_pos_w"][:, 1:, 2] += 1.0
    ranges = names["observe"](time_s)
    assert ranges.data_ptr() == names["lidar"].frame.ranges.data_ptr()
    height = names["link_pos_w"][:, 0, 2]
    points = names["lidar"].frame.points_b
    below = torch.nan_to_num(points[..., 2], nan=0.0).amin(1)
    torch.testing.assert_close(below, -height, rtol=1e-5, atol=1e-5)


def test_a_mesh_file(run):
    pytest.importorskip("trimesh")
    names = run("mesh")
    hits = names["hits"]
    corners = TETRAHEDRON * 1e-3 * 1.5
    normal = np.cross(corners[2] - corners[1], corners[3] - corners[1])
    height = corners[1][2] - (normal[0] * (0.1 - corners[1][0]) + normal[1] * (0.0 - corners[1][1])) / normal[2]
    assert hits.shape_id.tolist() == [[1], [1]]
    np.testing.assert_allclose(hits.ranges.numpy(), 5.0 - (2.0 + height), rtol=1e-5)


def test_sizes_by_environment(run):
    sizes = run("sizes")["scene"].sizes((0, 1))
    kept = torch.tensor([[0.2, 0.2, 0.4], [0.1, 0.5, 0.0]], dtype=torch.float64)
    changed = (sizes != kept).flatten(1).any(1).nonzero().flatten().tolist()
    assert changed == [3, 7] and (sizes[:, 1, 2] == 0.0).all()


def test_a_scan_table(run):
    names = run("table")
    first, second = names["first"][0], names["second"][0]
    radius = 1.0 / np.tan(np.radians(30.0))
    np.testing.assert_allclose(torch.linalg.vector_norm(first[:, :2], dim=1), radius, rtol=1e-4)
    steps = torch.atan2(second[:, 1], second[:, 0]) - torch.atan2(first[:, 1], first[:, 0])
    np.testing.assert_allclose(np.mod(steps.numpy() + 1e-3, 2 * np.pi), 1e-3, atol=1e-4)  # 1000 points are a turn


def test_files(run, capsys):
    names = run("files")
    told = capsys.readouterr().out.strip()
    assert f"print(frame)  # {told}" in LIDAR.read_text()
    torch.testing.assert_close(names["again"].points_w, names["frame"].points_w[1:], equal_nan=True, rtol=0.0, atol=0.0)
    assert set(names["table"].names) == {"x", "y", "z", "ranges", "class_id"}
