"""Reward-free learning of a map, local controllers and plans from a robot's babbling."""

from importlib.metadata import version

from rfl_torch.agent import Agent
from rfl_torch.config import AgentConfig, ExecutorConfig
from rfl_torch.hmm import GridHMM, Statistics
from rfl_torch.innate import InnateController, env_action, record, record_episodes
from rfl_torch.learning import Stage
from rfl_torch.logs import read_logs, save_logs
from rfl_torch.monitor import TensorBoardMonitor
from rfl_torch.trajectory import Trajectory

__all__ = [
    "Agent",
    "AgentConfig",
    "ExecutorConfig",
    "GridHMM",
    "InnateController",
    "Stage",
    "Statistics",
    "TensorBoardMonitor",
    "Trajectory",
    "env_action",
    "read_logs",
    "record",
    "record_episodes",
    "save_logs",
]
__version__ = version("rfl-torch")
