"""Work and precision of the physics: time step, integrator, solver, friction cone, and where the PD law is computed."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from benchmarks.harness.pareto import Choice, Study
from benchmarks.harness.timing import paired_timings
from omniperception.build import RunConfig
from omniperception.config import ConfigError
from omniperception.scene import ObstacleGroup, ObstaclesConfig, World, build_world
from omniperception.scene.build import FOOT_FORCE, LINK_FORCE
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
_CTRL = int(mujoco.mjtState.mjSTATE_CTRL)


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
        timestep: s.
        integrator: MuJoCo's name in small letters; "discrete" is not among those that ``sim.integrator`` knows.
        iterations: Of the solver.
        cone: "pyramidal" or "elliptic".
        outside: Whether the PD torque is computed outside of the engine before every step, instead of by actuators.
    """

    timestep: float
    integrator: str
    iterations: int
    cone: str
    outside: bool = False

    @property
    def steps(self) -> int:
        """Physics steps of a control step."""
        return round(CONTROL_DT / self.timestep)

    @property
    def family(self) -> str:
        return f"{self.integrator}, PD outside" if self.outside else self.integrator

    def apply(self, world: World, sim: SimConfig) -> mujoco.MjModel:
        """A copy of the world's model that is stepped this way."""
        known = self.integrator != "discrete"
        options = replace(
            sim,
            timestep=self.timestep,
            decimation=self.steps,
            integrator=self.integrator if known else "euler",
            iterations=self.iterations,
            cone=self.cone,
        )
        model = copy.copy(world.model)
        apply_options(model, options)
        if not known:
            model.opt.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
        if self.outside:
            model.actuator_gainprm[:, 0] = 1.0
            model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_NONE
            model.actuator_biasprm[:] = 0.0
        return model


def default_method(sim: SimConfig) -> Method:
    """What the configuration chooses."""
    return Method(sim.timestep, sim.integrator, sim.iterations, sim.cone)


@dataclass(frozen=True)
class Trajectory:
    """A motion from several starts.

    Attributes:
        name: What happens.
        world: Its world, with sensors of contact force.
        qpos, qvel: The starts, (n, nq) and (n, nv).
        targets: Joint targets of each start's control steps, rad, (n, K, num_joints).
    """

    name: str
    world: World
    qpos: np.ndarray
    qvel: np.ndarray
    targets: np.ndarray


@dataclass(frozen=True)
class Course:
    """States at the ends of the control steps.

    Attributes:
        qpos, qvel: (n, K, nq) and (n, K, nv).
        impulse: What the robot has given to the ground and obstacles so far, vertically, N s, (n, K).
    """

    qpos: np.ndarray
    qvel: np.ndarray
    impulse: np.ndarray


class Bench:
    """Trajectories of a configuration's robot, and the truth about them."""

    def __init__(self, run: RunConfig, sizes: Sizes) -> None:
        self.sizes, self.sim, self.robot, self.terrain = sizes, run.env.sim, run.env.robot, run.env.terrain
        self.default = default_method(self.sim)
        if abs(self.sim.control_dt - CONTROL_DT) > 1e-9:
            raise ConfigError(
                f"sim.timestep * sim.decimation = {self.sim.control_dt:g} s must be {CONTROL_DT:g} s, the period of the"
                " recorded gait"
            )
        self.trajectories = [self._gait(), self._drop(), self._stumble()]
        self._truths: dict[tuple[str, str], Course] = {}
        self.horizons: dict[str, int] = {}
        self.growths: dict[str, float] = {}
        self.doubts: dict[str, float] = {}
        for trajectory in self.trajectories:
            self._find_horizon(trajectory)

    def truth(self, trajectory: Trajectory, cone: str = "elliptic") -> Course:
        """At the reference's step, with the true friction cone unless another is given, up to the end."""
        key = (trajectory.name, cone)
        if key not in self._truths:
            self._truths[key] = follow(trajectory, reference(cone), self.sim)
        return self._truths[key]

    def errors(self, method: Method) -> dict[str, float]:
        """Of all trajectories together up to their horizons; infinite where a simulation is lost."""
        base, joints, impulse, own = [], [], [], []
        depth = 0.0
        for trajectory in self.trajectories:
            path, end = follow(trajectory, method, self.sim), self.horizons[trajectory.name]
            truth, same_cone = self.truth(trajectory), self.truth(trajectory, method.cone)
            base.append((path.qpos - truth.qpos)[:, :end, :3].reshape(-1, 3))
            joints.append((path.qpos - truth.qpos)[:, :end, 7:].reshape(-1))
            own.append((path.qpos - same_cone.qpos)[:, :end, :3].reshape(-1, 3))
            weight = _weight(trajectory.world.model) * CONTROL_DT * np.arange(1, end + 1)
            impulse.append(((path.impulse - truth.impulse)[:, :end] / weight[-1]).reshape(-1))
            depth = max(depth, penetration(trajectory.world.model, path.qpos[:, :end]))
        with np.errstate(over="ignore"):
            found = {
                SAME: _rms(np.concatenate(own)) * math.sqrt(3.0),
                TRUE: _rms(np.concatenate(base)) * math.sqrt(3.0),
                "joint RMSE (rad)": _rms(np.concatenate(joints)),
                "contact impulse RMSE (of the weight's)": _rms(np.concatenate(impulse)),
                "deepest penetration (mm)": 1e3 * depth,
            }
        return found if math.isfinite(found[TRUE]) else dict.fromkeys(found, math.inf)

    def costs(self, methods: Mapping[str, Method]) -> dict[str, float]:
        """CPU time of a control step of the gait, us per environment, in turn."""
        steppers = {name: Stepper(self, method) for name, method in methods.items()}
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

    def _find_horizon(self, trajectory: Trajectory) -> None:
        truth, name = self.truth(trajectory), trajectory.name
        rng = np.random.default_rng(0)
        moved = replace(trajectory, qpos=trajectory.qpos + 0.0)
        moved.qpos[:, 7:] += PERTURBATION * rng.choice([-1.0, 1.0], moved.qpos[:, 7:].shape)
        change = np.abs(follow(moved, reference("elliptic"), self.sim).qpos - truth.qpos).max(axis=(0, 2))
        early = np.flatnonzero(change / PERTURBATION > GROWTH)
        self.horizons[name] = max(1, int(early[0])) if len(early) else len(change)
        self.growths[name] = float(change[self.horizons[name] - 1] / PERTURBATION)
        other = follow(trajectory, replace(reference("elliptic"), integrator="rk4"), self.sim)
        gap = (other.qpos - truth.qpos)[:, : self.horizons[name], :3]
        self.doubts[name] = _rms(gap) * math.sqrt(3.0)

    def _gait(self, name: str = "gait", obstacles: ObstaclesConfig | None = None) -> Trajectory:
        recorded = json.loads(GAIT.read_text())
        starts = recorded["starts"][: self.sizes.num_starts]
        count = round(self.sizes.duration_s / CONTROL_DT)
        targets = np.array(recorded["joint_targets"])
        world = self._world(obstacles or ObstaclesConfig())
        qpos, qvel = (np.array([start[key] for start in starts]) for key in ("qpos", "qvel"))
        return Trajectory(name, world, qpos, qvel, np.stack([targets[s["step"] :][:count] for s in starts]))

    def _drop(self) -> Trajectory:
        """From rest in the default pose, 5 to 20 cm above the ground and a little tilted."""
        rng, n = np.random.default_rng(1), self.sizes.num_starts
        default = np.array([self.robot.default_joint_pos[joint] for joint in self.robot.joints])
        world = self._world(ObstaclesConfig())
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

    def _world(self, obstacles: ObstaclesConfig) -> World:
        return build_world(self.robot, self.terrain, obstacles, (FOOT_FORCE, LINK_FORCE))


class Stepper:
    """One control step of the gait in many environments on one thread; called with its number."""

    def __init__(self, bench: Bench, method: Method) -> None:
        self._gait, self._method = bench.trajectories[0], method
        world = build_world(bench.robot, bench.terrain, ObstaclesConfig())
        self._batch = Batch(method.apply(world, bench.sim), TIMED_ENVS, 1)
        self._qpos, self._qvel, self._ctrl = (self._batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        starts = np.arange(TIMED_ENVS) % len(self._gait.qpos)
        self._start, self._targets = (self._gait.qpos[starts], self._gait.qvel[starts]), self._gait.targets[starts, 0]
        self._gains = bench.robot.kp, bench.robot.kv

    def __call__(self, number: int) -> None:
        self._qpos[:], self._qvel[:] = self._start
        if not self._method.outside:
            self._ctrl[:] = self._targets
            self._batch.step(nstep=self._method.steps)
            return
        kp, kv = self._gains
        for _ in range(self._method.steps):
            self._ctrl[:] = kp * (self._targets - self._qpos[:, 7:]) - kv * self._qvel[:, 6:]
            self._batch.step()


@cache
def reference(cone: str) -> Method:
    """What counts as the truth."""
    return Method(REFERENCE_DT, "implicitfast", 100, cone)


def follow(trajectory: Trajectory, method: Method, sim: SimConfig) -> Course:
    """A trajectory's states at the ends of its control steps; NaN where a simulation is lost."""
    model = method.apply(trajectory.world, sim)
    states = _stepped_outside(trajectory, method, model) if method.outside else _rolled_out(trajectory, method, model)
    forces = states["sensordata"][:, :, 2::3].sum(axis=2)  # vertically, of all geoms that touch something
    impulse = -method.timestep * np.cumsum(forces, axis=1)
    ends = slice(method.steps - 1, None, method.steps)
    return Course(states["qpos"][:, ends], states["qvel"][:, ends], impulse[:, ends])


def _rolled_out(trajectory: Trajectory, method: Method, model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """States and sensors of every physics step, with the actuators of the engine."""
    control = np.repeat(trajectory.targets, method.steps, axis=1)
    batch, states = Batch(model, len(control), 1), _records(model, *control.shape[:2])
    batch.bind("qpos")[:], batch.bind("qvel")[:] = trajectory.qpos, trajectory.qvel
    try:
        batch.rollout(control.shape[1], control=control, control_spec=_CTRL, record=tuple(states), out=states)
    except SimulationError as error:
        for values in states.values():
            values[np.asarray(error.ids)] = math.nan
    return states


def _stepped_outside(trajectory: Trajectory, method: Method, model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """The same with a torque that is computed before every physics step."""
    n, num_control, _ = trajectory.targets.shape
    states, robot = _records(model, n, num_control * method.steps), trajectory.world.robot
    for i in range(n):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = trajectory.qpos[i], trajectory.qvel[i]
        for k in range(num_control * method.steps):
            target = trajectory.targets[i, k // method.steps]
            data.ctrl[:] = robot.kp * (target - data.qpos[7:]) - robot.kv * data.qvel[6:]
            mujoco.mj_step(model, data)
            for name, values in states.items():
                values[i, k] = getattr(data, name)
    return states


def _records(model: mujoco.MjModel, n: int, steps: int) -> dict[str, np.ndarray]:
    widths = {"qpos": model.nq, "qvel": model.nv, "sensordata": model.nsensordata}
    return {name: np.zeros((n, steps, width)) for name, width in widths.items()}


def penetration(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    """Deepest overlap of two geoms in any of the states (n, K, nq), m."""
    data, deepest = mujoco.MjData(model), 0.0
    for state in qpos.reshape(-1, model.nq):
        if np.isfinite(state).all():
            data.qpos[:] = state
            mujoco.mj_fwdPosition(model, data)
            deepest = max(deepest, -float(data.contact.dist.min(initial=0.0)))
    return deepest


def steps_study(
    bench: Bench,
    integrators: Sequence[str] = ("euler", "implicitfast", "implicit", "rk4", "discrete"),
    outside: Sequence[str] = ("euler", "implicitfast"),
) -> Study:
    """Time step x integrator, with the PD law in the engine and, for some integrators, outside."""
    default, methods = bench.default, {}
    for timestep in sorted({*bench.sizes.timesteps, default.timestep}):
        for names, is_outside in ((integrators, False), (outside, True)):
            for integrator in names:
                methods |= _named(replace(default, timestep=timestep, integrator=integrator, outside=is_outside))
    note = f"Solver as configured: {default.iterations} iterations, {default.cone} cone."
    return _study(bench, "steps", "Time step, integrator, place of the PD law", methods, note)


def solver_study(bench: Bench) -> Study:
    """Iterations of the solver x friction cone, at the configured step."""
    methods = {}
    for cone in ("pyramidal", "elliptic"):
        for iterations in sorted({*bench.sizes.iterations, bench.default.iterations}):
            method = replace(bench.default, iterations=iterations, cone=cone)
            methods[f"{cone} {iterations}"] = method
    note = f"{1e3 * bench.default.timestep:g} ms, {bench.default.integrator}."
    return _study(bench, "solver", "Solver iterations and friction cone", methods, note)


def _named(method: Method) -> dict[str, Method]:
    return {f"{method.family} {1e3 * method.timestep:g} ms": method}


def _study(bench: Bench, name: str, title: str, methods: Mapping[str, Method], note: str) -> Study:
    costs = bench.costs(methods)
    choices = [
        Choice(key, costs[key], bench.errors(m), m == bench.default, m.family if name == "steps" else m.cone)
        for key, m in methods.items()
    ]
    error = SAME if name == "steps" else TRUE
    return Study(name, f"{title}: gait, drop, stumble", COST, error, choices, 1e-6, (note, *bench.notes()))


@dataclass(frozen=True)
class Order:
    """How the error of smooth motion falls with the step.

    Attributes:
        integrator: Its name.
        theory: The order that its maker states.
        errors: Largest error of the generalised position at the end by step.
        energy: Relative change of the energy over the motion by step, where nothing takes or gives energy.
    """

    integrator: str
    theory: int
    errors: Mapping[float, float] = field(default_factory=dict)
    energy: Mapping[float, float] = field(default_factory=dict)

    @property
    def observed(self) -> float:
        """Slope of log error over log step, by least squares over steps whose error is above rounding."""
        pairs = [(math.log(h), math.log(e)) for h, e in self.errors.items() if 1e-11 < e < math.inf]
        return float(np.polyfit(*zip(*pairs, strict=True), 1)[0]) if len(pairs) > 1 else math.nan


EVALUATIONS = {"rk4": 4}
"""Of the forces per step; one for all others."""
THEORY = {"euler": 1, "implicitfast": 1, "implicit": 1, "rk4": 4, "discrete": 1}


def orders(run: RunConfig, timesteps: Sequence[float], duration_s: float = 0.2) -> list[Order]:
    """The robot tumbling in the air, held by its PD law far below the torque limits: smooth, without contact."""
    env = run.env
    world = build_world(env.robot, env.terrain, ObstaclesConfig())
    sim, results = env.sim, []
    truth = _tumble(world, _configured_but(sim, "rk4", REFERENCE_DT), sim, duration_s)
    for integrator, theory in THEORY.items():
        order = Order(integrator, theory, {}, {})
        for timestep in timesteps:
            if abs(duration_s / timestep - round(duration_s / timestep)) < 1e-9:
                method = _configured_but(sim, integrator, timestep)
                order.errors[timestep] = float(np.abs(_tumble(world, method, sim, duration_s) - truth).max())
                order.energy[timestep] = _energy_drift(world, method, sim, duration_s)
        results.append(order)
    return results


def _configured_but(sim: SimConfig, integrator: str, timestep: float) -> Method:
    """The configured way of stepping with another integrator and step."""
    return replace(default_method(sim), integrator=integrator, timestep=timestep)


def order_study(run: RunConfig, sizes: Sizes) -> Study:
    """Orders of convergence as a table: one row per integrator and step."""
    found = orders(run, sizes.timesteps)
    choices = [
        Choice(
            f"{order.integrator} {1e3 * h:g} ms",
            EVALUATIONS.get(order.integrator, 1) * 1e-3 / h,
            {
                "smooth motion, largest error (m, rad)": error,
                "energy drift (relative)": order.energy[h],
            },
            (order.integrator, h) == (run.env.sim.integrator, run.env.sim.timestep),
            f"{order.integrator}: observed order {order.observed:.2f}, theory {order.theory}",
            {"observed order": order.observed, "theoretical order": order.theory},
        )
        for order in found
        for h, error in order.errors.items()
    ]
    slopes = ", ".join(f"{o.integrator} {o.observed:.2f} ({o.theory})" for o in found)
    notes = (
        f"The robot tumbles in the air for 0.2 s, held by its PD law. Reference: RK4 at {1e3 * REFERENCE_DT:g} ms.",
        f"Observed order of convergence (theory): {slopes}.",
        "Energy drift: the same motion without actuators, damping and gravity, relative to its kinetic energy.",
    )
    error = "smooth motion, largest error (m, rad)"
    return Study(
        "order", "Smooth motion: order of convergence", "evaluations of the forces per ms", error, choices, 1e-13, notes
    )


def _tumble_start(world: World) -> tuple[np.ndarray, np.ndarray]:
    model, rng = world.model, np.random.default_rng(2)
    qpos, qvel = np.zeros(model.nq), np.zeros(model.nv)
    qpos[2], qpos[3] = 5.0, 1.0
    qpos[7:] = [world.robot.default_joint_pos[joint] for joint in world.robot.joints]
    qvel[3:6] = [1.0, -0.7, 0.5]
    qvel[6:] = rng.uniform(-1.0, 1.0, model.nv - 6)
    return qpos, qvel


def _tumble(world: World, method: Method, sim: SimConfig, duration_s: float) -> np.ndarray:
    """The state (nq,) at the end."""
    model = method.apply(world, sim)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = _tumble_start(world)
    data.ctrl[:] = data.qpos[7:] + 0.1
    mujoco.mj_step(model, data, nstep=round(duration_s / method.timestep))
    return data.qpos.copy()


def _energy_drift(world: World, method: Method, sim: SimConfig, duration_s: float) -> float:
    model = method.apply(world, sim)
    model.dof_damping[:], model.opt.gravity[:] = 0.0, 0.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = _tumble_start(world)
    mujoco.mj_forward(model, data)
    before = data.energy.sum()
    mujoco.mj_step(model, data, nstep=round(duration_s / method.timestep))
    mujoco.mj_forward(model, data)
    return abs(float(data.energy.sum() - before) / before)


STUDIES = ("steps", "solver", "order")


def measure(run: RunConfig, sizes: Sizes, only: Sequence[str] = ()) -> Iterator[Study]:
    """All studies, or some by name, as they are done."""
    wanted = only or STUDIES
    if {"steps", "solver"} & set(wanted):
        bench = Bench(run, sizes)
        yield from (
            study(bench) for name, study in (("steps", steps_study), ("solver", solver_study)) if name in wanted
        )
    if "order" in wanted:
        yield order_study(run, sizes)


def _weight(model: mujoco.MjModel) -> float:
    """Of the robot, N."""
    return float(model.body_mass[model.body_mocapid < 0].sum() * -model.opt.gravity[2])


def _rms(values: np.ndarray) -> float:
    return math.sqrt(float(np.mean(np.square(values))))
