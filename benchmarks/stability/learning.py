"""Learning under extreme numbers: it survives, or stops with a line that names the cause; never with NaN weights."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import torch
from tensordict import TensorDict

from omniperception import build, config
from omniperception.build import build_runner
from omniperception.learning import PerceptivePpo, RolloutTooSmall, Runner, TrainingDiverged
from omniperception.perception import FpsSampler, PdSampler, Sampler

BASE = (
    "experiment=quickstart",
    "num_envs=8",
    "ppo.num_steps_per_env=6",
    "ppo.mixed_precision=false",
    "obstacles.curriculum=null",
)
"""What every case trains, small: networks, supervision and sampler of the quickstart, all obstacles from the start."""

Step = Callable[[torch.Tensor], tuple[TensorDict, torch.Tensor, torch.Tensor, dict]]
Disturb = Callable[[Runner], None]


@dataclass(frozen=True)
class Case:
    """One extreme.

    Attributes:
        name: of the row.
        expected: "survives", or a part of the line with which training must stop.
        disturb: changes a runner before it learns.
        overrides: of the configuration besides BASE.
    """

    name: str
    expected: str
    disturb: Disturb
    overrides: tuple[str, ...] = ()


def cases() -> list[Case]:
    """Extreme numbers in rewards, observations, actions and gradients during training."""
    end_to_end = ("perception.supervised_epochs=0",)
    whole = ("ppo.num_mini_batches=8",)
    return [
        Case("as it is", "survives", _nothing),
        Case("rewards of +1e6", "survives", _rewards(lambda r: r + 1e6)),
        Case("rewards of -1e6", "survives", _rewards(lambda r: r - 1e6)),
        Case("rewards of +-1e6", "survives", _rewards(lambda r: 1e6 * torch.randn_like(r).sign())),
        Case("rewards of 1e30", "critic overflowed in every step", _rewards(lambda r: r + 1e30)),
        Case("advantages all equal", "survives", _equal_advantages),
        Case("NaN in one environment's observation", "non-finite proprioception", _observation(math.nan)),
        Case("infinity in one environment's observation", "non-finite proprioception", _observation(math.inf)),
        Case("an observation of 1e30", "square overflows", _observation(1e30)),
        Case("NaN in one environment's frame", "observation 'frames'", _frame(math.nan)),
        Case("the same, end to end", "observation 'frames'", _frame(math.nan), end_to_end),
        Case("NaN in one action", "rollout's actions", _action(math.nan)),
        Case("action noise of 1e-6", f"survives{_OR}overflowed in every step", _noise(1e-6)),
        Case("action noise of 1e6", "survives", _noise(1e6)),
        Case("log-probability ratio overflows", "times as likely", _certain_actions, ("perception=none",)),
        Case("KL divergence of 1e6", "survives", _far_policy),
        Case("gradients of 1e8", "survives", _gradients(1e8)),
        Case("gradients of 1e30", "overflowed in every step", _gradients(1e30)),
        Case("gradients of 1e8, end to end", "survives", _gradients(1e8), end_to_end),
        Case("learning rate of 1e30", "not finite", _learning_rate(1e30)),
        Case("empty clouds", "survives", _nothing, ("lidar.min_range=5.99",)),
        Case("one ray a frame", "survives", _nothing, ("lidar.num_rays=1",)),
        Case("fewer points than sampled", "survives", _nothing, ("lidar.num_rays=20",)),
        Case("every point masked to 0 m", "survives", _nothing, _MASKED),
        Case("episodes of one step", "survives", _nothing, ("terminations.episode_length_s=0.02",)),
        Case("mini-batches of one environment", "survives", _nothing, whole),
        Case("rollouts of one step", "survives", _nothing, ("ppo.num_steps_per_env=1", *whole)),
        Case("one environment", "survives", _nothing, ("num_envs=1", "ppo.num_mini_batches=1")),
        Case("more mini-batches than environments", "must not exceed", _nothing, ("num_envs=2",)),
        Case("one environment, one step", "no spread", _nothing, ("num_envs=1", "ppo.num_steps_per_env=1", *_ONE)),
        Case("every environment diverges in every step", "survives", _diverge),
    ]


_OR = " | "
"""Between ends that are both right: rounding decides."""

_ONE = ("ppo.num_mini_batches=1",)
_MASKED = tuple(f"randomization.lidar_mask.{key}" for key in ("ratio=1.0", "low=0.0", "high=0.0"))


def run_case(case: Case, iterations: int) -> dict[str, object]:
    """Trains `iterations` and says how it ended, and whether that is right."""
    outcome, runner = "survives", None
    try:
        run = build.assemble(config.compose([*BASE, *case.overrides]))
        runner = build_runner(replace(run, env=replace(run.env, skip_curricula=True)), None)
        case.disturb(runner)
        runner.learn(iterations)
    except (TrainingDiverged, RolloutTooSmall, config.ConfigError) as error:
        outcome = str(error)
    weights = runner is None or all(torch.isfinite(w).all() for w in _weights(runner))
    ends = case.expected.split(_OR)
    as_expected = any(end == outcome if end == "survives" else end in outcome for end in ends)
    good = as_expected and weights and "\n" not in outcome
    return {"case": case.name, "good": good, "weights finite": weights, "outcome": outcome}


def precision(seed: int = 0, num_envs: int = 16) -> list[dict[str, object]]:
    """Relative error of float32 against float64 by layer of the paper's PD-RiskNet actor, and of PPO's loss.

    The error of a tensor is |a - b| / |b| in the Euclidean norm; `gradient` is that of the layer's parameters.
    """
    torch.manual_seed(seed)
    overrides = ["experiment=quickstart", "perception=pd_risknet", f"num_envs={num_envs}", "ppo.num_steps_per_env=11"]
    run = build.assemble(config.compose([*overrides, "ppo.mixed_precision=false", "obstacles.curriculum=null"]))
    runner = build_runner(replace(run, env=replace(run.env, skip_curricula=True)), None)
    runner.learn(1)
    alg, obs = runner.alg, runner.env.get_observations()
    with torch.inference_mode():
        for _ in range(11):
            obs = runner.step(obs)
        alg.compute_returns(obs)
    single = _pass(alg, torch.float32)
    double = _pass(alg, torch.float64)
    return [
        {"layer": name, "output": _relative(single[name][0], double[name][0]), "gradient": _relative(*gradients)}
        for name in double
        for gradients in [(single[name][1], double[name][1])]
    ]


def clouds() -> list[dict[str, object]]:
    """Samplers on clouds that are empty, of one point, of equal points, or of fewer points than wanted."""
    samplers: list[tuple[str, Sampler]] = [
        ("FPS", FpsSampler(16, max_range=20.0)),
        ("FPS by buckets", FpsSampler(16, max_range=20.0)),
        ("proximal and distal", PdSampler(16, 8, split_deg=20.0, max_range=20.0)),
    ]
    samplers[1][1].buckets_from = 1
    rows = []
    for cloud, ranges in _clouds().items():
        for name, sampler in samplers:
            out = torch.full((1, sampler.num_points, 3), math.nan)
            elevation, azimuth = (
                torch.linspace(-0.5, 0.9, ranges.shape[1])[None],
                torch.linspace(-3, 3, ranges.shape[1]),
            )
            azimuth = azimuth[None].contiguous()
            directions = torch.stack(
                (elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()), -1
            )
            sampler(ranges, directions, elevation, azimuth, out)
            points = ranges[..., None] * directions / 20.0
            hits = points[ranges.isfinite()]
            finite = bool(out.isfinite().all())
            zero = bool((out == 0).all())
            good = finite and (
                zero if not len(hits) else bool(out.norm(dim=-1).max() <= hits.norm(dim=-1).max() + 1e-6)
            )
            rows.append({"cloud": cloud, "sampler": name, "good": good, "finite": finite, "all zero": zero})
    return rows


def _clouds() -> dict[str, torch.Tensor]:
    miss = torch.full((1, 12), math.inf)
    one = miss.clone()
    one[0, 3] = 2.0
    few = miss.clone()
    few[0, ::4] = 2.0
    return {
        "empty": miss,
        "one ray, a miss": miss[:, :1],
        "one point": one,
        "three points": few,
        "all at 0 m": torch.zeros(1, 12),
        "all at the largest range": torch.full((1, 12), 20.0),
        "at 1e-30 m": torch.full((1, 12), 1e-30),
    }


# ---- disturbances ----------------------------------------------------------------------------------------------------


def _nothing(runner: Runner) -> None:
    """Leaves everything as it is."""


def _stepping(runner: Runner, change: Callable[[TensorDict, torch.Tensor], torch.Tensor]) -> None:
    step = runner.env.step

    def changed(actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        observations, rewards, done, extras = step(actions)
        return observations, change(observations, rewards), done, extras

    runner.env.step = changed


def _rewards(change: Callable[[torch.Tensor], torch.Tensor]) -> Disturb:
    return lambda runner: _stepping(runner, lambda _, rewards: change(rewards))


def _observation(value: float) -> Disturb:
    def change(observations: TensorDict, rewards: torch.Tensor) -> torch.Tensor:
        observations["proprioception"] = observations["proprioception"].clone()
        observations["proprioception"][3, 5] = value
        return rewards

    return lambda runner: _stepping(runner, change)


def _frame(value: float) -> Disturb:
    def change(observations: TensorDict, rewards: torch.Tensor) -> torch.Tensor:
        observations["frames"] = observations["frames"].clone()
        observations["frames"][3] = value
        return rewards

    return lambda runner: _stepping(runner, change)


def _action(value: float) -> Disturb:
    def disturb(runner: Runner) -> None:
        act = runner.alg.act

        def broken(observations: TensorDict) -> torch.Tensor:
            actions = act(observations)
            actions[3, 5] = value
            return actions

        runner.alg.act = broken

    return disturb


def _after_rollout(runner: Runner, change: Callable[[], None]) -> None:
    compute = runner.alg.compute_returns

    def changed(observations: TensorDict) -> None:
        compute(observations)
        change()

    runner.alg.compute_returns = changed


def _equal_advantages(runner: Runner) -> None:
    _after_rollout(runner, lambda: runner.alg.storage.advantages.zero_())


def _certain_actions(runner: Runner) -> None:
    """The rollout's actions were drawn with noise of 1; now they are the means, and the noise is 1e-6."""

    def change() -> None:
        storage = runner.alg.storage
        storage.actions.copy_(storage.distribution_params[0])
        with torch.no_grad():
            runner.alg.actor.distribution.std_param.fill_(1e-6)

    _after_rollout(runner, change)


def _far_policy(runner: Runner) -> None:
    """The old policy lies 1400 standard deviations away: KL = 1400^2 / 2, and the ratio is 0."""
    _after_rollout(runner, lambda: runner.alg.storage.distribution_params[0].add_(1400.0))


def _noise(std: float) -> Disturb:
    def disturb(runner: Runner) -> None:
        with torch.no_grad():
            runner.alg.actor.distribution.std_param.fill_(std)

    return disturb


def _gradients(factor: float) -> Disturb:
    """Multiplies what arrives at every parameter, before it is clipped."""

    def disturb(runner: Runner) -> None:
        for model in (runner.alg.actor, runner.alg.critic):
            for parameter in model.parameters():
                parameter.register_hook(lambda gradient: gradient * factor)

    return disturb


def _learning_rate(rate: float) -> Disturb:
    def disturb(runner: Runner) -> None:
        runner.alg.learning_rate, runner.alg.schedule = rate, "fixed"
        for group in runner.alg.optimizer.param_groups:
            group["lr"] = rate

    return disturb


def _diverge(runner: Runner) -> None:
    step = runner.env.step

    def broken(actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        runner.env.sim.qvel[:, 0] = math.nan
        return step(actions)

    runner.env.step = broken


# ---- precision -------------------------------------------------------------------------------------------------------


def _weights(runner: Runner) -> Iterator[torch.Tensor]:
    for model in (runner.alg.actor, runner.alg.critic):
        yield from (t for t in (*model.parameters(), *model.buffers()) if t.is_floating_point())


def _pass(alg: PerceptivePpo, dtype: torch.dtype) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """(output, gradient of the parameters) by layer, and of PPO's loss, over the whole rollout in a precision."""
    batch = alg.storage.batch_of(torch.arange(alg.storage.num_envs))
    actor, critic = alg.actor.to(dtype), alg.critic.to(dtype)
    observations = replace(
        batch.observations,
        groups=batch.observations.groups.to(dtype),
        frames=batch.observations.frames.to(dtype),
    )
    outputs: dict[str, torch.Tensor] = {}
    modules = {f"actor.{n}": m for n, m in actor.named_modules()} | {
        f"critic.{n}": m for n, m in critic.named_modules()
    }
    layers = {name: module for name, module in modules.items() if list(module.parameters(recurse=False))}
    layers = {name: module for name, module in layers.items() if not name.endswith("distribution")}
    for name, module in layers.items():
        module.register_forward_hook(partial(_keep_first, outputs, name))
    actor.zero_grad()
    critic.zero_grad()
    loss = _ppo_loss(alg, actor, critic, observations, batch, dtype)
    loss.backward()
    layers = {name: module for name, module in layers.items() if name in outputs}
    gradients = {
        name: torch.cat([p.grad.flatten() for p in module.parameters(recurse=False) if p.grad is not None])
        for name, module in layers.items()
    }
    whole = torch.cat(list(gradients.values()))
    return {name: (outputs[name], gradients[name]) for name in layers} | {"loss": (loss.detach(), whole)}


def _keep_first(outputs: dict[str, torch.Tensor], name: str, _: object, __: object, output: torch.Tensor) -> None:
    """A forward hook; a later call of a perception network embeds the empty history."""
    outputs.setdefault(name, output.detach())


def _ppo_loss(alg: PerceptivePpo, actor, critic, observations, batch, dtype: torch.dtype) -> torch.Tensor:
    """The clipped surrogate, the value loss and the entropy, as rsl_rl's PPO adds them."""
    actor(observations, stochastic_output=True)
    ratio = (
        actor.get_output_log_prob(batch.actions.to(dtype)) - batch.old_actions_log_prob.to(dtype).squeeze(-1)
    ).exp()
    advantages, returns = batch.advantages.to(dtype).squeeze(-1), batch.returns.to(dtype)
    clipped = ratio.clamp(1.0 - alg.clip_param, 1.0 + alg.clip_param)
    surrogate = torch.max(-advantages * ratio, -advantages * clipped).mean()
    value = (critic(observations) - returns).square().mean()
    return surrogate + alg.value_loss_coef * value - alg.entropy_coef * actor.output_entropy.mean()


def _relative(ours: torch.Tensor, true: torch.Tensor) -> float:
    return float((ours.double() - true.double()).norm() / true.double().norm().clamp(min=1e-300))
