"""PPO: returns by hand, its update against rsl_rl's, and the stop at numbers that are not finite."""

import copy

import pytest
import torch
from rsl_rl.algorithms import PPO
from toy_env import ToyEnv, collect, config, steps_of

from omniperception.learning import PerceptivePpo, RolloutTooSmall, Runner, TrainingDiverged
from omniperception.learning.phases import FIRST_LEARNING_RATE


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


@pytest.mark.parametrize("options", [{}, {"schedule": "fixed", "use_clipped_value_loss": False}], ids=str)
def test_an_update_is_that_of_rsl_rl_bit_for_bit(options):
    """Of policy, critic, their statistics, the learning rate and the losses."""
    ours = collected(frames=False, **options)
    theirs = copy.deepcopy(ours)
    torch.manual_seed(1)
    losses = ours.update()
    torch.manual_seed(1)
    assert losses == PPO.update(theirs) and ours.learning_rate == theirs.learning_rate
    for model in ("actor", "critic"):
        mine, other = (getattr(alg, model).state_dict() for alg in (ours, theirs))
        assert all(torch.equal(mine[name], other[name]) for name in other)


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
    again = algorithm(ToyEnv(4), critic_warmup=1, critic_learning_rate=2e-3)
    again.load(alg.save())
    assert again.learning_rate == alg.learning_rate < 1e-3


@pytest.mark.parametrize("schedule", ["adaptive", "fixed"])
def test_the_critic_warms_up_alone(schedule):
    env = ToyEnv(4)
    alg = algorithm(env, critic_warmup=2, schedule=schedule)
    changed, steps, divergence = [], steps_of(alg), alg.actor.get_kl_divergence
    # a policy that stays has a divergence a little above 0 where rounding makes it so
    alg.actor.get_kl_divergence = lambda *given: divergence(*given).abs() + 1e-9
    for _ in range(4):
        before = [[p.clone() for p in model.parameters()] for model in (alg.actor, alg.critic)]
        collect(alg, env, 8)
        alg.update()
        now = [list(model.parameters()) for model in (alg.actor, alg.critic)]
        changed.append([not all(map(torch.equal, *both)) for both in zip(before, now, strict=True)])
    assert changed == [[False, True], [False, True], [True, True], [True, True]]
    first_of_ppo = [pytest.approx(FIRST_LEARNING_RATE * 1.5**k) for k in (1, 2, 3, 4)]
    assert steps[:12] == [1e-3] * 8 + (first_of_ppo if schedule == "adaptive" else [1e-3] * 4)
    assert schedule == "fixed" or steps[12] > FIRST_LEARNING_RATE * 1.5**4  # it goes on from there


@pytest.mark.parametrize(
    ("given", "dtype"), [(True, torch.bfloat16), (False, torch.float32), (None, torch.float32)]
)  # None is in the files of older runs
def test_updates_multiply_in_the_precision_that_is_asked_for(given, dtype):
    alg, kinds = collected(6, frames=False, mixed_precision=given), set()
    first = next(module for module in alg.actor.modules() if isinstance(module, torch.nn.Linear))
    first.register_forward_hook(lambda module, inputs, result: kinds.add(result.dtype))
    alg.update()
    assert kinds == {dtype}


def stopped_by(alg):
    """The line with which an update stops, before what is not finite reaches the weights."""
    with pytest.raises(TrainingDiverged) as error:
        alg.update()
    assert "\n" not in str(error.value)
    assert all(torch.isfinite(p).all() for model in (alg.actor, alg.critic) for p in model.parameters())
    return str(error.value)


class TestNumbersThatAreNotFinite:
    @pytest.mark.parametrize("value", [float("nan"), float("inf")])
    def test_of_a_return(self, value):
        alg = collected()
        alg.storage.returns[3, 1] = value
        line = stopped_by(alg)
        assert "gradient of the critic" in line and "returns" in line

    def test_of_a_frame(self):
        env = ToyEnv(6)
        alg = PerceptivePpo(env, config(supervised=True), "cpu")
        collect(alg, env, 8)
        alg.storage.frames[2] = float("nan")
        line = stopped_by(alg)
        assert "gradient of the perception network" in line and "observation 'frames'" in line

    def test_of_a_parameter(self):
        alg = algorithm(ToyEnv(4))
        with torch.no_grad():
            alg.actor.perception.distal.bias_hh_l0[0] = float("nan")
        with pytest.raises(TrainingDiverged, match="perception.distal.bias_hh_l0"):
            alg.guard.check_parameters()

    @pytest.mark.parametrize("model", ["actor", "critic"])
    def test_of_a_gradients_norm(self, model):
        """Clipping divides by their norm, infinity, and nothing would ever be learnt."""
        alg = collected()
        for parameter in getattr(alg, model).parameters():
            parameter.register_hook(lambda gradient: gradient * 1e25)
        assert f"gradient of the {model} overflowed in every step" in stopped_by(alg)

    def test_of_a_likelihood_ratio(self):
        alg = collected(frames=False)
        alg.storage.actions.copy_(alg.storage.distribution_params[0])
        alg.storage.actions_log_prob.fill_(-100.0)
        with torch.no_grad():
            alg.actor.distribution.std_param.fill_(1e-6)
        assert "times as likely, smallest standard deviation 1.0e-06" in stopped_by(alg)

    def test_of_the_square_of_an_observation(self):
        alg = collected(frames=False)
        alg.storage.observations["command"][3, 2, 0] = 1e30
        assert "observation 'command' reach 1e+30, whose square overflows" in stopped_by(alg)

    def test_of_a_learning_rate(self):
        env = ToyEnv(4)
        alg = algorithm(env, learning_rate=1e30, schedule="fixed", max_grad_norm=1e30)
        with pytest.raises(TrainingDiverged):
            for _ in range(5):
                collect(alg, env, 8)
                alg.update()


def test_nothing_to_learn_for_the_actor_is_no_reason_to_stop():
    alg = collected(frames=False, entropy_coef=0.0)
    alg.storage.advantages = torch.zeros_like(alg.storage.advantages)
    alg.update()


@pytest.mark.parametrize(
    ("num_mini_batches", "frames", "steps", "message"),
    [
        (2, True, 8, "num_mini_batches=2 must not exceed the 1 environments"),
        (2, False, 1, "num_mini_batches=2 must not exceed the 1 steps"),
        (1, False, 1, "no spread"),
    ],
)
def test_rollouts_that_are_too_small_are_refused_before_they_are_collected(num_mini_batches, frames, steps, message):
    alg = algorithm(ToyEnv(1, frames=frames), steps, frames, num_mini_batches=num_mini_batches)
    with pytest.raises(RolloutTooSmall, match=message):
        alg.check_rollout()


def test_anomalies_are_on_the_console_when_they_happen(tmp_path, capsys):
    env = ToyEnv(4)
    step = env.step

    def log(actions):
        observations, rewards, dones, extras = step(actions)
        extras["log"] |= {"Anomalies/diverged": 3.0, "Anomalies/engine": 0.0}
        return observations, rewards, dones, extras

    env.step = log
    Runner(env, config(), tmp_path).learn(1)
    line = capsys.readouterr().out
    assert "| diverged 3" in line and "engine" not in line
