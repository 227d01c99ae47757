"""A hundred wrong command lines over all commands and groups: exit code 2 and one line that names the key."""

import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from omnilidar.sensor import Lidar  # noqa: F401  Warp asks for the processor in a process of its own
from omniperception import build, config
from omniperception.commands import COMMANDS, main
from omniperception.common import provenance
from omniperception.learning import Runner

ROOT = Path(__file__).resolve().parents[1]
GROUPS = sorted(path.name for path in config.CONFIG_DIR.iterdir() if path.is_dir())


def wrong_shape(state):
    """A reward of a shape that no reward has."""
    return torch.zeros(3, 5)


def not_a_tensor(state):
    """A reward that is none."""
    return 1.0


# The command line, and what the message must name. RUN is a run directory of experiment=walk.
LINES = [
    # words
    ("trian", "trian"),
    ("train num_envs", "num_envs"),
    ("train --fast", "--fast"),
    ("train num_envs=2 num_envs=3", "num_envs is given twice"),
    ("train --config-dir nowhere", "nowhere"),
    ("train seed=1,2", "seed=1,2"),
    ("train commands.lin_vel_x=[1", "commands.lin_vel_x=[1"),
    ("train hydra.searchpath=[nowhere]", "nowhere"),
    ("train hydra/launcher=rocket", "rocket"),
    ("train hydra.run.dri=x", "hydra.run.dri"),
    ("train run=nowhere", "run=latest"),
    ("train run=latest", "train one first"),
    ("train run=", "run="),
    ("train run=RUN -m", "-m"),
    ("train run=RUN seed=9", "has begun already"),
    ("train run=RUN init=other", "has begun already"),
    ("play run=RUN viewer=none obstacles.split=test", "evaluate split=test"),
    ("evaluate run=RUN ++obstacles.split=test", "argument of its own"),
    ("gait run=RUN what=kicks num_envs=3", "this command sets num_envs=64 itself"),
    ("gait run=RUN what=kicks scenario=corridor", "this command sets scenario=walk itself"),
    ("gait run=RUN what=feet scenario=corridor", "this command sets scenario=walk itself"),
    ("train job", "argument 'job' is not of the form key=value"),
    ("train --cfg num_envs=3 job", "argument 'job' is not of the form key=value"),
    ("train experiment=walk ppo.start_std=0.3", "is of a policy that another run gives"),
    ("train perception=direct_mlp_small perception.sampler.num_rays=7", "must be perception.sampler.num_rays=7"),
    ("gait run=RUN what=kicks trials=5", "trials= would mean nothing: it is not read for what=kicks"),
    ("gait run=RUN speeds=1", "speeds= would mean nothing"),
    ("gait run=RUN robots=9", "robots= would mean nothing: it is not read for what=ranges"),
    ("gait run=RUN what=response condition=ideal", "condition= would mean nothing: it is not read for what=response"),
    ("gait run=RUN what=response terrain=mixed", "this command sets terrain=flat itself"),
    ("gait run=RUN what=response conditions=calm", "condition=calm"),
    ("gait run=RUN preset=lidar", "nothing to measure: preset=lidar"),
    ("gait run=RUN factors=0", "no factor is above 0"),
    ("gait run=RUN what=feet obstacles.split=test", "evaluate split=test"),
    ("ablate seeds=1,2,1", "names one twice"),
    ("train run=RUN experiment=paper", "experiment=paper"),
    ("train run=RUN episodes=3", "episodes=3"),
    ("train run=RUN ppo.foo=1", "max_iterations"),
    # keys that nothing takes
    ("train num_env=64", "did you mean num_envs?"),
    ("train +num_env=64", "did you mean num_envs?"),
    ("train ++num_env=64", "did you mean num_envs?"),
    ("train sede=1", "did you mean seed?"),
    ("train obstacle=static", "did you mean obstacles?"),
    ("train ~nothing", "nothing"),
    ("train obstacles=null", "obstacles=null: obstacles names a preset; known: all, corridor"),
    ("train condition=null", "~condition leaves it out"),
    ("train lidar.max_rage=3", "did you mean lidar.max_range?"),
    ("train +lidar.rate=3", "lidar.rate"),
    ("train observations.command_acceleration=[4,8]", "is added: +observations.command_acceleration=[4,8]"),
    ("train robot.kq=3", "robot.kq"),
    ("train rewards.terms.tilt_squred.weight=1", "did you mean rewards.terms.tilt_squared?"),
    ("train +rewards.terms.tilt_squred.weight=1", "did you mean rewards.terms.tilt_squared?"),
    ("train rewards.terms.yaw_rate_tracking.sigma=1.0", "rewards.terms.yaw_rate_tracking.sigma"),
    ("train +observations.groups.proprioception.terms.smell={}", "smell"),
    ("train +obstacles.groups.box={kind:cone,count:1,size:[[1,1]]}", "cone"),
    ("train seed.x=3", "seed.x=3"),
    ("train experiment=quickstart observations=gait_without_velocity", "estimates would be fitted to the command"),
    (
        "train experiment=avoid +observations.groups.command.history=3",
        "groups.command.history=3: an avoid",
    ),
    # values of another type
    ("train seed=-1", "seed=-1 must lie in 0 to 8796093022207"),
    ("train seed=20000000000000", "seed=20000000000000 must lie in 0 to 8796093022207"),
    ("train seed=abc", "seed=abc must be a whole number"),
    ("train num_envs=2.5", "num_envs=2.5 must be a whole number"),
    ("train num_envs=true", "num_envs=true must be a whole number"),
    ("train init=3", "init=3 does not exist; give a run directory"),
    ("train init={a:1}", "init={'a': 1} must be a run directory, a list of them, or null"),
    ("train ppo.learning_rate=fast", "ppo.learning_rate=fast must be a number"),
    ("train ppo.hidden_dims=64", "ppo.hidden_dims=64"),
    ("train ppo.hidden_dims=[a]", "ppo.hidden_dims=[a]"),
    ("train ppo.symmetry=maybe", "ppo.symmetry=maybe must be true or false"),
    ("train commands.lin_vel_x=1.0", "commands.lin_vel_x=1.0 must be [low, high]"),
    ("train commands.lin_vel_x=[1.0]", "commands.lin_vel_x=[1.0] must be [low, high]"),
    ("train terminations.on_collision=3", "terminations.on_collision=3 must be true or false"),
    ("train rewards.terms.tilt_squared.weight=heavy", "rewards.terms.tilt_squared.weight=heavy must be a number"),
    ("train rewards.terms.tilt_squared=3", "rewards.terms.tilt_squared=3"),
    ("train rewards=3", "rewards=3"),
    ("train robot.joints=none", "robot.joints=none"),
    ("train robot.kp=[1,2]", "robot.kp"),
    ("train lidar.mount=3", "lidar.mount=3"),
    ("train randomization.latency_s=0.02", "randomization.latency_s=0.02"),
    ("train terrain.friction=ice", "terrain.friction=ice"),
    ("train perception.history=long", "perception.history=long"),
    ("train sim.cone=round", "sim.cone=round"),
    ("train obstacles.boundary=3", "obstacles.boundary=3"),
    # values out of range
    ("train num_envs=0", "num_envs=0 must be at least 1"),
    ("train sim.timestep=nan", "sim.timestep=.nan must be finite"),
    ("train terminations.min_base_height=nan", "terminations.min_base_height=.nan must be finite"),
    ("train terminations.episode_length_s=inf", "terminations.episode_length_s=.inf must be finite"),
    ("train commands.lin_vel_x=[nan,1]", "commands.lin_vel_x=[.nan, 1] must be finite"),
    ("train lidar.motion_jump=nan", "lidar.motion_jump=.nan must be finite"),
    ("train terminations.episode_length_s=0.001", "terminations.episode_length_s=0.001 is less than a control step"),
    ("train randomization=paper randomization.payload_position=[0.1]", "payload_position=[0.1] must be [x, y, z]"),
    ("train ppo.hidden_dims=[]", "ppo.hidden_dims=[] must be widths of hidden layers"),
    ("train ppo.hidden_dims=[64,0]", "ppo.hidden_dims=[64, 0] must be widths of hidden layers"),
    ("train ppo.value_loss_coef=-1", "ppo.value_loss_coef=-1 must not be negative"),
    ("train scenario=maze +obstacles.groups.wall.layout.cell=-2", "cell=-2.0 of a maze must be wider"),
    ("train sim.timestep=-1", "sim.timestep=-1"),
    ("train sim.decimation=0", "sim.decimation=0"),
    ("train ppo.num_mini_batches=0", "ppo.num_mini_batches=0"),
    ("train ppo.gamma=1.5", "ppo.gamma=1.5"),
    ("train ppo.activation=foo", "ppo.activation=foo"),
    ("train ppo.max_iterations=-1", "ppo.max_iterations=-1"),
    ("train commands.lin_vel_x=[1.0,-1.0]", "lin_vel_x"),
    ("train terrain.restitution=1.5", "terrain.restitution=1.5"),
    ("train terrain.friction=-1", "terrain.friction=-1"),
    ("train terrain=mixed terrain.levels=0", "terrain.levels=0"),
    ("train robot.kp=-1", "robot.kp=-1"),
    ("train lidar.period_s=-0.1", "period_s=-0.1"),
    ("train lidar.period_s=0.03", "lidar.period_s=0.03"),
    ("train lidar.max_range=-1", "max_range=-1"),
    ("train lidar.num_rays=0", "num_rays=0"),
    ("train lidar.selection=best", "lidar.selection=best"),
    ("train obstacles.groups.walker.count=-1", "obstacles.groups.walker: count=-1"),
    ("train obstacles.area=[5,-5,5,-5]", "obstacles.area=[5, -5, 5, -5] must be [x_low"),
    ("train obstacles.groups.walker.size=[[300,300],[1,1]]", "obstacles.groups.walker are 600 m across"),
    ("train robot.base=torso", "robot.base=torso is no body of go2.xml; known: base"),
    ("train robot.default_joint_pos.FL_calf_joint=1", "default_joint_pos.FL_calf_joint=1 is outside its range"),
    ("train +robot.ray_groups=[7]", "robot.ray_groups names 7, in which go2.xml has no geom"),
    ("train robot.gait.frequency=50", "robot.gait.frequency=50 is too fast for control steps of 0.02 s; at most 12.5"),
    ("train observations.actor=[smell]", "smell"),
    ("train perception.sampler.num_proximal=0", "perception.sampler.num_proximal=0"),
    ("train randomization.latency_s=[0.02,0.01]", "latency_s"),
    ("train terminations.episode_length_s=0", "episode_length_s=0"),
    # parts that do not fit together
    ("train lidar=none", "perception=none"),
    ("train lidar=none perception=none", "rewards=walk observations=walk"),
    ("train scenario=corridor obstacles=static", "scenario=corridor defines the obstacles"),
    ("train commands=corridor obstacles=corridor obstacles.free_path=3", "free_path"),
    ("train robot.base=trunk", "robot.base=trunk"),
    ("train robot.joints=[a,b]", "robot.joints"),
    ("train robot.file=nowhere.xml", "robot.file=nowhere.xml"),
    ("train robot.mounts.head.exclude_geoms=[nose]", "nose"),
    ("train init=nowhere", "init=nowhere"),
    ("train suite=held_out", "suite=held_out is unknown"),
    ("train experiment=walk init=RUN robot=anymal", "it moves the robot of go2.xml, this one is that of anymal.xml"),
    ("train init=RUN stepping={lift:1.5,rest_s:1}", "its actions meant another motion, that of 'stepping=null'"),
    ("train init=RUN stepping={lift:1.5}", "stepping"),
    ("train stepping={lift:-1,rest_s:1}", "stepping.lift=-1 must be positive"),
    ("train experiment=avoid init=nowhere", "init=nowhere does not exist; give a run directory or init=latest"),
    ("train experiment=walk ppo.num_learning_epochs=0", "ppo.num_learning_epochs=0 keeps the policy as it is"),
    ("train +rewards.terms.mine={func:wrong_input_terms.wrong_shape,weight:1.0}", "has shape (3, 5), expected (2,)"),
    ("train +rewards.terms.mine={func:wrong_input_terms.not_a_tensor,weight:1.0}", "rewards.terms.mine"),
    ("train +rewards.terms.mine={func:wrong_input_terms.missing,weight:1.0}", "rewards.terms.mine"),
    ("train +rewards.terms.mine={func:nowhere.at_all,weight:1.0}", "nowhere"),
    ("train +rewards.terms.mine={func:wrong_input_terms.wrong_shape}", "rewards.terms.mine"),
    # the other commands
    ("play run=nowhere", "run=nowhere"),
    ("play run=EMPTY", "is not a run directory"),
    ("play run=RUN viewer=hologram", "viewer=hologram must be one of video, web, none"),
    ("play run=RUN trials=many", "trials=many must be a whole number >= 1"),
    ("play run=RUN trails=3", "did you mean trials?"),
    ("play run=RUN video_s=0", "video_s=0"),
    ("play run=RUN camera=front", "camera=front must be one of chase, top, side"),
    (
        "play run=RUN video_size=640x360",
        "must be a whole number >= 2, or several with commas between",
    ),
    ("play run=RUN video_size=641,360", "video_size=641,360 must be width,height, two even numbers such as 1280,720"),
    ("play run=RUN video_envs=1,1", "video_envs=1,1 must be different numbers"),
    ("play run=RUN video_envs=0,2", "video_envs=0,2: there are 2 environments, from 0 on; num_envs=3 would do"),
    ("play run=RUN speed=3", "speed=3"),
    ("play run=RUN rewards.terms.tilt_squared.weight=1e-9 robot.kp=x", "robot.kp=x"),
    ("play run=RUN obstacles=dragons", "obstacles=dragons"),
    ("play run=RUN", "checkpoint"),
    ("evaluate run=RUN scenario=statik", "scenario=statik is unknown; did you mean static?"),
    ("evaluate run=RUN scenario=static,static", "scenario=static,static"),
    ("evaluate run=RUN policy=magic", "policy=magic"),
    ("evaluate run=RUN policy=command", "policy=command must be one of run"),
    ("evaluate run=RUN suite=hold_out", "suite=hold_out is unknown; did you mean held_out?"),
    ("evaluate run=RUN suite=held_out scenario=rod", "leave scenario= out"),
    ("evaluate run=RUN split=holdout", "split=holdout must be one of dev, test"),
    ("evaluate run=RUN split=test seed=4", "the seed of split=test follows from the weights"),
    ("evaluate run=RUN condition=dream", "condition=dream is unknown"),
    ("evaluate run=RUN policy=oracle walker=nowhere", "walker=nowhere"),
    ("evaluate run=RUN plots=maybe", "plots=maybe must be true or false"),
    ("evaluate run=pretrained/avoider obstacles=moving plots=false", "scenario=corridor defines the obstacles"),
    ("evaluate run=RUN num_envs=0", "num_envs=0"),
    ("ablate stage=dance", "stage=dance"),
    ("ablate study=perceptoin", "study=perceptoin is unknown; did you mean perception?"),
    ("ablate study=end_to_end arms=tougt", "arms=tougt is unknown; did you mean taught?"),
    ("ablate study=end_to_end arms=taught", "after=lesson must be an arm before it"),
    ("ablate variants=fps_gruu", "variants=fps_gruu is unknown; did you mean fps_gru?"),
    ("ablate seeds=a", "seeds=a"),
    ("ablate scenarios=statik", "scenarios=statik"),
    ("ablate seed=3", "seed=3: experiment=, seeds= and variants= of the study say this; leave it out"),
    ("ablate stage=table out=EMPTY variants=fps_mlp seeds=1", "has not been trained; use stage=train or stage=all"),
    ("export run=RUN formats=tarball", "formats=tarball"),
    ("export run=RUN num_envs=3", "num_envs=3"),
    ("export run=EMPTY", "is not a run directory"),
    ("publish run=RUN", "to=... must be given"),
    ("publish run=RUN to=EMPTY precision=float8", "precision=float8"),
    ("scan at=1,2", "at= would mean nothing: without mesh= there is no mesh"),
    ("scan scale=5", "scale= would mean nothing"),
    ("scan rays=5 lidar.num_rays=6", "rays=5 and lidar.num_rays= are two words for one thing"),
    ("scan port=9000", "port= would mean nothing: viewer=none has no page"),
    ("scan viewer=web seconds=2", "seconds= would mean nothing: the lab of viewer=web does not read it"),
    ("play run=RUN host=0.0.0.0", "host= would mean nothing: viewer=video has no page"),
    ("evaluate run=RUN port=9000", "port= would mean nothing: viewer=none has no page"),
    ("demo viewer=video stop_after_s=5", "stop_after_s= would mean nothing: viewer=video has no page"),
    ("evaluate run=RUN log=noted.jsonl", "log= would mean nothing: only split=test is noted"),
    ("evaluate run=RUN walker=RUN", "walker= would mean nothing: none of policy=run drives a gait"),
    ("evaluate run=RUN out=results.txt", "out=results.txt must be a file that ends in .json or .json.gz"),
    ("evaluate run=RUN", "no checkpoint in"),
    ("gait run=RUN num_envs=1", "num_envs=1: this command sets num_envs=64 itself"),
    ("curves runs=RUN out=curves.abc", "out=curves.abc must be a file that ends in .png or .pdf or .svg"),
    ("robot-trials run=RUN scenario=static,corridorr", "scenario=corridorr is unknown; did you mean corridor"),
    ("ablate conditions=paperr", "conditions=paperr is unknown; did you mean paper"),
    ("ablate policies=exported", "policies=exported: no run is exported yet"),
    ("demo viewer=video obstacles.split=test", "no film may see it"),
    ("robot-sim run=RUN obstacles.split=test", "no trial on the wire may see it"),
    ("train init=RUN", "no checkpoint in"),
    ("scan lidar=none", "lidar=none has nothing to view"),
    ("scan lidar=sonar", "lidar=sonar"),
    ("scan colour=pink", "colour=pink must be one of class, height"),
    ("scan rays=0", "rays=0 must be a whole number >= 1"),
    ("scan seed=-1", "seed=-1 must be a whole number >= 0"),
    ("plan num_envs=x", "num_envs=x"),
    ("runs nowhere", "folder=nowhere does not exist"),
    ("curves runs=nowhere", "runs=nowhere is no run directory"),
    ("train logger.video_interval=0", "logger.video_interval=0 must be at least 1"),
    ("train logger.project=legs", "logger.project=legs is unknown"),
    *((f"train {group}=dragons", f"{group}=dragons is unknown") for group in GROUPS),
    *((f"{command} --wrong", "--wrong is unknown") for command in COMMANDS),
]


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    config.save(build.assemble(config.compose(["experiment=walk", "num_envs=2"])).composed, folder)
    return folder


@pytest.fixture
def one_line(monkeypatch, tmp_path, run_dir, capfd):
    """Runs a command line in-process, and gives its one line."""

    def never(*_, **__):
        raise AssertionError("this line was accepted")

    def run(text):
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.setattr(Runner, "learn", never)
        monkeypatch.setattr(subprocess, "Popen", never)
        monkeypatch.setattr(provenance, "commit", lambda: None)  # which asks git
        shutil.copy(__file__, tmp_path / "wrong_input_terms.py")
        (tmp_path / "EMPTY").mkdir()
        words = [word.replace("=RUN", f"={run_dir}") for word in text.split()]
        if words[0] in ("train", "plan") and "run=" not in text:
            small = [one for one in ("num_envs=2", "ppo.num_mini_batches=1") if one.split("=")[0] not in text]
            words += small if words[0] == "train" else small[:1]
        with pytest.raises(SystemExit) as stopped:
            main(words)
        error = capfd.readouterr().err
        assert stopped.value.code == 2 and error.count("\n") == 1 and error.startswith("error: "), error
        return error

    return run


def test_there_are_a_hundred():
    assert len(LINES) >= 100 and len({line for line, _ in LINES}) == len(LINES)


@pytest.mark.parametrize(("line", "named"), LINES, ids=[line.replace(" ", "_") for line, _ in LINES])
def test_wrong_input_is_one_line(one_line, line, named):
    assert named in one_line(line)


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("train --help", 0),
        ("evaluate --help", 0),
        ("train --cfg job", 0),
        ("train num_env=4", 2),
        ("train lidar.max_rage=3", 2),
        ("train +foo=1", 2),
        ("train -m seed=1,2 num_env=4", 2),
    ],
)
def test_what_needs_no_pytorch_is_answered_without(line, code):
    """It takes most of the seconds after which an answer would come."""
    program = "import sys; sys.modules['torch'] = None; from omniperception.commands import main; main(sys.argv[1:])"
    done = subprocess.run(
        [sys.executable, "-c", program, *line.split()], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == code and done.stderr.count("\n") == (code == 2), done.stderr


SCRIPTS = sorted([*ROOT.glob("scripts/*.py"), ROOT / "train.py", ROOT / "play.py"])


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_every_script_explains_itself_and_refuses_what_it_does_not_know(script, monkeypatch, capfd):
    assert len(SCRIPTS) >= 16
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    runpy.run_path(str(script), run_name="__main__")
    assert capfd.readouterr().out.startswith("usage: ")
    for wrong in ("--wrong", "nonsense"):
        monkeypatch.setattr(sys, "argv", [str(script), wrong])
        with pytest.raises(SystemExit, match="2"):
            runpy.run_path(str(script), run_name="__main__")
        error = capfd.readouterr().err
        assert wrong in error and error.count("\n") == 1


@pytest.mark.slow
def test_a_process_of_its_own_says_one_line_too(tmp_path):
    command = [sys.executable, str(ROOT / "train.py"), "num_envs=0"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and done.stderr == "error: num_envs=0 must be at least 1\n"
