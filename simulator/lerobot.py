"""The stand-in simulator as LeRobot's EnvHub and its evaluation expect an environment; see `make_env`."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

from cloning.lerobot import TASK
from cloning.road.motion import MPH
from simulator.environment import ID, Info


class LeRobotDrive(gymnasium.Wrapper):
    """Observes and acts with the features of the data sets of `cloning.lerobot`, but for the side cameras.

    | | |
    |---|---|
    | observation | `pixels`: `center`, uint8 (160, 320, 3), RGB; `agent_pos`: float32 (2,), speed in mph and m/s |
    | action | float32 (3,): steering, -1..1, right positive; throttle and brake, 0..1 |
    | info | `is_success`: the laps are finished; all else is that of the environment, as are the rewards |
    """

    task = task_description = TASK  # LeRobot gives it to policies that read

    def __init__(self, env: gymnasium.Env):
        """env: of `simulator.environment`."""
        super().__init__(env)
        pixels = spaces.Dict({"center": env.observation_space})
        self.observation_space = spaces.Dict({"pixels": pixels, "agent_pos": spaces.Box(-100, 100, (2,), np.float32)})
        self.action_space = spaces.Box(np.array([-1, 0, 0], np.float32), np.ones(3, np.float32))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], Info]:
        """Begin an episode; seed, options: of the environment. LeRobot's own option, "lerobot_new_rollout", is none."""
        own = {name: value for name, value in (options or {}).items() if name != "lerobot_new_rollout"}
        return self._described(*self.env.reset(seed=seed, options=own))

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], Any, bool, bool, Info]:
        """Drive until the next frame."""
        steering, throttle, brake = action
        frame, reward, terminated, truncated, info = self.env.step(np.array([steering, throttle - brake]))
        observation, info = self._described(frame, info)
        return observation, reward, terminated, truncated, info

    def _described(self, frame: np.ndarray, info: Info) -> tuple[dict[str, Any], Info]:
        observation = {"pixels": {"center": frame}, "agent_pos": np.array([1, MPH], np.float32) * info["speed"]}
        return observation, {**info, "is_success": self.get_wrapper_attr("finished")}


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None) -> dict[str, dict[int, VectorEnv]]:
    """Return vector environments of the lake track, or of the one that LeRobot's configuration `cfg` names as its task.

    Each episode begins elsewhere on the lane's centre, by its seed: from one place a policy succeeds always or never.
    n_envs: that many drive at once; use_async_envs: each in a process of its own. LeRobot calls this function from the
    env.py beside a data set, once that is in a model repository on the Hub; in a data set's LeRobot does not look:
    `lerobot.envs.factory.make_env("USER/REPOSITORY", n_envs=2, trust_remote_code=True)`. Raises TrackError.
    """
    track = getattr(cfg, "task", None) or "lake"

    def make() -> gymnasium.Env:
        return LeRobotDrive(gymnasium.make(ID, track=track, random_start=True, render_mode="rgb_array"))

    vector = AsyncVectorEnv if use_async_envs else SyncVectorEnv
    return {track: {0: vector([make] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP)}}
