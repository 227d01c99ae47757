"""The ablation study: one command trains, goes on, evaluates and writes the table."""

import json
import re
from pathlib import Path

import pytest

from omniperception.commands import main
from omniperception.evaluation.ablation import Ablation, pooled, write_tables

GIVEN = {"out": Path("x"), "experiment": "avoid", "variants": ["fps_gru"], "seeds": [1], "scenarios": ["corridor"]}


def test_pooled_rates_by_hand():
    rate = pooled([(8, 10), (4, 10)])
    assert (rate["rate"], rate["least"], rate["most"], rate["n"]) == (0.6, 0.4, 0.8, 20)
    assert rate["low"] == pytest.approx(0.3866, abs=1e-4) and rate["high"] == pytest.approx(0.7812, abs=1e-4)


def test_every_line_of_a_table_has_as_many_cells(tmp_path):
    """Or it is not shown as one."""
    study = Ablation(**GIVEN | {"out": tmp_path})
    rates = {
        name: {"count": 1, "rate": 0.5} for name in ("success", "success_untouched", "collision", "fall", "time_out")
    }
    file = study.run_dir("fps_gru", 1) / "evaluation" / "corridor.json"
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps({"policies": {"run": {"rates": rates, "episodes": 2}}}))
    lines = [line for line in write_tables(study).splitlines() if line.startswith("|")]
    assert len(lines) == 3 and {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {8}


@pytest.mark.slow
def test_a_study_goes_on_where_it_was_and_writes_the_table(tmp_path, capfd):
    arguments = [
        f"out={tmp_path}",
        "variants=fps_mlp_small",
        "seeds=1,2",
        "scenarios=corridor",
        "trials=2",
        "num_envs=2",
        "ppo.num_steps_per_env=4",
        "ppo.num_mini_batches=1",
        "ppo.max_iterations=1",
        "observations.groups.proprioception.history=1",
        "obstacles.curriculum=null",
        "terminations.episode_length_s=0.3",
    ]
    main(["ablate", "stage=train", *arguments])
    checkpoints = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/seed*/checkpoints/model_1.pt")}
    assert len(checkpoints) == 2
    main(["ablate", *arguments])
    assert {path: path.stat().st_mtime_ns for path in checkpoints} == checkpoints
    table = (tmp_path / "ablation.md").read_text()
    assert re.search(r"\| fps_mlp_small +\| .*33\.3 \\\| 93\.3 +\|", table)
    rows = json.loads((tmp_path / "ablation.json").read_text())["rows"]
    assert rows["fps_mlp_small"]["corridor"]["collision"]["n"] == 4
    with pytest.raises(SystemExit, match="2"):
        main(["ablate", *arguments, "ppo.gamma=0.9"])
    assert "holds a run of another configuration" in capfd.readouterr().err
