"""What a run consists of and what it leaves out, read off the parts that were built."""

from collections.abc import Collection

from omniperception.env.env import OmniEnv
from omniperception.env.mixed import families_of
from omniperception.learning import Runner


def parts_of(runner: Runner) -> dict[str, list[str]]:
    """What each part of a run consists of, by its name or that of its family and its own; nothing: it is left out."""
    families = families_of(runner.env).items()
    parts = {f"{family} {name}".lstrip(): items for family, env in families for name, items in _of_env(env).items()}
    learned = {"perception": runner.config.perception, "estimator": runner.config.estimator}
    return parts | {name: ["learned"] if part else [] for name, part in learned.items()}


def _of_env(env: OmniEnv) -> dict[str, list[str]]:
    model, rays, groups = env.world.model, list[str](), env.config.observations.groups
    if env.sensing is not None:
        rays = [f"{env.sensing.lidar.config.num_rays} every {env.sensing.period_steps} steps"]
        rays += sorted({s.kind.name.lower() for s in env.sensing.scene.shapes} | env.sensing.lidar.features)
    optional = {"obstacles": env.obstacles, "sectors": env.avoidance, "pushes": env.pushes}
    return {
        "physics": [f"{model.nbody} bodies", f"{model.ngeom} geoms", f"{model.nu} actuators"],
        "uneven ground": [f"{model.nhfielddata} heights"] if model.nhfielddata else [],
        "contact sensors": sorted(env.world.sensors),
        "randomized fields": sorted(env.sim.state_dict()["fields"]),
        **{name: ["built"] if part else [] for name, part in optional.items()},
        "rays": rays,
        "rewards": [f"{name} {term.weight:g}" for name, term in env.config.rewards.terms.items()],
        "observations": [f"{g}.{name} {n}" for g in groups for name, n in env.observation_widths(g).items()],
    }


def summary(parts: dict[str, list[str]], families: Collection[str] = ()) -> str:
    """Two lines for the start of a run; what one of its families has is built, and stands there once."""
    there: dict[str, list[str]] = {}
    for name, items in parts.items():
        family, _, own = name.partition(" ")
        there.setdefault(own if family in families else name, []).extend(items)
    built, left_out = ([name for name, items in there.items() if bool(items) == wanted] for wanted in (True, False))
    return f"built: {', '.join(built)}\nleft out: {', '.join(left_out) or 'nothing'}"
