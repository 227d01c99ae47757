"""The stability report: its theory against closed forms and simulation, and that its cases hold."""

import math

import numpy as np
import pytest

from benchmarks.stability import learning, lidar, physics
from benchmarks.stability.__main__ import command

M, H = 0.02, 0.005
"""Inertia (kg m^2) and step (s)."""


def stable(kp, kv, integrator, outside=False):
    return physics.spectral_radius(np.array([[M]]), kp, kv, 0.0, H, integrator, outside) <= 1.0 + 1e-12


@pytest.mark.parametrize("kv", [0.0, 0.5, 2.0])
@pytest.mark.parametrize(
    ("integrator", "outside", "limit"),
    [
        ("euler", False, lambda kv: (4 * M - 2 * H * kv) / H**2),
        ("euler", True, lambda kv: (4 * M - 2 * H * kv) / H**2),
        ("implicitfast", True, lambda kv: (4 * M - 2 * H * kv) / H**2),
        ("implicitfast", False, lambda kv: (4 * M + 2 * H * kv) / H**2),
        ("implicit", False, lambda kv: (4 * M + 2 * H * kv) / H**2),
    ],
)
def test_the_limit_by_hand(kv, integrator, outside, limit):
    assert stable(0.999 * limit(kv), kv, integrator, outside)
    assert not stable(1.001 * limit(kv), kv, integrator, outside)


def test_the_limits_of_runge_kutta_by_hand():
    """On the imaginary axis up to 2 sqrt(2); with a held torque of a spring alone, never."""
    limit = M * (2 * math.sqrt(2) / H) ** 2
    assert stable(0.999 * limit, 0.0, "rk4") and not stable(1.001 * limit, 0.0, "rk4")
    assert not stable(1.0, 0.0, "rk4", outside=True)


def test_simulation_and_theory_agree(make_config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = make_config("perception=none", "lidar=none", "rewards=walk", "observations=walk", "obstacles=none").env
    found = physics.stability_map(env, "euler", 5.0, False, size=5, num_steps=150)
    assert found.agreement == 1.0 and 0.1 < (found.radius > 1).mean() < 0.9
    found = physics.stability_map(env, "implicitfast", 5.0, False, size=5, num_steps=150)
    assert found.agreement == 1.0 and not (found.radius > 1).any()


def test_widened_ranges_stay_physical(make_config):
    env = make_config("perception=none", "lidar=none", "rewards=walk", "observations=walk", "obstacles=none").env
    paper = make_config("randomization=paper").env.randomization
    wide = physics.widened(paper, 3.0, physics._floating(env, env.sim, 1))
    assert wide.com_x == pytest.approx((-0.3, 0.3)) and wide.ground_restitution == (0.0, 1.0)
    assert 6.921 + wide.added_mass[0] + wide.payload_mass[0] == pytest.approx(0.6921)


def test_every_lidar_case_holds():
    rows = lidar.run(rays=100, many=1000)
    assert [row["case"] for row in rows if not row["good"]] == [] and len(rows) == 41


def test_a_wrong_range_is_found():
    true = np.array([1.0, 2.0, math.inf])
    assert lidar._row("", true, true, 1e-5)["good"]
    for wrong in ([1.0, 2.1, math.inf], [1.0, math.inf, math.inf], [1.0, 2.0, 3.0], [1.0, math.nan, math.inf]):
        assert lidar._row("", np.array(wrong), true, 1e-5)["wrong"] == 1


def test_degenerate_clouds_give_finite_points():
    assert all(row["good"] for row in learning.clouds())


@pytest.mark.slow
@pytest.mark.parametrize("case", learning.cases(), ids=lambda case: case.name)
def test_every_learning_case_ends_as_it_should(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    row = learning.run_case(case, 1 if case.expected == "survives" else 2)
    assert row["good"], row


@pytest.mark.slow
def test_float32_is_precise_enough_in_every_layer():
    rows = learning.precision(num_envs=4)
    assert {"loss", "actor.perception.proximal"} <= {row["layer"] for row in rows}
    assert all(row["output"] < 1e-4 and row["gradient"] < 1e-4 for row in rows)


def test_the_exit_status_says_whether_all_is_well(tmp_path, monkeypatch, capsys):
    arguments = ["subject=lidar", f"out={tmp_path}", "rays=50", "many=100"]
    monkeypatch.setattr(lidar, "run", lambda rays, many: [{"case": "a", "good": True}])
    with pytest.raises(SystemExit, match="0"):
        command(arguments)
    monkeypatch.setattr(lidar, "run", lambda rays, many: [{"case": "a", "good": True}, {"case": "b", "good": False}])
    with pytest.raises(SystemExit, match="1"):
        command(arguments)
    assert "| b    | NO   |" in capsys.readouterr().out and (tmp_path / "lidar.csv").is_file()
