"""The agent of Fig. 1: predictor, controllers and planner behind one object.

Fitting runs the paper's scenario: learn the HMM from a log (section 2.2), drop unused nodes,
recognise the log (2.3), give its triplets to the nodes' controllers (2.4). Executors (2.5) are made
from a fitted agent and leave it unchanged.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from torch import Tensor

from rfl_torch import footprint, growth, inference, learning, places, repair
from rfl_torch.agent_layout import check_state
from rfl_torch.checkpoint import load_checkpoint, save_checkpoint
from rfl_torch.config import AgentConfig
from rfl_torch.contact import Contact, learn_contact
from rfl_torch.controllers import (
    MLPBank,
    RBFBank,
    Triplets,
    assign_reversed,
    assign_triplets,
    concatenate,
    explained,
    latest,
    pool_sparse_nodes,
)
from rfl_torch.executor import Executor, make_executor
from rfl_torch.explorer import FINE, WIDE, Explorer
from rfl_torch.free_ways import FreeWays, learn_free_ways
from rfl_torch.hmm import GridHMM, Statistics
from rfl_torch.homing import Homing, Place, move_to_sight, places_like
from rfl_torch.looks import BATCH, find_looks, look_radius
from rfl_torch.memory import Memory, join
from rfl_torch.motion import Motion, remember, remember_more
from rfl_torch.online_svr import SVRBank
from rfl_torch.planner import look_alikes, seen_edges
from rfl_torch.practice import Attempt, PracticeMonitor, Strategy, practice
from rfl_torch.reckoning import Reckoning, mend
from rfl_torch.resume import SavedLearning, identity
from rfl_torch.senses import apart
from rfl_torch.spaces import Actions, Readings
from rfl_torch.trajectory import Trajectory

Goal = int | NDArray[np.float32] | Callable[[int], bool]
Bank = MLPBank | RBFBank | SVRBank

REVERSIBLE_SHARE = 0.5
"""A world is reversible if controllers explain this share of a backwards log's actions."""

UNFAMILIAR_SHARE = 0.05
"""An observation is unfamiliar if its density is below that of all but this share of the log."""

STRANGE_GOAL = 4.0
"""Radii of a look beyond which a goal is no place that the agent knows."""

HOP_PROBABILITY = 0.005
"""Chance a step that the belief changes over to a node that looks the same."""

MOST_SAMPLES = 256
"""Triplets a node that are kept to learn from again when more come."""

MOST_PLACES = 2
"""Times as many nodes as by the grid's places that places by a track may make that wasn't seen to
come back: with more, the actions don't add up to positions."""

MOST_DIMENSIONS = 3
"""Of actions, for a robot that is lost to explore: a lattice of more has too many cells."""

MOST_ROUNDS = 8
"""Times that a repaired map is counted and its logs recognised anew, until all nodes are used."""

RARE = 0.02
"""Share of more data that may read below or above the range that counts as [0, 1]: outliers."""

MIN_STEPS = 10
"""Shortest log that is accepted: the coarsest stage still needs a few steps."""


class AgentMonitor(learning.LearningMonitor, Protocol):
    """What `Agent.fit` reports to."""

    def scalar(self, tag: str, value: float, step: int) -> None:
        """Called with `controllers/loss` once the controllers are learned."""


class Agent:
    """Learns a map and controllers from logs of what a robot saw and did, and goes places."""

    hmm: GridHMM
    bank: Bank
    edges: csr_array
    """(N, N): how often the recognised logs took each edge."""
    tried: NDArray[np.float64]
    """(N, K): steps of the logs at each node along each of the `innate.directions`."""
    counts: repair.Counts | None
    """What the logs say of each node, if the map was rebuilt by looks and places."""
    statistics: Statistics | None
    """What the logs say of each node of a grid, if it was not."""
    readings: Readings
    """The range that each reading had in the logs."""
    actions: Actions
    """The action space that they were made in."""
    look_radius: float
    """Mean absolute difference of normalised observations within which places look the same."""
    samples: Triplets
    """What the controllers learned from: the latest of each node."""
    last_seen: tuple[NDArray[np.float64], NDArray[np.float64]] | None
    """Normalised observation (D,) and belief (N,) of the last control step."""
    is_reversible: bool
    """Whether the log run backwards obeys the same controllers, with opposite actions."""
    memory: Memory | None
    """The logs, where they are gone back to: actions add up to positions, and what the map needs of
    them is laid out anew with what comes next; or the world isn't reversible, and motion is learned
    from them (`config.steers`)."""
    positions: NDArray[np.float64] | None
    """Of the nodes on the track, in full actions, (N, A), if actions add up to positions."""
    reckoning: Reckoning | None
    """Follows the robot by its actions, if they add up to positions."""
    free_ways: FreeWays | None
    """What free ways look like, if actions add up to positions."""
    contact: Contact | None
    """What blocked ways look like, if actions add up to positions."""
    least_familiar: float
    """Tempered log-density [nat] under its node that an observation of a known place has."""

    def __init__(self, config: AgentConfig | None = None, seed: int = 0) -> None:
        self.config = AgentConfig() if config is None else config
        self.seed = seed
        self._forget()

    def _forget(self) -> None:
        """Know nothing yet."""
        self.record: list[learning.Progress] = []
        self.counts = self.statistics = self.memory = self.last_seen = None
        self.free_ways = self.contact = self.positions = None
        self._motion: Motion | None = None

    # -- learning ---------------------------------------------------------------------------

    def fit(
        self,
        logs: Trajectory | list[Trajectory],
        monitor: AgentMonitor | None = None,
        resume: str | Path | None = None,
    ) -> "Agent":
        """Learn everything from one log or several of the same robot.

        Readings that never change in any of the logs say nothing and are left out, with a
        warning; the agent still takes them in every observation.

        Args:
            logs: what was sensed and done.
            monitor: told of every iteration.
            resume: file to keep unfinished learning in. Where one of the same logs, choices and
                seed is there already, learning goes on from it, and ends with the same numbers.
                Remove it once the agent is saved.

        Raises:
            ValueError: if the logs are empty, too short, of different widths, if no reading
                changes, or if they take more memory than there is.
        """
        logs = [logs] if isinstance(logs, Trajectory) else logs
        self._forget()
        self._check_logs(logs)
        self.readings = Readings.of_logs(logs, self.config.unwraps)
        self.actions = Actions.of_logs(logs)
        observations = [torch.from_numpy(self.readings.normalize(log.observations)) for log in logs]
        config = self.config
        self.hmm = GridHMM(
            config.shape, observations[0].shape[1], config.radius, config.metric, config.boundary
        )
        learning.start(self.hmm, observations, config.start, self.seed)
        power = config.power(self.hmm.obs_dim)
        stages = tuple(stage.tempered(power) for stage in config.stages)
        if resume is None:
            self.record = learning.learn(self.hmm, observations, stages, monitor)
        else:
            own = identity([config.to_json(), self.seed], logs)
            saved = SavedLearning(Path(resume), own, monitor)
            record = saved.restore(self.hmm)
            self.record = learning.learn(self.hmm, observations, stages, saved, record)
        learning.prune(self.hmm, observations, power)
        paths = self._recognize_logs(observations)
        actions = [self.actions.to_unit(log.actions) for log in logs]
        seen = self._filled(observations, paths)
        self.look_radius = look_radius(seen, actions)
        track = (
            self._follow_track(seen, actions) if config.repairs and config.uses_reversal else None
        )
        adds_up = track is not None and track.comes_back
        loss = self._learn_controllers(observations, actions, paths, adds_up)
        if track is not None and self.is_reversible:
            positions = track.positions()
            paths = self._repair(observations, paths, track, positions)
            loss = self._learn_controllers(observations, actions, paths, adds_up)
            if adds_up and self.is_reversible:
                nodes = [path.numpy() for path in paths]
                self.memory = join(list(zip(nodes, seen, actions, strict=True)))
                self._learn_land(self.memory.node, positions, track.shifts, seen, actions)
        else:
            self.statistics = self.hmm.e_step(observations, power)
        if monitor is not None:
            monitor.scalar("controllers/loss", loss, len(self.record))
        self._prepare_planning()
        return self

    def learn_from_labels(
        self,
        logs: list[Trajectory],
        nodes: list[NDArray[np.int64]],
        positions: list[NDArray[np.float64]] | None = None,
    ) -> "Agent":
        """Take labelled logs for the map's nodes, as from an oracle, and learn controllers.

        Args:
            logs: what `fit` learned the spaces from.
            nodes: of every observation of each log, int64 (T+1,).
            positions: of every observation, in full actions, (T+1, A) for each log, if actions add
                up to positions.
        """
        self.memory = self.last_seen = None
        self.free_ways = self.contact = self.positions = None
        observations = [self.readings.normalize(log.observations) for log in logs]
        actions = [self.actions.to_unit(log.actions) for log in logs]
        paths = [torch.from_numpy(path) for path in self._count(nodes, observations)]
        self._prepare_recognition()
        self._learn_controllers([torch.from_numpy(x) for x in observations], actions, paths)
        if positions is not None:
            shifts = [np.diff(position, axis=0) for position in positions]
            labels = torch.cat(paths).numpy()
            self._learn_land(labels, positions, shifts, observations, actions)
        self._prepare_planning()
        return self

    def partial_fit(self, logs: Trajectory | list[Trajectory]) -> "Agent":
        """Learn from more data without starting over.

        What the logs show anew becomes new nodes, what they do anew becomes new edges. A log that
        begins with the very observation that the last one ended with goes on from it. Executors
        made before are of the old map: make new ones.

        Where actions add up to positions, the logs are kept and laid out anew together, and the
        range that readings are normalised by becomes wide enough for them, but for outliers. A node
        that is still there keeps its number, but where the range changed, so do nodes. What lay at
        one of the `positions` lies there still: a goal is the node nearest to where it lay. What
        was learned from and is shown often enough by later steps is left out, beyond 10,000 steps
        and 30 a node: time and memory grow with the map, about 0.1 ms (0.5 with thousands of nodes)
        and 110 bytes for each step kept.

        Raises:
            ValueError: if a log has other readings or actions than those learned from, or takes
                more memory than there is.
        """
        logs = [logs] if isinstance(logs, Trajectory) else logs
        for log in logs:
            self._check_log(log)
            self._check_memory(log.num_steps)
        blamed = self.blamed()
        path = self._lay_out(logs) if self.has_track else self._grow(logs)
        self._prepare_planning()
        self._blame_again(blamed)
        if logs:
            belief = np.zeros(self.num_nodes)
            belief[path[-1]] = 1.0
            self.last_seen = self.readings.normalize(logs[-1].observations[-1]), belief
        return self

    def practice(
        self,
        env: Any,
        num_steps: int,
        seed: int = 0,
        strategy: Strategy = "frontier",
        monitor: PracticeMonitor | None = None,
        progress: Callable[[range], Iterable[int]] = iter,
    ) -> list[Attempt]:
        """Choose goals, go there, learn from what happens (step 4 of Fig. 1).

        Args:
            env: a Gymnasium environment of the robot learned from; it is reset once.
            num_steps: control steps.
            seed: of the environment and all choices.
            strategy: how goals are chosen.
            monitor: told of coverage, success and surprise after every attempt.
            progress: wraps the range of steps, as `tqdm.tqdm` does.

        Returns:
            The attempts, in their order.
        """
        return practice(self, env, num_steps, seed, strategy, monitor, progress)

    @property
    def has_track(self) -> bool:
        """Whether the map is laid out by the track of the logs, which are kept."""
        return self.is_reversible and self.memory is not None

    def _check_memory(self, num_steps: int) -> None:
        """Refuse a log that takes more memory than there is."""
        obs_dim, num_nodes = self.hmm.obs_dim, self.num_nodes
        needed = footprint.to_extend(num_steps, obs_dim, num_nodes)
        if self.memory is not None and self.has_track:
            num_all = num_steps + len(self.memory.node)
            action_dim = self.memory.action.shape[1]
            needed = footprint.to_fit(num_all, obs_dim, action_dim, num_nodes, self.config.horizon)
        footprint.check(needed, f"taking {num_steps} steps into {num_nodes} nodes")

    def _lay_out(self, logs: list[Trajectory]) -> NDArray[np.int64]:
        """Lay all that is kept out anew by looks and track; returns the nodes of its steps."""
        assert self.memory is not None
        memory, known = self.memory, self.memory.node
        for log in logs:
            observations = torch.from_numpy(self.readings.normalize(log.observations))
            goes_on = memory.ends_with(observations[0].numpy())
            path = torch.zeros(len(observations), dtype=torch.int64)
            if observations.isnan().any():
                (path,) = self._recognize_logs([observations])
            (filled,) = self._filled([observations], [path])
            more = join([(path.numpy(), filled, self.actions.to_unit(log.actions))])
            memory = memory.plus(more, goes_on)
        memory = self._widen(memory, len(known))
        seen, actions = memory.logs()
        track = self._follow_track(seen, actions, known[: memory.settled])
        positions = track.positions()
        nodes = track.split(positions)
        self.memory = memory._replace(node=repair.keep_numbers(np.concatenate(nodes), known))
        self._count(self.memory.paths(), seen)
        if self.positions is not None:
            before = self.positions[known]
            positions = places.keep_origin(positions, before, len(self.memory.paths()[0]))
        self._learn_land(self.memory.node, positions, track.shifts, seen, actions)
        self._prepare_recognition()
        paths = [torch.from_numpy(path) for path in self.memory.paths()]
        recognised = self._note_paths([torch.from_numpy(x) for x in seen], actions, paths)
        horizon = self.config.horizon
        parts = [assign_triplets(*log, horizon) for log in recognised]
        parts += [assign_reversed(*log, horizon) for log in recognised]
        self.samples = latest(concatenate(parts), MOST_SAMPLES)
        self._train_bank(self.samples)
        self.memory = self.memory.thinned()
        return self.memory.node

    def _widen(self, memory: Memory, num_known: int) -> Memory:
        """Let the range that counts as [0, 1] hold what is read now, too; returns the memory in it.

        A reading that hardly changed in the first log would outweigh all others where it changes:
        looks would be as short as a step there, and logs that cross have none in common.

        Args:
            memory: all logs, normalised as before.
            num_known: steps of it that are not new.
        """
        fresh = memory.observation[num_known:].astype(np.float64)
        if not len(fresh) or self.readings.period.any():
            return memory  # who wraps has two columns, of no range
        low, high = np.quantile(fresh, (RARE, 1.0 - RARE), axis=0)
        low, high = low.clip(max=0.0), high.clip(min=1.0)
        if not low.any() and (high == 1.0).all():
            return memory
        self.readings = self.readings.widened(low, high)
        observation = ((memory.observation - low) / (high - low)).astype(np.float32)
        memory = memory._replace(observation=observation)
        self.look_radius = look_radius(*memory.logs())
        return memory

    def _grow(self, logs: list[Trajectory]) -> NDArray[np.int64]:
        """Take logs into the map one by one; returns the path of the last one."""
        parts = [self.samples]
        path = np.empty(0, np.int64)
        for log in logs:
            observations = self.readings.normalize(log.observations)
            actions = self.actions.to_unit(log.actions)
            path = self._extend_map(observations, actions)
            known = np.where(np.isnan(observations), self._mean[path], observations)
            samples = (
                torch.from_numpy(path),
                torch.from_numpy(known).float(),
                torch.from_numpy(actions),
                self.config.horizon,
            )
            parts.append(assign_triplets(*samples))
            if self.memory is not None:
                self.memory, self._motion = remember_more(self.memory, *samples[:3]), None
            if self.is_reversible:
                parts.append(assign_reversed(*samples))
        self.samples = latest(concatenate(parts), MOST_SAMPLES)
        self._train_bank(self.samples)
        return path

    def _extend_map(
        self, observations: NDArray[np.float64], actions: NDArray[np.float32]
    ) -> NDArray[np.int64]:
        """Take one more log into the map; returns its path."""
        num_nodes = self.num_nodes
        if self.counts is not None:
            rows = inference.log_emission(self.chain, observations)[:, self.chain.cell]
            seen = np.where(np.isnan(observations), self._mean[rows.argmax(1)], observations)
            unknown = growth.log_unknown(rows, seen, self._mean, self.look_radius)
            path = growth.recognize(self.hmm, rows, unknown)
            path = growth.add_looks(path, seen, actions, self.look_radius, num_nodes)
            num_nodes = max(num_nodes, int(path.max()) + 1)
            more = repair.Counts.of([path], [observations], num_nodes)
            self.counts = self.counts.padded(num_nodes) + more
            self.edges = self.counts.edges
            self._rebuild()
        else:
            assert self.statistics is not None
            stage = self.config.stages[-1]
            self.statistics = learning.partial_fit(
                self.hmm,
                observations,
                self.statistics,
                temperature=self.config.power(self.hmm.obs_dim),
                min_scale=stage.min_scale,
                pseudo_count=stage.pseudo_count,
            )
        self._prepare_recognition()
        if self.counts is None:
            path = inference.most_likely_path(self._uniform_chain, observations)
            self.edges = csr_array(self.edges + places.sum_edges([path], num_nodes))
        self.tried = np.pad(self.tried, ((0, num_nodes - len(self.tried)), (0, 0)))
        self.tried += repair.count_directions([path], [actions], num_nodes)
        return path

    def blamed(self) -> list[tuple[int, int, float]]:
        """Edges (source, target, factor) that execution found to cost more than the map says."""
        graph = self.graph.tocoo()
        factor = graph.data / self.map_cost
        return [
            (int(graph.row[k]), int(graph.col[k]), float(factor[k]))
            for k in np.flatnonzero(factor != 1.0)
        ]

    def _blame_again(self, blamed: list[tuple[int, int, float]]) -> None:
        """Raise the costs of edges that are still there."""
        for source, target, factor in blamed:
            if source >= self.num_nodes:
                continue  # the node is gone
            row = slice(self.graph.indptr[source], self.graph.indptr[source + 1])
            for edge in row.start + np.flatnonzero(self.graph.indices[row] == target):
                self.graph.data[edge] = factor * self.map_cost[edge]

    def _check_log(self, log: Trajectory) -> None:
        widths = (log.observations.shape[1], log.actions.shape[1])
        needed = (len(self.readings.low), len(self.actions.low))
        if widths != needed:
            raise ValueError(
                f"the log has (readings, actions) {widths}, needs {needed} as in the log that the "
                "agent learned from."
            )

    def _check_logs(self, logs: list[Trajectory]) -> None:
        """Refuse logs that nothing can be learned from."""
        if not logs:
            raise ValueError("no log was given; record one first.")
        widths = {(log.observations.shape[1], log.actions.shape[1]) for log in logs}
        if len(widths) > 1:
            raise ValueError(
                f"logs have (readings, actions) {sorted(widths)}; needs the same robot in all."
            )
        num_steps = sum(log.num_steps for log in logs)
        if num_steps < MIN_STEPS * max(stage.stride for stage in self.config.stages):
            raise ValueError(
                f"the logs hold {num_steps} steps, too few to sub-sample at "
                f"1/{max(stage.stride for stage in self.config.stages)}; record thousands, "
                "e.g. 10000."
            )
        ((obs_dim, action_dim),) = widths
        needed = footprint.to_fit(
            num_steps, obs_dim, action_dim, math.prod(self.config.shape), self.config.horizon
        )
        footprint.check(needed, f"learning from {num_steps} steps of {obs_dim} readings")

    def _recognize_logs(self, observations: list[Tensor]) -> list[Tensor]:
        """Most likely paths under the map as it is now."""
        self._prepare_recognition()
        return [
            torch.from_numpy(inference.most_likely_path(self._uniform_chain, sequence.numpy()))
            for sequence in observations
        ]

    def _filled(self, observations: list[Tensor], paths: list[Tensor]) -> list[NDArray[np.float64]]:
        """The observations, with their nodes' means where a reading is missing."""
        return [
            np.where(np.isnan(sequence), self._mean[path], sequence)
            for sequence, path in zip(map(Tensor.numpy, observations), paths, strict=True)
        ]

    def _follow_track(
        self,
        seen: list[NDArray[np.float64]],
        actions: list[NDArray[np.float32]],
        known: NDArray[np.int64] | None = None,
    ) -> places.Track:
        """Where logs without gaps went, and what looks they saw there."""
        looks = find_looks(seen, actions, self.look_radius)
        return places.follow_track(looks, seen, actions, self.look_radius, known)

    def _learn_land(
        self,
        node: NDArray[np.int64],
        positions: list[NDArray[np.float64]],
        shifts: list[NDArray[np.float64]],
        seen: list[NDArray[np.float64]],
        actions: list[NDArray[np.float32]],
    ) -> None:
        """Where the nodes are, and what free ways look like, by logs whose nodes are known."""
        if actions[0].shape[1] > MOST_DIMENSIONS:
            return
        self.positions = places.middles(node, positions, self.num_nodes)
        self.free_ways = learn_free_ways(
            positions, seen, shifts, actions, *self.readings.own_units()
        )
        self.contact = learn_contact(seen, shifts, actions).completed(self.free_ways)

    def _repair(
        self,
        observations: list[Tensor],
        paths: list[Tensor],
        track: places.Track,
        positions: list[NDArray[np.float64]],
    ) -> list[Tensor]:
        """Rebuild the map by looks and places; returns the logs' paths on the new one."""
        values = [sequence.numpy() for sequence in observations]
        if track.comes_back:  # it tells more than sights: halfway along a hall they don't change
            nodes = self._count(track.split(positions), values)
            self._prepare_recognition()
            return [torch.from_numpy(path) for path in nodes]
        nodes = repair.split_by_place(track.looks, [path.numpy() for path in paths])
        if track.num_places <= MOST_PLACES * (1 + max(int(node.max()) for node in nodes)):
            nodes = track.split(positions)
        for _ in range(MOST_ROUNDS):
            self._count(nodes, values)
            nodes = [path.numpy() for path in self._recognize_logs(observations)]
            if repair.number_anew(nodes)[1] == self.num_nodes:
                break  # else leave out what the most likely paths leave out
        assert self.counts is not None
        self.counts = replace(self.counts, edges=places.sum_edges(nodes, self.num_nodes))
        return [torch.from_numpy(path) for path in nodes]

    def _count(
        self, nodes: list[NDArray[np.int64]], observations: list[NDArray[np.float64]]
    ) -> list[NDArray[np.int64]]:
        """Make the map what labelled logs say; returns the labels, numbered without gaps."""
        nodes, num_nodes = repair.number_anew(nodes)
        self.counts = repair.Counts.of(nodes, observations, num_nodes)
        self._rebuild()
        return nodes

    def _rebuild(self) -> None:
        """Make the map what the counts say."""
        stage = self.config.stages[-1]
        counts = self.counts
        assert counts is not None
        if self.is_reversible:  # else what looks the same differs in what doesn't show
            counts = repair.tie(counts, self.config.power(self.hmm.obs_dim), repair.MIN_SCALE)
        repair.rebuild(self.hmm, counts, self.is_reversible, repair.MIN_SCALE, stage.pseudo_count)

    def _learn_controllers(
        self,
        observations: list[Tensor],
        unit_actions: list[NDArray[np.float32]],
        paths: list[Tensor],
        adds_up: bool = False,
    ) -> float:
        """Count the edges that the logs take, train the bank on their triplets; returns its loss.

        Where actions add up to positions, or where the controllers so learned predict the log run
        backwards, the world is reversible: they learn from both directions then, and the planner
        trusts edges taken one way only.
        """
        logs = self._note_paths(observations, unit_actions, paths)
        forward = concatenate([assign_triplets(*log, self.config.horizon) for log in logs])
        loss = self._train_bank(forward)
        self.is_reversible = False
        if self.config.uses_reversal and len(forward.node):
            backward = concatenate([assign_reversed(*log, self.config.horizon) for log in logs])
            self.is_reversible = adds_up or explained(self.bank, backward) > REVERSIBLE_SHARE
        triplets = forward
        if self.is_reversible:
            triplets = concatenate([forward, backward])
            loss = self._train_bank(triplets)
        self.samples = latest(triplets, MOST_SAMPLES)
        is_steered = self.config.steers and not self.is_reversible and len(triplets.node) > 0
        self.memory, self._motion = remember(logs) if is_steered else None, None
        return loss

    def _note_paths(
        self,
        observations: list[Tensor],
        unit_actions: list[NDArray[np.float32]],
        paths: list[Tensor],
    ) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Count what recognised logs do; returns (node, observation, action) of each.

        A missing reading is taken for the node's own there, as `control` does.
        """
        nodes = [path.numpy() for path in paths]
        self.edges = places.sum_edges(nodes, self.num_nodes)
        self.tried = repair.count_directions(nodes, unit_actions, self.num_nodes)
        own = [
            self._own_log_density(seen, path)
            for seen, path in zip(observations, paths, strict=True)
        ]
        self.least_familiar = float(np.quantile(torch.cat(own), UNFAMILIAR_SHARE))
        mean = self.hmm.emission_mean.detach()
        return [
            (path, torch.where(seen.isnan(), mean[path], seen).float(), torch.from_numpy(actions))
            for path, seen, actions in zip(paths, observations, unit_actions, strict=True)
        ]

    def _train_bank(self, triplets: Triplets) -> float:
        """Learn a new bank from triplets; where the log never changes node, it stays at rest."""
        pooled = pool_sparse_nodes(triplets, self.hmm.successor, self.hmm.successor_mask)
        torch.manual_seed(self.seed)
        self.bank = make_bank(
            self.config.controller, self.num_nodes, self.hmm.obs_dim, pooled.action.shape[1]
        )
        if not len(pooled.node):
            return 0.0
        return self.bank.fit(pooled.inputs, pooled.action, pooled.node)

    def _own_log_density(self, observations: Tensor, path: Tensor) -> Tensor:
        """Tempered log-density of each observation under its own node, (T,)."""
        hmm, power = self.hmm, self.config.power(self.hmm.obs_dim)
        parts = []
        with torch.no_grad():
            for seen, node in zip(observations.split(BATCH), path.split(BATCH), strict=True):
                own = torch.distributions.Normal(hmm.emission_mean[node], hmm.emission_scale[node])
                log_density = own.log_prob(seen.nan_to_num(0.0))
                parts.append(power * log_density.masked_fill(seen.isnan(), 0.0).sum(1))
        return torch.cat(parts)

    def _prepare_recognition(self) -> None:
        self.chain = self.hmm.chain(self.config.power(self.hmm.obs_dim))
        uniform = np.where(self.chain.is_node, -np.log(self.num_nodes), -np.inf)
        self._uniform_chain = self.chain._replace(initial_log=uniform)
        self._mean = self.hmm.emission_mean.detach().numpy()

    def _prepare_planning(self) -> None:
        """Lay out the graph that is planned over, and the transitions of the belief."""
        rows, columns = np.nonzero(self.hmm.successor_mask.numpy())
        target = self.hmm.successor.numpy()[rows, columns]
        shape = (self.num_nodes, self.num_nodes)
        prob = self.hmm.log_transition().exp().detach().numpy()[rows, columns]
        seen = seen_edges(self.edges, self.is_reversible)
        self.alike = self._look_alikes(seen)
        self.near = places.surroundings(self.edges, self.positions)
        self.twins = self._twins()
        self.telling = places.find_telling(self.twins, self.edges, self.positions)
        self.graph = csr_array(seen.multiply(self._steps_between(seen)) + self.alike)
        self.map_cost = self.graph.data.copy()  # executors raise the graph's where they fail
        self.transition_in = self._with_hops(csr_array((prob, (rows, target)), shape=shape))
        self.reckoning = None
        if self.positions is not None:
            self.reckoning = Reckoning(self.positions, self.edges, self.transition_in)

    def _steps_between(self, edges: csr_array) -> csr_array:
        """Control steps that each edge should take, (N, N) on the same edges.

        In a reversible world the controllers say: what j's asks for at i's mean, before it is
        shortened to the action space, is that many full actions. An edge over a wormhole then
        costs what the way costs. Elsewhere an edge counts as one step.
        """
        source, target = edges.tocoo().coords
        steps = np.ones(len(source))
        if self.is_reversible:
            unit = self.ask(source, target).astype(np.float64)
            steps = np.maximum(1.0, 2.0 * np.abs(unit - 0.5).max(1))
        return csr_array((steps, (source, target)), shape=edges.shape)

    def _look_alikes(self, seen: csr_array) -> csr_array:
        """Nodes that may be one place twice; none where a log can't run backwards.

        There, nodes that look the same differ in what doesn't show, as a velocity does. In a map
        rebuilt by places they are different places. Nodes with an edge between them are neighbours,
        not doubles.
        """
        if not self.is_reversible or self.counts is not None:
            return csr_array((self.num_nodes, self.num_nodes), dtype=bool)
        mean, scale, power = self._emissions()
        alike = look_alikes(mean, scale, power)
        return csr_array(alike - alike.multiply(seen > 0) > 0)

    def _twins(self) -> csr_array:
        """Places that look the same, (N, N); none but in a map rebuilt by places."""
        if self.counts is None or not self.is_reversible:
            return csr_array((self.num_nodes, self.num_nodes), dtype=bool)
        near = places.surroundings(self.edges, self.positions, places.PLACE_STEPS)
        return places.find_twins(*self._emissions(), near)

    def _emissions(self) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """Means and scales of the nodes, (N, D) each, and the power of their densities."""
        mean, scale = self.hmm.emission_mean.detach(), self.hmm.emission_scale.detach()
        return mean.numpy(), scale.numpy(), self.config.power(self.hmm.obs_dim)

    def _with_hops(self, transition: csr_array) -> csr_array:
        """Transitions, transposed, with which a belief may change over to a node's double."""
        alike = self.alike.sum(1).astype(np.float64)
        share = np.where(alike > 0, HOP_PROBABILITY / np.maximum(alike, 1), 0.0)
        stays = 1.0 - HOP_PROBABILITY * (alike > 0)
        hopping = diags_array(stays) @ transition + diags_array(share) @ self.alike
        return csr_array(hopping.T)

    # -- using ------------------------------------------------------------------------------

    @property
    def num_nodes(self) -> int:
        """Nodes kept after pruning."""
        return self.hmm.num_nodes

    @property
    def visits(self) -> NDArray[np.float64]:
        """Steps of the logs at each node, (N,)."""
        return np.asarray(self.edges.sum(1)).ravel()

    @property
    def motion(self) -> Motion | None:
        """What choices lead to; None where the agent acts by its map and controllers alone."""
        if self._motion is None and self.memory is not None and not self.is_reversible:
            self._motion = Motion(self.memory)
        return self._motion

    def recognize(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        """The node at each step of a sequence (T, D), by Viterbi (section 2.3); int64 (T,).

        What the map was laid out from is where the track has it.
        """
        normal = self.readings.normalize(observations)
        known = np.full(len(normal), -1)
        if self.memory is not None and self.has_track:
            known = self.memory.remember(normal)
        if (known >= 0).all():
            return known
        return np.where(known >= 0, known, inference.most_likely_path(self._uniform_chain, normal))

    def executor(self, goal: Goal, seed: int = 0) -> Executor:
        """Make the object that drives to `goal`.

        Args:
            goal: a node's index; an observation (D,), for any place that looks like it (given up
                at once if no node does); or a predicate on node indices, for the nearest node
                that fulfils it.
            seed: of the innate actions that it falls back on.

        Raises:
            ValueError: if the goal is no kept node or no node fulfils it.
        """
        if isinstance(goal, int | np.integer) or callable(goal):
            return make_executor(self, self._goal_nodes(goal), seed)
        sight = self.readings.normalize(np.asarray(goal))
        homing = Homing(self, sight, self._places_like(sight))
        executor = make_executor(self, homing.nodes, seed, homing)
        if self.strangeness(sight, int(homing.nodes[0])) > STRANGE_GOAL:
            executor.status = "gave_up"
            executor.reason = "no node looks like the goal: the log has not been there"
        return executor

    def _goal_nodes(self, goal: int | Callable[[int], bool]) -> NDArray[np.int64]:
        if isinstance(goal, int | np.integer):
            if not 0 <= goal < self.num_nodes:
                raise ValueError(f"goal {goal} is no kept node; needs 0 to {self.num_nodes - 1}.")
            return np.array([goal])
        nodes = np.array([node for node in range(self.num_nodes) if goal(node)], np.int64)
        if not nodes.size:
            raise ValueError("no kept node fulfils the goal's predicate; widen it.")
        return nodes

    def _places_like(self, sight: NDArray[np.float64]) -> list[Place]:
        """Places that look like a goal (D,), the likeliest first."""
        if sight.ndim != 1 or np.isnan(sight).all():
            raise ValueError(
                f"goal has shape {sight.shape}; needs one observation "
                f"({len(self.readings.low)},) with at least one reading."
            )
        if self.memory is not None and self.positions is not None:
            seen, node = self.memory.observation, self.memory.node
            return places_like(seen, node, self.positions, sight, self.look_radius)
        likeliest = int(self.log_emission(sight).argmax())
        if self.strangeness(sight, likeliest) > 1.0:  # densities of strange sights say little
            likeliest = int(np.nanmean(np.abs(self._mean - sight), 1).argmin())
        twins = self.twins.indices[self.twins.indptr[likeliest] : self.twins.indptr[likeliest + 1]]
        nodes = np.append(likeliest, twins).astype(np.int64)
        return [Place(nodes, self.strangeness(sight, likeliest))]

    def explorer(self, seed: int = 0, node: int | None = None) -> Explorer:
        """What takes a robot to where it has seen nothing yet.

        Args:
            seed: decides where nothing is left.
            node: where the robot is, so that what the map knows is not new; None if it is lost.

        Raises:
            ValueError: if actions don't add up to positions, so that it could not tell.
        """
        if self.free_ways is None or self.contact is None or self.positions is None:
            raise ValueError("the logs show no free ways: their actions don't add up to positions.")
        gap = WIDE if node is None else FINE
        explorer = Explorer(
            *self.actions, self.look_radius, self.free_ways, self.contact, seed, gap
        )
        if node is not None:
            explorer.know(self.positions - self.positions[node])
        return explorer

    def strangeness(self, normal: NDArray[np.float64], node: int) -> float:
        """How far an observation (D,) is from what a node looks like, in radii of a look.

        NaN if all its readings are missing.
        """
        return float(apart(normal, self._mean[node])) / self.look_radius

    def node_width(self, nodes: NDArray[np.int64]) -> NDArray[np.float64]:
        """How far from the nodes' (G,) means observations of them are, (G,).

        The rms over readings and observations, each reading as a share of its range in the log.
        """
        scale = self.hmm.emission_scale.detach().numpy()[nodes]
        return np.asarray(np.sqrt((scale**2).mean(-1)))

    def log_emission(self, normal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Tempered log-density of one normalised observation (D,) under every node, (N,)."""
        return inference.log_emission(self.chain, normal[None])[0, self.chain.cell]

    def ask(self, source: NDArray[np.integer], target: NDArray[np.integer]) -> NDArray[np.float32]:
        """What the controllers of nodes `target` (E,) ask for at the means of `source`, (E, A).

        In [0, 1], not yet shortened to the action space.
        """
        mean = self.hmm.emission_mean.detach().float()
        with torch.no_grad():
            inputs = torch.cat([mean[source], mean[target]], 1)
            return self.bank(inputs, torch.from_numpy(target).long()).numpy()

    def control(self, normal: NDArray[np.float64], node: int) -> NDArray[np.float32]:
        """f_j(o_t, mu_j): the action by which node j's controller heads for the node, (A,)."""
        return self.actions.of_unit(self._unit_control(normal, node))

    def control_to_sight(
        self, normal: NDArray[np.float64], node: int, sight: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """The action by which a robot at a node heads for where it sees a sight (D,), (A,)."""
        if self.positions is None:
            return self.actions.of_unit(self._unit_control(normal, node, sight))
        around = self._around(node)
        node = int(around[np.nansum(np.abs(self._mean[around] - normal), 1).argmin()])
        around = self._around(node)
        where, means = self.positions[around], self._mean[around]
        move = move_to_sight(sight - normal, means - self._mean[node], where - self.positions[node])
        return self.actions.of_move(move)

    def control_by_reckoning(
        self, normal: NDArray[np.float64], node: int, here: int, where: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """`control`, and what the controller leaves out of the way goes by dead reckoning, (A,).

        Args:
            normal: what is seen, (D,).
            node: to head for.
            here: node at which the robot is.
            where: its position, in full actions, (A,).
        """
        assert self.positions is not None
        action, asked = (
            2.0 * self._unit_control(seen, node).astype(np.float64) - 1.0
            for seen in (normal, self._mean[here])
        )
        full = mend(action, asked, self.positions[node] - where)
        return self.actions.of_move(full)

    def is_near(self, node: int, other: int) -> bool:
        """Whether one node is in the surroundings of another, or is it."""
        return other in self._around(node)

    def _around(self, node: int) -> NDArray[np.int64]:
        return np.asarray(self.near.indices[self.near.indptr[node] : self.near.indptr[node + 1]])

    def _unit_control(
        self, normal: NDArray[np.float64], node: int, target: NDArray[np.float64] | None = None
    ) -> NDArray[np.float32]:
        mean = self._mean[node]
        observation = np.where(np.isnan(normal), mean, normal)
        target = mean if target is None else np.where(np.isnan(target), mean, target)
        row = np.concatenate([observation, target], dtype=np.float32, casting="same_kind")
        return self.bank.at(row, node)

    # -- keeping ----------------------------------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write the agent as one safetensors file."""
        state = {f"hmm.{name}": value for name, value in self.hmm.state_dict().items()}
        state |= {f"bank.{name}": value for name, value in self.bank.state_dict().items()}
        edges, blamed = self.edges.tocoo(), self.blamed()
        state |= {f"samples.{name}": value for name, value in self.samples._asdict().items()}
        if self.counts is not None:
            state |= {
                f"counts.{name}": torch.from_numpy(getattr(self.counts, name))
                for name in ("weight", "first", "second")
            }
        if self.statistics is not None:
            state |= {"statistics": self.statistics.to_vector()}
        state |= {
            "edges.pair": torch.from_numpy(np.stack([edges.row, edges.col], 1).astype(np.int64)),
            "edges.count": torch.from_numpy(edges.data),
            "blame.pair": torch.tensor([x[:2] for x in blamed], dtype=torch.int64).reshape(-1, 2),
            "blame.factor": torch.tensor([x[2] for x in blamed], dtype=torch.float64),
            "tried": torch.from_numpy(self.tried),
            "look_radius": torch.tensor(self.look_radius, dtype=torch.float64),
            "least_familiar": torch.tensor(self.least_familiar, dtype=torch.float64),
            "is_reversible": torch.tensor(self.is_reversible),
            "observation_low": torch.from_numpy(self.readings.low),
            "observation_scale": torch.from_numpy(self.readings.scale),
            "observation_period": torch.from_numpy(self.readings.period),
            "action_low": torch.from_numpy(self.actions.low),
            "action_high": torch.from_numpy(self.actions.high),
        }
        if self.memory is not None:
            memory = self.memory._asdict()
            state |= {f"memory.{name}": torch.from_numpy(value) for name, value in memory.items()}
        if self.contact is not None:
            state["contact.threshold"] = torch.from_numpy(self.contact.threshold)
            state["contact.side"] = torch.from_numpy(self.contact.side)
        if self.free_ways is not None and self.positions is not None:
            state["positions"] = torch.from_numpy(self.positions)
            state["free_ways.weight"] = torch.from_numpy(self.free_ways.weight)
            state["free_ways.still"] = torch.tensor(self.free_ways.still, dtype=torch.float64)
        save_checkpoint(Path(path), {"agent": self.config.to_json(), "seed": self.seed}, state)

    @classmethod
    def load(cls, path: str | Path) -> "Agent":
        """Read an agent that `save` wrote.

        Raises:
            ValueError: naming the file, if it is damaged or no agent of this version.
        """
        config, state = load_checkpoint(Path(path))
        try:
            agent = cls(AgentConfig.from_json(config["agent"]), int(config["seed"]))
            agent._restore(state)
        except (
            KeyError,
            TypeError,
            ValueError,
            RuntimeError,
            IndexError,
            ArithmeticError,
        ) as error:
            raise ValueError(f"{path} is no agent that this version can use: {error}") from None
        return agent

    def _restore(self, state: dict[str, Tensor]) -> None:
        config = self.config
        if "memory.node" in state:  # a file of before there was that number holds all steps
            state.setdefault("memory.settled", torch.zeros((), dtype=torch.int64))
        sizes = check_state(state, config)
        self.hmm = GridHMM.of_state(
            config.shape, config.radius, config.metric, config.boundary, _with_prefix(state, "hmm.")
        )
        ranges = (state[f"observation_{name}"].numpy() for name in Readings._fields)
        self.readings = Readings(*ranges)
        self.actions = Actions(state["action_low"].numpy(), state["action_high"].numpy())
        self.look_radius = float(state["look_radius"])
        self.edges = _sparse(state["edges.pair"], state["edges.count"], self.num_nodes)
        self.tried = state["tried"].numpy()
        if "statistics" in state:
            self.statistics = Statistics.zeros(self.hmm).from_vector(state["statistics"])
        if "counts.weight" in state:
            fields = ("weight", "first", "second")
            self.counts = repair.Counts(
                self.edges, *(state[f"counts.{name}"].numpy() for name in fields)
            )
        self.samples = Triplets(**_with_prefix(state, "samples."))
        self.least_familiar = float(state["least_familiar"])
        self.is_reversible = bool(state["is_reversible"])
        self.bank = make_bank(config.controller, self.num_nodes, sizes["D"], sizes["A"])
        self.bank.load_state_dict(_with_prefix(state, "bank."))
        memory = {name: t.numpy() for name, t in _with_prefix(state, "memory.").items()}
        self.memory = Memory(**memory) if memory else None
        if "free_ways.weight" in state:
            weight, still = state["free_ways.weight"].numpy(), float(state["free_ways.still"])
            self.free_ways, self.positions = FreeWays(weight, still), state["positions"].numpy()
            own = {name: t.numpy() for name, t in _with_prefix(state, "contact.").items()}
            self.contact = Contact(**own) if own else Contact.unknown(sizes["A"], sizes["D"])
        self._prepare_recognition()
        self._prepare_planning()
        pairs, factors = state["blame.pair"].tolist(), state["blame.factor"].tolist()
        self._blame_again([(i, j, factor) for (i, j), factor in zip(pairs, factors, strict=True)])


def _sparse(pair: Tensor, count: Tensor, num_nodes: int) -> csr_array:
    """Counts of pairs (E, 2) as a matrix (N, N)."""
    coordinates = (pair[:, 0].numpy(), pair[:, 1].numpy())
    return csr_array((count.numpy(), coordinates), shape=(num_nodes, num_nodes))


def make_bank(kind: str, num_nodes: int, obs_dim: int, action_dim: int) -> Bank:
    """An untrained bank of the named kind."""
    if kind == "mlp":
        return MLPBank(num_nodes, obs_dim, action_dim)
    if kind == "svr":
        # The paper names neither. Goals lie 4-8 steps outside a node's samples: narrower kernels
        # and softer fits answer with the bias there.
        return SVRBank(num_nodes, 2 * obs_dim, action_dim, bandwidth=1.0, cost=100.0)
    return RBFBank(num_nodes, obs_dim, action_dim)


def _with_prefix(state: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): t for name, t in state.items() if name.startswith(prefix)}
