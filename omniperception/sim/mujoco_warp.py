"""MuJoCo Warp on a GPU (or, slowly, on a CPU): thousands of worlds in one launch behind the Simulator protocol."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import ModuleType

import mujoco
import torch
import warp as wp

from omnilidar.launch import wp_device
from omniperception.common.checked import Count, checked
from omniperception.scene import World
from omniperception.sim.base import Failure, Failures, JointColumns, SizedGeoms
from omniperception.sim.kernels import move_kinematic, record, turn_kinematic
from omniperception.sim.mujoco import SimConfig, apply_options

_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0")
"""Model fields that the engine derives from masses and inertias."""
_MASSES = ("body_mass", "body_ipos", "body_inertia")
_DERIVED_AT_ONCE = 32
"""Worlds whose constants are derived in one launch."""
_GROUND_CONTACTS = {mujoco.mjtGeom.mjGEOM_SPHERE: 1, mujoco.mjtGeom.mjGEOM_CAPSULE: 2}
"""Most contacts of a geom with a plane; every other kind has up to _MANY."""
_MANY = 4
_OBSTACLES_AT_ONCE = 3
"""Obstacles that a robot can be pressed against at the same time before capacities have to be raised, ..."""
_PAIRS_PER_OBSTACLE = 6
"""... links with which each of them is then in contact, ..."""
_CONTACTS_PER_PAIR = 2
"""... and contacts of each of those, on average."""
_ROWS_PER_CONTACT = {"pyramidal": 4, "elliptic": 3}


@checked("sim")
class MujocoWarpConfig(SimConfig):
    """Physics settings of `sim=mujoco_warp`.

    Attributes:
        device: 'auto' (a GPU where there is one), 'cpu', 'cuda' (the GPU of this process's rank) or 'cuda:<index>'.
            `num_threads` is for LiDAR rays on a CPU; the physics has one thread there.
        contacts_per_env: contacts for which there is room, on average over all environments; 0: from the scene.
        rows_per_env: constraint rows for which every environment has room; 0: from the scene.
        deterministic: the same bits in every run on a GPU, at a cost; a CPU always gives them.
    """

    device: str = "auto"
    contacts_per_env: Count = 0
    rows_per_env: Count = 0
    deterministic: bool = False

    def __post_init__(self) -> None:
        kind, _, index = self.device.partition(":")
        if kind not in ("auto", "cpu", "cuda") or (index and not (kind == "cuda" and index.isdigit())):
            raise ValueError(f"sim.device={self.device} is unknown; use auto, cpu, cuda or cuda:<index>")
        if index and int(os.environ.get("WORLD_SIZE", 1)) > 1:
            raise ValueError(f"sim.device={self.device} would give all processes the same GPU; use sim.device=cuda")
        if kind == "cuda" and not torch.cuda.is_available():
            raise ValueError(f"sim.device={self.device} needs a GPU that PyTorch can use; use sim.device=cpu")

    @property
    def torch_device(self) -> torch.device:
        kind = self.device
        if kind == "auto":
            kind = "cuda" if torch.cuda.is_available() else "cpu"
        if kind == "cuda":
            return torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        return torch.device(kind)

    def build(self, world: World, num_envs: int, record_states: bool = False) -> MujocoWarpSimulator:
        return MujocoWarpSimulator(world, self, num_envs, record_states)


@dataclass(frozen=True)
class Capacity:
    """Room for what a scene can need at once.

    Attributes:
        contacts: contacts and pairs of near geoms per environment; all environments share the sum.
        convex: pairs per environment that only the general convex search can tell apart; shared likewise.
        rows: constraint rows of each environment.
    """

    contacts: int
    convex: int
    rows: int

    @classmethod
    def of(cls, world: World, config: MujocoWarpConfig) -> Capacity:
        """Configured capacities, or those for a robot that lies on all of its geoms, pressed against some obstacles."""
        model = world.model
        robot = [k for k in range(model.ngeom) if model.geom_conaffinity[k]]
        tiled = world.ground_mocap is not None
        ground = sum(_MANY if tiled else _GROUND_CONTACTS.get(int(model.geom_type[k]), _MANY) for k in robot)
        pairs = _PAIRS_PER_OBSTACLE * min(len(world.obstacles.parts()), _OBSTACLES_AT_ONCE)
        pairs += min(model.npair, len(robot))  # of the robot with itself
        contacts = config.contacts_per_env or ground + _CONTACTS_PER_PAIR * pairs
        limits = int(model.jnt_limited.sum()) + int((model.dof_frictionloss > 0).sum())
        rows = config.rows_per_env or limits + _ROWS_PER_CONTACT[config.cone] * contacts
        convex = max((len(robot) if tiled else 0) + pairs, 1)
        return cls(contacts, min(convex, contacts), rows)


class MujocoWarpSimulator(Failures):
    """`num_envs` worlds on one device; every tensor is a view of the engine's own float32 memory.

    A call of `step` is one CUDA graph on a GPU: the obstacles' path, the physics steps and the recording of what
    is read after each of them. Only these synchronise the host with the device: `anomalies`, `state_dict` and
    `load_state_dict`.

    Attributes:
        capacity: the room that was made for contacts and constraints; `anomalies` tells when it was too small.
        overflow: (num_envs,) int32: bits of what did not fit since the last call of `anomalies`.
    """

    def __init__(self, world: World, config: MujocoWarpConfig, num_envs: int, record_states: bool = False) -> None:
        self._engine = engine = _load_engine()
        self.world, self.config, self.num_envs = world, config, num_envs
        self.device = config.torch_device
        self._wp_device = wp_device(self.device)
        apply_options(world.model, config)
        model = _supported(world.model)
        self.capacity = room = Capacity.of(world, config)
        with wp.ScopedDevice(self._wp_device):
            self.model = engine.put_model(model)
            self.data = engine.make_data(
                model,
                num_envs,
                nconmax=room.contacts,
                nccdmax=room.convex,
                njmax=room.rows,
            )
        self.model.opt.warn_overflow = 0  # reported by `anomalies` instead of printed by every thread
        if config.deterministic:
            self.model.opt.deterministic = int(engine.DeterminismType.ALL)
        data = self.data
        self.qpos, self.qvel, self._ctrl = (wp.to_torch(array) for array in (data.qpos, data.qvel, data.ctrl))
        self.mocap_pos, self.mocap_quat = wp.to_torch(data.mocap_pos), wp.to_torch(data.mocap_quat)
        self.ground_pos: torch.Tensor | None = None
        if world.ground_mocap is not None:
            self.ground_pos = self.mocap_pos[:, 0]
            self.mocap_pos, self.mocap_quat = self.mocap_pos[:, 1:], self.mocap_quat[:, 1:]
        self._joints = JointColumns(world, self.device)
        self.failure = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self.overflow = wp.to_torch(data.overflow)
        self._torque = wp.to_torch(data.actuator_force)
        self._forgotten = (wp.to_torch(data.qacc_warmstart), self._ctrl, self._torque)
        self._pos, self._quat = wp.to_torch(data.xpos), wp.to_torch(data.xquat)
        self._geom_pos, self._geom_mat = wp.to_torch(data.geom_xpos), wp.to_torch(data.geom_xmat)
        recorded = (("sensordata",) if world.sensors else ()) + (("qpos", "qvel") if record_states else ())
        self._recorded: tuple[str, ...] = recorded
        self._fields: dict[str, torch.Tensor] = {}
        self._sized: dict[tuple[int, ...], SizedGeoms] = {}
        self._indices: dict[tuple[int, ...], torch.Tensor] = {}
        self._graphs: dict[str, wp.Graph | None] = {}
        self._constants: Constants | None = None
        self._allocate_steps(config.decimation)

    def robot_state(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self._joints.state(self.qpos.clone(), self.qvel.clone())

    def recorded_states(self) -> tuple[torch.Tensor, torch.Tensor]:
        qpos, qvel = (self._records[name] for name in ("qpos", "qvel"))
        return self._joints.state(qpos, qvel)

    def step(
        self,
        joint_target: torch.Tensor,
        num_steps: int = 1,
        mocap_path: torch.Tensor | None = None,
        mocap_turn: torch.Tensor | None = None,
    ) -> None:
        if num_steps != self._num_steps:
            self._allocate_steps(num_steps)
        self._ctrl.copy_(self.finite_targets(joint_target, self._ctrl))
        moves, turns = mocap_path is not None, mocap_turn is not None
        if mocap_path is not None:
            self._path.copy_(mocap_path)
        if mocap_turn is not None:
            self._turns().copy_(mocap_turn)
        self._launch(f"steps, {moves=}, {turns=}", partial(self._steps, moves, turns))

    def reset(self, env_ids: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        self.qpos[env_ids], self.qvel[env_ids] = self._joints.engine_state(qpos.float(), qvel.float())
        self.failure.index_fill_(0, env_ids, int(Failure.NONE))
        for values in (*self._forgotten, *self._records.values()):
            values.index_fill_(0, env_ids, 0.0)

    def joint_torque(self) -> torch.Tensor:
        return self._torque.clone()

    def contact_sensor(self, kind: str) -> torch.Tensor:
        return self._records["sensordata"][:, -1, self.world.sensor_slice(kind)].clone()

    def touched(self, kind: str) -> torch.Tensor:
        return (self._records["sensordata"][:, :, self.world.sensor_slice(kind)] > 0).flatten(1).any(1)

    def contact_impulse(self, kind: str) -> torch.Tensor:
        forces = self._records["sensordata"][:, :, self.world.sensor_slice(kind)]
        return forces.unflatten(2, (-1, 3)).norm(dim=-1).sum((1, 2)) * self.config.timestep

    def body_poses(self, bodies: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        self._launch("kinematics", self._kinematics)
        index = self._index(bodies)
        return self._pos[:, index], self._quat[:, index]

    def geom_poses(self, geoms: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        self._launch("kinematics", self._kinematics)
        index = self._index(geoms)
        return self._geom_pos[:, index], self._geom_mat[:, index]

    def geom_motion(self, geoms: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        self._launch("velocities", self._kinematics_and_velocities)
        model = self.world.model
        index, body = self._index(geoms), self._index(tuple(int(b) for b in model.geom_bodyid[list(geoms)]))
        root = self._index(tuple(int(b) for b in model.body_rootid[model.geom_bodyid[list(geoms)]]))
        velocity, centre = wp.to_torch(self.data.cvel)[:, body], wp.to_torch(self.data.subtree_com)[:, root]
        pos = self._geom_pos[:, index]
        offset = pos - centre  # velocities are those at the tree's centre of mass
        return pos, velocity[..., 3:] + torch.linalg.cross(velocity[..., :3], offset)

    def resize(self, geoms: tuple[int, ...], env_ids: torch.Tensor, sizes: torch.Tensor) -> None:
        if geoms not in self._sized:
            self._sized[geoms] = SizedGeoms(self.world.model, geoms, self.device)
        sized, rows = self._sized[geoms], env_ids[:, None]
        sizes, half_extents = sized.read(sizes.float())
        self.model_field("geom_size")[rows, sized.index] = sizes
        self.model_field("geom_aabb")[rows, sized.index, 1] = half_extents
        self.model_field("geom_rbound")[rows, sized.index] = sized.shapes.bounding_radii(sizes)

    def model_field(self, name: str) -> torch.Tensor:
        if name not in self._fields:
            self._expand(name)
            if name in _MASSES:
                for field in (*_MASSES, *_DERIVED):
                    self._expand(field)
                self.update_model(torch.arange(self.num_envs, device=self.device))
        return self._fields[name]

    def update_model(self, env_ids: torch.Tensor) -> None:
        if self._constants is None:
            with wp.ScopedDevice(self._wp_device):
                self._constants = Constants(self._engine, _supported(self.world.model))
        constants = self._constants
        for ids in env_ids.split(_DERIVED_AT_ONCE):
            for name in _MASSES:
                constants.fields[name][: len(ids)] = self._fields[name][ids]
            self._launch("constants", constants.derive)
            for name in _DERIVED:
                self._fields[name][ids] = constants.fields[name][: len(ids)]

    def anomalies(self) -> dict[str, float]:
        """Environments for whose contacts or constraints there was no room since the last call; synchronises the host.

        A warning names the override that makes room, once.
        """
        kinds = self._engine.OverflowType
        rows = int(kinds.NEFC | kinds.NJMAX_NNZ)
        contacts = int(kinds.BROADPHASE | kinds.NARROWPHASE | kinds.CCD | kinds.HFIELD | kinds.CONTACT_MATCH)
        bits = ((self.overflow & rows) != 0, (self.overflow & contacts) != 0)
        row_count, contact_count = torch.stack(bits).sum(1).tolist()
        self.overflow.zero_()
        if row_count:
            self._warn("some environments had no room for all constraints", "rows_per_env", self.capacity.rows)
        if contact_count:
            self._warn("some environments had no room", "contacts_per_env", self.capacity.contacts)
        return {"constraint_overflow": row_count, "contact_overflow": contact_count}

    def state_dict(self) -> dict:
        """State that the next step depends on, and the model fields that differ between the worlds."""
        return {
            "state": {name: wp.to_torch(getattr(self.data, name)).clone() for name in _STATE},
            "fields": {name: value.clone() for name, value in self._fields.items()},
        }

    def load_state_dict(self, state: dict) -> None:
        for name, value in state["state"].items():
            wp.to_torch(getattr(self.data, name)).copy_(value)
        self.failure.zero_()
        for name, value in state["fields"].items():
            self._expand(name)
            self._fields[name].copy_(value)

    # ---- what runs on the device -------------------------------------------------------------------------------------

    def _steps(self, moves: bool, turns: bool) -> None:
        for step in range(self._num_steps):
            if moves:
                self._move(move_kinematic, step, self._wp_path, self.data.mocap_pos)
            if turns:
                self._move(turn_kinematic, step, self._wp_turn, self.data.mocap_quat)
            self._engine.step(self.model, self.data)
            self._record(step)

    def _move(self, kernel: wp.Kernel, step: int, path: object, out: wp.array) -> None:
        first = 0 if self.ground_pos is None else 1
        wp.launch(kernel, dim=(self.num_envs, self._path.shape[2]), inputs=[step, first, path], outputs=[out])

    def _record(self, step: int) -> None:
        for name, out in self._wp_records.items():
            wp.launch(record, dim=(out.shape[0], out.shape[2]), inputs=[step, getattr(self.data, name)], outputs=[out])

    def _kinematics(self) -> None:
        self._engine.kinematics(self.model, self.data)

    def _kinematics_and_velocities(self) -> None:
        self._engine.kinematics(self.model, self.data)
        self._engine.com_pos(self.model, self.data)
        self._engine.com_vel(self.model, self.data)

    def _launch(self, name: str, work: Callable[[], None]) -> None:
        """Runs device work on PyTorch's stream: the first time as it is, which compiles kernels, then as a graph."""
        with wp.ScopedDevice(self._wp_device):
            if self.device.type != "cuda":
                work()
                return
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
            if name not in self._graphs:
                with wp.ScopedStream(stream, sync_enter=False):
                    work()
                self._graphs[name] = None
                return
            graph = self._graphs[name]
            if graph is None:
                graph = self._graphs[name] = self._captured(work)
            wp.capture_launch(graph, stream=stream)

    def _captured(self, work: Callable[[], None]) -> wp.Graph:
        """A graph of the work, captured on a stream of its own, since PyTorch's default stream cannot be captured."""
        with wp.ScopedStream(wp.Stream(self._wp_device), sync_enter=False):
            with wp.ScopedCapture(device=self._wp_device, force_module_load=False) as capture:
                work()
            return capture.graph

    # ---- memory ------------------------------------------------------------------------------------------------------

    @torch.inference_mode(False)  # what is allocated within a rollout is written outside of one, too
    def _allocate_steps(self, num_steps: int) -> None:
        """Buffers for the inputs and outputs of every physics step of a call."""
        self._num_steps = num_steps
        model, device = self.world.model, self.device
        widths = {"sensordata": model.nsensordata, "qpos": model.nq, "qvel": model.nv}
        self._records = {n: torch.zeros(self.num_envs, num_steps, widths[n], device=device) for n in self._recorded}
        self._wp_records = {name: wp.from_torch(values) for name, values in self._records.items()}
        self._path = torch.zeros(self.num_envs, num_steps, self.mocap_pos.shape[1], 3, device=device)
        self._wp_path = wp.from_torch(self._path, dtype=wp.vec3)
        self._turn: torch.Tensor | None = None
        self._wp_turn: object = None
        self._graphs.clear()

    @torch.inference_mode(False)
    def _turns(self) -> torch.Tensor:
        """Buffer for orientations of the kinematic bodies, made at its first use."""
        if self._turn is None:
            self._turn = torch.zeros(*self._path.shape[:3], 4, device=self.device)
            self._wp_turn = wp.from_torch(self._turn, dtype=wp.quat)
        return self._turn

    def _expand(self, name: str) -> None:
        if name not in self._fields:
            self._fields[name] = _own_values(self.model, name, self.num_envs)
            self._graphs.clear()  # they hold the old address

    def _index(self, ids: tuple[int, ...]) -> torch.Tensor:
        if ids not in self._indices:
            self._indices[ids] = torch.tensor(ids, device=self.device)
        return self._indices[ids]

    def _warn(self, what: str, override: str, capacity: int) -> None:
        message = f"{what}, which are missing in the physics; raise sim.{override} (now {capacity})"
        warnings.warn(message, RuntimeWarning, stacklevel=3)


class Constants:
    """Model fields that the engine derives from masses and inertias, in a small model of their own.

    The engine derives those of all worlds of a model, one launch after the other for each degree of freedom and body,
    while few robots are reset at a time.

    Attributes:
        fields: by name of the model field, (_DERIVED_AT_ONCE, ...): masses to be written, and what `derive` makes of
            them.
    """

    def __init__(self, engine: ModuleType, model: mujoco.MjModel) -> None:
        self._engine, self._model = engine, engine.put_model(model)
        self._data = engine.make_data(model, _DERIVED_AT_ONCE, nconmax=1, njmax=1)
        names = (*_MASSES, *_DERIVED)
        self.fields = {name: _own_values(self._model, name, _DERIVED_AT_ONCE) for name in names}

    def derive(self) -> None:
        groups = self._engine.SetConstGroup
        self._engine.set_const(self._model, self._data, groups.FIXED | groups.INERT0, restore=False)


@torch.inference_mode(False)  # what is allocated within a rollout is written outside of one, too
def _own_values(model: object, name: str, num_worlds: int) -> torch.Tensor:
    """Gives every world values of its own of an engine's model field; the memory that it then reads."""
    *path, last = name.split(".")
    owner = getattr(model, path[0]) if path else model
    shared = getattr(owner, last)
    values = wp.to_torch(shared)
    fields = values.expand(num_worlds, *values.shape[1:]).clone()
    own = wp.from_torch(fields, dtype=shared.dtype)
    own._is_batched = True  # type: ignore[union-attr]  # as the engine marks its own; Warp does not declare it
    setattr(owner, last, own)
    return fields


_STATE = ("qpos", "qvel", "qacc_warmstart", "time", "ctrl", "mocap_pos", "mocap_quat", "actuator_force")
"""Arrays of the engine's data that the next step, or a reader before it, depends on."""


def _load_engine() -> ModuleType:
    """mujoco_warp, which only this simulator needs."""
    try:
        import mujoco_warp
    except ImportError as error:
        raise ImportError(
            f"sim=mujoco_warp needs mujoco-warp ({error.name} is missing): pip install 'omniperception[gpu]', or use"
            " sim=mujoco"
        ) from error
    return mujoco_warp


def _supported(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model without the flag that the engine does not know: it never resets a world by itself."""
    model = copy.copy(model)
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return model
