"""What is forced in exists, does nothing to the task, and is gone again afterwards."""

import pytest
import torch

from benchmarks import pruning_benchmark as benchmark
from omniperception.env.env import OmniEnv
from omniperception.lidar import OUTPUTS
from omniperception.plan import OPTIONAL_FIELDS


def build(scene, item=None):
    run = benchmark._run_of(scene, 13)
    if item is None:
        return OmniEnv(run.env)
    with item.during():
        return OmniEnv(item.change(run.env))


def test_everything_that_walking_leaves_out_can_be_forced_in():
    forced = build("walk", benchmark.items_of("walk")[-1])
    assert forced.sensing is not None and forced.world.model.nsensor > 0 and len(forced.actions) == 3
    assert all(exists(forced) for _, exists in OPTIONAL_FIELDS.values())
    assert {"body_mass", "geom_friction", "opt.gravity"} <= set(forced.sim.batch._expanded)


def test_what_is_forced_into_the_rays_does_not_change_them():
    """All outputs, kinds and noise models of size 0 give the same frame; what is built afterwards is as before."""
    plain, forced = build("quickstart"), build("quickstart", benchmark.items_of("quickstart")[-1])
    assert set(forced.sensing.lidar.outputs) == set(OUTPUTS) > set(plain.sensing.lidar.outputs)
    compiled = [env.sensing.lidar.variant.kinds for env in (plain, forced, build("quickstart"))]
    assert compiled[0] == compiled[2] < compiled[1]
    for env in (plain, forced):
        env.sensing.lidar.reset()
        env.sensing.scene.body_pos.copy_(plain.sensing.scene.body_pos)
        env.sensing.scene.body_quat.copy_(plain.sensing.scene.body_quat)
        env.sensing.lidar.phase_rows.copy_(plain.sensing.lidar.phase_rows)
        env.sensing.lidar.cast(2.0)
    found = [env.sensing.lidar.frame.true_ranges for env in (plain, forced)]
    same = torch.isclose(*found, rtol=1e-5, atol=1e-5)  # but for rounding, and rays that graze an edge
    assert same.float().mean() > 0.998 and found[0].isfinite().any()


@pytest.mark.slow
def test_the_tables_have_a_line_for_every_item():
    gains = benchmark.measure("walk", num_envs=8, repeats=1, blocks=1)
    assert [g.item for g in gains] == [item.name for item in benchmark.items_of("walk")]
    for gain in (gains[0], gains[-1]):
        assert gain.bytes_per_env[1] > gain.bytes_per_env[0] > 0
    for ratio, lowest, highest in (gain.step_ratio for gain in gains):  # how much it is, other work decides, too
        assert 0.0 < lowest <= ratio <= highest
    starts = benchmark.start_up("walk", num_envs=8, repeats=1)
    assert starts[1].memory_mb > starts[0].memory_mb and starts[1].modules > starts[0].modules
    assert benchmark.step_row(gains[0]).count("|") == benchmark.step_header(8)[0].count("|")
    assert benchmark.start_row(*starts).count("|") == benchmark.START_HEADER[0].count("|")
