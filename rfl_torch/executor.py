"""Acting until a goal node is reached (section 2.5, execution procedure).

The executor is the one object that keeps state between control steps. It needs no environment:
a robot's loop calls `act(observation)` once a step and looks at `status`.

    P(s)      belief          probability of every node
    s(t)      node            the node taken as the current state
    path(..)  path            planned nodes from the current one to the goal
    f_j       bank            asked for the controller of the next node on the path
"""

from collections import deque
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from rfl_torch import inference
from rfl_torch.explorer import Explorer
from rfl_torch.homing import Homing
from rfl_torch.innate import InnateController
from rfl_torch.looks import LOOK_STEPS
from rfl_torch.planner import cost_to_go, reachability_path, threshold_graph
from rfl_torch.search import LookSearch
from rfl_torch.senses import FEW, Sensors, apart, believed, sensible
from rfl_torch.steering import SteeringExecutor
from rfl_torch.trail import Trail

if TYPE_CHECKING:
    from rfl_torch.agent import Agent

Status = Literal["running", "reached", "gave_up"]

BLAME_LIMIT = 100.0
"""An edge costs at most so many times what the map says: costs must still add up in float64."""

STRANGE = 1.0
"""Radii of a look beyond which an observation is not what its node looks like."""

LOST = 3
"""Steps in a row that no node explains after which the robot takes itself for lost."""

FORGOTTEN = 0.01
"""Chance that between two tasks the robot was put at a place that looks the same."""

MOST_JUMPS = 3
"""Jumps of the belief in a task after which a robot goes back to where it can tell where it is."""

LONGEST_DOUBT = 60
"""Steps in a row that the map is followed while many readings don't fit: about a moved wall's
reach. A robot whose senses are wrong everywhere is lost after that."""

LONGEST_ASTRAY = 300
"""Steps in a row where it could tell where it is, none of which looks right, after which the senses
are taken for wrong and not the place. A robot in a room that no log knows, and that looks like one
that is known, must come back within them."""

SOME = 0.2
"""Share of the sights of the last LONGEST_DOUBT steps that must be familiar where arrival is said.
To a robot whose senses are wrong everywhere, one in a hundred looks familiar, by chance."""

LONGEST_SEARCH = 2000
"""Steps in a row without a familiar sight after which a goal is given up."""

CONFIRMED = 10
"""Familiar steps in a row without a jump after which a belief that jumped may be trusted: a wall
that moved makes one room look like another for some steps."""

KICK = 20
"""Innate actions after an aborted or a null plan, or the next plan fails where this one did. Three
leave the robot stuck, forty take it off the map."""


class PathExecutor:
    """The paper's procedure: recognise along the planned path, abort below a threshold, re-plan."""

    def __init__(self, agent: "Agent", goals: NDArray[np.int64], seed: int) -> None:
        self._agent, self._config = agent, agent.config.executor
        self.goal = int(goals[0])
        self._graph = threshold_graph(
            agent.hmm.transition_matrix().detach().numpy(), self._config.epsilon
        )
        self._chain = agent.chain
        self._window: deque[NDArray[np.float64]] = deque(maxlen=self._config.window)
        self._innate = InnateController(*agent.actions, seed=seed)
        self._plans = self._stalled = self._babble_left = 0
        self.status: Status = "running"
        self.path: list[int] = []
        self.node = -1
        self.belief = np.full(agent.num_nodes, 1.0 / agent.num_nodes)
        self.recovering = False
        self.is_familiar = True
        self.reason = ""

    def watch(
        self, observation: NDArray[np.float32], action: NDArray[np.float32] | None = None
    ) -> None:
        """Follow where the robot is while someone else chooses its actions; see BeliefExecutor."""
        normal = sensible(self._agent.readings.normalize(observation))
        self._window.append(normal)
        self._recognize()
        self.is_familiar = self._agent.strangeness(normal, self.node) <= STRANGE

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action of this control step, (A,), inside the action space."""
        self.watch(observation)
        if self.status == "running" and not self.path and self._babble_left == 0:
            self._plan()
        if self.status != "running":
            return self._agent.actions.rest
        if not self.path:
            self._babble_left -= 1
            return self._innate.act()
        following = self.path[1] if len(self.path) > 1 else self.goal
        return self._agent.control(self._window[-1], following)

    def _recognize(self) -> None:
        """Steps 1-3: Viterbi scores over the window, then the best node of the remaining path."""
        scores = inference.viterbi_scores(self._chain, np.stack(self._window))
        self.belief = np.exp(scores - scores.max())
        self.belief /= self.belief.sum()
        if not self.path:
            self.node = int(self.belief.argmax())
            return
        best = int(self.belief[self.path].argmax())
        self.node = self.path[best]
        self.path = self.path[best:]
        self._stalled = 0 if best > 0 else self._stalled + 1
        is_lost = self.belief[self.node] < self._config.abort_probability
        if is_lost or self._stalled >= self._config.window:
            self.path, self.node = [], int(self.belief.argmax())
            self._babble_left = KICK
        elif self.node == self.goal:
            self.status = "reached"

    def _plan(self) -> None:
        """Plan anew from the likeliest node."""
        self._plans += 1
        if self._plans > self._config.max_plans:
            self.status = "gave_up"
            self.reason = f"{self._config.max_plans} plans were aborted or found no way"
            return
        self._stalled = 0
        self.path = reachability_path(self._graph, self.node, self.goal)
        self.recovering = not self.path
        if self.recovering:
            self._babble_left = KICK
        elif self.node == self.goal:
            self.status = "reached"


class BeliefExecutor:
    """Filter over all nodes, head for one next node at a time, and learn where the map misleads.

    A next node is kept until it or a cheaper one is recognised: choosing anew at every step, two
    neighbours that each name the other would hold the robot between them. A next node that is not
    reached in time puts its edge's cost up, for this and for later tasks of the agent, and the way
    is planned anew.
    """

    def __init__(
        self,
        agent: "Agent",
        goals: NDArray[np.int64],
        seed: int,
        homing: Homing | None = None,
    ) -> None:
        self._agent, self._config = agent, agent.config.executor
        self._goals, self._homing = goals, homing
        self.goal = int(goals[0])
        self._seed = seed
        self._search = LookSearch(*agent.actions, agent.look_radius, seed)
        self._explorer: Explorer | None = None
        self._trail: Trail | None = None
        self._last_place: tuple[NDArray[np.float64], NDArray[np.float64], int] | None = None
        self._refuted = 0
        self._is_exploring = self._is_led = False
        self._cut_off = 0
        self.is_familiar = True
        self._recent: deque[bool] = deque(maxlen=LONGEST_DOUBT)
        self._unfamiliar = self._weak = self._known = self._plain = 0
        self._was_known = False
        self._sensors = Sensors(agent.hmm.obs_dim)
        self._reckoning = agent.reckoning
        self._did: NDArray[np.float64] | None = None
        self._where = np.empty((0, 0)) if agent.positions is None else agent.positions
        self._cost = agent.graph  # shared: what one task finds out, the next one knows
        # A goal that is a sight is any place that looks like it.
        self._can_be_unsure = homing is None and len(agent.telling) < agent.num_nodes
        self._knows_where = not self._can_be_unsure
        self._astray = self._jumps = 0
        self._confirmed = CONFIRMED
        self._landed, self._beyond = -1, np.empty(0, np.int64)
        self._is_proving = False
        self._from = -1
        self._steps_left = 0
        self._failures = 0
        self._babble_left = 0
        self.status: Status = "running"
        self.node = -1
        self._head_for(goals)
        self.belief = np.full(agent.num_nodes, 1.0 / agent.num_nodes)
        self.recovering = False
        self.reason = ""

    def _head_for(self, targets: NDArray[np.int64]) -> None:
        """Plan to the goals, or to where the robot can tell which of several places it is at."""
        self._targets = targets
        self._cost_to_go = cost_to_go(self._cost, targets)
        self._distance = self._cost_to_go  # as the map has it, whatever is blamed later
        self._best = np.inf if self.node < 0 else self._distance[self.node]
        self._next = -1

    @property
    def path(self) -> list[int]:
        """Planned nodes from the likeliest one to the goal; [] while there is no way."""
        if self.node < 0 or not np.isfinite(self._cost_to_go[self.node]):
            return []
        path = [self.node]
        while path[-1] not in self._targets:
            path.append(self._cheapest_neighbor(path[-1]))
        return path

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action of this control step, (A,), inside the action space."""
        self._is_led = False
        action = self._decide(observation)
        self._note_action(action)
        if self._explorer is not None and self._did is not None:
            working = self._sensors.working(self._sensed)
            if not self._is_led:
                self._explorer.watch(working, self._did)
            if self._trail is not None:
                self._look_back(self._explorer, self._trail, working)
        return action

    def _look_back(self, explorer: Explorer, trail: Trail, normal: NDArray[np.float64]) -> None:
        """Take note of whether what was seen on the way here speaks against the belief.

        While the map is followed from node to node it says how far the robot came: a slide along a
        wall can't be counted.

        Args:
            explorer: counts the steps.
            trail: keeps what is seen.
            normal: what is seen now, (D,).
        """
        place = counted, where, node = explorer.position, self._where[self.node], self.node
        last_counted, last_where, last_node = self._last_place or place
        follows = not self._is_led and self.is_familiar and self._agent.is_near(last_node, node)
        trail.note(where - last_where if follows else counted - last_counted, normal)
        self._last_place = place
        is_wrong = trail.speaks_against(node, trail.position - where)
        self._refuted = self._refuted + 1 if is_wrong else 0
        if self._refuted > LONGEST_ASTRAY:
            trail.clear()

    def _note_action(self, action: NDArray[np.float32] | None) -> None:
        """Remember what was done, in full actions."""
        self._did = None if action is None else self._agent.actions.to_move(action)

    def _decide(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        self._sensed = sensible(self._agent.readings.normalize(observation))
        normal = self._recognize(self._sensed)
        is_lost = self._unfamiliar >= LOST or self._astray > 0 or self._is_exploring
        is_lost = is_lost or self._refuted > 0
        seems_there = self.belief[self._goals].sum() > 0.5 and self._knows_where
        is_homing = self._homing is not None and self._homing.has_begun
        if self.status == "running" and (is_homing or (seems_there and self._trusts_sight())):
            if self._homing is None:
                self.status = "reached"
            elif (action := self._go_home(self._homing)) is not None:
                return action
        if is_lost and self.status == "running":
            self.recovering = True
            self._next = -1
            if self._unfamiliar <= LONGEST_SEARCH:
                return self._search_map(normal)
            self.status = "gave_up"
            self.reason = f"no node looks like anything seen in the last {LONGEST_SEARCH} steps"
        if self.status == "running":
            targets = self._goals if self._knows_where else self._agent.telling
            self._is_proving = self._landed >= 0 and (self._is_proving or seems_there)
            if self._is_proving:
                targets = self._beyond
            if targets is not self._targets:
                self._head_for(targets)
            if self._is_proving and not np.isfinite(self._cost_to_go[self.node]):
                self._landed = -1  # no way leads to what could prove it
            is_cut_off = not np.isfinite(self._cost_to_go[self.node])
            if self._landed < 0 and not is_cut_off:
                self._cut_off = 0
            if (is_cut_off or self._cut_off) and self._agent.free_ways is not None:
                return self._look_for_a_way()
            self._choose_next()
        if self.status != "running":
            return self._agent.actions.rest
        self.recovering = self._babble_left > 0
        if self.recovering:
            self._babble_left -= 1
            return self._search.act(normal)
        if self._reckoning is None:
            return self._agent.control(normal, self._next)
        where = self._where[self.node]
        if 2 * self._steps_left < self._config.patience and self._next != self.node:
            # A node of few steps taught its controller little: beside it, it may go to and fro.
            return self._agent.actions.of_move(self._reckoning.positions[self._next] - where)
        return self._agent.control_by_reckoning(normal, self._next, self.node, where)

    def _search_map(self, normal: NDArray[np.float64]) -> NDArray[np.float32]:
        """Look for what is known."""
        if self._agent.free_ways is None:
            return self._search.act(normal)
        if not self._is_exploring and self._trail is not None and not self._cut_off:
            # It was led by what it believed, so what it took for explored may be elsewhere.
            self._explorer, self._last_place = self._agent.explorer(self._seed), None
        self._is_exploring = True
        return self._explore()

    def _look_for_a_way(self) -> NDArray[np.float32]:
        """Explore on from a part of the map from which none is known, until another is proved."""
        self.recovering, self._next = True, -1
        self._cut_off += 1
        if self._cut_off > LONGEST_SEARCH:
            self.status = "gave_up"
            self.reason = f"no way is known from here, nor found in {LONGEST_SEARCH} steps"
            return self._agent.actions.rest
        positions = self._agent.positions
        if positions is None or self._cut_off not in (1, CONFIRMED):
            return self._explore()
        return self._explore(positions - positions[self.node])

    def _explore(self, known: NDArray[np.float64] | None = None) -> NDArray[np.float32]:
        """Go to where nothing was seen yet; places (N, A), counted from here, are known."""
        self._set_out()
        assert self._explorer is not None
        if known is not None:
            self._explorer.know(known)
        self._is_led = True
        return self._explorer.act(self._sensors.working(self._sensed))

    def _set_out(self) -> None:
        """Count the steps from here on, and keep what is seen."""
        agent = self._agent
        if self._explorer is None and agent.free_ways is not None and agent.positions is not None:
            self._explorer = agent.explorer(self._seed)
            self._trail = Trail(agent.positions, agent._mean, agent.edges, agent.look_radius)
            self._last_place = None

    def _trusts_sight(self) -> bool:
        """Whether this sight is familiar, not after many strange ones, and a jump was proved."""
        if self._confirmed < CONFIRMED or self._landed >= 0 or self._refuted:
            return False
        return self.is_familiar and sum(self._recent) >= SOME * len(self._recent)

    def _ask_whether(self, before: int) -> None:
        """Take note of whether a belief that jumped, or that a lost robot came by, is proved.

        It is by a familiar sight beyond the surroundings of where it landed: what only looks right
        looks right for as long as the robot stands there, and doesn't go on as the map says. At its
        goal the robot goes there and comes back.

        Args:
            before: node of the last step; -1 if there is none.
        """
        agent = self._agent
        has_jumped = before >= 0 and not agent.is_near(before, self.node)
        if has_jumped:
            self._confirmed = 0
        elif self._confirmed < CONFIRMED:
            self._confirmed = self._confirmed + 1 if self.is_familiar else 0
        if has_jumped or self._unfamiliar >= LOST:
            if self._landed != self.node:
                self._landed = self.node
                self._beyond = np.flatnonzero(~agent.near[[self.node]].toarray()[0])
        elif self._landed >= 0 and self.is_familiar and not agent.is_near(self._landed, self.node):
            self._landed = -1
        if not self._beyond.size:  # the map has nothing that could prove it
            self._landed = -1

    def _ask_where(self, before: int, is_plain: bool) -> None:
        """Take note of whether the robot knows which of the places that look like this it is at.

        It does once it was where no other place looks the same, and as long as it goes on from node
        to node: a belief that jumps, jumps to what looks right. Until then no place is the goal.

        Args:
            before: node of the last step; -1 if there is none.
            is_plain: what is seen is as likely as what the log saw at the node.
        """
        if not self._can_be_unsure:
            return
        is_telling = self.node in self._agent.telling
        if is_telling and (is_plain or self._astray > LONGEST_ASTRAY):
            self._knows_where = True
        elif self._knows_where and before >= 0 and not self._agent.is_near(before, self.node):
            self._jumps += 1
            self._knows_where = self._jumps > MOST_JUMPS
        # What looks wrong there is off the map, if it isn't the senses that are wrong.
        self._astray = self._astray + 1 if is_telling and not self._knows_where else 0

    def _go_home(self, homing: Homing) -> NDArray[np.float32] | None:
        """The action by which the robot heads for its goal's own sight, (A,), if it goes on.

        It is not left to doubt which readings count: what is unlike its node may be like the goal.
        """
        action = homing.act(self._sensors.working(self._sensed), self.node)
        if homing.is_there:
            self.status = "reached"
        elif not len(homing.nodes):
            self.status = "gave_up"
            self.reason = "no place that is like the goal looks just like it from near"
        self._goals = homing.nodes
        return action

    def _recognize(self, normal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Filter: push the belief over the edges, allow a teleport, weigh by the emission.

        Returns the readings that are believed; a frame without any leaves what was known.
        """
        sensed, before = normal, self.node
        normal = self._sensors.working(sensed)
        if before < 0:
            self.belief = self._first_belief(normal)
        teleport = self._config.teleport
        if self._reckoning is None or self._did is None:
            pushed = self._agent.transition_in @ self.belief
        else:
            pushed, self._where = self._reckoning.push(self.belief, self._where, self._did)
        predicted = (1 - teleport) * pushed + teleport / len(pushed)
        log_emission = seen = self._agent.log_emission(normal)
        if not np.isnan(normal).all():
            normal, log_emission = self._doubt(normal, log_emission, predicted)
        log_belief = np.log(predicted) + log_emission
        belief = np.exp(log_belief - log_belief.max())
        self.belief = belief / belief.sum()
        self._agent.last_seen = normal, self.belief
        self.node = int(self.belief.argmax())
        is_plain = bool(seen[self.node] >= self._agent.least_familiar)
        self._known = self._known + 1 if self.is_familiar else 0
        self._plain = self._plain + 1 if is_plain else 0
        self._was_known |= self._known >= CONFIRMED
        is_known = self._plain >= CONFIRMED or (self._knows_where and self._known >= CONFIRMED)
        if is_known and not self._refuted:
            self._is_exploring = False
        # What is wrong where it asks which place this is may be the place, not the sensor.
        is_asking = not self._knows_where and self.node in self._agent.telling
        if self.is_familiar and not is_asking:
            self._sensors.note(sensed, self._agent._mean[self.node], self._agent.look_radius)
        self._ask_whether(before)
        self._ask_where(before, is_plain)
        return normal

    def _doubt(
        self,
        normal: NDArray[np.float64],
        log_emission: NDArray[np.float64],
        predicted: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Leave out readings that don't fit, and take note of how familiar the rest looks."""
        agent = self._agent
        doubted = 0.0
        self.is_familiar = agent.strangeness(normal, int(log_emission.argmax())) <= STRANGE
        if not self.is_familiar:
            normal, doubted = believed(normal, agent._mean, predicted, agent.look_radius)
            if doubted < 1.0:
                log_emission = agent.log_emission(normal)
                self.is_familiar = doubted <= FEW
        self._recent.append(self.is_familiar)
        if self.is_familiar:
            self._unfamiliar = self._weak = 0
        elif doubted < 1.0 and self._weak < LONGEST_DOUBT and self._was_known:
            self._unfamiliar, self._weak = 0, self._weak + 1
        else:
            self._unfamiliar += 1
            self._was_known = self._was_known and self._unfamiliar < LOST
        return normal, log_emission

    def _first_belief(self, normal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Uniform, or what the last task left, if the robot still sees what it saw then.

        Where places look the same, a robot that forgot between two tasks which one it is at could
        only guess.
        """
        uniform = np.full(self._agent.num_nodes, 1.0 / self._agent.num_nodes)
        seen, belief = self._agent.last_seen or (normal, uniform[:0])
        is_same = apart(seen, normal) <= self._agent.look_radius / LOOK_STEPS
        if not is_same or len(belief) != len(uniform):
            self._set_out()
            return uniform
        self._knows_where = self._was_known = True
        return (1 - FORGOTTEN) * belief + FORGOTTEN * uniform

    def watch(
        self, observation: NDArray[np.float32], action: NDArray[np.float32] | None = None
    ) -> None:
        """Follow where the robot is while someone else chooses its actions.

        Args:
            observation: what is seen now, (D,).
            action: what was done since the last observation, (A,); None if that isn't known.
        """
        self._explorer, self._trail, self._refuted = None, None, 0  # they count its own steps
        self._note_action(action)
        self._recognize(sensible(self._agent.readings.normalize(observation)))

    def _cheapest_neighbor(self, node: int) -> int:
        """The neighbour over which the goal is cheapest; a node without any is its own."""
        row = slice(self._cost.indptr[node], self._cost.indptr[node + 1])
        neighbor = self._cost.indices[row]
        if not len(neighbor):
            return node
        return int(neighbor[(self._cost.data[row] + self._cost_to_go[neighbor]).argmin()])

    def _choose_next(self) -> None:
        """Keep the next node while it is worth it; else plan from where the robot is."""
        if self._babble_left > 0:
            return
        if self._distance[self.node] < self._best:
            self._best, self._failures = self._distance[self.node], 0
        if self._next == self.node != self._from:
            self._scale_edge(1 / self._config.blame)
        is_pursued = self._next >= 0 and self._next != self.node
        if is_pursued and self._cost_to_go[self.node] > self._cost_to_go[self._next]:
            self._steps_left -= 1
            if self._steps_left > 0:
                return
            self._blame()
            if self.status != "running" or self._babble_left > 0:
                return
        if not np.isfinite(self._cost_to_go[self.node]):
            self._fail("no way is known from here")
            return
        is_nearly_there = self.node in self._targets and self.is_familiar
        if is_nearly_there and self._agent.is_reversible:  # else no node can be stayed at
            if self._next != self.node:
                self._steps_left = self._config.patience
            self._from = self._next = self.node
            self._steps_left -= 1
            if self._steps_left >= 0:
                return
        self._from, self._next = self.node, self._cheapest_neighbor(self.node)
        # No action leads from a node to its double: take it as done and head for what follows.
        while self._agent.alike[self._from, self._next] and self._next not in self._targets:
            self._from, self._next = self._next, self._cheapest_neighbor(self._next)
        self._steps_left = self._config.patience

    def _blame(self) -> None:
        """Raise the cost of the edge that led nowhere, plan anew, count the failure."""
        self._scale_edge(self._config.blame)
        self._fail("no closer to the goal")

    def _scale_edge(self, factor: float) -> None:
        """Multiply the cost of the pursued edge, between the map's own and BLAME_LIMIT times it."""
        row = slice(self._cost.indptr[self._from], self._cost.indptr[self._from + 1])
        if row.start == row.stop:
            return
        edge = row.start + int((self._cost.indices[row] == self._next).argmax())
        base = self._agent.map_cost[edge]
        cost = np.clip(self._cost.data[edge] * factor, base, BLAME_LIMIT * base)
        if cost != self._cost.data[edge]:
            self._cost.data[edge] = cost
            self._cost_to_go = cost_to_go(self._cost, self._targets)

    def _fail(self, reason: str) -> None:
        """Count a failure; the more in a row, the longer the search takes over."""
        self._failures += 1
        self._next = -1
        if self._failures > self._config.max_plans:
            self.status = "gave_up"
            self.reason = f"{reason} after {self._failures - 1} plans"
        elif self._failures > 1:
            self._babble_left = min(2 * self._failures, 20)


Executor = PathExecutor | BeliefExecutor | SteeringExecutor


def make_executor(
    agent: "Agent", goals: NDArray[np.int64], seed: int, homing: Homing | None = None
) -> Executor:
    """The executor that the agent's configuration asks for.

    Args:
        agent: to execute.
        goals: nodes, any of which will do.
        seed: of the innate actions.
        homing: what goes on from there, if the goal is a sight.
    """
    if agent.config.executor.recognition == "path":
        return PathExecutor(agent, goals, seed)
    if agent.motion is not None:
        return SteeringExecutor(agent, agent.motion, goals, seed)
    return BeliefExecutor(agent, goals, seed, homing)
