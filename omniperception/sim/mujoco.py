"""MuJoCo on CPU cores: `mujoco.batch.Batch` behind the Simulator protocol."""

from __future__ import annotations

from typing import Literal

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch, SimulationError

from omnilidar.launch import default_num_threads
from omniperception.common.checked import AtLeastOne, Count, Positive, checked
from omniperception.scene import World
from omniperception.sim.base import Failure, Failures, JointColumns, Simulator, SizedGeoms

_INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
}
_CONES = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}
_MOCAP_POS, _MOCAP_QUAT = int(mujoco.mjtState.mjSTATE_MOCAP_POS), int(mujoco.mjtState.mjSTATE_MOCAP_QUAT)
_STAGE_POS, _STAGE_VEL = mujoco.mjtStage.mjSTAGE_POS.value, mujoco.mjtStage.mjSTAGE_VEL.value
_NO_CONTACTS = int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)


@checked("sim")
class SimConfig:
    """Physics settings.

    Attributes:
        timestep: physics step (s).
        decimation: physics steps per control step.
        integrator: 'euler', 'implicitfast', 'implicit' or 'rk4'.
        iterations: iterations of the constraint solver.
        ls_iterations: line-search iterations of the solver.
        cone: friction cone, 'pyramidal' or 'elliptic'.
        num_threads: CPU threads; 0 uses every core, or this process's share of them under torchrun.
    """

    timestep: Positive = 0.005
    decimation: AtLeastOne = 4
    integrator: Literal["euler", "implicitfast", "implicit", "rk4"] = "implicitfast"
    iterations: AtLeastOne = 10
    ls_iterations: AtLeastOne = 20
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    num_threads: Count = 0

    has_legs = True

    @property
    def control_dt(self) -> float:
        """Control step (s)."""
        return self.timestep * self.decimation

    @property
    def torch_device(self) -> torch.device:
        """Device of the simulations and of everything that they feed."""
        return torch.device("cpu")

    def build(self, world: World, num_envs: int, record_states: bool = False) -> Simulator:
        """`num_envs` simulations of a world; with `record_states` their states after each physics step are kept."""
        return MujocoSimulator(world, self, num_envs, record_states)


class MujocoSimulator(Failures):
    """`num_envs` simulations on a native thread pool; only what is asked for is copied out of the engine.

    State tensors are views of the engine's own memory. Contact sensors and torques describe the state before the last
    physics step, as `mj_step` leaves them; body poses are recomputed for the current state.

    The steps of one call are one native call: threads that sleep between calls cost more than the obstacles' motion.
    """

    def __init__(self, world: World, config: SimConfig, num_envs: int, record_states: bool = False) -> None:
        self.world, self.config, self.num_envs = world, config, num_envs
        self.device = torch.device("cpu")
        apply_options(world.model, config)
        self.batch = Batch(world.model, num_envs, config.num_threads or default_num_threads())
        self.qpos = torch.from_numpy(self.batch.bind("qpos"))
        self.qvel = torch.from_numpy(self.batch.bind("qvel"))
        self._kinematic = tuple(torch.from_numpy(self.batch.bind(name)) for name in ("mocap_pos", "mocap_quat"))
        self.mocap_pos, self.mocap_quat = self._kinematic
        self.ground_pos: torch.Tensor | None = None
        if world.ground_mocap is not None:
            self.ground_pos = self.mocap_pos[:, 0]
            self.mocap_pos, self.mocap_quat = self.mocap_pos[:, 1:], self.mocap_quat[:, 1:]
        self._joints = JointColumns(world, self.device)
        self.failure = torch.zeros(num_envs, dtype=torch.int64)
        self._ctrl = torch.from_numpy(self.batch.bind("ctrl"))
        self._record = (("sensordata",) if world.sensors else ()) + (("qpos", "qvel") if record_states else ())
        self._records: dict[str, np.ndarray] = self._allocate_records(1)
        self._fields: dict[str, torch.Tensor] = {}
        self._sized: dict[tuple[int, ...], SizedGeoms] = {}
        self._actuator_force: np.ndarray | None = None
        self._torque: torch.Tensor | None = None
        self._poses: tuple[np.ndarray, np.ndarray] | None = None
        self._geom_poses: tuple[np.ndarray, np.ndarray] | None = None
        self._velocities: tuple[np.ndarray, ...] | None = None
        self._flags: np.ndarray | None = None
        self._roots = self._find_roots()

    def _find_roots(self) -> dict[int, tuple[torch.Tensor, torch.Tensor]]:
        """Position and orientation of each body that floats or is kinematic, as views of the state."""
        model, (mocap_pos, mocap_quat) = self.world.model, self._kinematic
        ids = {k: int(model.body_mocapid[k]) for k in range(model.nbody) if model.body_mocapid[k] >= 0}
        roots = {body: (mocap_pos[:, k], mocap_quat[:, k]) for body, k in ids.items()}
        for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
            first = int(model.jnt_qposadr[joint])
            pose = self.qpos[:, first : first + 3], self.qpos[:, first + 3 : first + 7]
            roots[int(model.jnt_bodyid[joint])] = pose
        return roots

    def robot_state(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self._joints.state(self.qpos.float(), self.qvel.float())

    def recorded_states(self) -> tuple[torch.Tensor, torch.Tensor]:
        qpos, qvel = (torch.from_numpy(self._records[name]) for name in ("qpos", "qvel"))
        return self._joints.state(qpos, qvel)

    def step(
        self,
        joint_target: torch.Tensor,
        num_steps: int = 1,
        mocap_path: torch.Tensor | None = None,
        mocap_turn: torch.Tensor | None = None,
    ) -> None:
        self._ctrl.copy_(self.finite_targets(joint_target, self._ctrl))
        try:
            if mocap_path is None and not self._record:
                self.batch.step(nstep=num_steps)
            else:
                self._roll_out(num_steps, mocap_path, mocap_turn)
        except SimulationError as error:
            raised = torch.zeros(self.num_envs, dtype=torch.bool)
            raised[torch.from_numpy(np.asarray(error.ids))] = True
            self.mark_failed(raised, Failure.ENGINE)
        if self._torque is not None:  # any later call, such as `forward` for poses, overwrites the engine's array
            self._torque.numpy()[:] = self._actuator_force

    def _roll_out(self, num_steps: int, mocap_path: torch.Tensor | None, mocap_turn: torch.Tensor | None) -> None:
        """Steps with the kinematic bodies on their paths, recording the requested fields after every step."""
        if self._records and next(iter(self._records.values())).shape[1] != num_steps:
            self._records = self._allocate_records(num_steps)
        control, spec = self._control(num_steps, mocap_path, mocap_turn)
        self.batch.rollout(
            num_steps, control=control, control_spec=spec, record=self._record or ("time",), out=self._records
        )

    def _control(
        self, num_steps: int, mocap_path: torch.Tensor | None, mocap_turn: torch.Tensor | None
    ) -> tuple[np.ndarray | None, int]:
        """What the engine writes into each step's state, and which part of the state that is."""
        if mocap_path is None:
            return None, _MOCAP_POS
        given = [mocap_path] if mocap_turn is None else [mocap_path, mocap_turn]
        if self.ground_pos is not None:  # it is the first kinematic body
            ground = (self.ground_pos, self._kinematic[1][:, 0])
            own = [pose[:, None, None].expand(-1, num_steps, -1, -1) for pose in ground]
            given = [torch.cat(pair, 2) for pair in zip(own, given, strict=False)]
        control = given[0].flatten(2) if len(given) == 1 else torch.cat([path.flatten(2) for path in given], 2)
        return control.numpy(), _MOCAP_POS if mocap_turn is None else _MOCAP_POS | _MOCAP_QUAT

    def _allocate_records(self, num_steps: int) -> dict[str, np.ndarray]:
        model = self.world.model
        widths = {"sensordata": model.nsensordata, "qpos": model.nq, "qvel": model.nv}
        return {name: np.zeros((self.num_envs, num_steps, widths[name])) for name in self._record}

    def detect_failures(self) -> None:
        """Also looks at the engine's warnings, at which a simulation stops until the call's end."""
        super().detect_failures()
        warned = self.batch.warning[..., 1].any(1)
        if warned.any():
            self.mark_failed(torch.from_numpy(warned), Failure.ENGINE)

    def reset(self, env_ids: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        kept = [poses[env_ids].clone() for poses in self._kinematic]
        self.batch.reset(env_ids.numpy(), stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        for poses, before in zip(self._kinematic, kept, strict=True):
            poses[env_ids] = before
        self.qpos[env_ids], self.qvel[env_ids] = self._joints.engine_state(qpos.double(), qvel.double())
        self.failure[env_ids] = Failure.NONE
        for values in self._records.values():
            values[env_ids.numpy()] = 0.0
        if self._torque is not None:
            self._torque.numpy()[env_ids.numpy()] = 0.0

    def joint_torque(self) -> torch.Tensor:
        if self._torque is None:
            self._actuator_force = self.batch.bind("actuator_force")
            self._torque = torch.zeros(self._actuator_force.shape)
        return self._torque.clone()

    def contact_sensor(self, kind: str) -> torch.Tensor:
        values = self._records["sensordata"][:, -1, self.world.sensor_slice(kind)]
        return torch.from_numpy(values.astype(np.float32))

    def touched(self, kind: str) -> torch.Tensor:
        found = self._records["sensordata"][:, :, self.world.sensor_slice(kind)] > 0
        return torch.from_numpy(found.any(axis=(1, 2)))

    def contact_impulse(self, kind: str) -> torch.Tensor:
        forces = torch.from_numpy(self._records["sensordata"][:, :, self.world.sensor_slice(kind)])
        return (forces.unflatten(2, (-1, 3)).norm(dim=-1).sum((1, 2)) * self.config.timestep).float()

    def body_poses(self, bodies: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        if set(bodies) <= self._roots.keys():
            return self._root_poses(bodies)
        if self._poses is None:
            self._poses = self.batch.bind("xpos"), self.batch.bind("xquat")
        self._find_motion(_STAGE_POS)
        index = np.asarray(bodies)
        pos, quat = (field[:, index].astype(np.float32) for field in self._poses)
        return torch.from_numpy(pos), torch.from_numpy(quat)

    def _find_motion(self, stage: int) -> None:
        """Poses, and in the later stage velocities, of the current state: the engine's own, without looking for
        contacts, which takes three quarters of the time."""
        if self._flags is None:
            self._flags = self.batch.expand("opt.disableflags")
        self._flags |= _NO_CONTACTS
        try:
            self.batch.forward(stage=stage)
        finally:
            self._flags[:] = self.world.model.opt.disableflags

    def _root_poses(self, bodies: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        """`body_poses` of bodies whose poses are part of the state, without computing anything."""
        roots = [self._roots[body] for body in bodies]
        pos, quat = torch.stack([pos for pos, _ in roots], 1), torch.stack([quat for _, quat in roots], 1)
        return pos.float(), torch.nn.functional.normalize(quat, dim=-1).float()

    def geom_poses(self, geoms: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        if self._geom_poses is None:
            self._geom_poses = self.batch.bind("geom_xpos"), self.batch.bind("geom_xmat")
        self._find_motion(_STAGE_POS)
        index = np.asarray(geoms)
        pos, mat = (field[:, index].astype(np.float32) for field in self._geom_poses)
        return torch.from_numpy(pos), torch.from_numpy(mat.reshape(*pos.shape, 3))

    def geom_motion(self, geoms: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        if self._velocities is None:
            self._velocities = tuple(self.batch.bind(name) for name in ("geom_xpos", "cvel", "subtree_com"))
        self._find_motion(_STAGE_VEL)
        index, model = np.asarray(geoms), self.world.model
        body = model.geom_bodyid[index]
        pos, velocity, centre = self._velocities
        here = pos[:, index]
        offset = here - centre[:, model.body_rootid[body]]  # velocities are those at the tree's centre of mass
        linear = velocity[:, body, 3:] + np.cross(velocity[:, body, :3], offset)
        return torch.from_numpy(here.astype(np.float32)), torch.from_numpy(linear.astype(np.float32))

    def resize(self, geoms: tuple[int, ...], env_ids: torch.Tensor, sizes: torch.Tensor) -> None:
        """The engine derives from size and box what else bounds a geom and its body."""
        if geoms not in self._sized:
            self._sized[geoms] = SizedGeoms(self.world.model, geoms, self.device)
        sized, rows = self._sized[geoms], env_ids[:, None]
        sizes, half_extents = sized.read(sizes.double())
        self.model_field("geom_size")[rows, sized.index] = sizes
        self.model_field("geom_aabb")[rows, sized.index, 3:] = half_extents
        self.update_model(env_ids)

    def model_field(self, name: str) -> torch.Tensor:
        if name not in self._fields:
            self._fields[name] = torch.from_numpy(self.batch.expand(name))
        return self._fields[name]

    def update_model(self, env_ids: torch.Tensor) -> None:
        self.batch.set_const(env_ids.numpy())

    def anomalies(self) -> dict[str, float]:
        return {}

    def state_dict(self) -> dict:
        """State rows of all simulations and the model fields that differ between them."""
        return {
            "state": torch.from_numpy(self.batch.state.copy()),
            "fields": {name: value.clone() for name, value in self._fields.items()},
        }

    def load_state_dict(self, state: dict) -> None:
        self.batch.state[:] = state["state"].numpy()
        self.failure.zero_()
        for name, value in state["fields"].items():
            self.model_field(name).copy_(value)
        if state["fields"].keys() & {"body_mass", "geom_size"}:
            self.update_model(torch.arange(self.num_envs))


def apply_options(model: mujoco.MjModel, config: SimConfig) -> None:
    """Writes the physics settings into a compiled model."""
    model.opt.timestep = config.timestep
    model.opt.integrator = _INTEGRATORS[config.integrator]
    model.opt.cone = _CONES[config.cone]
    model.opt.iterations = config.iterations
    model.opt.ls_iterations = config.ls_iterations
