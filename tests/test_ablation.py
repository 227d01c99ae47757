"""The ablation study: one command trains, goes on, evaluates and writes the table."""

import hashlib
import json
import re
from pathlib import Path

import pytest
import torch

from omniperception.commands import main
from omniperception.config import ConfigError
from omniperception.env.metrics import OUTCOMES
from omniperception.evaluation.ablation import Ablation, write_tables
from omniperception.evaluation.outcomes import Episodes
from omniperception.evaluation.records import Record, write

GIVEN = {"out": Path("x"), "experiment": "avoid", "variants": ["fps_gru"], "seeds": [1], "scenarios": ["corridor"]}


def evaluated(study, trials=2, **given):
    """Writes a result of the study's only run, one that reached the goal and one that fell, and its checkpoint."""
    checkpoint = study.run_dir("fps_gru", 1) / "checkpoints" / "model_1.pt"
    checkpoint.parent.mkdir(parents=True, exist_ok=True)
    checkpoint.write_bytes(b"weights")
    outcome = torch.tensor([OUTCOMES.index("goal"), OUTCOMES.index("fall")])[:trials]
    zeros = torch.zeros(trials, dtype=torch.float64)
    plain = dict.fromkeys(("length_s", "first_contact_s", "energy", "path", "velocity_error", "yaw_rate_error"), zeros)
    nothing = dict.fromkeys(("impulse", "clearance", "free_time_s", "free_velocity_error", "free_s"))
    trials = Episodes(**plain, **nothing, outcome=outcome, contacts=outcome * 0, has_goal=True, weight=150.0)
    weights = hashlib.sha256(b"weights").hexdigest()
    named = {"policy": "run", "world": "corridor", "terrain": "own", "condition": "ideal", "split": "dev"}
    named |= {"weights": weights} | given
    record = Record(**named, condition_version=1, run="a", seed=1, facts={}, episodes=trials)
    path = "{split}-{condition}-{world}-{terrain}-{policy}.json".format(**named)
    write(study.run_dir("fps_gru", 1) / "evaluation" / path, [record])


def test_every_line_of_a_table_has_as_many_cells(tmp_path):
    """Or it is not shown as one."""
    study = Ablation(**GIVEN | {"out": tmp_path, "trials": 2})
    evaluated(study)
    lines = [line for line in write_tables(study).splitlines() if line.startswith("|")]
    assert len(lines) == 3 and {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {8}


@pytest.mark.parametrize(
    "given", [{"trials": 1}, {"condition": "robot"}, {"split": "test"}, {"weights": "0f"}], ids=str
)
def test_results_of_other_evaluations_are_not_in_the_table(tmp_path, given):
    study = Ablation(**GIVEN | {"out": tmp_path, "trials": 2})
    evaluated(study, **given)
    with pytest.raises(ConfigError, match="has not been evaluated in corridor with trials=2 and its newest checkpoint"):
        write_tables(study)
    evaluated(study)
    assert "50.0 [" in write_tables(study)


def test_a_seed_is_one_run():
    with pytest.raises(ConfigError, match="seeds=1,2,1 names one twice"):
        Ablation(**GIVEN | {"seeds": [1, 2, 1]})


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
        "obstacles.curriculum=null",
        "terminations.episode_length_s=0.3",
    ]
    main(["ablate", "stage=train", *arguments])
    checkpoints = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/seed*/checkpoints/model_1.pt")}
    assert len(checkpoints) == 2
    main(["ablate", *arguments])
    assert {path: path.stat().st_mtime_ns for path in checkpoints} == checkpoints
    table = (tmp_path / "ablation.md").read_text()
    assert re.search(r"\| fps_mlp_small +\| \d", table)
    rows = json.loads((tmp_path / "ablation.json").read_text())["rows"]
    assert rows["fps_mlp_small"]["corridor"]["collision"]["seeds"] == 2
    with pytest.raises(SystemExit, match="2"):
        main(["ablate", *arguments, "ppo.gamma=0.9"])
    assert "holds a run of another configuration" in capfd.readouterr().err
