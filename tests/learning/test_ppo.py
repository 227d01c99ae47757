"""PPO: returns by hand, its update with shared frames, and the stop at non-finite numbers."""

from dataclasses import replace

import pytest
import torch
from toy_env import ToyEnv, collect, config, steps_of

from omniperception.learning import PerceptivePpo, TrainingDiverged
from omniperception.learning.ppo import FIRST_LEARNING_RATE


def algorithm(env, num_steps=8, frames=True, **options):
    torch.manual_seed(0)
    return PerceptivePpo(env, config(frames, num_steps_per_env=num_steps, **options), "cpu")


def collected(num_envs=4, frames=True, num_steps=8, **options):
    """An algorithm, with one rollout in its storage."""
    env = ToyEnv(num_envs, frames=frames)
    alg = algorithm(env, num_steps, frames, **options)
    collect(alg, env, num_steps)
    return alg


def test_returns_by_hand_with_termination_and_time_out():
    """gamma = lambda = 0.5, V = 2 everywhere, reward 1; of the environments 0 runs on, 1 falls, 2 times out.

    Step 2 bootstraps: delta = 1 + 0.5 * 2 - 2 = 0 for all, so its return is 2.
    Step 1: running on, delta 0; falling, 1 - 2 = -1, return 1; time-out, the reward becomes 1 + 0.5 * 2 = 2
    and nothing follows: delta 2 - 2 = 0, return 2. Step 0: delta 0 plus 0.25 times the advantage of step 1:
    returns 2, 2 - 0.25 and 2.
    """
    env = ToyEnv(3, frames=False)
    alg = algorithm(env, num_steps=3, frames=False, gamma=0.5, lam=0.5)
    alg.critic.forward = lambda obs, **_: torch.full((3, 1), 2.0)
    obs = env.get_observations()
    for step in range(3):
        alg.act(obs)
        dones = torch.tensor([0, 1, 1]) if step == 1 else torch.zeros(3, dtype=torch.long)
        time_outs = torch.tensor([0.0, 0.0, 1.0]) if step == 1 else torch.zeros(3)
        alg.process_env_step(obs, torch.ones(3), dones, {"time_outs": time_outs})
    alg.compute_returns(obs)
    expected = torch.tensor([[2.0, 1.75, 2.0], [2.0, 1.0, 2.0], [2.0, 2.0, 2.0]])
    assert torch.allclose(alg.storage.returns.squeeze(-1), expected)


@pytest.mark.parametrize("num_envs", [2, 7])
def test_update_with_frames(num_envs):
    env = ToyEnv(num_envs)
    alg = algorithm(env)
    before = [p.clone() for p in alg.actor.perception.parameters()]
    for _ in range(3):
        collect(alg, env, 8)
        losses = alg.update()
    assert losses["height_target"] > 0 and all(torch.isfinite(torch.tensor(v)) for v in losses.values())
    assert all((a != b).any() for a, b in zip(before, alg.actor.perception.parameters(), strict=True))


def test_first_ratio_is_one():
    """Before any step the update sees the log-probabilities of the rollout: windows and caching agree with it."""
    env = ToyEnv(6, episode=9)
    alg = algorithm(env)
    collect(alg, env, 8)
    for batch in alg.storage.mini_batch_generator(2, 1):
        alg.actor(batch.observations, stochastic_output=True)
        log_prob = alg.actor.get_output_log_prob(batch.actions)
        assert torch.allclose(log_prob, batch.old_actions_log_prob.squeeze(-1), atol=1e-4)


def test_storage_holds_only_what_is_read():
    assert set(algorithm(ToyEnv(4)).storage.observations.keys()) == {"command", "height_target"}
    assert set(algorithm(ToyEnv(4, frames=False), frames=False).storage.observations.keys()) == {"command"}


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_non_finite_return_stops_before_it_reaches_the_weights(value):
    alg = collected()
    alg.storage.returns[3, 1] = value
    with pytest.raises(TrainingDiverged, match="gradient of the critic.*returns") as error:
        alg.update()
    assert "\n" not in str(error.value)
    for key, tensor in alg.critic.state_dict().items():
        assert torch.isfinite(tensor).all(), key


def test_non_finite_parameters_are_named():
    alg = algorithm(ToyEnv(4))
    with torch.no_grad():
        alg.actor.perception.distal.bias_hh_l0[0] = float("nan")
    with pytest.raises(TrainingDiverged, match="perception.distal.bias_hh_l0"):
        alg.guard.check_parameters()


def test_an_exploding_learning_rate_ends_in_a_clear_stop():
    env = ToyEnv(4)
    alg = algorithm(env, learning_rate=1e30, schedule="fixed", max_grad_norm=1e30)
    with pytest.raises(TrainingDiverged):
        for _ in range(5):
            collect(alg, env, 8)
            alg.update()


def test_symmetry_and_frames_are_refused():
    with pytest.raises(ValueError, match="one-dimensional observations only"):
        PerceptivePpo(ToyEnv(4), replace(config(), mirror=lambda **_: None), "cpu")
    with pytest.raises(ValueError, match="observations.actor is empty"):
        PerceptivePpo(ToyEnv(4), replace(config(), actor_groups=()), "cpu")


@pytest.mark.parametrize(
    ("name", "first", "final", "expected"),
    [
        ("entropy_coef", 0.01, 0.002, [0.01, 0.008, 0.006, 0.004, 0.002, 0.002]),
        ("desired_kl", 0.02, 0.012, [0.02, 0.018, 0.016, 0.014, 0.012, 0.012]),
    ],
)
def test_a_setting_changes_evenly_to_its_final_value(name, first, final, expected):
    env, seen = ToyEnv(4, frames=False), []
    alg = algorithm(env, frames=False, max_iterations=4, **{name: first, f"final_{name}": final})
    for _ in range(6):
        collect(alg, env, 8)
        alg.update()
        seen.append(getattr(alg, name))
    assert seen == pytest.approx(expected)
    assert getattr(algorithm(env, frames=False, **{name: first}), name) == first


def test_final_desired_kl_is_checked():
    env = ToyEnv(4, frames=False)
    with pytest.raises(ValueError, match="final_desired_kl=0.0 must be positive"):
        algorithm(env, frames=False, final_desired_kl=0.0)
    with pytest.raises(ValueError, match="is for ppo.schedule=adaptive"):
        algorithm(env, frames=False, final_desired_kl=0.002, schedule="fixed")


def test_fixed_steps_stay_after_a_warm_up():
    env = ToyEnv(4)
    alg = algorithm(env, critic_warmup=1, schedule="fixed")
    steps = steps_of(alg)
    for _ in range(2):
        collect(alg, env, 8)
        alg.update()
    assert steps == [1e-3] * 8


@pytest.mark.parametrize(("is_new", "first"), [(True, 1e-3), (False, FIRST_LEARNING_RATE)])
def test_what_another_run_has_learned_is_not_lost_in_the_first_step(is_new, first):
    alg = collected()
    alg.is_new = is_new
    steps = steps_of(alg)
    alg.update()
    assert first / 1.5 <= steps[0] <= first * 1.5


def test_the_critic_keeps_steps_of_its_own():
    env = ToyEnv(4)
    alg = algorithm(env, critic_warmup=1, critic_learning_rate=2e-3)
    policy, critic = steps_of(alg, group=0), steps_of(alg, group=1)
    for _ in range(3):
        collect(alg, env, 8)
        before = [p.clone() for p in alg.critic.parameters()]
        alg.update()
    assert set(critic) == {2e-3} and max(policy[4:]) < 1e-3 and policy[0] == 1e-3
    moved = max((p - was).abs().max().item() for p, was in zip(alg.critic.parameters(), before, strict=True))
    assert 1e-3 < moved < 4 * 2.1e-3  # four steps of Adam
    state = alg.save()
    again = algorithm(ToyEnv(4), critic_warmup=1, critic_learning_rate=2e-3)
    again.load(state)
    assert again.learning_rate == alg.learning_rate < 1e-3
    with pytest.raises(ValueError, match=r"ppo.critic_learning_rate=0.0 must be positive or null"):
        algorithm(env, critic_learning_rate=0.0)


def test_the_critic_warms_up_alone():
    env = ToyEnv(4)
    alg = algorithm(env, critic_warmup=2)
    first_rate, changed, rates, divergence = alg.learning_rate, [], [], alg.actor.get_kl_divergence
    # a policy that stays has a divergence a little above 0 where rounding makes it so
    alg.actor.get_kl_divergence = lambda *given: divergence(*given).abs() + 1e-9
    steps = steps_of(alg)
    for _ in range(3):
        before = [{n: p.clone() for n, p in model.named_parameters()} for model in (alg.actor, alg.critic)]
        collect(alg, env, 8)
        alg.update()
        now = [dict(model.named_parameters()) for model in (alg.actor, alg.critic)]
        rates.append(alg.learning_rate)
        changed.append(
            [any(not torch.equal(old[n], new[n]) for n in old) for old, new in zip(before, now, strict=True)]
        )
    assert changed == [[False, True], [False, True], [True, True]]
    assert all(p.requires_grad for p in alg.actor.parameters())
    assert rates[:2] == [first_rate] * 2 and rates[2] != first_rate and alg.schedule == "adaptive"
    assert steps == [first_rate] * 8 + [pytest.approx(FIRST_LEARNING_RATE * 1.5**k) for k in (1, 2, 3, 4)]
    collect(alg, env, 8)
    alg.update()
    assert alg.learning_rate > FIRST_LEARNING_RATE * 1.5**4  # it goes on from there
    with pytest.raises(ValueError, match="ppo.critic_warmup=-1 must not be negative"):
        algorithm(env, critic_warmup=-1)


@pytest.mark.parametrize(
    ("given", "dtype"), [(True, torch.bfloat16), (False, torch.float32), (None, torch.float32)]
)  # None is in the files of older runs
def test_updates_multiply_in_the_precision_that_is_asked_for(given, dtype):
    env, kinds = ToyEnv(6), set()
    alg = PerceptivePpo(env, config(frames=False, mixed_precision=given), "cpu")
    collect(alg, env, 8)
    first = next(module for module in alg.actor.modules() if isinstance(module, torch.nn.Linear))
    first.register_forward_hook(lambda module, inputs, result: kinds.add(result.dtype))
    alg.update()
    assert kinds == {dtype}
