"""Two reward-free environments: a robot with rangefinders in a maze, and a weak pendulum.

`import sims` registers `rfl/RangefinderMaze-v0` and `rfl/TorquePendulum-v0` with Gymnasium.
Episodes have no end of their own; pass `max_episode_steps` to `gym.make` for one.
"""

import gymnasium as gym

gym.register("rfl/RangefinderMaze-v0", entry_point="sims.maze:RangefinderMazeEnv")
gym.register("rfl/TorquePendulum-v0", entry_point="sims.pendulum:TorquePendulumEnv")
