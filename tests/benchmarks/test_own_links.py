"""What a robot's links take of its scan, against MuJoCo's own rays."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from benchmarks import own_links

ROBOT = """
<mujoco><worldbody><body name="trunk" pos="0 0 1"><freejoint/>
  <geom name="trunk" type="box" size="0.3 0.2 0.1"/>
  <geom name="mast" type="cylinder" size="0.03 0.1" pos="0 0 0.2"/>
  <body name="arm" pos="0.4 0 0.2"><joint name="shoulder" axis="0 1 0"/>
    <geom name="arm" type="box" size="0.02 0.3 0.2"/>
  </body>
</body></worldbody></mujoco>
"""


@pytest.fixture
def arguments(tmp_path):
    (tmp_path / "robot.xml").write_text(ROBOT)
    return [f"file={tmp_path / 'robot.xml'}", "body=trunk", "pos=0,0,0.4", "through=mast", "joints=should*:0.5"]


def test_rays_end_on_the_links_that_mj_ray_hits(arguments):
    given = own_links.Arguments(
        file=Path(arguments[0].removeprefix("file=")),
        body="trunk",
        pos=(0.0, 0.0, 0.4),
        through=("mast",),
        joints=("should*:0.5",),
    )
    found = own_links.scans(given)
    model, data = own_links.in_a_room(given.file, given.joints)
    mujoco.mj_forward(model, data)
    assert data.qpos[-1] == 0.5 and data.qpos[2] == pytest.approx(0.1)  # the trunk's underside is on the floor
    model.geom_rgba[model.geom("mast").id, 3] = 0.0  # what is transparent no ray of MuJoCo hits
    geom, checked = np.zeros(1, np.int32), 0
    for k in range(0, len(found.ranges), 50):
        away = found.points_w[k] - found.sensor_w
        distance = mujoco.mj_ray(model, data, found.sensor_w, away / np.linalg.norm(away), None, 1, -1, geom)
        assert distance == pytest.approx(found.ranges[k], abs=1e-4)
        link = "" if model.geom_bodyid[geom[0]] == 0 else model.body(int(model.geom_bodyid[geom[0]])).name
        assert found.link[k] == link
        checked += link == "arm"
    assert checked > 5 and (found.alone >= found.ranges - 1e-4).all()


def test_the_command_tells_and_draws(arguments, tmp_path, capsys):
    own_links.command([*arguments, f"out={tmp_path}"])
    assert "arm" in capsys.readouterr().out and (tmp_path / "own_links.png").is_file()
    for wrong, said in (("joints=elbow:1", "joints=elbow:1 must be"), ("through=nose", "through=nose is neither")):
        with pytest.raises(SystemExit):
            own_links.command([*arguments[:3], wrong, f"out={tmp_path}"])
        assert said in capsys.readouterr().err
