"""The list of runs: recipe, iterations and rates of each, the newest last."""

import os

import pytest

from omniperception import config
from omniperception.commands import main
from omniperception.learning.progress import PROGRESS_FILE, save_progress


def run_dir(folder, name, age_s):
    path = folder / "outputs" / name
    config.save({"seed": 1}, path)
    os.utime(path / config.CONFIG_FILE, (1e9 - age_s, 1e9 - age_s))
    return path


def test_runs_are_listed_with_what_is_known_of_them(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    new, old = run_dir(tmp_path, "new", 10), run_dir(tmp_path, "a/old", 1000)
    (run_dir(tmp_path, "begun", 1) / PROGRESS_FILE).write_text('{"iterations": 3}')  # of another program
    config.save_recipe(["experiment=walk", "hydra.run.dir=outputs/new", "seed=3"], new)
    save_progress(new, 12, 300, {"velocity_error": 0.25, "reward": 1.5})
    (old / "checkpoints").mkdir()
    for iteration in (9, 50):
        (old / "checkpoints" / f"model_{iteration}.pt").touch()
    main(["runs"])
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == ["run", "recipe", "iterations", "reward", "velocity_error"]
    assert lines[2:] == [
        ["outputs/a/old", "–", "50", "–", "–"],
        ["outputs/new", "experiment=walk seed=3", "12/300", "1.5", "0.25"],
        ["outputs/begun", "–", "–", "–", "–"],
    ]
    main(["runs", "outputs/a"])
    assert "outputs/a/old" in capsys.readouterr().out


@pytest.mark.parametrize("folder", ["nowhere", "empty"])
def test_a_folder_without_runs_is_named(tmp_path, monkeypatch, capsys, folder):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(SystemExit, match="2"):
        main(["runs", f"folder={folder}"])
    error = capsys.readouterr().err
    assert error.startswith(f"error: folder={folder} ") and error.count("\n") == 1
