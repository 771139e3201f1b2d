"""Every choice of the method, with the paper's values beside the default ones.

Where the paper is silent or its formula cannot be meant as printed, the field says what is done.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, Literal, get_args, get_origin, get_type_hints

from rfl_torch.grid import Boundary, Metric
from rfl_torch.learning import Stage, paper_stages


@dataclass(frozen=True)
class ExecutorConfig:
    """How a goal is pursued (section 2.5)."""

    recognition: Literal["belief", "path"] = "belief"
    """"path" is the paper's procedure: Viterbi over the last `window` observations, then the best
    node on the rest of the planned path, so arrival can be declared while a node off the path is
    likelier. "belief" filters over all nodes and re-plans from the likeliest."""
    window: int = 30
    """tau of the execution procedure, steps; unstated in the paper."""
    abort_probability: float = 1e-300
    """"path": the plan is aborted when its likeliest node is less probable; unstated. Between
    nodes, 24 sharp Gaussians make the right one hundreds of nats less likely than a rival for a
    moment: 1e-6 aborts most plans, this aborts what float64 calls impossible. A plan is aborted
    too when `window` steps bring no next node of it."""
    max_plans: int = 20
    """Plans made without getting closer before giving up; unstated ("maximum limit")."""
    epsilon: float = 0.01
    """"path": transitions above this probability can be planned over (planning step 3)."""
    patience: int = 8
    """"belief": steps that a next node is pursued for before its edge is blamed."""
    blame: float = 3.0
    """"belief": factor on the cost of an edge each time that it led nowhere."""
    teleport: float = 1e-6
    """"belief": chance per step of being anywhere at all: a kidnapped robot finds itself again."""


@dataclass(frozen=True)
class AgentConfig:
    """The whole method: `AgentConfig()` is the best known, `AgentConfig.paper()` is section 3."""

    shape: tuple[int, ...] = (20, 20)
    """Sizes of the square grid or cubic lattice of nodes."""
    radius: float = 2.0
    """theta_d: nodes within this distance are joined, the node itself included."""
    metric: Metric = "euclidean"
    """Distance on the lattice; "chebyshev" with radius 2 joins 24 neighbours."""
    boundary: Boundary = "open"
    """"torus" joins opposite borders of the lattice."""
    start: Literal["equal", "data"] = "data"
    """"equal" is the paper's mean 0.5 and scale 0.05 for all nodes; "data" the log's own."""
    counted_readings: float | None = 7.2
    """How many readings an observation counts for: with D of them the emission log-densities are
    multiplied by min(1, counted_readings / D), on top of the stages' temperatures. Rays that see
    the same few walls are not independent, and counted in full they outvote every transition.
    None counts all, as the paper does."""
    stages: tuple[Stage, ...] = (
        Stage(3, 200, (0.01, 1.0), pseudo_count=0.01, min_scale=0.05, tolerance=0.0),
        Stage(1, 40, pseudo_count=0.01, min_scale=0.05),
    )
    """The learning procedure, from coarse time to fine. A high floor of the scales leaves nodes
    free to tell places apart that look the same, instead of looks that are at one place."""
    repairs: bool = True
    """Rebuild the map by looks and places, in a world that the log shows to be reversible."""
    controller: Literal["rbf", "mlp", "svr"] = "rbf"
    """Function estimator of eq. 12; "svr" is the paper's online support vector regression."""
    horizon: int = 1
    """Furthest target of a controller's training triplets, steps; the paper's is the next step."""
    uses_reversal: bool = True
    """Learn from the log run backwards too, if the log shows that the world allows it."""
    executor: ExecutorConfig = field(default_factory=ExecutorConfig)
    """How goals are pursued."""

    @classmethod
    def paper(cls) -> "AgentConfig":
        """Every choice as the paper has it, for the maze of section 3."""
        return cls(
            start="equal",
            counted_readings=None,
            stages=paper_stages(),
            controller="svr",
            repairs=False,
            uses_reversal=False,
            executor=ExecutorConfig(recognition="path"),
        )

    @classmethod
    def paper_pendulum(cls) -> "AgentConfig":
        """The paper's choices for section 4: 22 x 22 nodes and no sub-sampling."""
        return dataclasses.replace(cls.paper(), shape=(22, 22), stages=paper_stages((1,)))

    def power(self, obs_dim: int) -> float:
        """Power of the emission densities of `obs_dim` readings, in learning and recognition."""
        counted = obs_dim if self.counted_readings is None else self.counted_readings
        return min(1.0, counted / obs_dim)

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "AgentConfig":
        """Rebuild what `to_json` gave.

        Raises:
            ValueError: if a field is unknown or has a value that none can have.
        """
        try:
            values = dict(values)
            stages = tuple(
                Stage(**{**stage, "temperature": tuple(stage["temperature"])})
                for stage in values.pop("stages")
            )
            executor = ExecutorConfig(**values.pop("executor"))
            shape = tuple(int(size) for size in values.pop("shape"))
            config = cls(shape=shape, stages=stages, executor=executor, **values)
        except (TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"the configuration doesn't fit this version: {error}") from None
        _check_fields(config)
        if config.counted_readings == 0:
            raise ValueError("counted_readings is 0, needs a positive number or None")
        if executor.teleport > 1 or executor.blame < 1:
            raise ValueError(
                f"teleport is {executor.teleport} and blame {executor.blame}; need a probability "
                "and a factor of at least 1"
            )
        return config


def _check_fields(value: Any) -> None:
    """Make sure that every field of a dataclass has a value of its type; numbers are not negative.

    Raises:
        ValueError: naming the field.
    """
    for name, kind in get_type_hints(type(value)).items():
        if not _fits(getattr(value, name), kind):
            raise ValueError(f"{name} is {getattr(value, name)!r}, needs {kind}")


def _fits(value: Any, kind: Any) -> bool:
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return value in inner
    if origin is tuple:
        kinds = inner[:1] * len(value) if inner[1:] == (...,) else inner
        return len(value) == len(kinds) and all(map(_fits, value, kinds))
    if inner:  # a union
        return any(_fits(value, one) for one in inner)
    if dataclasses.is_dataclass(kind):
        _check_fields(value)
        return True
    if kind in (int, float):
        numbers = (int,) if kind is int else (int, float)
        is_number = isinstance(value, numbers) and not isinstance(value, bool)
        return is_number and (1 if kind is int else 0) <= value < math.inf
    return isinstance(value, kind)
