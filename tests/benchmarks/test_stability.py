"""The stability report: what its ranges are, and that its command writes what it names."""

import json

import pytest

from benchmarks import stability

BLIND = ("perception=none", "lidar=none", "rewards=walk", "observations=walk", "obstacles=none")


def test_widened_ranges_stay_physical(make_config):
    sim, _ = stability._standing(make_config(*BLIND).env, 1)
    wide = stability.widened(make_config("randomization=paper").env.randomization, 3.0, sim)
    assert wide.com_x == pytest.approx((-0.3, 0.3)) and wide.ground_restitution == (0.0, 1.0)
    assert 6.921 + wide.added_mass[0] + wide.payload_mass[0] == pytest.approx(0.6921)


@pytest.mark.slow
def test_gains_that_are_too_high_for_a_step_chatter_and_scenes_stay_finite(tmp_path):
    stability.command([f"out={tmp_path}", "size=3", "num_envs=2", "seconds=1.0"])
    rows = {(row["PD"], row["step ms"]): row for row in json.loads((tmp_path / "standing.json").read_text())["rows"]}
    assert len(rows) == 10 and rows["in engine", 0.5]["unstable"] == 0.0 < rows["outside", 10.0]["unstable"]
    scenes = {row["scene"]: row for row in json.loads((tmp_path / "scenes.json").read_text())["rows"]}
    assert len(scenes) == 17 and all(row["finite"] == 1.0 for row in scenes.values())
    assert scenes["standing"]["recovered"] == 1.0 and scenes["5 cm inside an obstacle"]["obstacle felt"] == 1.0
    assert (tmp_path / "standing.png").stat().st_size > 10_000
