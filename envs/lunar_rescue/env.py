"""``LunarRescue-v0``: the multi-objective Markov decision process of section 2.1 as a Gymnasium environment."""

import math
import sys
from collections import deque
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from lunar_rescue import rewards
from lunar_rescue.contacts import body_contacts, both_arms_under, hold, mark_distances, touches_rock
from lunar_rescue.episode import Episode, begin_episode
from lunar_rescue.observation import as_dict, observation_space
from lunar_rescue.physics.client import NotCopied
from lunar_rescue.physics.engines import DEFAULT, make_simulation
from lunar_rescue.physics.robot import JOINTS, Robot, checked_action
from lunar_rescue.physics.solver import SolverSettings
from lunar_rescue.rewards import RewardWeights
from lunar_rescue.scenes.sampling import easy_scene, sample_scene
from lunar_rescue.scenes.scene import Scene
from lunar_rescue.scenes.splits import SPLITS
from lunar_rescue.tasks import HOLD_STEPS, MAX_STEPS

if TYPE_CHECKING:
    from lunar_rescue.pictures.live import Window
    from lunar_rescue.pictures.rendering import Studio

Array = NDArray[np.float64]
ENVIRONMENT_VERSION = "2.0"  # a change to what an episode does is a new version, see docs/environment.md
#: What the info of an episode's last step tells about how it ended.
OUTCOME = (
    *("is_success", "both_arms_under", "failure", "task", "posture"),
    *("peak_force", "peak_speed", "peak_acceleration", "gentle"),
)


class LunarRescueEnv(NotCopied, gymnasium.Env[dict[str, NDArray[np.float32]], NDArray[np.float32]]):
    """A two-armed robot gets its arms under a fallen astronaut and lifts them or turns them over.

    Action: Eq. 3 for the ten arm joints (arm A, arm B), then the waist, all in [-1, 1], (11,).
    Observation: a Dict with the paper's symbols, see ``lunar_rescue.observation``.
    Reward: Eq. 2 towards the target areas, then towards the goal pose; ``info["reward_terms"]`` has every term.
    ``info["aapf"]`` is the AAPF term also where the contact reward replaces it, so that returns can be compared.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array", "human"], "render_fps": 10}  # type: ignore[misc]

    def __init__(
        self,
        render_mode: str | None = None,
        weights: RewardWeights | None = None,
        obstacle_reward: str = "aapf",
        max_steps: int = MAX_STEPS,
        solver: SolverSettings | None = None,
        simulator: str = DEFAULT,
        scenes: dict[str, Any] | None = None,
    ) -> None:
        """Connect to the simulator.

        Args:
            render_mode: None, ``"rgb_array"``, or ``"human"``: in the browser, in real time; the address is printed.
            weights: Weights of the reward's terms.
            obstacle_reward: ``"aapf"`` (Eq. 2) or ``"contact"`` (the ablation of section 4.3).
            max_steps: phi_max, step limit of an episode.
            solver: How finely the simulator works, if not as usual; other settings are for convergence studies.
            simulator: ``"pybullet"`` or ``"mujoco"``.
            scenes: Options of ``reset`` that hold in every one, such as ``{"task": "lift"}``.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode: expected None, 'rgb_array' or 'human', got {render_mode!r}")
        if obstacle_reward not in ("aapf", "contact"):
            raise ValueError(f"obstacle_reward: expected 'aapf' or 'contact', got {obstacle_reward!r}")
        self.render_mode = render_mode
        self.weights = weights or RewardWeights()
        self.obstacle_reward = obstacle_reward
        self.scenes = dict(scenes or {})
        self.set_max_steps(max_steps)
        self.observation_space: spaces.Space[Any] = observation_space()
        self.action_space = spaces.Box(-1.0, 1.0, (JOINTS,), np.float32)
        self.simulation = make_simulation(simulator, solver)
        self.robot = Robot(self.simulation)
        self._closed = False
        self._episode: Episode | None = None
        self._studio: Studio | None = None  # made with the first picture
        self._window: Window | None = None  # opened with the first episode that is to be seen
        self._zero = np.zeros(JOINTS)

    def set_max_steps(self, max_steps: int) -> None:
        """Set phi_max, to which time bonus, ``phase`` and the step limit count from the next step on."""
        if isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 1:
            raise ValueError(f"max_steps: expected an integer >= 1, got {max_steps!r}")
        self.max_steps = max_steps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Number of the scene in its split, the first one is 0; without one a scene is drawn.
            options: Either ``scene``, or any of ``split`` (``"train"`` unless given), ``posture`` and ``task``, or
                ``split`` and ``easy``: one posture, no rocks, the lightest astronaut.
        """
        vector, info = self.reset_flat(seed, options)
        return as_dict(vector), info

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[dict[str, NDArray[np.float32]], float, bool, bool, dict[str, Any]]:
        """Hold an action for 0.1 s and return what Gymnasium wants of a step."""
        vector, reward, terminated, truncated, info = self.step_flat(action)
        return as_dict(vector), reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (height, width, 3); None without a render mode, or where people see every step anyway."""
        self._check_open()
        if self.render_mode != "rgb_array":
            return None
        if self._studio is None:
            from lunar_rescue.pictures.rendering import Studio

            self._studio = Studio(fine=1)
        return self._studio.picture(self.episode)

    def close(self) -> None:
        """Disconnect from the simulator; a second call does nothing, and any other is an error."""
        self._closed = True
        self.simulation.close()
        if self._studio is not None:
            self._studio.close()
            self._studio = None
        if self._window is not None:
            self._window.close()
            self._window = None

    # -- the same with flat observations, for learners --------------------------------------------------------------
    def reset_flat(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode as ``reset`` does, with the observation as one vector (SIZE,)."""
        self._check_open()
        super().reset(seed=seed)
        scene = self._choose_scene(seed, dict(options or {}))
        self._episode = self._begin(scene)
        self._show(self._episode)
        return self._observe(self._zero), {"scene": scene, "task": scene.task, "posture": scene.posture}

    def step_flat(
        self, action: NDArray[np.floating[Any]]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold an action as ``step`` does, with the observation as one vector (SIZE,)."""
        episode, clipped = self.episode, checked_action(action)
        before = episode.robot.angles
        self.robot.drive(clipped, before)
        forces = hold(self.simulation, self.robot, episode)
        episode.update(self.robot.state(), episode.astronaut.state(), forces)
        terms, success, failure = self._judge(episode, episode.robot.angles - before)
        if not success and failure is None and episode.steps >= self.max_steps:
            failure = "timeout"
        info = self._info(episode, terms, success, failure)
        self._show(episode, "rescued" if success else f"failed by {failure}" if failure else "")
        # Time is observed, so its end is a state like any other: terminal, and nothing is to be expected beyond it.
        return self._observe(clipped), sum(terms.values()), success or failure is not None, False, info

    @property
    def episode(self) -> Episode:
        """Return the episode under way; without one, or once closed, this is an error."""
        self._check_open()
        if self._episode is None:
            raise RuntimeError("LunarRescue-v0: call reset() before step() or render()")
        return self._episode

    def _check_open(self) -> None:
        if self._closed:
            raise gymnasium.error.ClosedEnvironmentError("LunarRescue-v0: the environment is closed; make a new one")

    def _show(self, episode: Episode, words: str = "") -> None:
        """Let people see where everything is now, if they want to; opens the page at first."""
        if self.render_mode != "human":
            return
        if self._window is None:
            try:
                from lunar_rescue.pictures.live import Window
            except ModuleNotFoundError as error:
                wanted = f"render_mode='human' needs {error.name}: pip install 'lunar-rescue[report]'"
                raise gymnasium.error.DependencyNotInstalled(wanted) from None
            self._window = Window()
            print(f"watch at {self._window.address}", file=sys.stderr)
        self._window.show(episode, words=words)

    # -- parts -------------------------------------------------------------------------------------------------------
    def _choose_scene(self, seed: int | None, options: dict[str, Any]) -> Scene:
        if "scene" not in options:
            options = {**self.scenes, **options}
        scene, posture, task, split = (options.pop(key, None) for key in ("scene", "posture", "task", "split"))
        easy = options.pop("easy", False)
        if options:
            names = ", ".join(map(repr, options))
            raise ValueError(f"options: expected scene, posture, task, split or easy, got {names}")
        if scene is not None:
            if not isinstance(scene, Scene):
                raise ValueError(f"options['scene']: expected a Scene, got {type(scene).__name__}")
            if posture is not None or task is not None or split is not None or easy:
                raise ValueError("options: a scene has its posture, task and split already; give them or a scene")
            return scene
        if split is not None and split not in SPLITS:
            raise ValueError(f"options['split']: expected one of {', '.join(SPLITS)}, got {split!r}")
        seeds = SPLITS[split or "train"]
        number = int(self.np_random.integers(len(seeds))) if seed is None else seed % len(seeds)
        if easy and (posture is not None or task is not None):
            raise ValueError("options['easy']: easy scenes have a posture of their own; leave posture and task out")
        return easy_scene(seeds[number]) if easy else sample_scene(seeds[number], posture=posture, task=task)

    def _begin(self, scene: Scene) -> Episode:
        self._clear()
        return begin_episode(self.simulation, self.robot, scene, self.weights.memory)

    def _clear(self) -> None:
        """Clear the world of the last episode, or make it anew when it is due."""
        if self.simulation.needs_rebuild:
            self.simulation.renew()
            self.robot = Robot(self.simulation)
        self.robot.rest()
        self.simulation.clear([self.robot.handle])

    def _observe(self, action: Array) -> NDArray[np.float32]:
        e = self.episode
        phase = np.array([float(e.process == 2), e.steps / self.max_steps])
        return e.observer.fill(e.robot, e.body, e.targets(), e.entries(), e.astronaut.keypoints(e.body), action, phase)

    def _judge(self, e: Episode, moved: Array) -> tuple[dict[str, float], bool, str | None]:
        """Update the episode's memory; return reward terms, success and failure."""
        clearance = mark_distances(e)
        e.nearest_mark = min(e.nearest_mark, clearance.min(initial=math.inf))
        touches = touches_rock(self.simulation, self.robot, e, clearance)
        e.rock_contact = e.rock_contact or touches
        distance = e.distances() if e.process == 1 else np.full(2, e.task.pose_error(e.body))
        best = _least(e.recent)
        e.recent.append(distance)
        under = e.process == 1 and both_arms_under(self.simulation, e, distance)
        if under:
            e.process = 2
            e.recent.clear()
            e.recent.append(np.full(2, e.task.pose_error(e.body)))
        success = self._succeeds(e)
        failure = None if success else self._fails(e, touches)
        step = rewards.Transition(
            best=best,
            distance=distance,
            clearance=clearance,
            moved=moved,
            touches_rock=touches,
            contact_reward=self.obstacle_reward == "contact",
            steps=e.steps,
            max_steps=self.max_steps,
            both_arms_under=under,
            success=success,
            failed=failure is not None,
        )
        terms = rewards.reward_terms(step, self.weights)
        e.aapf = rewards.aapf(step, self.weights) if step.contact_reward else terms["obstacle_avoidance"]
        return terms, success, failure

    def _succeeds(self, e: Episode) -> bool:
        """Count steps in the goal pose of process 2, and tell whether the body rests there after ``HOLD_STEPS``."""
        held = e.process == 2 and e.task.pose_reached(e.body)
        held = held and e.task.contacts_right(body_contacts(self.simulation, e))
        e.held = e.held + 1 if held else 0
        return e.held >= HOLD_STEPS and e.task.at_rest(e.body)

    def _fails(self, e: Episode, touches: bool) -> str | None:
        if touches and e.process == 1:
            return "obstacle_contact"  # criterion (2) of section 4.2 can no longer be met
        return e.task.failure(e.body, e.process)

    def _info(self, e: Episode, terms: dict[str, float], success: bool, failure: str | None) -> dict[str, Any]:
        return {
            "reward_terms": terms,
            "aapf": e.aapf,
            "is_success": success,
            "failure": failure,
            "both_arms_under": e.process == 2,
            "task": e.scene.task,
            "posture": e.scene.posture,
            "peak_force": e.peak_force,
            "peak_speed": e.peak_speed,
            "peak_acceleration": e.peak_acceleration,
            "gentle": e.gentle,
        }


def _least(recent: deque[Array]) -> Array:
    return recent[0] if len(recent) == 1 else np.min(recent, axis=0)
