"""Terms and other names in configurations: found, checked, and not taken from strangers."""

import importlib.util
import json
import os
import sys
from functools import partial

import pytest
import yaml

from omniperception import build, config
from omniperception.config import ConfigError
from omniperception.env.mdp import observations, rewards
from omniperception.schema import NAMES, look_up

OWN = '''
"""A module of the user's own."""

from omniperception.perception import FpsGru
from omniperception.scene.tiles import Rough


def gentle(state, limit: float, power: int = 2):
    return 0


class Steady:
    def __init__(self, window: int) -> None:
        self.window = window

    def __call__(self, state):
        return 0


class Waves(Rough):
    pass


class Wide(FpsGru):
    pass
'''


@pytest.fixture
def own_project(tmp_path, monkeypatch):
    (tmp_path / "own_terms_project.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    yield "own_terms_project"
    sys.modules.pop("own_terms_project", None)


def terms(*overrides):
    return build.assemble(config.compose(overrides)).env.rewards.terms


class TestNames:
    def test_every_name_is_there(self):
        for place, kind in NAMES.items():
            for name in () if isinstance(kind.names, str) else kind.names:
                if name != "mujoco_warp" or importlib.util.find_spec("mujoco_warp"):
                    assert callable(look_up(kind, name, place))

    def test_a_key_is_the_name_of_its_function(self):
        found = terms("rewards=default")
        term = found["velocity_tracking_with_avoidance"]
        assert isinstance(term.func, partial) and term.func.func is rewards.velocity_tracking_with_avoidance
        assert (term.weight, term.func.keywords) == (2.0, {"beta": 4.0})
        assert found["tilt_squared"].func is rewards.tilt_squared

    def test_one_function_twice(self):
        found = terms("+rewards.terms.slow={func: velocity_tracking, weight: 1, beta: 1.0}")
        assert found["slow"].func.func is rewards.velocity_tracking

    def test_observations(self):
        override = "+observations.groups.proprioception.terms.joint_vel={scale: 0.05}"
        group = build.assemble(config.compose([override])).env.observations.groups["proprioception"]
        assert group.terms["joint_vel"].func is observations.joint_vel
        assert group.terms["joint_vel"].keywords == {"scale": 0.05}
        assert group.terms["base_lin_vel"] is observations.base_lin_vel

    @pytest.mark.parametrize("nothing", ["rewards.terms.tilt_squared.weight=0", "rewards.terms.tilt_squared=null"])
    def test_weight_zero_and_null_leave_a_term_out(self, nothing):
        assert "tilt_squared" not in terms(nothing)
        assert "tilt_squared" in terms("rewards.terms.tilt_squared.weight=-3")

    @pytest.mark.parametrize(
        ("override", "message"),
        [
            (
                "+rewards.terms.tilt_square={weight: 1}",
                "rewards.terms.tilt_square is unknown; did you mean rewards.terms.tilt_squared?",
            ),
            ("+rewards.terms.x={weight: 1, func: alife}", "rewards.terms.x.func=alife is unknown; did you mean alive?"),
            (
                "+rewards.terms.tilt_squared.wieght=1",
                "rewards.terms.tilt_squared.wieght is unknown; did you mean rewards.terms.tilt_squared.weight?",
            ),
            (
                "+rewards.terms.closing_speed.margn=1",
                "rewards.terms.closing_speed.margn is unknown; did you mean rewards.terms.closing_speed.margin?",
            ),
            ("+rewards.terms.foot_stumble={weight: 1, unit: 1.0}", "rewards.terms.foot_stumble lacks ratio: give"),
            ("+rewards.terms.alive={}", "rewards.terms.alive lacks its weight: give rewards.terms.alive.weight=..."),
            ("rewards.terms.closing_speed.margin=far", "rewards.terms.closing_speed.margin=far must be a number"),
            ("+rewards.terms.x={weight: 1, func: 3}", "rewards.terms.x.func=3 must be text"),
            (
                "+rewards.terms.x={weight: 1, func: nowhere.x}",
                "rewards.terms.x.func=nowhere.x cannot be imported: No module named 'nowhere'; PYTHONPATH=. has",
            ),
            ("+rewards.terms.x={weight: 1, func: math.nothing}", "math has no function or class nothing"),
            ("+observations.groups.command.terms.command.scal=1", "observations.groups.command.terms.command.scal is"),
            ("perception.network.type=pd_risk", "perception.network.type=pd_risk is unknown; did you mean pd_risknet?"),
            ("perception.sampler.type=fsp", "perception.sampler.type=fsp is unknown; did you mean fps?"),
            (
                "+perception.sampler.splitdeg=3",
                "perception.sampler.splitdeg is unknown; did you mean perception.sampler.split_deg?",
            ),
            ("commands.type=gaol", "commands.type=gaol is unknown; did you mean goal?"),
            ("~commands.type", "commands lacks its type: give commands.type=..., one of velocity, goal"),
            ("+terrain.tiles={hills: {}}", "terrain.tiles is unknown"),
            ("terrain=mixed terrain.tiles.rough=3", "terrain.tiles.rough=3 must be a group of settings"),
            ("lidar.mount=had", "lidar.mount=had is unknown; robot.mounts has head"),
            ("+lidar.mount_pos=[0,0,0]", "lidar.mount_pos is unknown; a mount has it"),
            ("lidar.device=mid306", "lidar.device=mid306 is unknown; known: mid360"),
            ("obstacles.groups.walker.size=[1,2]", "walker.size=[1, 2] must be ranges 0 < low <= high"),
            ("obstacles.groups.walker.kind=null", "obstacles.groups.walker.kind=null must be text"),
        ],
    )
    def test_mistakes_are_named_in_one_line(self, override, message):
        with pytest.raises(ConfigError) as error:
            build.assemble(config.compose([override] if override[0] in "+~" else override.split(" ")))
        assert message in str(error.value) and "\n" not in str(error.value)


class TestOnesOwn:
    def test_a_dotted_path_names_it(self, own_project):
        found = terms(
            f"+rewards.terms.gentle={{func: {own_project}.gentle, weight: 1, limit: 2.0}}",
            f"+rewards.terms.steady={{func: {own_project}.Steady, weight: 1, window: 3}}",
        )
        assert found["gentle"].func.keywords == {"limit": 2.0}
        assert found["steady"].func().window == 3
        with pytest.raises(ConfigError, match="rewards.terms.steady lacks window"):
            terms(f"+rewards.terms.steady={{func: {own_project}.Steady, weight: 1}}")

    def test_networks_and_tiles(self, own_project):
        network, tile = f"perception.network.type={own_project}.Wide", f"+terrain.tiles.rough.type={own_project}.Waves"
        run = build.assemble(config.compose(["perception=fps_gru", network, "terrain=rough", tile]))
        assert type(run.perception.build_network()).__name__ == "Wide"
        assert type(run.env.terrain.tiles["rough"]).__name__ == "Waves"


class TestStrangers:
    """A run directory's file builds nothing outside of this package, unless the user trusts it."""

    @pytest.fixture
    def run_with(self, tmp_path):
        composed = build.assemble(config.compose(["experiment=quickstart", "terrain=rough"])).composed

        def write(path, value):
            changed = json.loads(json.dumps(composed))
            node, (*parents, last) = changed, path.split("/")
            for name in parents:
                node = node[name]
            node[last] = value
            (tmp_path / config.CONFIG_FILE).write_text(yaml.safe_dump(changed))
            return config.load(tmp_path)

        return write

    @pytest.mark.parametrize(
        ("path", "value"),
        [
            ("rewards/terms/x", {"weight": 1.0, "func": "logging.FileHandler", "filename": "touched", "mode": "w"}),
            ("rewards/terms/x", {"weight": 0.0, "func": "logging.FileHandler"}),
            ("rewards/terms/x", {"weight": 1.0, "func": "omniperception.config.save", "run_dir": "touched"}),
            ("rewards/terms/x", {"weight": 1.0, "func": "omnilidar.os.system"}),
            ("observations/groups/command/terms/x", {"func": "os.mkdir", "path": "touched"}),
            ("perception/network", {"type": "os.system", "command": "touch touched"}),
            ("perception/network", {"type": "polar_rings", "rings": {"type": "os.system"}}),
            ("perception/sampler/type", "os.mkdir"),
            ("lidar/pattern", {"type": "os.mkdir", "path": "touched"}),
            ("terrain/type", "logging.FileHandler"),
            ("terrain/tiles/x", {"type": "logging.FileHandler", "filename": "touched"}),
            ("commands/type", "logging.FileHandler"),
            ("sim/type", "logging.FileHandler"),
        ],
    )
    def test_names_outside_of_this_package_are_refused(self, run_with, path, value, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        with pytest.raises(ConfigError, match=r"a run's file names it, .*; if you trust it, add trust=") as error:
            build.assemble(run_with(path, value), trust=("own", "log"))
        assert "\n" not in str(error.value)
        assert os.listdir(tmp_path) == [config.CONFIG_FILE]

    @pytest.mark.parametrize(
        ("path", "value"),
        [
            ("rewards/terms/tilt_squared", {"_target_": "logging.FileHandler", "filename": "touched"}),
            ("rewards/avoidance", {"_target_": "logging.FileHandler", "filename": "touched"}),
            ("obstacles/groups/x", {"_target_": "os.mkdir", "path": "touched"}),
            ("robot/_target_", "os.system"),
            ("ppo/_target_", "os.system"),
        ],
    )
    def test_hydras_targets_mean_nothing(self, run_with, path, value, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        with pytest.raises(ConfigError):
            build.assemble(run_with(path, value))
        assert os.listdir(tmp_path) == [config.CONFIG_FILE]

    def test_what_the_user_trusts_is_built(self, run_with, own_project):
        loaded = run_with("rewards/terms/gentle", {"weight": 1.0, "func": f"{own_project}.gentle", "limit": 2.0})
        with pytest.raises(ConfigError, match=f"trust={own_project}"):
            build.assemble(loaded)
        assert own_project not in sys.modules
        assert "gentle" in build.assemble(loaded, trust=(own_project,)).env.rewards.terms

    def test_overrides_do_not_make_a_file_trustworthy(self, run_with, own_project, tmp_path):
        run_with("rewards/terms/x", {"weight": 1.0, "func": f"{own_project}.gentle", "limit": 2.0})
        with pytest.raises(ConfigError, match="trust="):
            build.assemble(config.load(tmp_path, ["obstacles=static", "num_envs=2"]))


def test_a_term_is_an_ordinary_function(make_config):
    """Hydra's own partials validate their target in every call, which took a fifth of a step."""
    env = make_config("experiment=quickstart").env
    found = [term.func for term in env.rewards.terms.values()]
    found += [term for group in env.observations.groups.values() for term in group.terms.values()]
    found = [term.func if isinstance(term, partial) else term for term in found]
    assert all(term.__module__.startswith("omniperception") for term in found)
