"""A policy that starts from another run's weights, and one that stays as it is while perception learns."""

from dataclasses import replace

import pytest
import torch

from omniperception.build import build_runner
from omniperception.config import ConfigError
from omniperception.env.mdp.observations import avoidance_target
from omniperception.env.mdp.terms import ObservationGroup
from omniperception.learning import CheckpointError
from omniperception.learning.checkpoint import checkpoint_path

SMALL = ("num_envs=8", "ppo.hidden_dims=[32,16]", "ppo.num_mini_batches=2", "ppo.num_steps_per_env=10")
BLIND = ("experiment=gait", *SMALL)
SEEING = ("experiment=avoid", *SMALL, "lidar.num_rays=200", "perception.supervised_epochs=1")
MANY = ("num_envs=48",)  # frames enough that what was learned holds for others
OTHERWISE = ("init=unread", "observations.groups.proprioception.history=2")


@pytest.fixture(scope="module")
def walk(make_config, tmp_path_factory):
    """Run directory and runner of a blind policy."""
    folder = tmp_path_factory.mktemp("walk")
    runner = build_runner(make_config(*BLIND, "seed=5"), None)
    with torch.no_grad():
        runner.alg.actor.obs_normalizer._mean.normal_()
        runner.alg.actor.mlp[0].weight.normal_()
    runner.save(checkpoint_path(folder, 3))
    return folder, runner


@pytest.fixture(scope="module")
def seeing(make_config, tmp_path_factory):
    """Run directory and runner of a policy that perceives, with another history than the others."""
    folder = tmp_path_factory.mktemp("seeing")
    runner = build_runner(make_config(*SEEING, *OTHERWISE, "seed=9"), None)
    runner.save(checkpoint_path(folder, 1))
    return folder, runner


def test_walks_alike_before_it_has_seen_anything(make_config, walk):
    run_dir, blind = walk
    runner = build_runner(make_config(*SEEING, f"init={run_dir}"), None)
    assert runner.alg.is_new
    runner.start_from(run_dir)
    assert not runner.alg.is_new
    obs = runner.env.get_observations()
    obs["frame_count"] = torch.zeros_like(obs["frame_count"])
    with torch.no_grad():
        assert torch.allclose(runner.alg.actor(obs), blind.alg.actor(obs), atol=1e-6)
    assert torch.equal(runner.alg.critic.mlp[0].weight, blind.alg.critic.mlp[0].weight)  # it observes the same


def test_perception_comes_along_where_it_fits(make_config, seeing):
    run_dir, first = seeing
    second = build_runner(make_config(*SEEING, *OTHERWISE, "seed=10"), None)
    before = [p.clone() for p in second.alg.actor.perception_parameters()]
    second.start_from(run_dir)
    mine, theirs = second.alg.actor.state_dict(), first.alg.actor.state_dict()
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs)
    assert not all(torch.equal(a, b) for a, b in zip(before, second.alg.actor.perception_parameters(), strict=True))


def test_a_gait_and_perception_are_joined(make_config, walk, seeing):
    (run_dir, blind), (seeing_dir, seeing) = walk, seeing
    run = make_config(*SEEING, f"init=[{seeing_dir},{run_dir}]", "seed=10")
    joined = build_runner(run, None)
    joined.start_from(*run.init)
    assert torch.equal(joined.alg.actor.mlp[2].weight, blind.alg.actor.mlp[2].weight)
    assert torch.equal(joined.alg.actor.obs_normalizer._mean, blind.alg.actor.obs_normalizer._mean)
    mine, theirs = joined.alg.actor.state_dict(), seeing.alg.actor.state_dict()
    perceived = [name for name in theirs if name.startswith("perception.")]
    assert perceived and all(torch.equal(mine[name], theirs[name]) for name in perceived)


def test_the_first_of_two_that_perceive_alike_gives_perception(make_config, seeing, tmp_path):
    seeing_dir, first = seeing
    second = build_runner(make_config(*SEEING, *OTHERWISE, "seed=11"), None)
    torch.nn.init.normal_(second.alg.actor.mlp[0].weight)
    second.save(checkpoint_path(tmp_path, 1))
    joined = build_runner(make_config(*SEEING, *OTHERWISE, "seed=10"), None)
    assert joined.start_from(seeing_dir, tmp_path) == [seeing_dir]
    mine, theirs, moves = (one.alg.actor.state_dict() for one in (joined, first, second))
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs if name.startswith("perception."))
    blind_dim = joined.alg.actor.blind_dim
    assert torch.equal(mine["mlp.0.weight"][:, :blind_dim], moves["mlp.0.weight"][:, :blind_dim])
    assert bool((mine["mlp.0.weight"][:, blind_dim:] == 0).all())  # the second's weighed another embedding


def test_what_does_not_perceive_alike_is_not_joined(make_config, walk, seeing):
    (run_dir, blind), (seeing_dir, _) = walk, seeing
    for perception in ("perception=proximity_gru", "perception.history=4"):
        runner = build_runner(make_config(*SEEING, "init=unread", perception), None)
        with pytest.raises(CheckpointError, match="both the same perception|neither perceives nor navigates"):
            runner.start_from(run_dir if "history" in perception else seeing_dir, run_dir)
    with pytest.raises(CheckpointError, match="neither perceives nor navigates as this run does"):
        blind.start_from(seeing_dir, run_dir)


def test_an_estimate_takes_over_what_was_measured(make_config, walk):
    """With the true velocity, the same in all control steps, as its estimate."""
    run_dir, measuring = walk
    run = make_config(*BLIND, "observations=gait_without_velocity", f"init={run_dir}", "seed=5")
    runner = build_runner(run, None)
    runner.start_from(run_dir, observations=measuring.env.config.observations)
    actor, group = runner.alg.actor, measuring.env.config.observations.groups["proprioception"]
    assert actor.obs_dim == measuring.alg.actor.obs_dim - 3 * group.history and group.history > 1
    observed, velocity = measuring.env.get_observations(), torch.tensor([0.7, -0.3, 0.1])
    steps = observed["proprioception"].unflatten(1, (group.history, -1)).clone()
    at = [
        i
        for i, one in enumerate(measuring.env.actor_inputs(measuring.env.config.observations))
        if one[1] == "base_lin_vel"
    ]
    assert at[:3] == [24, 25, 26]
    steps[..., 24:27] = velocity
    without = torch.cat((steps[..., :24], steps[..., 27:]), -1)
    obs = observed.clone()
    obs["proprioception"] = without.flatten(1)
    observed["proprioception"] = steps.flatten(1)
    with torch.no_grad():
        for parameter in actor.estimator.parameters():
            parameter.zero_()
        list(actor.estimator.parameters())[-1].copy_(velocity)
        assert torch.allclose(actor(obs), measuring.alg.actor(observed), atol=1e-4)
        list(actor.estimator.parameters())[-1].zero_()
        assert not torch.allclose(actor(obs), measuring.alg.actor(observed), atol=1e-2)


def test_it_explores_as_much_as_it_is_told_to(make_config, walk):
    run_dir, blind = walk
    with torch.no_grad():
        blind.alg.actor.distribution.std_param.fill_(0.2)
    blind.save(checkpoint_path(run_dir, 4))
    for setting, std in ((), 0.2), (("ppo.start_std=0.6",), 0.6):
        runner = build_runner(make_config(*BLIND, *setting), None)
        assert torch.allclose(runner.alg.actor.distribution.std_param, torch.full((12,), 0.5))
        runner.start_from(run_dir)
        assert torch.allclose(runner.alg.actor.distribution.std_param, torch.full((12,), std))


@pytest.mark.parametrize(
    "other", ["observations.groups.proprioception.history=2", "observations.groups.proprioception.terms.joint_vel=null"]
)
def test_what_is_not_estimated_may_not_be_missing(make_config, walk, other):
    run_dir, measuring = walk
    runner = build_runner(make_config(*BLIND, "observations=gait_without_velocity", other), None)
    with pytest.raises(CheckpointError, match="give both the same observations"):
        runner.start_from(run_dir, observations=measuring.env.config.observations)


def test_other_observations_are_refused(make_config, walk):
    run_dir, _ = walk
    runner = build_runner(make_config(*SEEING, *OTHERWISE), None)
    with pytest.raises(CheckpointError, match=r"init=.* does not fit: this run's .* give both the same observations"):
        runner.start_from(run_dir)


PLAIN = ("ppo.obs_normalization=false",)


@pytest.fixture(scope="module")
def plain(make_config, tmp_path_factory):
    """Run directory and observations of a policy whose observations are not normalized."""
    folder = tmp_path_factory.mktemp("plain")
    runner = build_runner(make_config(*BLIND, *PLAIN), None)
    runner.save(checkpoint_path(folder, 1))
    return folder, runner.env.config.observations


class TestAsManyNumbersThatMeanOtherThings:
    """Without normalization no shape tells them apart."""

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (("observations.actor=[action,proprioception,command,clock]",), "input 0 .* action.* proprioception"),
            (("observations.groups.proprioception.terms.joint_vel=null",), "input [0-9]+ of this run's policy is"),
            (("observations=gait_without_velocity", "observations.estimated=null"), "of that run's .*base_lin_vel"),
        ],
        ids=("order", "missing", "velocity"),
    )
    def test_are_refused(self, make_config, plain, change, message):
        runner = build_runner(make_config(*BLIND, *PLAIN, *change), None)
        before = {name: value.clone() for name, value in runner.alg.actor.state_dict().items()}
        with pytest.raises(CheckpointError, match=rf"{message}.*; give both the same observations"):
            runner.start_from(plain[0], observations=plain[1])
        assert all(torch.equal(value, before[name]) for name, value in runner.alg.actor.state_dict().items())

    def test_of_a_critic_stay_behind(self, make_config, plain):
        order = "observations.critic=[clock,privileged,physics,command,action]"
        runner = build_runner(make_config(*BLIND, *PLAIN, order), None)
        before = runner.alg.critic.mlp[0].weight.clone()
        runner.start_from(plain[0], observations=plain[1])
        assert torch.equal(runner.alg.critic.mlp[0].weight, before)

    def test_of_quantities_that_are_not_here(self, make_config, plain):
        """V_avoid, in a task without obstacles: a critic stays behind, a policy is refused."""
        runner = build_runner(make_config(*BLIND, *PLAIN), None)
        truth = ObservationGroup({"avoidance_target": avoidance_target})
        groups = {**plain[1].groups, "truth": truth}
        before = runner.alg.critic.mlp[0].weight.clone()
        runner.start_from(plain[0], observations=replace(plain[1], groups=groups, critic=[*plain[1].critic, "truth"]))
        assert torch.equal(runner.alg.critic.mlp[0].weight, before)
        with pytest.raises(CheckpointError, match="policy observes what this task does not have"):
            runner.start_from(plain[0], observations=replace(plain[1], groups=groups, actor=[*plain[1].actor, "truth"]))

    def test_renamed_groups_are_the_same(self, make_config, plain):
        actor = "observations.actor=[proprioception,command,doing,clock]"
        renamed = "+observations.groups.doing={terms: {previous_action: {}}}"
        runner = build_runner(make_config(*BLIND, *PLAIN, renamed, actor), None)
        runner.start_from(plain[0], observations=plain[1])


@pytest.mark.parametrize("estimates", [False, True])
@pytest.mark.parametrize("normalized", [True, False])
def test_normalization_is_both_runs_or_none(make_config, tmp_path, normalized, estimates):
    mine, theirs = (f"ppo.obs_normalization={str(which).lower()}" for which in (not normalized, normalized))
    other = build_runner(make_config(*BLIND, theirs), None)
    other.save(checkpoint_path(tmp_path, 1))
    runner = build_runner(
        make_config(*BLIND, mine, *(["observations=gait_without_velocity"] if estimates else [])), None
    )
    before = runner.alg.actor.mlp[0].weight.clone()
    with pytest.raises(
        CheckpointError,
        match=r"does not fit: .*obs_normalizer.* and ppo\.obs_normalization",
    ):
        runner.start_from(tmp_path, observations=other.env.config.observations)
    assert torch.equal(runner.alg.actor.mlp[0].weight, before)


def test_what_estimates_does_not_start_what_does_not(make_config, tmp_path):
    """Its policy reads the estimates; those columns would be lost."""
    first = build_runner(make_config(*BLIND, "observations=gait_without_velocity"), None)
    first.save(checkpoint_path(tmp_path, 1))
    runner = build_runner(
        make_config(*BLIND, "observations=gait_without_velocity", "observations.estimated=null"), None
    )
    with pytest.raises(CheckpointError, match=r"does not fit: .* and what is estimated\)"):
        runner.start_from(tmp_path, observations=first.env.config.observations)


@pytest.mark.slow
def test_perception_learns_and_the_policy_stays_as_it_is(make_config, walk):
    run_dir, _ = walk
    terrain = ("terrain=mixed", "randomization=lidar")
    often = ("perception.learning_rate=1e-3", "perception.supervised_epochs=4")
    runner = build_runner(make_config(*SEEING, *MANY, *terrain, f"init={run_dir}", *often), None)
    runner.start_from(run_dir)
    actor, critic = runner.alg.actor, runner.alg.critic
    kept = {name: value.clone() for name, value in actor.state_dict().items() if not name.startswith("perception.")}
    valued = {name: value.clone() for name, value in critic.state_dict().items()}
    seen = {name: value.clone() for name, value in actor.perception.state_dict().items()}
    obs = runner.env.get_observations()
    runner.alg.train_mode()
    for update in range(13):
        with torch.inference_mode():
            for _ in range(10):
                obs = runner.step(obs)
        if update < 12:
            losses = runner.alg.update()
    assert all(torch.equal(actor.state_dict()[name], value) for name, value in kept.items())
    assert all(torch.equal(critic.state_dict()[name], value) for name, value in valued.items())
    assert not any(torch.equal(actor.perception.state_dict()[name], value) for name, value in seen.items())
    assert set(losses) == {"motion_target"}
    trained = losses_on_the_rollout(runner)
    actor.perception.load_state_dict(seen)
    untrained = losses_on_the_rollout(runner)
    for target in losses:
        assert trained[target] < 0.9 * untrained[target], target


def losses_on_the_rollout(runner):
    """By target, on frames that no update has seen."""
    actor, storage = runner.alg.actor, runner.alg.storage
    frames = storage.observations_of(torch.arange(storage.num_envs), storage.first_steps)
    with torch.no_grad():
        actor.supervised_loss(actor.embed(frames), frames)
    return actor.pop_supervised_losses()


def test_init_is_a_run_or_several(make_config):
    assert make_config(*BLIND).init == ()
    assert make_config(*BLIND, "init=[a,b]").init == ("a", "b")
    with pytest.raises(ConfigError, match=r"init=.*: give two at most"):
        make_config(*BLIND, "init=[a,b,c]")
