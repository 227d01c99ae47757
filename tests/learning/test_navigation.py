"""A navigation policy: what it begins as, within which limits it asks, and where its weights go."""

import math

import pytest
import torch

from omniperception import build, config
from omniperception.avoidance.navigation import navigation_inputs
from omniperception.avoidance.velocity_risk import VelocityRisk
from omniperception.learning.checkpoint import CheckpointError
from omniperception.learning.read_out import MotionReadOut
from omniperception.learning.warm_start import take_parts
from omniperception.perception.networks.rings import RingPath
from omnirobot.common.errors import ConfigError

SMALL = ("num_envs=6", "sim.num_threads=1", "ppo.num_mini_batches=2", "ppo.num_steps_per_env=4", "lidar.num_rays=200")
TOLD = ("experiment=navigate", *SMALL[:-1])
SEEING = ("experiment=perceive", *SMALL)
ON_LEGS = ("experiment=navigator", "num_envs=3", *SMALL[1:], "ppo.max_iterations=1")


def runner(*overrides):
    return build.build_runner(build.assemble(config.compose(list(overrides))), None)


def test_it_begins_as_the_choice_without_learning():
    begun = runner(*TOLD)
    observations = begun.env.get_observations()
    with torch.no_grad():
        assert torch.equal(begun.alg.actor(observations), observations["navigation"][:, :3])


@pytest.mark.parametrize(("distance", "share"), [(math.inf, 0.0), (4.0, 0.0), (3.0, 0.5), (2.0, 1.0), (0.3, 1.0)])
def test_where_nothing_is_near_the_command_is_followed(distance, share):
    """Whatever was learned; what is added fades out between 2 and 4 m."""
    policy = runner(*TOLD).alg.actor.mlp
    for value in policy.network.parameters():
        torch.nn.init.normal_(value, std=0.3)
    risk = build.assemble(config.compose([*TOLD])).env.rewards.avoidance.risk
    sectors = torch.tensor([math.inf, 0.0, 0.0]).repeat(2, 36, 1)
    sectors[0, 7, 0] = distance
    command, still = torch.tensor([[0.3, -0.4, 0.5]]).repeat(2, 1), torch.zeros(2, 3)
    no_risk = torch.zeros(2, risk.num_candidates)
    inputs = navigation_inputs(sectors, command, still, still, risk, risk.candidates(), no_risk)
    with torch.no_grad():
        asked, added = policy(inputs), policy.network(inputs)
    torch.testing.assert_close(asked[0], command[0] + share * added[0])
    assert torch.equal(asked[1], command[1]) and added.abs().min() > 1e-3


def test_it_learns_and_goes_on_from_a_checkpoint(tmp_path):
    one, other = runner(*TOLD), runner(*TOLD)
    one.learn(1)
    one.save(tmp_path / "model.pt")
    one.learn(1)
    other.load(tmp_path / "model.pt")
    other.learn(1)
    weights = [each.alg.actor.state_dict() for each in (one, other)]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    assert weights[0]["mlp.network.0.weight"].abs().sum() > 0


def test_what_it_does_not_read_is_refused():
    with pytest.raises(ConfigError, match="a navigation policy reads the 265 numbers .*use observations=navigate"):
        runner(*TOLD, "observations.actor=[navigation,truth]")
    with pytest.raises(ConfigError, match="ppo.obs_normalization=true"):
        runner(*TOLD, "ppo.obs_normalization=true")
    with pytest.raises(ConfigError, match="perceived sectors|needs the observations .*use observations=perceive"):
        runner(*SEEING, "observations.actor=[command]")


class TestOnLegs:
    @pytest.fixture(scope="class")
    def joined(self):
        return runner(*ON_LEGS)

    def ask(self, joined, wanted, last, has_frame=True, command=(0.5, 0.0, 0.1)):
        """What the gait is asked for where navigation wants `wanted`."""
        actor = joined.alg.actor
        said = torch.tensor([wanted])
        actor.navigation.forward = lambda *_, **__: torch.minimum(
            torch.maximum(said, actor.navigation.least), actor.navigation.most
        )
        features = torch.zeros(1, actor.perception.feature_dim + 109)
        given = (torch.tensor([command]), torch.zeros(1, 3), torch.tensor([last]))
        try:
            return actor.navigate(features, torch.tensor([has_frame]), *given)[0].tolist()
        finally:
            del actor.navigation.forward

    def test_it_changes_no_faster_than_a_gait_bears(self, joined):
        """6 m/s^2 and 8 rad/s^2 over 0.02 s."""
        asked = self.ask(joined, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
        assert asked == pytest.approx([0.12 / math.sqrt(2)] * 2 + [0.16], abs=1e-5)
        assert self.ask(joined, (0.05, 0.0, -0.1), (0.0, 0.0, 0.0)) == pytest.approx([0.05, 0.0, -0.1])

    def test_it_stays_within_what_the_gait_can(self, joined):
        assert self.ask(joined, (9.0, 0.0, 9.0), (1.95, 0.0, 1.45)) == pytest.approx([2.0, 0.0, 1.5])

    def test_without_a_frame_the_command_is_followed(self, joined):
        asked = self.ask(joined, (-1.0, 1.0, 1.0), (0.45, 0.0, 0.1), has_frame=False)
        assert asked == pytest.approx([0.5, 0.0, 0.1])

    def test_it_reads_the_robots_own_velocity(self, joined, monkeypatch):
        """Of the newest control step, in the base's frame."""
        env, actor, read = joined.env, joined.alg.actor, []
        for _ in range(7):
            env.step(torch.zeros(3, 12))
        measured = env.state.measured
        expected = torch.cat((measured.base_lin_vel_b[:, :2], measured.base_ang_vel_b[:, 2:]), 1)
        monkeypatch.setattr(actor, "navigate", lambda *given: read.append(given[3]) or given[2])
        with torch.no_grad():
            actor(env.get_observations())
        torch.testing.assert_close(read[0], expected, atol=1e-5, rtol=0)

    def test_what_it_asks_for_is_observed_in_the_next_step(self, joined):
        env, actor = joined.env, joined.alg.actor
        with torch.no_grad():
            for _ in range(8):
                env.step(actor(env.get_observations()))
        going = ~env.done
        assert torch.equal(env.get_observations()["last_asked"][going], actor.asked[going])
        assert actor.asked.shape == (3, 3)


def test_weights_of_each_run_go_where_they_belong():
    seeing, told, joined = runner(*SEEING), runner(*TOLD), runner(*ON_LEGS)
    for number, given in enumerate((seeing, told)):
        for value in given.alg.actor.parameters():
            torch.nn.init.constant_(value, 0.5 + number)
    assert take_parts(joined.alg.actor, seeing.alg.actor.state_dict(), "a")
    assert not take_parts(joined.alg.actor, told.alg.actor.state_dict(), "b")
    state = joined.alg.actor.state_dict()
    assert (state["perception.rings.layers.0.weight"] == 0.5).all()
    assert (state["navigation.mlp.network.0.weight"] == 1.5).all()
    assert not (state["mlp.0.weight"] == 1.5).any()
    with pytest.raises(CheckpointError, match="init=c neither perceives nor navigates as this run does"):
        take_parts(joined.alg.actor, {"mlp.0.weight": torch.zeros(3, 3)}, "c")
    wider = runner(*TOLD, "navigation.hidden_dims=[64,64]")
    with pytest.raises(CheckpointError, match="init=d does not fit"):
        take_parts(joined.alg.actor, wider.alg.actor.state_dict(), "d")


def test_one_run_that_is_such_a_policy_gives_all_that_it_has(tmp_path):
    """A critic of something else is left out as a whole."""
    first, second = runner(*ON_LEGS), runner(*ON_LEGS, "ppo.hidden_dims=[256,128,64]")
    for value in first.alg.actor.parameters():
        torch.nn.init.constant_(value, 0.25)
    (tmp_path / "checkpoints").mkdir()
    first.save(tmp_path / "checkpoints" / "model_1.pt")
    assert second.start_from(tmp_path) == [tmp_path]
    state, given = second.alg.actor.state_dict(), first.alg.actor.state_dict()
    assert all(torch.equal(state[name], given[name]) for name in given if not name.startswith("distribution"))
    told = runner(*TOLD)
    before = {name: value.clone() for name, value in told.alg.critic.state_dict().items()}
    told.start_from(tmp_path)
    assert all(torch.equal(before[name], value) for name, value in told.alg.critic.state_dict().items())
    assert (told.alg.actor.state_dict()["mlp.network.0.weight"] == 0.25).all()


class TestSaidRisks:
    RISK = VelocityRisk(1.8, 2, 36, (0.4, 0.8), 0.25, 0.15, 2.0, 8.0, 0.05)

    def test_directions_are_those_of_the_candidates(self):
        """A sector that says danger is the candidate that leads along its left edge."""
        path = RingPath(36 * 6, 2, risk_rings=2)
        logits = torch.full((1, 3, 36), -9.0)
        logits[0, 1, 20] = 9.0  # the second speed; the sector from 20 to 30 degrees
        risks = path._risks(logits)[0]
        (worst,) = (risks > 0.5).nonzero().flatten().tolist()
        angle = math.radians(30.0)
        expected = 1.8 * torch.tensor([math.cos(angle), math.sin(angle)])
        torch.testing.assert_close(self.RISK.candidates()[worst], expected)

    def test_to_stand_is_as_risky_as_any_sector_says(self):
        path = RingPath(36 * 6, 2, risk_rings=2)
        logits = torch.full((1, 3, 36), -9.0)
        logits[0, 2, 33] = 0.0
        assert path._risks(logits)[0, 0].item() == pytest.approx(0.5)

    def test_they_turn_with_the_world(self):
        path = RingPath(36 * 6, 2, risk_rings=2)
        for value in path.parameters():
            torch.nn.init.normal_(value, std=0.2)
        rings = torch.randn(2, path.layers[0].weight.shape[1], 36)

        def said(rings):
            hidden = path.layers[:-1](rings)
            return path._risks(path.risk(torch.cat((hidden, path.layers[-1](hidden)), 1)))

        here, turned = said(rings), said(torch.roll(rings, 5, -1))
        torch.testing.assert_close(here[:, 0], turned[:, 0])
        wheel = here[:, 1:].unflatten(1, (2, 36))
        torch.testing.assert_close(torch.roll(wheel, 5, -1), turned[:, 1:].unflatten(1, (2, 36)))

    def test_they_are_compared_with_those_of_the_true_sectors(self):
        read_out = MotionReadOut(108 + 73, 108, slice(0, 108), self.RISK, slice(108, 181))
        target = torch.zeros(1, 108)  # nothing near
        features = torch.zeros(1, 181)
        assert read_out.error(features, target).item() == 0.0
        features[0, 108:] = 0.5
        assert read_out.error(features, target).item() == pytest.approx(3.0 * 0.25)
        assert torch.equal(read_out.extend(features)[:, 181:], features[:, 108:])

    def test_other_candidates_are_refused(self):
        with pytest.raises(ValueError, match="risk_rings=2 .*num_rings=2 num_directions=24; give both the same"):
            other = VelocityRisk(1.8, 2, 24, (0.4,), 0.2, 0.1, 2.0, 8.0, 0.05)
            MotionReadOut(181, 108, slice(0, 108), other, slice(108, 181))
