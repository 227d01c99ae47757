"""The perceptive actor: caching, windows of an update, supervision, the avoidance velocity."""

import functools
from dataclasses import replace

import pytest
import torch
from toy_env import HISTORY, ToyEnv, collect, config, rollout

from omniperception.learning import PerceptionActor, PerceptivePpo, PerceptiveStorage
from omniperception.perception import FpsMlp, FpsSampler

FPS = {
    "sampler": functools.partial(FpsSampler, 3, max_range=5.0),
    "network": functools.partial(FpsMlp, hidden=(6,), feature_dim=8),
}


def actor_for(env, network="pd", normalize=False, max_change=None, groups=("command",), obs=None, **weights):
    """An actor whose perception the policy's loss trains, supervised with the weights that are given."""
    torch.manual_seed(1)
    given = config(hidden_dims=[8], obs_normalization=normalize)
    weights = {"height_weight": 0.0, **(FPS if network == "mlp" else {}), **weights}
    perception = replace(given.perception, **weights)
    learning = replace(given, perception=perception, actor_groups=groups, max_change=max_change)
    return PerceptionActor(env.get_observations() if obs is None else obs, learning, 2)


def advance(env, steps):
    for _ in range(steps):
        env.step(torch.randn(env.num_envs, 2))


def assert_update_equals_rollout(actor, storage, seen, num_mini_batches):
    with torch.no_grad():
        by_step = torch.stack([actor(obs) for obs in seen])
        for batch in storage.mini_batch_generator(num_mini_batches, 1):
            for got, action in zip(actor(batch.observations), batch.actions, strict=True):
                step, env_id = (storage.actions == action).all(-1).nonzero()[0].tolist()
                assert torch.allclose(got, by_step[step, env_id], atol=1e-5)


@pytest.mark.parametrize("network", ["pd", "mlp"])
@pytest.mark.parametrize("normalize", [False, True])
def test_update_equals_rollout(network, normalize):
    """Features of a mini-batch are those that the actor computes at each step by itself."""
    torch.manual_seed(3)
    env = ToyEnv(5, episode=11)
    advance(env, 13)
    actor = actor_for(env, network, normalize)
    torch.nn.init.normal_(actor.mlp[0].weight)  # an untrained actor ignores its features
    storage = PerceptiveStorage(5, 12, env.get_observations(), ["command"], 2, frames=True, steps_per_frame=5)
    seen = rollout(env, storage, 12)
    if normalize:
        actor.update_normalization(storage.observations.flatten(0, 1))
    assert_update_equals_rollout(actor, storage, seen, 2)


def test_features_once_per_tick_until_the_actor_is_reset():
    env = ToyEnv(4)
    actor = actor_for(env)
    calls = []
    actor.perception.register_forward_hook(lambda *_: calls.append(1))
    with torch.inference_mode():
        for _ in range(5):
            actor(env.get_observations())
            advance(env, 1)
        first = len(calls)
        for _ in range(3):
            actor(env.get_observations())
            assert len(calls) == 2 * first
            env._reset(torch.tensor([2]))  # alone embeds nothing
    with torch.no_grad():
        next(actor.perception.parameters()).add_(0.1)
    with torch.inference_mode():
        before = actor.embed_newest(env.get_observations())
        actor.reset()
        assert not torch.equal(actor.embed_newest(env.get_observations()), before)
    assert len(calls) == 3 * first


def test_weights_that_learn_or_are_loaded_are_used_at_once():
    env = ToyEnv(6)
    alg, other = (PerceptivePpo(env, config(supervised=True), "cpu") for _ in range(2))
    collect(alg, env, 8)
    obs = env.get_observations()
    with torch.inference_mode():
        before = alg.actor(obs)
    alg.update()
    for changed in (lambda: None, lambda: alg.load(other.save())):
        changed()
        with torch.inference_mode():
            now = alg.actor(obs)
            expected = alg.actor.perception(obs["frames"], obs["frame_count"])[:, 0]
            assert torch.equal(
                alg.actor.embed_newest(obs),
                torch.where(obs["frame_count"] > 0, expected, alg.actor.perception.empty(obs["frames"])),
            )
            assert not torch.equal(now, before)
            before = now


def test_another_environment_of_the_same_tick_is_embedded():
    a, b = ToyEnv(4, seed=0), ToyEnv(4, seed=1)
    advance(a, 10)
    advance(b, 10)
    actor = actor_for(a)
    with torch.no_grad():
        first, second = actor.embed_newest(a.get_observations()), actor.embed_newest(b.get_observations())
    assert not torch.allclose(first, second)


@pytest.mark.parametrize("network", ["pd", "mlp"])
def test_reset_between_frames_gives_the_empty_embedding(network):
    env = ToyEnv(4)
    advance(env, 10)
    actor = actor_for(env, network)
    with torch.no_grad():
        actor(env.get_observations())
        env.frame_count[2] = 0
        latent = actor.get_latent(env.get_observations())
        empty = actor.perception(torch.zeros(1, HISTORY, 3, 3), torch.zeros(1, 1, dtype=torch.long))[0, 0]
    assert torch.allclose(latent[2, 3:], empty) and not torch.allclose(latent[1, 3:], empty)


def height_case(weight):
    """An actor, a mini-batch and its gradients of a loss on the actions."""
    torch.manual_seed(5)
    env = ToyEnv(5, episode=11)
    advance(env, 7)
    actor = actor_for(env, height_weight=weight)
    storage = PerceptiveStorage(5, 9, env.get_observations(), ["command", "height_target"], 2, frames=True)
    rollout(env, storage, 9)
    torch.manual_seed(6)
    [batch] = storage.mini_batch_generator(1, 1)
    return actor, batch.observations


@pytest.mark.parametrize("weight", [0.5, 3.0])
def test_the_height_loss_is_added_at_unit_scale(weight):
    actor, obs = height_case(weight)
    (1e-3 * actor(obs).square().sum() + actor.auxiliary_loss).backward()
    got = [p.grad.clone() for p in actor.parameters() if p.grad is not None]

    plain, _ = height_case(0.0)
    latent = plain.get_latent(obs)
    prediction, valid = latent[:, 3:8], obs.step_count > 0
    height = (prediction[valid] - obs["height_target"][valid]).square().mean()
    (1e-3 * plain.mlp(latent).square().sum() + weight * height).backward()
    expected = [p.grad for p in plain.parameters() if p.grad is not None]
    assert 0 < valid.sum() < len(valid)
    for a, b in zip(got, expected, strict=True):
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-7)
    assert actor.pop_supervised_losses() == {"height_target": pytest.approx(height.item(), rel=1e-5)}
    assert actor.pop_supervised_losses() == {}


def test_no_step_with_a_frame_gives_zero_height_loss():
    actor, obs = height_case(1.0)
    obs.step_count.zero_()
    (actor(obs).sum() + actor.auxiliary_loss).backward()
    assert actor.pop_supervised_losses() == {"height_target": 0.0}
    assert all(torch.isfinite(p.grad).all() for p in actor.parameters() if p.grad is not None)


def test_height_supervision_needs_a_predictor_and_a_fitting_target():
    env = ToyEnv(3)
    with pytest.raises(ValueError, match="sets nothing aside for height_target"):
        actor_for(env, "mlp", height_weight=1.0)
    obs = env.get_observations()
    obs["height_target"] = torch.zeros(3, 7)
    with pytest.raises(ValueError, match="of 5 values within the embedding's 8, the environment gives 7"):
        actor_for(env, height_weight=1.0, obs=obs)


def avoiding_actor(env, network="mlp", **options):
    actor = actor_for(env, network, avoidance_weight=1.0, **options)
    with torch.no_grad():
        actor.read_out.layers[-1].weight.normal_()
        actor.read_out.layers[-1].bias.normal_()
    return actor


@pytest.mark.parametrize("normalize", [False, True])
def test_avoidance_velocity_shifts_the_command(normalize):
    """The MLP sees exactly what it would see of the sum as a command; without a frame, the command itself."""
    env = ToyEnv(4)
    advance(env, 7)
    env.frame_count[2] = 0
    obs = env.get_observations()
    actor = avoiding_actor(env, normalize=normalize)
    if normalize:
        actor.update_normalization(obs)
    with torch.no_grad():
        velocity = actor.read_out.layers(actor.perception(obs["frames"], obs["frame_count"])[:, 0])
        velocity[2] = 0.0
        seen = actor.get_latent(obs)[:, :3]
        command = obs["command"] + torch.cat([velocity, torch.zeros(4, 1)], 1)
        expected = (command - actor.obs_normalizer.mean) / (actor.obs_normalizer.std + 1e-2) if normalize else command
    assert velocity[[0, 1, 3]].abs().min() > 1e-3
    assert torch.allclose(seen, expected, atol=1e-6)


def test_an_untrained_actor_follows_the_command_alone():
    env = ToyEnv(4)
    advance(env, 7)
    actor = actor_for(env, avoidance_weight=1.0)
    with torch.no_grad():
        assert torch.equal(actor.get_latent(env.get_observations())[:, :3], env.get_observations()["command"])


def test_avoidance_velocity_of_an_update_equals_that_of_the_rollout_and_is_learnt():
    torch.manual_seed(5)
    env = ToyEnv(5, episode=11)
    advance(env, 7)
    actor = avoiding_actor(env)
    storage = PerceptiveStorage(5, 9, env.get_observations(), ["command", "avoidance_target"], 2, frames=True)
    seen = rollout(env, storage, 9)
    [batch] = storage.mini_batch_generator(1, 1)
    assert_update_equals_rollout(actor, storage, seen, 1)
    optimizer = torch.optim.Adam(actor.parameters(), 0.02)
    losses = []
    for _ in range(150):
        optimizer.zero_grad()
        actor(batch.observations)
        actor.auxiliary_loss.backward()
        optimizer.step()
        losses.append(actor.pop_supervised_losses()["avoidance_target"])
    assert losses[-1] < 0.2 * losses[0]


def test_what_is_asked_for_changes_no_faster_than_the_limit():
    """From what was asked for last; shorter changes are not touched, and without a frame the limit holds, too."""
    env = ToyEnv(4)
    advance(env, 7)
    env.frame_count[2] = 0
    obs = env.get_observations()
    actor = avoiding_actor(env)
    with torch.no_grad():
        wanted = actor.get_latent(obs)[:, :2]
    assert actor.asked is None
    last = wanted + torch.tensor([[3.0, 4.0], [0.03, -0.04], [-0.6, 0.8], [0.0, 0.0]])
    obs["last_asked"] = last
    actor.max_change = 0.1
    with torch.no_grad():
        asked = actor.get_latent(obs)[:, :2]
    moved = torch.tensor([[-0.06, -0.08], [-0.03, 0.04], [0.06, -0.08], [0.0, 0.0]])
    assert torch.allclose(asked, last + moved, atol=1e-5) and torch.equal(actor.asked, asked)


def test_a_limit_needs_to_observe_what_was_asked_for():
    with pytest.raises(ValueError, match="needs observations 'last_asked', which the environment does not give"):
        avoiding_actor(ToyEnv(3), max_change=0.1)


def test_avoidance_needs_an_observed_command():
    with pytest.raises(ValueError, match="need the actor to observe 'command', it observes \\['height_target'\\]"):
        actor_for(ToyEnv(3), groups=("height_target",), avoidance_weight=1.0)
