"""Looks at a gait: where it breaks, which kicks it survives, when its feet are down, how it answers to commands.

    gait run=latest                                   # each row of randomization=robot alone, times 0.5 to 3
    gait run=latest rows=latency_s,joint_offset factors=1,2,4,8
    gait run=latest what=kicks speeds=0.5,1,1.5,2     # under condition=robot, one kick in each trial
    gait run=latest what=feet                         # a gait diagram for each of seven commands
    gait run=latest what=response                     # gain, lag, delay, errors; writes <run>/response.json

Robots follow the commands of scenario=walk on flat ground, or one command each. Prints a table and draws a picture in
the run's evaluation folder; `out` adds the trials of the ranges to a file. The command for the ranges goes on where it
was stopped. For the response, robots are asked for a new velocity each second, within what the gait was trained for, at
no more than 6 m/s^2 and 8 rad/s^2, with all that happens to them under a condition, pushes among it; robots without
legs follow what it writes. Falls, errors, torques and slip on all grounds are `evaluate suite=walking`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from omniperception import build, config
from omniperception.common.tables import markdown
from omniperception.env.env import OmniEnv, Policy
from omniperception.evaluation.gait import robustness
from omniperception.evaluation.gait.footfall import COMMANDS, SETTLES_S, SHOWN_S, Footfall, draw_footfall, watch
from omniperception.evaluation.gait.kicks import AFTER_S, WATCHED_S, KickResults, draw_kicks, kick
from omniperception.evaluation.gait.response import COMMANDS as CYCLES
from omniperception.evaluation.gait.response import (
    COPIES,
    STEP_S,
    Recording,
    around_cycle,
    cycles,
    draw_response,
    falls_by_jump,
    gait_frequency,
    record,
)
from omniperception.evaluation.gait.response_fit import SETTLES_S as UNSETTLED_S
from omniperception.evaluation.gait.response_fit import fit, kept
from omniperception.evaluation.report.records import FOLDER, merge
from omniperception.evaluation.suite import Evaluation, World
from omniperception.scene.build import FOOT_FORCE
from omniperception.sim.response import AXES, ConditionResponse, GaitResponse
from omnirobot.common.cli import RESULTS, Command, argument, refuse_arguments, refuse_overrides, trust
from omnirobot.common.errors import ConfigError
from omnirobot.common.figures import check_figures

READ = {
    "ranges": ("rows", "factors", "preset", "trials", "out"),
    "kicks": ("speeds", "bearings", "repeats", "condition"),
    "feet": ("condition",),
    "response": ("conditions", "robots", "seconds"),
}
"""Arguments that mean something for these alone."""
OWN: dict[str, dict[str, object]] = {
    "ranges": {"num_envs": Evaluation.num_envs, "scenario": "walk"},
    "kicks": {"num_envs": 64, "scenario": "walk", "terminations.episode_length_s": AFTER_S + WATCHED_S},
    "feet": {"num_envs": len(COMMANDS), "scenario": "walk", "terminations.episode_length_s": 2 * (SETTLES_S + SHOWN_S)},
    "response": {"num_envs": 192, "scenario": "walk", "terrain": "flat", "terminations.episode_length_s": 60},
}
"""Values that the command sets itself."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    run: str = argument("latest", "run directory, or latest for the newest under outputs/")
    what: str = argument("ranges", "what is tried", choices=tuple(READ))
    rows: tuple[str, ...] = argument((), "rows of the randomization; none: all that have a range and concern the robot")
    factors: tuple[float, ...] = argument((0.5, 1.0, 1.5, 2.0, 2.5, 3.0), "multiples of the ranges")
    preset: str = argument("robot", "preset of randomization that has the ranges")
    trials: int = argument(200, "trials of each row and factor", least=1)
    speeds: tuple[float, ...] = argument((0.5, 1.0, 1.5, 2.0), "sizes of the kicks (m/s)", positive=True)
    bearings: int = argument(16, "directions of the kicks, evenly around", least=1)
    repeats: int = argument(16, "kicks of each size and direction", least=1)
    condition: str | None = argument("robot", "preset of conf/condition for kicks (without its pushes) and feet")
    conditions: tuple[str, ...] = argument(("ideal", "paper", "robot"), "presets of conf/condition for the response")
    robots: int = argument(192, "robots whose response is measured under each condition", least=4)
    seconds: int = argument(16, "for how long it is (s)", least=8)
    out: Path | None = argument(None, "file that the trials of the ranges are added to", suffixes=RESULTS)
    trust: tuple[str, ...] = trust()


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Measures, prints a table and draws a picture."""
    others = {name for names in READ.values() for name in names} - {*READ[arguments.what]}
    refuse_arguments(arguments, others, f"it is not read for what={arguments.what}")
    refuse_overrides(overrides, OWN[arguments.what])
    run_dir = config.find_run(arguments.run)
    picture = run_dir / FOLDER / f"gait-{arguments.what}.png"
    picture.parent.mkdir(exist_ok=True)
    check_figures()
    if arguments.what == "kicks":
        trained = policy_on_free_ground(arguments, run_dir, overrides)
        results = kick(trained.env, trained.policy, arguments.speeds, arguments.bearings, arguments.repeats)
        print(kicks_table(results, arguments.speeds))
        draw_kicks(results, arguments.speeds, arguments.bearings, picture)
    elif arguments.what == "feet":
        trained = policy_on_free_ground(arguments, run_dir, overrides)
        footfall = watch(trained.env, trained.policy)
        draw_footfall(footfall, picture)
        print(feet_table(footfall))
    elif arguments.what == "response":
        response, recordings = answered(arguments, run_dir, overrides)
        print(response_table(response))
        draw_response(recordings, picture)
        print(f"wrote {response.save(run_dir)}")
    else:
        folders = config.search_path(overrides, config.read(run_dir))
        rows = arguments.rows or robustness.rows_of_the_robot(arguments.preset, folders)
        given = Evaluation([run_dir], [World("walk")], overrides=tuple(overrides), trust=arguments.trust)
        evaluation = replace(given, trials=arguments.trials, out=arguments.out)
        found = robustness.measure(robustness.stretches(evaluation, arguments.preset, rows, arguments.factors))
        print(robustness.table(found))
        robustness.draw(found, picture)
        if arguments.out is not None:
            merge(arguments.out, [record for _, record in found])
            print(f"added to {arguments.out}")
    print(f"wrote {picture}")


def answered(
    arguments: Arguments, run_dir: Path, overrides: list[str]
) -> tuple[GaitResponse, dict[str, tuple[Recording, torch.Tensor]]]:
    """Measures how the run's policy answers to commands: the response, and what was recorded and fitted by condition.

    Raises:
        ConfigError: its robots fall too often to be measured, or the overrides change a condition.
    """
    own = [f"{key}={value}" for key, value in OWN["response"].items()]
    runs = {
        name: build.load_run(run_dir, [*own, f"condition={name}", *overrides], arguments.trust)
        for name in dict.fromkeys(("ideal", *arguments.conditions))
    }
    ranges = commanded(run_dir, runs["ideal"])
    known, size = cycles(*_calm(runs["ideal"], run_dir, COPIES * len(CYCLES)), ranges)
    conditions, recordings = {}, {}
    for name in arguments.conditions:
        condition = runs[name].condition
        if condition is None:
            raise ConfigError(f"{' '.join(overrides)} would change condition={name}, whose response is asked for")
        env, policy = _calm(runs[name], run_dir, arguments.robots)
        recording = record(env, policy, ranges, arguments.seconds)
        frequency = gait_frequency(env)
        try:
            axes, predicted = fit(recording.asked, recording.velocity, recording.done, recording.dt, frequency)
        except ValueError as error:
            raise ConfigError(f"condition={name}: {error}") from None
        spread = around_cycle(recording, known, kept(recording.done, round(UNSETTLED_S / recording.dt)))
        conditions[name] = ConditionResponse(condition.version, axes, *spread, falls_by_jump(recording))
        recordings[name] = recording, predicted
    response = GaitResponse(frequency, ranges, *size, conditions, known)
    return response, recordings


def _calm(run: build.RunConfig, run_dir: Path, robots: int) -> tuple[OmniEnv, Policy]:
    """Environment and policy of a run, without what nobody reads: rewards."""
    build.check_split(run, "picture", run_dir)
    env = replace(run.env, num_envs=robots, rewards=replace(run.env.rewards, terms={}))
    trained = build.load_policy(replace(run, env=env), run_dir)
    return trained.env, trained.policy


def commanded(run_dir: Path, run: build.RunConfig) -> dict[str, tuple[float, float]]:
    """By axis, the velocities (m/s, rad/s) that a run was trained for; as of its robot where it was given goals."""
    commands = config.read(run_dir).commands
    given = commands if "lin_vel_x" in commands else run.composed["commands"]
    return {
        axis: (float(given[key][0]), float(given[key][1]))
        for axis, key in zip(AXES, ("lin_vel_x", "lin_vel_y", "ang_vel_z"), strict=True)
    }


def policy_on_free_ground(arguments: Arguments, run_dir: Path, overrides: list[str]) -> build.TrainedPolicy:
    """The run's policy under the condition, without pushes."""
    given = {} if arguments.condition is None else {"condition": arguments.condition}
    own = [f"{key}={value}" for key, value in (OWN[arguments.what] | given).items()]
    run = build.load_run(run_dir, [*own, *overrides], arguments.trust)
    build.check_split(run, "picture", run_dir)
    calm = replace(run.env.randomization, pushes=None)
    return build.load_policy(
        replace(run, env=replace(run.env, randomization=calm, extra_requirements=(FOOT_FORCE,))), run_dir
    )


def kicks_table(results: KickResults, speeds: tuple[float, ...]) -> str:
    """Shares survived by size."""
    rates = [results.rate(speed) for speed in speeds]
    cells = [f"{100 * r['rate']:.1f} [{100 * r['low']:.1f}, {100 * r['high']:.1f}]" if r else "–" for r in rates]
    rows = [[f"{speed:g}", cell] for speed, cell in zip(speeds, cells, strict=True)]
    return markdown(["kick, m/s", f"no fall within {WATCHED_S:g} s, %"], rows) + "\n"


def feet_table(footfall: Footfall) -> str:
    """Velocities, step frequencies and duty factors by command."""
    rows, duty, frequency = [], footfall.duty(), footfall.frequency()
    for k, name in enumerate(footfall.names()):
        feet = f"{float(frequency[k].mean()):.2f}", f"{100 * float(duty[k].mean()):.0f}"
        walked = [*(f"{v:.2f}" for v in footfall.velocity[k].tolist()), *feet]
        rows.append([name, *(["fell, or left its ground", *[""] * (len(walked) - 1)] if footfall.fell[k] else walked)])
    heads = ["command", "v_x, m/s", "v_y, m/s", "yaw rate, rad/s", "steps of a foot per s", "a foot is down, %"]
    return markdown(heads, rows) + "\n"


def response_table(response: GaitResponse) -> str:
    """Figures by condition and axis, falls by size of the jump, and the robot's size."""
    rows = [
        [name, axis, *pairs, f"{one.noise:.3f}, {one.noise_s:.2f}", f"{one.acceleration:.1f}"]
        for name, condition in response.conditions.items()
        for axis, one in condition.axes.items()
        for pairs in [[f"{mean:.3f} ± {sd:.3f}" for mean, sd in (one.gain, one.lag_s, one.delay_s, one.offset)]]
    ]
    units = "SI units, mean ± standard deviation between robots:"
    heads = ["condition", "axis", "gain", "lag", "delay", "lasting error", "wandering error, for", "acceleration"]
    falls = {
        name: {(low, high): f"{fell} of {jumps}" for low, high, jumps, fell in condition.falls}
        for name, condition in response.conditions.items()
    }
    classes = sorted({size for own in falls.values() for size in own})
    jumps = [[f"{low:g} to {high:g}", *(own.get((low, high), "–") for own in falls.values())] for low, high in classes]
    fell = f"Falls within {STEP_S:g} s of a jump of the asked velocity (m/s):"
    size = f"Radius {response.radius:.3f} m, half length {response.half_length:.3f} m.\n"
    return "\n\n".join((units, markdown(heads, rows), fell, markdown(["jump", *falls], jumps), size))


command = Command(main, Arguments, __doc__, "of the run's configuration")
