"""The sparsely-connected hidden Markov model of section 2.2.

    node i       a hidden state, standing on a lattice cell
    pi_i         initial_prob        softmax(initial_logits)
    a_ij         transition_prob     softmax of transition_logits over the edges that exist
    mu_j         emission_mean
    sigma_j      emission_scale      exp(emission_log_scale), a standard deviation

Parameters are float64: a long log's likelihood and a sharp Gaussian's density need it, and the
work is done by `inference`, whatever the parameters' type.
"""

import math
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from rfl_torch import inference, kernels
from rfl_torch.grid import Boundary, Metric, build_grid

MIN_WEIGHT = 1e-8
"""Expected visits under which a node counts as unseen: the messages flush at 2**-126 a step, so the
ratios of smaller counts are rounding, not data."""

MAX_READING = 1e15
"""Largest reading taken: far larger ones overflow when squared, and are wrong units anyway."""

Sequences = Tensor | np.ndarray | list[Tensor] | list[np.ndarray]

MIN_LOG_PROB = -200.0
"""Where an edge's log-probability is floored: EM's zeros absorb, and a floor this far down changes
no sum, yet leaves every allowed path possible."""


@dataclass(frozen=True)
class Statistics:
    """Expected sufficient statistics of an E-step; statistics of several logs add.

    initial (N,), node (N,), edge (N, K): expected counts of the first node, of every node, of
    every transition. weight, first, second (N, D): expected count, sum and sum of squares of the
    readings that are not missing. log_likelihood (): natural log of a density, summed over steps,
    so positive values are normal.
    """

    initial: Tensor
    node: Tensor
    edge: Tensor
    weight: Tensor
    first: Tensor
    second: Tensor
    log_likelihood: Tensor
    num_steps: float

    @classmethod
    def zeros(cls, hmm: "GridHMM") -> "Statistics":
        """Nothing seen yet by a model of these shapes."""
        node, reading = (torch.zeros_like(x) for x in (hmm.initial_logits, hmm.emission_mean))
        edge = torch.zeros_like(hmm.transition_logits)
        none = torch.zeros((), dtype=torch.float64)
        return cls(node, node, edge, reading, reading, reading, none, 0.0)

    def __add__(self, other: "Statistics") -> "Statistics":
        """Pool the statistics of two sets of sequences under one model."""
        names = [field.name for field in fields(self)]
        return Statistics(**{name: getattr(self, name) + getattr(other, name) for name in names})

    def scaled(self, factor: float) -> "Statistics":
        """Count every step `factor` times: below 1 it forgets."""
        names = [field.name for field in fields(self)]
        return Statistics(**{name: getattr(self, name) * factor for name in names})

    def to_vector(self) -> Tensor:
        """All numbers in one vector, to be summed over processes."""
        tensors = [torch.as_tensor(getattr(self, field.name)) for field in fields(self)]
        return torch.cat([tensor.double().flatten() for tensor in tensors])

    def from_vector(self, vector: Tensor) -> "Statistics":
        """Statistics of this one's shapes, from a `to_vector`."""
        names = [field.name for field in fields(self)]
        shapes = [torch.as_tensor(getattr(self, name)).shape for name in names]
        parts = vector.split([shape.numel() for shape in shapes])
        values: dict[str, Any] = {
            name: part.view(shape) for name, part, shape in zip(names, parts, shapes, strict=True)
        }
        return Statistics(**values | {"num_steps": values["num_steps"].item()})


class Sample(NamedTuple):
    """A path drawn from the model: nodes int64 (T,), observations float64 (T, D)."""

    nodes: Tensor
    observations: Tensor


def _array(x: Tensor) -> np.ndarray:
    """The numbers as the kernels take them, float64 and contiguous.

    No exp or log is torch's: it wakes its threads for them, which spin in the E-step's way.
    """
    return np.ascontiguousarray(x.detach().numpy(), np.float64)


class GridHMM(nn.Module):
    """An HMM whose nodes lie on a square grid or cubic lattice and are joined to their neighbours.

    Starts with the paper's values: uniform transitions over the edges, equal means 0.5 and scales
    0.05 for every node.

    Args:
        shape: two sizes for a square grid, three for a cubic lattice.
        obs_dim: readings in an observation, D.
        radius: the paper's theta_d, in lattice spacings.
        metric: "euclidean" as the paper has it, or "chebyshev".
        boundary: "open", or "torus" to join opposite borders.
    """

    transition_logits: nn.Parameter
    emission_mean: nn.Parameter
    emission_log_scale: nn.Parameter
    initial_logits: nn.Parameter
    successor: Tensor
    successor_mask: Tensor
    cell: Tensor

    def __init__(
        self,
        shape: tuple[int, ...],
        obs_dim: int,
        radius: float = 2.0,
        metric: Metric = "euclidean",
        boundary: Boundary = "open",
    ) -> None:
        super().__init__()
        if obs_dim < 1:
            raise ValueError(f"obs_dim is {obs_dim}, needs at least one reading.")
        grid = build_grid(shape, radius, metric, boundary)
        self.shape, self.radius, self.metric, self.boundary = tuple(shape), radius, metric, boundary
        self.num_cells = len(grid.successor)
        self._set_graph(
            torch.from_numpy(grid.successor),
            torch.from_numpy(grid.mask),
            torch.arange(self.num_cells),
        )
        num_nodes, num_edges = self.successor.shape
        self.transition_logits = nn.Parameter(
            torch.zeros(num_nodes, num_edges, dtype=torch.float64)
        )
        self.initial_logits = nn.Parameter(torch.zeros(num_nodes, dtype=torch.float64))
        self.emission_mean = nn.Parameter(torch.full((num_nodes, obs_dim), 0.5).double())
        self.emission_log_scale = nn.Parameter(
            torch.full((num_nodes, obs_dim), 0.05).double().log()
        )

    @classmethod
    def of_state(
        cls,
        shape: tuple[int, ...],
        radius: float,
        metric: Metric,
        boundary: Boundary,
        state: dict[str, Tensor],
    ) -> "GridHMM":
        """Rebuild a model from its `state_dict`; the lattice itself is not laid out for it.

        Raises:
            ValueError: as `restore` does.
        """
        hmm = cls((1,) * len(shape), state["emission_mean"].shape[1], 1.0, metric, boundary)
        hmm.shape, hmm.radius, hmm.num_cells = tuple(shape), radius, math.prod(shape)
        hmm.restore(state)
        return hmm

    def _set_graph(self, successor: Tensor, mask: Tensor, cell: Tensor) -> None:
        self.register_buffer("successor", successor)
        self.register_buffer("successor_mask", mask)
        self.register_buffer("cell", cell)
        self._sort_edges()

    def _sort_edges(self) -> None:
        self._diagonals = inference.build_diagonals(
            self.successor.numpy(), self.successor_mask.numpy(), self.cell.numpy(), self.num_cells
        )

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self._sort_edges()  # the loaded graph may be another one of the same size

    @property
    def num_nodes(self) -> int:
        """Nodes left after pruning."""
        return len(self.cell)

    @property
    def obs_dim(self) -> int:
        """Readings in an observation."""
        return self.emission_mean.shape[1]

    @property
    def emission_scale(self) -> Tensor:
        """Standard deviations, (N, D)."""
        return self.emission_log_scale.exp()

    def log_transition(self) -> Tensor:
        """Log-probabilities of the edges, (N, K); -inf where there is none."""
        logits = self.transition_logits.masked_fill(~self.successor_mask, -torch.inf)
        return logits.log_softmax(-1)

    def transition_matrix(self) -> Tensor:
        """Dense a_ij, (N, N); rows sum to one."""
        dense = torch.zeros(self.num_nodes, self.num_nodes, dtype=self.transition_logits.dtype)
        return dense.scatter_add(1, self.successor, self.log_transition().exp())

    @torch.no_grad()
    def chain(self, temperature: float = 1.0) -> inference.Chain:
        """The parameters laid out for `inference`; emissions raised to `temperature`."""
        logits = _array(self.initial_logits)
        initial = logits - logits.max()
        initial -= np.log(np.exp(initial).sum())
        return inference.build_chain(
            self._diagonals,
            np.where(self.successor_mask.numpy(), _array(self.transition_logits), -np.inf),
            np.maximum(initial, MIN_LOG_PROB),
            _array(self.emission_mean),
            _array(self.emission_log_scale),
            self.cell.numpy(),
            self.num_cells,
            MIN_LOG_PROB,
            temperature,
        )

    def e_step(self, observations: Sequences, temperature: float = 1.0) -> Statistics:
        """Expected sufficient statistics under the present parameters (eqs. 2-10).

        Args:
            observations: (T, D), or a list of such sequences of any lengths; NaN is a missing
                reading.
            temperature: power of the emission densities; below 1 the transitions count for more.
        """
        chain = self.chain(temperature)
        total = [self._expect(chain, sequence) for sequence in self._sequences(observations)]
        return sum(total[1:], total[0])

    def _expect(self, chain: inference.Chain, sequence: np.ndarray) -> Statistics:
        found = inference.expectations(chain, self._diagonals, sequence)
        edge = torch.zeros(self.successor.shape, dtype=torch.float64)
        edge.numpy().ravel()[self._diagonals.slot] = found.edge
        return Statistics(
            torch.from_numpy(found.initial),
            torch.from_numpy(found.node),
            edge,
            torch.from_numpy(found.weight),
            torch.from_numpy(found.first),
            torch.from_numpy(found.second),
            torch.tensor(found.log_likelihood, dtype=torch.float64),
            len(sequence),
        )

    @torch.no_grad()
    def m_step(
        self,
        statistics: Statistics,
        *,
        min_scale: float = 0.01,
        pseudo_count: float = 0.0,
        trace: float = 0.0,
        fixed: frozenset[str] = frozenset(),
    ) -> None:
        """Set the parameters to what the statistics say (eqs. 7-11).

        A node or a reading without data keeps its parameters.

        Args:
            statistics: from `e_step`, added over logs.
            min_scale: floor of the standard deviations.
            pseudo_count: transitions that every existing edge is taken to have had beforehand.
            trace: tau of eq. 11, the share of the old means and variances that is kept.
            fixed: names of parameters to leave alone.
        """
        unknown = fixed - {name for name, _ in self.named_parameters()}
        if unknown:
            raise ValueError(f"`fixed` names {sorted(unknown)}, which the model does not have.")
        new = {name: _array(value).copy() for name, value in self.named_parameters()}
        with np.errstate(divide="ignore"):
            log_prob = np.log(_array(statistics.initial) / _array(statistics.initial).sum())
        new["initial_logits"] = np.maximum(log_prob, MIN_LOG_PROB)
        kernels.best_edges(
            _array(statistics.edge), self.successor_mask.numpy(), pseudo_count, MIN_WEIGHT,
            MIN_LOG_PROB, new["transition_logits"],
        )  # fmt: skip
        weight, log_scale = _array(statistics.weight), new["emission_log_scale"]
        variance = np.empty_like(log_scale)
        kernels.best_gaussians(
            weight, _array(statistics.first), _array(statistics.second),
            trace, min_scale**2, MIN_WEIGHT, new["emission_mean"], log_scale, variance,
        )  # fmt: skip
        np.copyto(log_scale, 0.5 * np.log(variance), where=weight > MIN_WEIGHT)
        for name, parameter in self.named_parameters():
            if name not in fixed:
                parameter.copy_(torch.from_numpy(new[name]))

    def log_likelihood(self, observations: Sequences) -> Tensor:
        """Natural log of the observations' density, () [nat], summed over steps and sequences."""
        chain = self.chain()
        parts = [
            inference.log_likelihood(chain, sequence) for sequence in self._sequences(observations)
        ]
        return torch.tensor(sum(parts), dtype=torch.float64)

    def num_free_parameters(self) -> int:
        """Numbers that EM chooses: edges and starts that sum to one, means and scales."""
        num_edges = int(self.successor_mask.sum())
        return (num_edges - self.num_nodes) + (self.num_nodes - 1) + 2 * self.emission_mean.numel()

    def aic(self, observations: Sequences) -> float:
        """Akaike's criterion, 2 k - 2 log L; the smaller the better."""
        return 2 * self.num_free_parameters() - 2 * self.log_likelihood(observations).item()

    def bic(self, observations: Sequences) -> float:
        """Bayesian criterion, k log T - 2 log L over all T steps; the smaller the better."""
        num_steps = sum(len(sequence) for sequence in self._sequences(observations))
        penalty = self.num_free_parameters() * math.log(num_steps)
        return penalty - 2 * self.log_likelihood(observations).item()

    def filter(self, observations: Tensor | np.ndarray) -> Tensor:
        """p(node at t | observations up to t), float32 (T, N)."""
        rows, _ = inference.filter_rows(self.chain(), self._sequence(observations))
        return torch.from_numpy(rows[:, self.cell.numpy()])

    def smooth(self, observations: Tensor | np.ndarray) -> Tensor:
        """p(node at t | all observations), float32 (T, N)."""
        return torch.from_numpy(inference.smooth(self.chain(), self._sequence(observations)))

    def most_likely_path(
        self, observations: Tensor | np.ndarray, temperature: float = 1.0
    ) -> Tensor:
        """Viterbi's path (section 2.3) from a uniform start, int64 (T,)."""
        chain = self.chain(temperature)
        uniform = np.where(chain.is_node, -np.log(self.num_nodes), -np.inf)
        path = inference.most_likely_path(
            chain._replace(initial_log=uniform), self._sequence(observations)
        )
        return torch.from_numpy(path)

    def forecast(self, belief: Tensor, num_steps: int) -> Tensor:
        """p(node n steps ahead) for n = 1..num_steps, (num_steps, N), from a belief (N,)."""
        transition_prob = self.log_transition().exp()
        rows = []
        for _ in range(num_steps):
            belief = self._push(belief, transition_prob)
            rows.append(belief)
        return torch.stack(rows) if rows else belief.new_zeros(0, self.num_nodes)

    def forecast_observation(self, belief: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (..., D) of the observation under a belief (..., N)."""
        belief = belief.to(self.emission_mean.dtype)
        mean = belief @ self.emission_mean
        second = belief @ (self.emission_scale**2 + self.emission_mean**2)
        return mean, (second - mean**2).clamp(min=0.0).sqrt()

    def _push(self, belief: Tensor, transition_prob: Tensor) -> Tensor:
        flow = belief.to(transition_prob.dtype)[:, None] * transition_prob
        return torch.zeros_like(flow[:, 0]).index_add(0, self.successor.flatten(), flow.flatten())

    def update(self, belief: Tensor, observation: Tensor | np.ndarray) -> Tensor:
        """One control step of the filter: p(node | ..., observation), (N,), from the belief.

        Lays the parameters out anew each time; a control loop makes `chain()` once and calls
        `inference.filter_step`.
        """
        chain = self.chain()
        state = inference.start_filter(chain, belief.detach().double().numpy())
        prob, _ = inference.filter_step(chain, state, self._sequence(observation[None])[0])
        return torch.from_numpy(prob).double()

    @torch.no_grad()
    def sample(self, num_steps: int, generator: torch.Generator) -> Sample:
        """Draw a path and its observations."""
        transition_prob, nodes = self.log_transition().exp(), []
        node = torch.multinomial(self.initial_logits.softmax(0), 1, generator=generator)
        for _ in range(num_steps):
            nodes.append(node)
            edge = torch.multinomial(transition_prob[node[0]], 1, generator=generator)
            node = self.successor[node[0], edge]
        path = torch.cat(nodes)
        noise = torch.randn(num_steps, self.obs_dim, generator=generator, dtype=torch.float64)
        return Sample(path, self.emission_mean[path] + noise * self.emission_scale[path])

    @torch.no_grad()
    def keep_nodes(self, kept: Tensor) -> None:
        """Drop every node that the bool mask `kept` (N,) leaves out, with its edges."""
        if not kept.any():
            raise ValueError("no node would be left; keep at least one.")
        index = kept.cumsum(0) - 1
        mask = (self.successor_mask & kept[self.successor])[kept]
        own = torch.arange(len(mask))[:, None]
        successor = torch.where(mask, index[self.successor[kept]], own)
        self._set_graph(successor, mask, self.cell[kept])
        for name, parameter in list(self.named_parameters()):
            setattr(self, name, nn.Parameter(parameter[kept]))

    def replace_graph(
        self,
        successor: Tensor,
        mask: Tensor,
        cell: Tensor,
        transition_logits: Tensor,
        emission_mean: Tensor,
        emission_log_scale: Tensor,
    ) -> None:
        """Take over other nodes and edges, which need not lie on the lattice.

        Shapes are those of the parameters and buffers. Cells are distinct numbers from 0 to N - 1,
        near for neighbours: the recursions' cost grows with the number of distinct differences
        between joined cells.
        """
        self.num_cells = len(cell)
        self._set_graph(successor, mask, cell)
        self.transition_logits = nn.Parameter(transition_logits)
        self.initial_logits = nn.Parameter(torch.zeros(len(cell), dtype=torch.float64))
        self.emission_mean = nn.Parameter(emission_mean)
        self.emission_log_scale = nn.Parameter(emission_log_scale)

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over the `state_dict` of another model, on its lattice, pruned, or rebuilt.

        Raises:
            ValueError: if the tensors don't fit together or contradict the lattice.
        """
        successor, mask, cell = state["successor"], state["successor_mask"], state["cell"]
        num_nodes, width = successor.shape
        num_cells = max(self.num_cells, num_nodes)
        shapes = {
            "successor": (num_nodes, width),
            "successor_mask": (num_nodes, width),
            "transition_logits": (num_nodes, width),
            "initial_logits": (num_nodes,),
            "emission_mean": (num_nodes, self.obs_dim),
            "emission_log_scale": (num_nodes, self.obs_dim),
        }
        for name, shape in shapes.items():
            if tuple(state[name].shape) != shape:
                raise ValueError(f"{name} has shape {tuple(state[name].shape)}, needs {shape}")
        is_cell = (cell >= 0) & (cell < num_cells)
        if not is_cell.all() or len(cell.unique()) != num_nodes or mask.dtype != torch.bool:
            raise ValueError(f"cells must be distinct and lie in 0..{num_cells - 1}")
        if not ((successor >= 0) & (successor < num_nodes)).all() or not mask.any(1).all():
            raise ValueError(f"successors must lie in 0..{num_nodes - 1}, one for each node")
        if not all(state[name].isfinite().all() for name, _ in self.named_parameters()):
            raise ValueError("parameters must be finite")
        self.num_cells = num_cells
        self._set_graph(successor, mask, cell)
        for name, _ in list(self.named_parameters()):
            setattr(self, name, nn.Parameter(state[name]))

    def _sequences(self, observations: Sequences) -> list[np.ndarray]:
        sequences = observations if isinstance(observations, list) else [observations]
        if not sequences:
            raise ValueError("no sequence of observations was given; give at least one (T, D).")
        return [self._sequence(sequence) for sequence in sequences]

    def _sequence(self, observations: Tensor | np.ndarray) -> np.ndarray:
        """Check one sequence and bring it to float64, contiguous."""
        if isinstance(observations, Tensor):
            observations = observations.detach().cpu().numpy()
        array = np.ascontiguousarray(observations, np.float64)
        if array.ndim != 2 or array.shape[1] != self.obs_dim or len(array) == 0:
            raise ValueError(
                f"observations have shape {array.shape}, need (T, {self.obs_dim}) with T >= 1; "
                "give one row a step."
            )
        if np.fmax.reduce(array, None) > MAX_READING or np.fmin.reduce(array, None) < -MAX_READING:
            t, d = np.argwhere(np.abs(array) > MAX_READING)[0]
            raise ValueError(
                f"observation {t}, reading {d} is {array[t, d]:g}, needs a finite number under "
                f"{MAX_READING:g}; check its units, or mark a missing reading with NaN."
            )
        return array
