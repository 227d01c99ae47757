"""Work and precision of the physics: time step, integrator, solver, friction cone, and where the PD law is computed."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from mujoco.batch import Batch, SimulationError

from benchmarks.harness.pareto import Choice, Study
from benchmarks.harness.timing import paired_timings
from omniperception.build import RunConfig
from omniperception.config import ConfigError
from omniperception.scene import ObstacleGroup, ObstaclesConfig, World, build_world
from omniperception.sim import SimConfig
from omniperception.sim.mujoco import apply_options

GAIT = Path(__file__).with_name("gait.json")
COST = "CPU time per control step (us per environment)"
SAME, TRUE = "base RMSE, same cone (m)", "base RMSE, elliptic cone (m)"
"""Of the base's position: what the step leaves, and what the cone adds to it."""
CONTROL_DT = 0.02
REFERENCE_DT = 5e-5
PERTURBATION, GROWTH = 1e-9, 1e3
"""A trajectory is compared until a change of its start (m, rad) by the first has grown by the second factor."""
TIMED_ENVS = 16


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        timesteps: Physics steps, s; each divides the control step.
        iterations: Of the solver.
        duration_s: Length of the trajectories at most, s.
        num_starts: Starts of each trajectory.
        rounds: How often each choice is timed, in turn.
        block_s: About how long at once, s.
    """

    timesteps: Sequence[float] = (0.00025, 0.0005, 0.001, 0.002, 0.004, 0.005, 0.01)
    iterations: Sequence[int] = (1, 2, 3, 5, 10, 20, 50)
    duration_s: float = 1.0
    num_starts: int = 4
    rounds: int = 5
    block_s: float = 0.02


SMALL = Sizes((0.002, 0.005, 0.01), (1, 10), 0.1, 1, 2, 0.002)


@dataclass(frozen=True)
class Method:
    """One way of stepping.

    Attributes:
        sim: Step, integrator and solver.
        outside: Whether the PD torque is computed outside of the engine before every step, instead of by actuators.
    """

    sim: SimConfig
    outside: bool = False

    def but(self, **changes: object) -> Method:
        """The same with another step, integrator or solver."""
        changed = replace(self.sim, **changes)
        return replace(self, sim=replace(changed, decimation=round(CONTROL_DT / changed.timestep)))

    @property
    def family(self) -> str:
        return f"{self.sim.integrator}, PD outside" if self.outside else self.sim.integrator


@dataclass(frozen=True)
class Trajectory:
    """A motion from several starts.

    Attributes:
        name: What happens.
        world: Its world.
        qpos, qvel: The starts, (n, nq) and (n, nv).
        targets: Joint targets of each start's control steps, rad, (n, K, num_joints).
    """

    name: str
    world: World
    qpos: np.ndarray
    qvel: np.ndarray
    targets: np.ndarray


class Robots:
    """Simulations of a world on one thread that are stepped by a method."""

    def __init__(self, world: World, method: Method, qpos: np.ndarray, qvel: np.ndarray) -> None:
        model = copy.copy(world.model)
        apply_options(model, method.sim)
        if method.outside:
            model.actuator_gainprm[:, 0] = 1.0
            model.actuator_biasprm[:] = 0.0
        self._batch = Batch(model, len(qpos), 1)
        self.qpos, self._qvel, self._ctrl = (self._batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self._start, self._robot, self._method = (qpos, qvel), world.robot, method
        self.lost = np.zeros(len(qpos), dtype=bool)
        self.restart()

    def restart(self) -> None:
        """Puts them back to their start."""
        self.qpos[:], self._qvel[:] = self._start

    def advance(self, targets: np.ndarray) -> None:
        """One control step towards joint targets (n, num_joints)."""
        decimation, outside = self._method.sim.decimation, self._method.outside
        for _ in range(decimation if outside else 1):
            self._ctrl[:] = targets
            if outside:
                self._ctrl[:] = self._robot.kp * (targets - self.qpos[:, 7:]) - self._robot.kv * self._qvel[:, 6:]
            try:
                self._batch.step(nstep=1 if outside else decimation)
            except SimulationError as error:
                self.lost[np.asarray(error.ids)] = True


def follow(trajectory: Trajectory, method: Method) -> np.ndarray:
    """Positions (n, K, nq) at the ends of a trajectory's control steps; NaN where a simulation is lost."""
    robots = Robots(trajectory.world, method, trajectory.qpos, trajectory.qvel)
    path = []
    for targets in trajectory.targets.swapaxes(0, 1):
        robots.advance(targets)
        path.append(np.where(robots.lost[:, None], math.nan, robots.qpos))
    return np.stack(path, 1)


class Bench:
    """Trajectories of a configuration's robot, and the truth about them."""

    def __init__(self, run: RunConfig, sizes: Sizes) -> None:
        self.sizes, self.robot, self.terrain = sizes, run.env.robot, run.env.terrain
        self.default = Method(run.env.sim)
        if abs(run.env.sim.control_dt - CONTROL_DT) > 1e-9:
            raise ConfigError(
                f"sim.timestep * sim.decimation = {run.env.sim.control_dt:g} s must be {CONTROL_DT:g} s, the period of"
                " the recorded gait"
            )
        self.reference = self.default.but(
            timestep=REFERENCE_DT, integrator="implicitfast", iterations=100, cone="elliptic"
        )
        self.trajectories = [self._gait(), self._drop(), self._stumble()]
        self._truths: dict[tuple[str, str], np.ndarray] = {}
        self.horizons: dict[str, int] = {}
        self.growths: dict[str, float] = {}
        self.doubts: dict[str, float] = {}
        for trajectory in self.trajectories:
            self._find_horizon(trajectory)

    def truth(self, trajectory: Trajectory, cone: str = "elliptic") -> np.ndarray:
        """At the reference's step, with the true friction cone unless another is given, up to the end."""
        key = (trajectory.name, cone)
        if key not in self._truths:
            self._truths[key] = follow(trajectory, self.reference.but(cone=cone))
        return self._truths[key]

    def errors(self, method: Method) -> dict[str, float]:
        """Of all trajectories together up to their horizons; infinite where a simulation is lost."""
        base, joints, own = [], [], []
        for trajectory in self.trajectories:
            path, end = follow(trajectory, method), self.horizons[trajectory.name]
            off = (path - self.truth(trajectory))[:, :end]
            base.append(off[..., :3].reshape(-1, 3))
            joints.append(off[..., 7:].ravel())
            own.append((path - self.truth(trajectory, method.sim.cone))[:, :end, :3].reshape(-1, 3))
        with np.errstate(over="ignore"):
            found = {SAME: _rms(*own, axes=3), TRUE: _rms(*base, axes=3), "joint RMSE (rad)": _rms(*joints)}
        return found if math.isfinite(found[TRUE]) else dict.fromkeys(found, math.inf)

    def costs(self, methods: Mapping[str, Method]) -> dict[str, float]:
        """CPU time of a control step of the gait, us per environment, in turn."""
        steppers = {name: self._stepper(method) for name, method in methods.items()}
        timings = paired_timings(steppers, self.sizes.rounds, block_s=self.sizes.block_s)
        return {name: 1e6 * timing.least_cpu_s / TIMED_ENVS for name, timing in timings.items()}

    def notes(self) -> tuple[str, ...]:
        """The trajectories' horizons and the reference's own error."""
        horizons = ", ".join(
            f"{name} {CONTROL_DT * end:.2f} s (a change of {PERTURBATION:g} grew {self.growths[name]:.3g} times)"
            for name, end in self.horizons.items()
        )
        doubts = ", ".join(f"{name} {doubt:.1e} m" for name, doubt in self.doubts.items())
        return (
            f"Reference: {1e3 * REFERENCE_DT:g} ms, implicitfast, elliptic cone, 100 iterations, float64. It differs"
            f" from RK4 at the same step by {doubts} (base RMSE).",
            f"Compared up to the horizon, at most {self.sizes.duration_s:g} s: {horizons}."
            f" {self.sizes.num_starts} starts each, errors at the ends of control steps.",
        )

    def _stepper(self, method: Method) -> Callable[[int], None]:
        """One control step of the gait in many environments."""
        gait, starts = self.trajectories[0], np.arange(TIMED_ENVS) % self.sizes.num_starts
        robots = Robots(gait.world, method, gait.qpos[starts], gait.qvel[starts])
        targets = gait.targets[starts, 0]

        def step(_: int) -> None:
            robots.restart()
            robots.advance(targets)

        return step

    def _find_horizon(self, trajectory: Trajectory) -> None:
        truth, name = self.truth(trajectory), trajectory.name
        moved = replace(trajectory, qpos=trajectory.qpos.copy())
        moved.qpos[:, 7:] += PERTURBATION * np.random.default_rng(0).choice([-1.0, 1.0], moved.qpos[:, 7:].shape)
        growth = np.abs(follow(moved, self.reference) - truth).max(axis=(0, 2)) / PERTURBATION
        early = np.flatnonzero(growth > GROWTH)
        self.horizons[name] = end = max(1, int(early[0])) if len(early) else len(growth)
        self.growths[name] = float(growth[end - 1])
        other = follow(trajectory, self.reference.but(integrator="rk4"))
        self.doubts[name] = _rms((other - truth)[:, :end, :3].reshape(-1, 3), axes=3)

    def _gait(self, name: str = "gait", obstacles: ObstaclesConfig | None = None) -> Trajectory:
        recorded = json.loads(GAIT.read_text())
        starts = recorded["starts"][: self.sizes.num_starts]
        count = round(self.sizes.duration_s / CONTROL_DT)
        targets = np.array(recorded["joint_targets"])
        world = build_world(self.robot, self.terrain, obstacles or ObstaclesConfig())
        qpos, qvel = (np.array([start[key] for start in starts]) for key in ("qpos", "qvel"))
        return Trajectory(name, world, qpos, qvel, np.stack([targets[s["step"] :][:count] for s in starts]))

    def _drop(self) -> Trajectory:
        """From rest in the default pose, 5 to 20 cm above the ground and a little tilted."""
        rng, n = np.random.default_rng(1), self.sizes.num_starts
        default = np.array([self.robot.default_joint_pos[joint] for joint in self.robot.joints])
        world = build_world(self.robot, self.terrain, ObstaclesConfig())
        qpos = np.zeros((n, world.model.nq))
        qpos[:, 2] = self.robot.base_height + np.linspace(0.05, 0.2, n)
        qpos[:, 3:7] = [1.0, 0.0, 0.0, 0.0] + 0.05 * rng.normal(size=(n, 4))
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        qpos[:, 7:] = default
        targets = np.broadcast_to(default, (n, round(self.sizes.duration_s / CONTROL_DT), len(default)))
        return Trajectory("drop", world, qpos, np.zeros((n, world.model.nv)), targets)

    def _stumble(self) -> Trajectory:
        """The gait into a sill 6 cm high, 0.36 m ahead of the base: the front feet and shins hit it."""
        sill = ObstacleGroup("box", 1, [[0.03, 0.03], [0.6, 0.6], [0.03, 0.03]], poses=[[0.36, 0.0, 0.0]])
        return self._gait("stumble", ObstaclesConfig({"sill": sill}))


def steps_study(
    bench: Bench,
    integrators: Sequence[str] = ("euler", "implicitfast", "implicit", "rk4"),
    outside: Sequence[str] = ("euler", "implicitfast"),
) -> Study:
    """Time step x integrator, with the PD law in the engine and, for some integrators, outside."""
    sim = bench.default.sim
    methods = [
        replace(bench.default.but(timestep=timestep, integrator=integrator), outside=is_outside)
        for timestep in sorted({*bench.sizes.timesteps, sim.timestep})
        for names, is_outside in ((integrators, False), (outside, True))
        for integrator in names
    ]
    note = f"Solver as configured: {sim.iterations} iterations, {sim.cone} cone."
    named = {f"{m.family} {1e3 * m.sim.timestep:g} ms": (m, m.family) for m in methods}
    return _study(bench, "steps", "Time step, integrator, place of the PD law", named, SAME, note)


def solver_study(bench: Bench) -> Study:
    """Iterations of the solver x friction cone, at the configured step."""
    sim = bench.default.sim
    counts = sorted({*bench.sizes.iterations, sim.iterations})
    cones = ("pyramidal", "elliptic")
    named = {f"{cone} {n}": (bench.default.but(iterations=n, cone=cone), cone) for cone in cones for n in counts}
    note = f"{1e3 * sim.timestep:g} ms, {sim.integrator}."
    return _study(bench, "solver", "Solver iterations and friction cone", named, TRUE, note)


def _study(
    bench: Bench, name: str, title: str, methods: Mapping[str, tuple[Method, str]], error: str, note: str
) -> Study:
    """Methods with their families, by name."""
    costs = bench.costs({key: method for key, (method, _) in methods.items()})
    choices = [
        Choice(key, costs[key], bench.errors(method), method == bench.default, family)
        for key, (method, family) in methods.items()
    ]
    return Study(name, f"{title}: gait, drop, stumble", COST, error, choices, 1e-6, (note, *bench.notes()))


STUDIES: dict[str, Callable[[Bench], Study]] = {"steps": steps_study, "solver": solver_study}


def measure(run: RunConfig, sizes: Sizes, only: Sequence[str] = ()) -> Iterator[Study]:
    """All studies, or some by name, as they are done."""
    bench = Bench(run, sizes)
    yield from (study(bench) for name, study in STUDIES.items() if not only or name in only)


def _rms(*differences: np.ndarray, axes: int = 1) -> float:
    """Root of the mean square of vectors of so many axes."""
    return math.sqrt(axes * float(np.mean(np.square(np.concatenate(differences)))))
