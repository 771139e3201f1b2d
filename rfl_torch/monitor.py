"""The course of a run, written for TensorBoard; the only importer of its SummaryWriter.

tensorboard --logdir runs

    hmm/, time/     scalars of each EM iteration
    map/graph       the graph of transitions while it unfolds; the last one is what is acted on
    controllers/    loss of the controllers, once they are learned
    practice/       coverage, success and surprise of goals chosen by the agent
    execute/        success of goals given to it, by their kind
    nodes           mean readings in the projector, with a label each
    config          options of the run
"""

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, shortest_path
from scipy.sparse.linalg import eigsh

from rfl_torch.hmm import GridHMM, Statistics
from rfl_torch.learning import Progress

MIN_EDGE_PROB = 0.01
"""Less likely transitions are left out of the map: pseudo-counts would make it a plain grid."""

MAX_MAP_NODES = 3000
"""The map holds the distances between all pairs of nodes: 72 MB, and seconds of work."""


MAP_EVERY = 40
"""EM iterations from one picture of the map to the next; a stage's end has one, too."""


class TensorBoardMonitor:
    """Writes one event file into `logdir`; a `learning.LearningMonitor` and a context manager.

    Raises:
        ImportError: if tensorboard is not installed.
    """

    def __init__(self, logdir: str | Path) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter  # takes seconds, and is optional
        except ImportError as error:
            raise ImportError(
                "TensorBoardMonitor found no tensorboard, which it needs to write its file; "
                "try pip install tensorboard."
            ) from error
        self._writer = SummaryWriter(str(logdir))
        self._iteration = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def on_iteration(self, hmm: GridHMM, statistics: Statistics, progress: Progress) -> None:
        """Write the scalars of an EM iteration; its number goes on from stage to stage."""
        values = {
            "hmm/log_likelihood_per_step": progress.log_likelihood_per_step,
            "hmm/active_nodes": int((statistics.node >= 1).sum()),
            "hmm/transition_entropy": transition_entropy(hmm, statistics),
            "hmm/temperature": progress.temperature,
            "time/seconds_per_iteration": progress.seconds,
        }
        for tag, value in values.items():
            self.scalar(tag, value, self._iteration)
        if self._iteration % MAP_EVERY == 0:
            self._map(hmm)
        self._iteration += 1

    def on_stage_end(self, hmm: GridHMM, stage: int) -> None:
        """Write the map as a picture, where `map_picture` has one."""
        self._map(hmm)

    def _map(self, hmm: GridHMM) -> None:
        picture = map_picture(hmm)
        if picture is not None:
            self.image("map/graph", picture, self._iteration)

    def nodes(self, hmm: GridHMM, num_steps: NDArray[np.int64]) -> None:
        """Write the map that came of it all: its picture, and the nodes for the projector.

        Args:
            hmm: the learned map.
            num_steps: (N,) steps of the log in each node, a label beside its number.
        """
        self._map(hmm)
        neighbours = (_symmetric_graph(hmm) > 0).sum(1)
        labels = [
            [str(value) for value in row]
            for row in zip(range(hmm.num_nodes), num_steps, neighbours, strict=True)
        ]
        self._writer.add_embedding(
            hmm.emission_mean.detach(),
            metadata=labels,
            metadata_header=["node", "steps of the log", "neighbours"],
            tag="nodes",
        )

    def scalar(self, tag: str, value: float, step: int) -> None:
        """Write one number."""
        self._writer.add_scalar(tag, value, step)

    def image(self, tag: str, array: NDArray[np.uint8], step: int) -> None:
        """Write one picture (height, width, 3) uint8; it costs about 0.2 s."""
        self._writer.add_image(tag, array, step, dataformats="HWC")

    def text(self, tag: str, markdown: str) -> None:
        """Write a note."""
        self._writer.add_text(tag, markdown)

    def config(self, config: Mapping[str, Any]) -> None:
        """Write the options of the run as a table; nested ones get dotted names."""
        rows = [f"| {_cell(name)} | {_cell(value)} |" for name, value in _flat(config)]
        self.text("config", "\n".join(["| option | value |", "| --- | --- |", *rows]))

    def close(self) -> None:
        """Finish the file; safe to call twice."""
        self._writer.close()


@torch.no_grad()
def transition_entropy(hmm: GridHMM, statistics: Statistics) -> float:
    """Return how undecided the transitions are, the mean over node visits [nat]."""
    entropy = torch.special.entr(hmm.log_transition().exp()).sum(-1)
    return float((entropy * statistics.node).sum() / statistics.node.sum())


@torch.no_grad()
def map_layout(hmm: GridHMM) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return nodes (M,) of the largest connected part of the graph and places (M, 2) for them.

    The places are the plane in which straight distances come nearest to the number of transitions
    between nodes (classical scaling). The graph's own eigenvectors are cheaper, but crowd the ends
    of a maze's corridors into points.
    """
    graph = _symmetric_graph(hmm)
    part = connected_components(graph, directed=False)[1]
    nodes = np.flatnonzero(part == np.bincount(part).argmax())
    if len(nodes) < 4:  # too few for the eigenvectors
        return nodes, np.column_stack([np.arange(len(nodes)), np.zeros(len(nodes))])
    square = shortest_path(graph[nodes][:, nodes], directed=False, unweighted=True) ** 2
    centred = -0.5 * (square - square.mean(0) - square.mean(1)[:, None] + square.mean())
    # The fixed start makes the picture the same every time.
    values, vectors = eigsh(centred, k=2, which="LA", v0=np.linspace(1, 2, len(nodes)))
    return nodes, vectors * np.sqrt(values.clip(min=0))


def map_picture(hmm: GridHMM) -> NDArray[np.uint8] | None:
    """Return the graph of transitions, drawn without any ground truth, (640, 640, 3) uint8.

    Nodes are coloured by their mean reading, dark for low ones; likely transitions are drawn
    wide. None without matplotlib, or with more than MAX_MAP_NODES nodes.
    """
    if hmm.num_nodes > MAX_MAP_NODES:
        return None
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import LineCollection
        from matplotlib.figure import Figure
    except ImportError:
        return None
    nodes, place = map_layout(hmm)
    graph = _symmetric_graph(hmm)[nodes][:, nodes].tocoo()
    figure = Figure(figsize=(6.4, 6.4), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.02, 0.02, 0.96, 0.92))
    axes.set_title(f"{len(nodes)} of {hmm.num_nodes} nodes, connected", fontsize=11)
    axes.set_axis_off()
    axes.set_aspect("equal")
    lines = np.stack([place[graph.row], place[graph.col]], 1)
    axes.add_collection(LineCollection(list(lines), colors="#9A9A9A", linewidths=3 * graph.data))
    reading = hmm.emission_mean.detach().mean(1).numpy()[nodes]
    axes.scatter(place[:, 0], place[:, 1], c=reading, cmap="cividis", s=22, zorder=3)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


@torch.no_grad()
def _symmetric_graph(hmm: GridHMM) -> csr_array:
    """Return the mean of the transition probabilities there and back, (N, N), without loops."""
    prob = hmm.log_transition().exp().numpy()
    node = np.broadcast_to(np.arange(hmm.num_nodes)[:, None], prob.shape)
    successor = hmm.successor.numpy()
    kept = (prob > MIN_EDGE_PROB) & (successor != node)
    shape = (hmm.num_nodes, hmm.num_nodes)
    graph = coo_array((prob[kept], (node[kept], successor[kept])), shape=shape).tocsr()
    return (graph + graph.T).tocsr() / 2


def _flat(config: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for name, value in config.items():
        if isinstance(value, Mapping):
            rows += _flat(value, f"{prefix}{name}.")
        else:
            rows.append((f"{prefix}{name}", value))
    return rows


def _cell(value: Any) -> str:
    """Return text that neither ends a table's cell nor its row."""
    return str(value).replace("|", "\\|").replace("\n", " ")
