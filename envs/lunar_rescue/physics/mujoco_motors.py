"""Motors for MuJoCo that do what Bullet's do: turn at a set speed, as a constraint that torque limits bound.

A motor asks for the speed ``POSITION_GAIN_PER_SECOND`` times what is missing to its set-point, and the torque for that
is found together with the contacts' forces, for the end of the substep: MuJoCo's ``discrete`` integrator takes a stiff
damper into the metric that its solver works in. It knows of a torque limit only what the state before the substep asks
for, so a stiff motor would overrun it for a substep, or use all of it where little is needed. Therefore a substep is
solved again wherever the torques that come out are not those that were put in: a motor beyond its limit exerts the
limit, and one at the limit that needs less is freed.
"""

from dataclasses import dataclass, field

import mujoco
import numpy as np

from lunar_rescue.arrays import Array
from lunar_rescue.physics.mujoco_scene import World
from lunar_rescue.physics.solver import POSITION_GAIN_PER_SECOND

#: Torque per missing speed [N m s/rad]; so stiff that 450 N m let a joint sag by less than a twentieth of a degree.
STIFFNESS = 5.0e4
FREEING = 3  # times that a substep is solved again before no motor at its limit is freed any more


@dataclass
class Motors:
    """The motors of a robot in one world; those that are not driven swing freely."""

    world: World
    targets: dict[int, float] = field(default_factory=dict)  # set-points [rad] by joint
    limits: dict[int, float] = field(default_factory=dict)  # torque limits [N m] by joint
    torques: dict[int, float] = field(default_factory=dict)  # of the last substep [N m] by joint
    gains: Array | None = None  # what each motor's gain is multiplied by; None for right ones

    def __post_init__(self) -> None:
        """Find the places of the driven joints; to be done again when others are driven."""
        joints = list(self.targets)
        self._joints = joints
        self.places = np.array(list(self.world.speeds.values()), np.int64)  # in qvel, of all joints that turn
        self._angles = np.array([self.world.angles[i] for i in joints], np.int64)
        self._speeds = np.array([self.world.speeds[i] for i in joints], np.int64)
        self._motors = np.array([self.world.motors[i] for i in joints], np.int64)
        self._targets = np.array([self.targets[i] for i in joints])
        self._limits = np.array([self.limits[i] for i in joints])
        self._bound = np.zeros(len(joints))  # -1 or 1 for who exerts its limit
        model, data = self.world.model, self.world.data
        model.actuator_gainprm[:, 0] = 0.0
        model.actuator_biasprm[:] = 0.0
        self._written: Array | None = None  # of which ``_bound`` the model has the gains
        self._all_free = True  # whether that is nobody at the limit
        # Looked up once: MuJoCo makes these views anew at each access.
        self._qpos, self._qvel, self._ctrl, self._warm = data.qpos, data.qvel, data.ctrl, data.qacc_warmstart

    def aim(self, targets: dict[int, float], limits: dict[int, float]) -> None:
        """Set other set-points and limits."""
        if list(targets) != self._joints or limits != self.limits:
            self.targets, self.limits = targets, limits
            self.__post_init__()
        self.targets = targets
        self._targets = np.array(list(targets.values()))

    def substep(self) -> None:
        """Let one substep pass."""
        model, data = self.world.model, self.world.data
        if not self._joints:
            mujoco.mj_step(model, data)
            return
        before = self._qpos.copy(), self._qvel.copy(), self._warm.copy(), data.time
        wanted = POSITION_GAIN_PER_SECOND * (self._targets - before[0].take(self._angles))  # speeds [rad/s]
        wanted = wanted if self.gains is None else wanted * self.gains
        bound, solved = self._bound, 0
        while True:
            self._set(bound, wanted)
            mujoco.mj_step(model, data)
            torques = exerted = STIFFNESS * (wanted - self._qvel.take(self._speeds))
            over = np.abs(torques) > self._limits
            if self._all_free and not over.any():
                break
            beyond = np.sign(torques) * over
            kept = bound if solved >= FREEING else bound * (bound == beyond)
            right = np.where(bound == 0, beyond, kept)
            if np.array_equal(right, bound):
                exerted = np.where(bound == 0, torques, bound * self._limits)
                break
            bound, solved = right, solved + 1
            self._qpos[:], self._qvel[:], self._warm[:], data.time = before
        self._bound = bound
        self.torques = dict(zip(self._joints, exerted.tolist(), strict=True))

    def _set(self, bound: Array, wanted: Array) -> None:
        """Let motors drive at the wanted speeds [rad/s] (0), or exert their limit (-1, 1)."""
        free = bound == 0
        if bound is not self._written:  # an array is never changed, only replaced
            model = self.world.model
            model.actuator_gainprm[self._motors, 0] = np.where(free, STIFFNESS, 1.0)
            model.actuator_biasprm[self._motors, 2] = np.where(free, -STIFFNESS, 0.0)
            self._written, self._all_free = bound, bool(free.all())
        self._ctrl[self._motors] = wanted if self._all_free else np.where(free, wanted, bound * self._limits)
