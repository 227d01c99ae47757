"""Errors in one line: robots' files that are wrong, full and closed disks, pipes that nobody reads, poor terminals."""

import contextlib
import os
import resource
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from omniperception import config
from omniperception.commands import COMMANDS, main
from omniperception.common import provenance
from omniperception.deploy.export import BlindNetwork, write_onnx, write_torchscript
from omniperception.evaluation.film.video import Recorder
from omniperception.learning import CheckpointError, load_checkpoint
from omniperception.scene.robot_file import compile_robot, read_robot
from omnirobot.common.figures import new_figure, save_figure
from omnirobot.common.files import write_whole

sys.path.insert(0, str(Path(__file__).parents[1]))
from own_robots import BIPED, HEXAPOD

ROOT = Path(__file__).resolve().parents[2]
SMALL = (
    *("perception=none", "lidar=none", "rewards=walk", "observations=walk", "obstacles=none", "num_envs=2"),
    *("ppo.num_steps_per_env=4", "ppo.num_mini_batches=1", "ppo.num_learning_epochs=1", "ppo.hidden_dims=[8]"),
    *("sim.num_threads=1", "ppo.save_interval=1"),
)
WIDE = [word.replace("=[8]", "=[256]") for word in SMALL]
PROGRAM = [sys.executable, "-m", "omniperception"]
REFUSED = "/sys/omniperception"
"""Where not even root may write."""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two checkpoints."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    main(["train", *SMALL, "ppo.max_iterations=2", f"hydra.run.dir={folder}"])
    return folder


@pytest.fixture
def run_dir(here, trained):
    """A copy of it, called run in the working directory."""
    shutil.copytree(trained, here / "run")
    return Path("run")


@pytest.fixture
def one_line(capsys):
    """Runs a command line that is refused, and gives its one line."""

    def run(*words):
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            main(list(words))
        error = capsys.readouterr().err
        assert stopped.value.code == 2 and error.startswith("error: ") and error.count("\n") == 1, error
        return error

    return run


@contextlib.contextmanager
def full_beyond(size):
    """A disk that takes no file of more bytes: of this process, and of what it starts."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


# --- a disk that is full, or is not written ---------------------------------------------------------------------------


def test_a_full_disk_at_a_checkpoint_names_the_older_ones_which_go_on(run_dir, one_line):
    size = (run_dir / "checkpoints" / "model_2.pt").stat().st_size
    with full_beyond(size // 2):
        error = one_line("train", f"run={run_dir}", "ppo.max_iterations=3", "logger=none")
    assert (
        "model_3.pt cannot be written: File too large; make room there" in error and "model_1.pt, model_2.pt" in error
    )
    names = sorted(path.name for path in (run_dir / "checkpoints").iterdir())
    assert names == ["model_1.pt", "model_2.pt"]
    words = shlex.split(error[: error.index(" goes on")].rpartition("; ")[2])
    main(words[words.index("train") :])
    assert load_checkpoint(run_dir / "checkpoints" / "model_3.pt")["iteration"] == 3


def test_a_full_disk_at_the_log_is_one_line_too(run_dir, one_line):
    """TensorBoard writes in a thread, whose traceback would stand before it."""
    with full_beyond(2000):
        assert "error: run: File too large; make room there" in one_line("train", "run=run")


@pytest.mark.slow
def test_a_disk_without_room_is_no_traceback(here):
    """A real one, of 2 MB, in a namespace of its own."""
    words = [*PROGRAM, "train", *WIDE, "ppo.max_iterations=9", "hydra.run.dir=full/run"]
    script = f"mount -t tmpfs -o size=2m none full && {shlex.join(words)}; code=$?; ls full/run/checkpoints; exit $code"
    (here / "full").mkdir()
    unshare = ["unshare", *(() if os.geteuid() == 0 else ("--user", "--map-root-user")), "--mount", "sh", "-c"]
    if subprocess.run([*unshare, "mount -t tmpfs none full"], capture_output=True).returncode:
        pytest.skip("no file system can be mounted here")
    done = subprocess.run([*unshare, script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and "cannot be written: No space left on device" in done.stderr, done.stderr
    assert done.stderr.count("\n") == 1 and "model_1.pt" in done.stdout.splitlines()


def test_a_file_that_cannot_be_written_leaves_the_old_one_and_is_named(here):
    path = here / "results.json"
    write_whole(path, "old")
    with full_beyond(1000), pytest.raises(OSError, match="File too large.*results.json"):
        write_whole(path, "new" * 1000)
    assert path.read_text() == "old" and list(here.iterdir()) == [path]


def test_networks_and_pictures_and_films_name_what_cannot_be_written(here, make_env, trained):
    pytest.importorskip("matplotlib")
    onnx = pytest.importorskip("onnx")
    from omniperception import build

    run = build.load_run(trained, ["num_envs=1"])
    policy = build.load_policy(run, trained)
    network = BlindNetwork(policy.policy)
    figure = new_figure(3.0, 3.0)
    env = make_env(num_envs=1, blind=True)

    def film(path):
        recorder = Recorder(env, path, 0.04)
        recorder()
        recorder()
        recorder.close()

    for write, name in (
        (lambda path: write_torchscript(network, path), "policy.pt"),
        (lambda path: write_onnx(network, path), "policy.onnx"),
        (lambda path: save_figure(figure, path), "figure.png"),
        (film, "film.mp4"),
    ):
        with full_beyond(500), pytest.raises(OSError) as error:
            write(here / name)
        assert Path(error.value.filename) == here / name, name
    write_onnx(network, here / "policy.onnx")
    onnx.checker.check_model(str(here / "policy.onnx"))


def test_results_of_a_run_name_what_cannot_be_written(run_dir, one_line):
    short = ("trials=2", "terminations.episode_length_s=0.1")
    with full_beyond(100):
        assert "error: run/replay.json: File too large" in one_line("play", "run=run", "viewer=none", *short)
        assert "error: public/config.yaml: File too large" in one_line("publish", "run=run", "to=public")
        evaluated = one_line("evaluate", "run=run", "scenario=walk", "num_envs=2", "jobs=1", *short)
        assert "error: run/evaluation/dev-ideal-walk-own-run-" in evaluated
        assert "error: robot/spider.yaml: File" in one_line("robot-new", f"{ROOT}/tests/data/spider.urdf", "out=robot")


@pytest.mark.parametrize(
    "line",
    [
        f"train {' '.join(SMALL)} hydra.run.dir={REFUSED}",
        f"train -m {' '.join(SMALL)} hydra.sweep.dir={REFUSED} seed=1,2",
        f"export run=run out={REFUSED}",
        f"publish run=run to={REFUSED}",
        f"curves runs=run tags=Loss/value out={REFUSED}/a.png",
        f"robot-check go2 lidar=none out={REFUSED}",
        f"robot-new {ROOT}/tests/data/spider.urdf out={REFUSED}/robot",
        f"scan seconds=0.01 rays=100 out={REFUSED}",
    ],
)
def test_a_place_that_cannot_be_written_is_named(run_dir, one_line, line):
    assert REFUSED in one_line(*line.split()).partition("error: ")[2].partition(" ")[0]


def test_a_folder_where_a_file_should_be_is_named(run_dir, one_line):
    (run_dir / "replay.json").mkdir()
    words = ("play", "run=run", "trials=2", "viewer=none", "terminations.episode_length_s=0.1")
    assert "error: run/replay.json: Is a directory; choose another place" in one_line(*words)


def test_without_a_cache_kernels_are_compiled_for_this_process_alone():
    """A home that cannot be written, as in a container; children have the same folder, which is gone at the end."""
    code = (
        "import warp as wp; import omnilidar.launch, os, subprocess, sys; wp.init();"
        "open(wp.config.kernel_cache_dir + '/a', 'w').close(); print(wp.config.kernel_cache_dir, flush=True);"
        "code = 'import omnilidar.launch, os; print(os.environ[chr(34)])'"
        ".replace('chr(34)', repr('WARP_CACHE_PATH')); subprocess.run([sys.executable, '-c', code])"
    )
    plain = {name: value for name, value in os.environ.items() if name not in ("XDG_CACHE_HOME", "WARP_CACHE_PATH")}
    done = subprocess.run(
        [sys.executable, "-c", code], env={**plain, "HOME": REFUSED}, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "Warp CUDA" not in line]
    assert f"{REFUSED}/.cache/warp cannot be written" in line and "WARP_CACHE_PATH" in line
    own, childs = done.stdout.split()
    assert own.startswith(childs) and not Path(childs).exists()


# --- what a run directory holds ---------------------------------------------------------------------------------------


def test_a_checkpoint_that_is_cut_short_says_what_to_delete(run_dir, one_line):
    newest = run_dir / "checkpoints" / "model_2.pt"
    for size in (newest.stat().st_size // 2, 0):
        os.truncate(newest, size)
        for words in (["play", "viewer=none", "run=run"], ["train", "run=run"], ["train", *SMALL, "init=run"]):
            error = one_line(*words)
            assert f"{newest} ({size:,} bytes) is damaged" in error and "model_1.pt is the newest: delete it" in error
    newest.unlink()
    main(["train", "run=run", "ppo.max_iterations=2", "logger=none"])
    (run_dir / "checkpoints" / "model_1.pt").unlink()
    os.truncate(newest, 10)
    with pytest.raises(CheckpointError, match="give another run"):
        load_checkpoint(newest)


def test_other_files_of_a_run_that_are_cut_short_are_named(run_dir, one_line):
    os.truncate(run_dir / provenance.FILE, 10)
    assert "run/provenance.json is damaged; delete it" in one_line("publish", "run=run", "to=public")
    os.truncate(run_dir / config.CONFIG_FILE, 0)
    assert "run/config.yaml is not a configuration" in one_line("play", "run=run", "viewer=none")


# --- pipes and terminals ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("buffering", [-1, 1])
def test_no_command_complains_where_nobody_reads(buffering, trained, capsys):
    """As in a pipe into head; with a buffer and without."""
    lines = [["--help"], *([name, "--help"] for name in COMMANDS), ["runs", str(trained)], ["train", "--cfg", "job"]]
    for words in lines:
        reads, writes = os.pipe()
        os.close(reads)
        with (
            open(writes, "w", buffering) as nobody,
            contextlib.redirect_stdout(nobody),
            pytest.raises(SystemExit) as stopped,
        ):
            main(words)
        assert stopped.value.code == 141, words
    assert capsys.readouterr().err == ""


def test_a_pipe_into_head_has_its_line_and_a_disk_that_is_full_says_so():
    head = subprocess.run(["head", "-1"], stdin=(shown := subprocess.Popen([*PROGRAM, "--help"], **piped())).stdout,
                          capture_output=True, text=True, timeout=60)  # fmt: skip
    assert head.stdout.startswith("usage: omniperception <command>")
    assert shown.wait(60) in (0, 141) and shown.stderr.read() == b""
    with open("/dev/full", "w") as full:
        done = subprocess.run([*PROGRAM, "--help"], stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "what is printed: No space left" in done.stderr
    closed = subprocess.run(["sh", "-c", f"{shlex.join([*PROGRAM, '--help'])} >&-"], capture_output=True, timeout=60)
    assert closed.returncode == 0 and closed.stderr == b""


def piped():
    return {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}


def test_a_training_goes_on_where_nobody_reads(here):
    """As it does without a terminal; it has a checkpoint to write."""
    reads, writes = os.pipe()
    os.close(reads)
    words = [*PROGRAM, "train", *SMALL, "ppo.max_iterations=2", "logger=none", "hydra.run.dir=run"]
    done = subprocess.run(words, stdout=writes, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.stderr == "" and done.returncode == 0 and (here / "run/checkpoints/model_2.pt").is_file()


def test_a_terminal_of_ascii_shows_other_signs(run_dir):
    """A dash where nothing is known, and a name as an escape."""
    (run_dir / "overrides.yaml").unlink()
    run_dir.rename("größe")
    env = {**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    done = subprocess.run([*PROGRAM, "runs", "."], env=env, capture_output=True, timeout=60)
    assert done.returncode == 0 and done.stderr == b""
    cells = [cell.strip() for cell in done.stdout.decode("ascii").splitlines()[-1].split("|")]
    assert cells[1:4] == [r"gr\xf6\xdfe", "-", "2/2"]


def test_a_name_that_is_not_utf8_is_shown_or_refused(here, trained, one_line, capsys):
    """TensorBoard does not take it."""
    name = os.fsdecode(b"gr\xf6\xdfe")
    shutil.copytree(trained, here / name)
    main(["runs", name])
    assert r"gr\udcf6\udcdfe" in capsys.readouterr().out
    shutil.rmtree(here / name)
    error = one_line("train", *SMALL, "ppo.max_iterations=1", f"hydra.run.dir={name}")
    assert r"gr\udcf6\udcdfe" in error and "a name that is not UTF-8" in error


def test_what_is_unknown_is_told_each_known_word_once(one_line, here):
    assert one_line("runs", "a", "nonsense=1").endswith("known: folder\n")


# --- robots' files ----------------------------------------------------------------------------------------------------


def robot_of(folder, content, name="six.urdf"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return compile_robot(read_robot(path), path)


XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
DECLARED = '<?xml version="1.0" encoding="iso-8859-1"?>'
FORMS = {
    "a namespace": HEXAPOD.replace("<robot ", '<robot xmlns="http://www.ros.org" '),
    "a prefix": HEXAPOD.replace("<robot ", '<r:robot xmlns:r="http://www.ros.org" ').replace("</robot", "</r:robot"),
    "what xacro leaves": HEXAPOD.replace("<robot ", f"<robot {XACRO} "),
    "a byte order mark": b"\xef\xbb\xbf" + HEXAPOD.encode(),
    "Windows lines": HEXAPOD.replace("\n", "\r\n"),
    "UTF-16": HEXAPOD.encode("utf-16"),
    "Latin 1": (DECLARED + HEXAPOD.replace("hexapod", "Käfer")).encode("latin-1"),
    "an empty first line": '\n<?xml version="1.0"?>' + HEXAPOD,
    "a world that carries it": HEXAPOD.replace(
        "</robot>",
        '<link name="world"/><joint name="w" type="floating"><parent link="world"/><child link="base_link"/>'
        "</joint></robot>",
    ),
    "Gazebo and ROS": HEXAPOD.replace(
        "</robot>", '<transmission name="t"><joint name="l0_lift"/></transmission><gazebo reference="x"/></robot>'
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_urdf_is_the_same_robot_in_any_form(tmp_path, form):
    """6.9 kg on twelve joints and a base that floats, by hand."""
    model = robot_of(tmp_path, FORMS[form])
    assert (model.nq, model.nbody, int(model.jnt_type[0])) == (19, 14, int(mujoco.mjtJoint.mjJNT_FREE))
    assert model.body_mass.sum() == pytest.approx(6.9) and model.joint("l0_swing").range.tolist() == [-0.6, 0.6]


def test_an_mjcf_is_the_same_robot_in_any_form(tmp_path):
    forms = (
        BIPED,
        BIPED.replace("\n", "\r\n"),
        b"\xef\xbb\xbf" + BIPED.encode(),
        BIPED.replace("<mujoco ", '<mujoco xmlns="http://m" '),
        BIPED.replace("torso", "Rümpf"),
    )
    masses = [robot_of(tmp_path, form, "two.xml").body_mass.tolist() for form in forms]
    assert all(other == masses[0] for other in masses)


def test_a_capsule_of_a_urdf_is_as_long_as_its_line_and_two_radii(tmp_path):
    capsule = HEXAPOD.replace('<box size="0.4 0.2 0.08"/>', '<capsule radius="0.05" length="0.3"/>')
    model = robot_of(tmp_path, capsule)
    assert model.geom_type[0] == mujoco.mjtGeom.mjGEOM_CAPSULE
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    group, found = np.ones(6, np.uint8), np.zeros(1, np.int32)
    above = data.geom_xpos[0] + (0.0, 0.0, 1.0)
    assert mujoco.mj_ray(model, data, above, np.array([0.0, 0.0, -1.0]), group, 1, -1, found) == pytest.approx(0.8)


BOX, LIFT = '<box size="0.4 0.2 0.08"/>', '<joint name="l1_lift" type="revolute">'
MESH = '<mesh filename="package://spider/meshes/a.stl"/>'
LOOSE = '<joint name="{0}" type="fixed"><parent link="{1}"/><child link="{2}"/></joint></robot>'
WRONG = [
    ("robot ", f"robot {XACRO} a='${{b}}' ", "it is xacro, with ${b} in it; expand it: xacro "),
    (BOX, '<box size="${a} 0.2 0.08"/>', "it is xacro, with ${a} 0.2 0.08 in it"),
    ('name="l0_swing"', 'name="$(arg side)_swing"', "it is xacro, with $(arg side)_swing in it"),
    ("</robot>", '<xacro:leg name="a"/></robot>', "is xacro; expand it: xacro "),
    ('name="hexapod">', f'name="a" {XACRO}><xacro:leg/>', "it is xacro, with <xacro:leg> in it; expand it: xacro "),
    ("trunk", "tr\xfcnk", "is not UTF-8 (line 4); save it as UTF-8"),
    ("</robot>", "", "is not XML: it ends too early (line 172, column 0); give an MJCF or a URDF"),
    ('lower="-1.2"', 'lower="-1,2"', 'joint l0_lift: lower="-1,2" of <limit> must be a number'),
    ('lower="-1.2"', 'lower="-inf"', 'joint l0_lift: lower="-inf" of <limit> must be a number'),
    ('lower="-1.2"', 'lower="nan"', 'joint l0_lift: lower="nan" of <limit> must be a number'),
    ('lower="-1.2" upper="1.2" ', "", "joint l0_lift has limits from 0 to 0; give it a range"),
    ("<limit ", "<limits ", "joint l0_swing has limits from 0 to 0; give it a range"),
    (BOX, '<box size="0,4 0,2 0,08"/>', 'link trunk: size="0,4 0,2 0,08" of <box> must be 3 numbers with spaces'),
    (BOX, '<box size="0.4 0.2"/>', 'link trunk: size="0.4 0.2" of <box> must be 3 numbers'),
    (BOX, '<box size="-0.4 0.2 0.08"/>', "size 0 must be positive in geom (trunk_geom_0); give it a size"),
    (BOX, '<ellipsoid size="1 1 1"/>', "link trunk has a <geometry> that is none of box, cylinder, sphere, capsule"),
    (BOX, "<mesh/>", "link trunk has a <mesh> without filename"),
    (BOX, MESH, "mesh package://spider/meshes/a.stl is missing; looked for "),
    ('mass value="3"', 'mass value="nan"', 'link trunk: value="nan" of <mass> must be a number'),
    ('mass value="0.4"', 'mass value="0"', "mass and inertia of moving bodies must be larger than mjMINVAL (l0_upper"),
    ('ixx="0.03"', 'ixx="-0.03"', "inertia must have positive eigenvalues' in fullinertia (trunk); give that link"),
    ('ixx="0.03"', 'ixx="3"', "inertia must satisfy A + B >= C; use 'balanceinertia' to fix (trunk); give that link"),
    ('name="l1_lift"', 'name="l0_lift"', "repeated name l0_lift of two joints; rename one of the two"),
    ('link name="l1_upper"', 'link name="l0_upper"', "repeated name l0_upper of two links; rename one of the two"),
    ('<link name="l0_upper">', "<link>", "a <link> has no name"),
    (
        'parent link="l0_upper"',
        'parent link="l0_uper"',
        "joint l0_lift has parent l0_uper, which is no link; did you",
    ),
    ('<child link="l0_lower"/>', "", "joint l0_lift has no child link"),
    ("</robot>", LOOSE.format("again", "l0_lower", "l1_lower"), "link l1_lower is the child of two joints"),
    ("</robot>", LOOSE.format("again", "l0_lower", "base_link"), "all of its links are children of joints"),
    ("</robot>", '<link name="alone"/></robot>', "alone and base_link are the children of no joint; one root"),
    ('type="revolute"', 'type="hinge"', "joint l0_swing has type hinge; known: revolute, continuous"),
    ('type="revolute"', 'type="floating"', "joint l0_swing is floating; only the root link floats"),
    ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', "joint l0_swing has an axis of length 0; give it a direction"),
    (
        LIFT,
        f'{LIFT}<mimic joint="l0_lft"/>',
        "joint l1_lift mimics l0_lft; both must turn or slide; did you",
    ),
    (LIFT, f'{LIFT}<mimic joint="l1_lift"/>', "joint l1_lift mimics l1_lift; both must turn or slide"),
    (LIFT, f'{LIFT}<mimic joint="l0_lift" offset="x"/>', 'joint l1_lift: offset="x" of <mimic> must be a number'),
]


@pytest.mark.parametrize(("old", "new", "named"), WRONG, ids=[new[:30] + named[:20] for _, new, named in WRONG])
def test_a_urdf_that_is_wrong_says_where(tmp_path, old, new, named):
    assert old in HEXAPOD
    with pytest.raises(ValueError) as error:
        robot_of(tmp_path, HEXAPOD.replace(old, new, 1).encode("latin-1"))
    text = str(error.value)
    assert text.startswith(f"robot.file={tmp_path / 'six.urdf'}") and "\n" not in text and named in text, text


def test_what_expands_a_xacro_file_writes_another(tmp_path):
    for name, expanded in (("spider.urdf.xacro", "spider.urdf.urdf"), ("spider.urdf", "spider_expanded.urdf")):
        with pytest.raises(ValueError, match=f"xacro {tmp_path / name} > {tmp_path / expanded}$"):
            robot_of(tmp_path, HEXAPOD.replace("0.4 0.2 0.08", "${x} 1 1"), name)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (BIPED.replace("<worldbody>", '<include file="gone.xml"/><worldbody>', 1), "'gone.xml' (<include>, line 8); "),
        (BIPED.replace('range="-1 1"', 'range="nan 1"', 1), '<joint> tail has range="nan 1"; give numbers'),
        (BIPED.replace('range="-1 1"', 'range="-inf inf"', 1), "joint tail has a range from -inf to inf; give it"),
        (BIPED.replace('pos="0 0.07 -0.08"', 'pos="nan 0 0"', 1), '<body> left_thigh has pos="nan 0 0"; give numbers'),
        (BIPED.replace('range="-1 1"', 'range="a b"', 1), "attribute 'range' (<joint>, line 14); give numbers"),
        (BIPED.replace('range="-1 1"', 'range="1"', 1), "does not have enough data (<joint>, line 14); give numbers"),
        ((DECLARED + BIPED.replace("torso", "Rümpf")).encode("latin-1"), "it is not UTF-8, as MuJoCo reads it"),
        (BIPED.encode("utf-16"), "it is not UTF-8, as MuJoCo reads it; save it as UTF-8"),
        ("", "is not XML: it ends too early (line 1"),
        (b"PXR-USDC\0\0", "is not XML (line 1, column 8); give an MJCF or a URDF"),
        ('<sdf version="1.6"/>', "its root is <sdf>; give an MJCF, <mujoco>, or a URDF, <robot>"),
        ("version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "is a pointer of Git LFS to the file; fetch it"),
    ],
)  # fmt: skip
def test_an_mjcf_that_is_wrong_says_where(tmp_path, content, named):
    with pytest.raises(ValueError) as error:
        robot_of(tmp_path, content, "two.xml")
    text = str(error.value)
    assert text.startswith(f"robot.file={tmp_path / 'two.xml'}") and "\n" not in text and named in text, text


def test_an_mjcf_of_another_suffix_says_what_to_call_it(tmp_path):
    with pytest.raises(ValueError, match=r"names that end in \.xml; call it two\.xml"):
        robot_of(tmp_path, BIPED, "two.mjcf")


@pytest.mark.parametrize("made", ["a link to nothing", "a folder"])
def test_what_is_no_file_of_a_robot_is_named(here, one_line, made):
    path = here / "six.urdf"
    path.mkdir() if made == "a folder" else path.symlink_to("nowhere.urdf")
    assert "file=six.urdf is no file" in one_line("robot-new", "six.urdf")
    assert "robot.file=six.urdf is neither a packaged asset nor a file" in one_line("train", "robot.file=six.urdf")
