"""Studies: one command trains, goes on, evaluates and writes the tables."""

import hashlib
import os
import re
import signal
import subprocess
import sys
import threading
from dataclasses import replace

import pytest
import torch
import yaml

from omniperception import build, config
from omniperception.commands import main
from omniperception.config import ConfigError
from omniperception.env.metrics import OUTCOMES
from omniperception.evaluation.ablation import (
    Ablation,
    Arm,
    Study,
    _ended_with_this_process,
    _training,
    check_trainings,
    load_study,
    write_tables,
)
from omniperception.evaluation.report.records import Record, read, write
from omniperception.evaluation.report.studies import study_table
from omniperception.evaluation.trials.outcomes import Episodes

STUDY = Study(experiment="avoid", variants=["fps_gru"], seeds=[1], scenarios=["corridor"], trials=2)


def evaluated(ablation, trials=2, arm="own", **given):
    """Writes a result of an arm's only run, one that reached the goal and one that fell, and its checkpoint."""
    run_dir = ablation.run_dir(arm, "fps_gru", 1)
    config.save(build.assemble(config.compose(["perception=fps_gru"])).composed, run_dir)
    checkpoint = run_dir / "checkpoints" / "model_1.pt"
    checkpoint.parent.mkdir(exist_ok=True)
    checkpoint.write_bytes(b"weights")
    outcome, count = torch.tensor([OUTCOMES.index("goal"), OUTCOMES.index("fall")])[:trials], trials
    zeros = torch.zeros(trials, dtype=torch.float64)
    plain = dict.fromkeys(("length_s", "first_contact_s", "energy", "path", "velocity_error", "yaw_rate_error"), zeros)
    nothing = dict.fromkeys(("impulse", "clearance", "free_time_s", "free_velocity_error", "free_s"))
    trials = Episodes(**plain, **nothing, outcome=outcome, contacts=outcome * 0, has_goal=True, weight=150.0)
    weights = hashlib.sha256(b"weights").hexdigest()
    named = {"policy": "run", "world": "corridor", "terrain": "own", "condition": "ideal", "split": "dev"}
    named |= {"weights": weights} | given
    record = Record(**named, condition_version=1, run=str(run_dir), seed=1, facts={}, episodes=trials)
    path = "{split}-{condition}-{world}-{terrain}-{policy}-{count}.json".format(**named, count=count)
    write(run_dir / "evaluation" / path, [record])


def test_a_row_for_each_arm_and_every_line_has_as_many_cells(tmp_path):
    """Or it is not shown as a table."""
    ablation = Ablation(replace(STUDY, arms={"alone": Arm(), "taught": Arm()}), tmp_path)
    evaluated(ablation, arm="alone")
    evaluated(ablation, arm="taught")
    lines = [line for line in write_tables(ablation).splitlines() if line.startswith("|")]
    assert len(lines) == 4 and {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {10}
    assert [line.split("|")[1].strip() for line in lines[2:]] == ["alone", "taught"]
    records = read(tmp_path / "results.json.gz")
    assert study_table(records) == (tmp_path / "ablation.md").read_text()


def test_the_worlds_of_a_suite_stand_in_one_table_first(tmp_path):
    (tmp_path / "suite").mkdir()
    (tmp_path / "suite" / "mine.yaml").write_text("worlds: {corridor: [flat], rod: [flat]}\n")
    study = replace(STUDY, suite="mine", scenarios=[], arms={"alone": Arm(), "taught": Arm()})
    ablation = Ablation(study, tmp_path, (f"hydra.searchpath=[file://{tmp_path}]",))
    assert [(world.name, world.terrain) for world in ablation.worlds()] == [("corridor", "flat"), ("rod", "flat")]
    for world in ("corridor", "rod"):
        evaluated(ablation, arm="alone", world=world, terrain="flat")
        evaluated(ablation, arm="taught", world=world, terrain="flat")
    rows = [line.split("|") for line in write_tables(ablation).splitlines() if line.startswith("|")]
    assert [cell.strip() for cell in rows[0][1:-1]] == ["world", "alone/fps_gru", "taught/fps_gru"]
    assert [row[1].strip() for row in rows[2:5]] == ["corridor", "rod", "all 2"]
    assert [cell.strip() for cell in rows[4][2:-1]] == ["50.0 [15.0, 85.0]"] * 2  # 2 of 4 trials
    with pytest.raises(ConfigError, match="suite=held is unknown; did you mean held_out"):
        Ablation(replace(STUDY, suite="held", scenarios=[]), tmp_path)


@pytest.mark.parametrize(
    "given", [{"trials": 1}, {"condition": "robot"}, {"split": "test"}, {"weights": "0f"}], ids=str
)
def test_results_of_other_evaluations_are_not_in_the_table(tmp_path, given):
    ablation = Ablation(STUDY, tmp_path)
    evaluated(ablation, **given)
    with pytest.raises(ConfigError, match="in corridor with condition=ideal policy=run trials=2"):
        write_tables(ablation)
    evaluated(ablation)
    assert "50.0 [" in write_tables(ablation)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"conditions": ["paperr"]}, "conditions=paperr is unknown; did you mean paper"),
        ({"scenarios": ["all", "static"]}, "scenarios=all has every scenario"),
        ({"seeds": [1, 2, 1]}, "seeds=1,2,1 names one twice"),
        ({"arms": {"taught": Arm(after="lesson"), "lesson": Arm()}}, "after=lesson must be an arm before it"),
        ({"split": "tests"}, "split=tests is unknown; did you mean test"),
        ({"policies": ["blinded"]}, "policies=blinded is unknown; did you mean blind"),
        ({"suite": "held_out"}, "either scenarios or a suite, got scenarios=corridor and suite=held_out"),
        ({"scenarios": []}, "either scenarios or a suite, got neither"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_study_that_cannot_be(given, message, tmp_path):
    """Is refused before the trainings."""
    with pytest.raises(ConfigError, match=message):
        Ablation(replace(STUDY, **given), tmp_path)
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "mine.yaml").write_text("experiment: avoid\nvariant: [fps_gru]\n")
    with pytest.raises(ConfigError, match=r"mine.yaml is no study: .*unexpected keyword argument 'variant'"):
        load_study("mine", [tmp_path])


@pytest.mark.parametrize("name", config.presets(config.STUDIES))
def test_studies_that_are_shipped_compose(name, tmp_path):
    check_trainings(Ablation(load_study(name), tmp_path))


def test_an_arm_says_more_than_its_study_and_the_command_line_more_than_both(tmp_path):
    arms = {"first": Arm(), "then": Arm(["ppo.lam=0.9", "ppo.gamma=0.98"], after="first")}
    shared = ["init=pretrained/gait", "ppo.lam=0.8", "ppo.gamma=0.97", "ppo.clip_param=0.3"]
    ablation = Ablation(replace(STUDY, arms=arms, overrides=shared), tmp_path, ("ppo.gamma=0.99",))
    first, then = (_training(ablation, arm, "fps_gru") for arm in arms)
    settings = [text for text in then if text.startswith(("ppo.", "init="))]
    begins = f'init="{tmp_path}/first/fps_gru/seed${{seed}}"'
    assert sorted(settings) == [begins, "ppo.clip_param=0.3", "ppo.gamma=0.99", "ppo.lam=0.9"]
    assert "init=pretrained/gait" in first and "ppo.lam=0.8" in first
    check_trainings(ablation)
    for given, said in (("init=other", "another has ended"), ("seed=3", "say this"), ("perception=none", "say this")):
        with pytest.raises(ConfigError, match=said):
            Ablation(ablation.study, tmp_path, (given,))


def test_studies_come_one_after_the_other_each_in_its_folder(monkeypatch, capsys):
    done = []
    monkeypatch.setattr("omniperception.commands.ablate.train", done.append)
    main(["ablate", "study=avoider,end_to_end", "stage=train", "seeds=2"])
    assert [(a.study.experiment, str(a.out), a.study.seeds) for a in done] == [
        ("avoid", "outputs/avoider", (2,)),
        ("end_to_end", "outputs/end_to_end", (2,)),
    ]
    for given, said in (
        (["out=x"], "out=x is the folder of one study, 2 are given"),
        (["arms=lesson"], "arms=lesson is unknown"),  # of avoider; nothing was trained before
    ):
        with pytest.raises(SystemExit, match="2"):
            main(["ablate", "study=end_to_end,avoider", "stage=train", *given])
        assert said in capsys.readouterr().err and len(done) == 2


@pytest.mark.slow
def test_a_study_goes_on_where_it_was_and_writes_the_table(tmp_path, capfd):
    """Two arms, of which the second begins with the weights of the first."""
    study = {"experiment": "avoid", "variants": ["fps_mlp_small"], "seeds": [1, 2], "scenarios": ["corridor"]}
    short, longer = ["ppo.max_iterations=1", "ppo.gamma=0.9"], ["ppo.max_iterations=2"]
    study |= {
        "trials": 2,
        "overrides": ["ppo.max_iterations=3", "ppo.lam=0.91"],
        "arms": {"short": {"overrides": short}, "long": {"after": "short", "overrides": longer}},
    }
    (tmp_path / "conf" / "study").mkdir(parents=True)
    (tmp_path / "conf" / "study" / "mine.yaml").write_text(yaml.safe_dump(study, sort_keys=False))
    out = tmp_path / "out"
    arguments = [
        *("--config-dir", str(tmp_path / "conf"), "study=mine", f"out={out}"),
        *("num_envs=2", "ppo.num_steps_per_env=4", "ppo.num_mini_batches=1", "ppo.gamma=0.98"),
        *("obstacles.curriculum=null", "terminations.episode_length_s=0.3"),
    ]
    main(["ablate", "stage=train", *arguments])
    checkpoints = {path: path.stat().st_mtime_ns for path in out.glob("*/*/seed*/checkpoints/model_*.pt")}
    names = sorted(str(path.relative_to(out)).replace("/checkpoints/", " ") for path in checkpoints)
    runs = [f"{arm}/fps_mlp_small/seed{seed}" for arm in ("long", "short") for seed in (1, 2)]
    assert {name.split()[0] for name in names} == set(runs)
    assert {f"{run} model_{2 if run.startswith('long') else 1}.pt" for run in runs} <= set(names)
    for seed in (1, 2):
        begun = config.load(out / f"long/fps_mlp_small/seed{seed}").init
        assert str(begun) == str(out / f"short/fps_mlp_small/seed{seed}")
    ppo = config.load(out / "short/fps_mlp_small/seed1").ppo
    assert (ppo.gamma, ppo.lam) == (0.98, 0.91)  # the command line's before the arm's, the arm's before the study's
    main(["ablate", *arguments])
    assert {path: path.stat().st_mtime_ns for path in checkpoints} == checkpoints
    table = (out / "ablation.md").read_text()
    assert re.search(r"\| long +\| fps_mlp_small +\| run +\| \d", table) and "each of 4 runs" in table
    with pytest.raises(SystemExit, match="2"):
        main(["ablate", *arguments, "ppo.lam=0.8"])
    assert "holds a run of another configuration" in capfd.readouterr().err


@pytest.mark.parametrize("another_failed", [False, True])
def test_trainings_do_not_outlive_who_started_them(another_failed):
    with pytest.raises(KeyboardInterrupt), _ended_with_this_process() as running:
        running.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]))
        threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGTERM)).start()
        if another_failed:
            raise ConfigError("this one is waited for all the same")
        running[0].wait()
    assert running[0].returncode == -signal.SIGTERM
