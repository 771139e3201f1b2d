"""Acting where nodes can't be waited in: choose what leads to the goal soonest (section 2.5).

    path(..)  path            nodes that the present choices would lead through
    P(s)      belief          of the map; it fills in missing readings and is there to be watched
    f_j       motion          local models of what each choice leads to, see `motion`

The plan is the expected time to the goal from every landmark, the least over the choices; it takes
the place of the shortest path. It is followed from where the last two observations put the robot,
anew at every step. So there is no plan to fall off, and nothing is waited for.
"""

from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from rfl_torch import inference
from rfl_torch.motion import Array, Motion, Prospect

if TYPE_CHECKING:
    from rfl_torch.agent import Agent

NEVER = 2000.0
"""Steps to a goal that no plan reaches."""

STRAY_COST = 3.0
"""A choice that ends `stray` units off the landmarks costs so many times its steps more."""

STALLED = 60.0
"""Steps without getting closer to the goal, on top of half of those that are left, that end in a
kick."""

WAIT = 5
"""Choices in a row without getting closer that end a planned path."""

CLOSER = 0.02
"""Share of the goal's reach by which a choice must lead closer, for the goal to be improved on."""

KICK = (5, 40)
"""Shortest and longest kick: one choice, held for that many steps."""

FORGETTING = 0.99
"""Weight of the next step against this one while holding: it looks 100 steps ahead."""

HOLD_DEPTH = 2
"""Choices in a row that are weighed while holding: balancing takes more care than arriving."""

PRECISION = 0.05
"""Change of a landmark's steps that is too small to go on planning for."""

HOLD_SPREAD = 0.5
"""While holding, observations so many spreads of the log's away from the goal's count in full."""


class Goal:
    """One or more situations to come to (G, 2 E), and how near is near enough.

    An observation is near within a landmark spacing, or half of what the goal moves in a step:
    steps may end no nearer. A change of observation is near within a spacing. Where observations
    show how things go, landmarks lie closer than what is seen at one node: near is then within the
    node's width, and any change will do.

    Args:
        motion: of the log.
        center: situations (G, 2 E).
        width: of each one's node, (G,), see `Agent.node_width`.
    """

    def __init__(self, motion: Motion, center: Array, width: Array) -> None:
        self.obs_dim, self.scale, self.center = motion.obs_dim, motion.scale, center
        if motion.is_shown:
            length = width * np.sqrt(self.obs_dim) / self.scale[0]
        else:
            move = np.linalg.norm(self.center[:, self.obs_dim :], axis=1) / self.scale[0]
            length = np.maximum(motion.spacing, move / 2)
        self.reach = np.stack([length, np.full(len(center), motion.spacing)], 1)

    def distance(self, situation: Array) -> Array:
        """Distance (...) from situations (..., 2 E) to the nearest center; up to 1 is near."""
        best = np.full(situation.shape[:-1], np.inf)
        for center, reach in zip(self.center, self.reach, strict=True):
            offset = (situation - center) / self.scale
            parts = (offset[..., : self.obs_dim], offset[..., self.obs_dim :])
            length = [
                np.linalg.norm(part, axis=-1) / r for part, r in zip(parts, reach, strict=True)
            ]
            best = np.minimum(best, np.maximum(*length))
        return best

    def apparent_distance(self, situation: Array) -> Array:
        """Distance of the observations alone, in spreads of the log's."""
        offset = (
            situation[..., None, : self.obs_dim] - self.center[:, : self.obs_dim]
        ) / self.scale[0]
        return np.asarray(np.linalg.norm(offset, axis=-1).min(-1))


def time_to_goal(motion: Motion, goal: Goal) -> Array:
    """Expected steps from each landmark to the goal under the best choices, (L,), at most NEVER.

    Value iteration. A choice that passes the goal ends there.
    """
    cost, is_open = _cost_to_pass(motion, goal, motion.prospect)
    time = np.full(len(motion.landmark), NEVER)
    while True:
        ahead = np.stack([leads_to @ time for leads_to in motion.leads_to], 1)
        better = np.minimum((cost + is_open * ahead).min(1), NEVER)
        is_settled = np.abs(better - time).max() < PRECISION
        time = better
        if is_settled:
            return time


def _cost_to_pass(
    motion: Motion, goal: Goal, prospect: Prospect
) -> tuple[Array, NDArray[np.bool_]]:
    """Steps (B, C) that the choices take, to the goal if they pass it; and which don't, (B, C)."""
    passes = (goal.distance(prospect.trace) <= 1.0) & prospect.is_held
    is_open = np.logical_not(passes.any(-1))
    strayed = prospect.num_steps * (1.0 + STRAY_COST * motion.stray(prospect.end))
    return np.where(is_open, strayed, passes.argmax(-1) + 1.0), is_open


def regret_at_goal(motion: Motion, goal: Goal) -> Array:
    """Least discounted sum of how far off the goal's observation all later ones are, (L,)."""
    cost, discount = _cost_of_absence(goal, motion.prospect)
    regret = np.zeros(len(motion.landmark))
    while True:
        ahead = np.stack([leads_to @ regret for leads_to in motion.leads_to], 1)
        more = (cost + discount * ahead).min(1)
        is_settled = np.abs(more - regret).max() < PRECISION
        regret = more
        if is_settled:
            return regret


def _cost_of_absence(goal: Goal, prospect: Prospect) -> tuple[Array, Array]:
    """How far off the choices are while held, summed, and the discount of what follows, (B, C)."""
    away = np.minimum(goal.apparent_distance(prospect.trace) / HOLD_SPREAD, 1.0) ** 2
    discount: Array = np.power(FORGETTING, prospect.num_steps)
    return (away * prospect.is_held).sum(-1), discount


class SteeringExecutor:
    """Look a choice ahead from the present situation, and take the one that is best by the plan.

    It has arrived where it is nearest to the goal. From then on `act` stays as well as it can: it
    keeps what is seen close to what is seen at the goal.
    """

    def __init__(self, agent: "Agent", motion: Motion, goals: NDArray[np.int64], seed: int) -> None:
        self._agent, self._motion = agent, motion
        self._mean = agent.hmm.emission_mean.detach().numpy()
        self.goal = int(goals[0])
        center = np.stack([self._center(node) for node in goals])
        self._target = Goal(motion, center, agent.node_width(goals))
        self._time = time_to_goal(motion, self._target)
        self._regret: Array | None = None
        self._filter = inference.start_filter(agent.chain)
        self._rng = np.random.default_rng(seed)
        self._before: Array | None = None
        self._situation: Array | None = None
        self._last = int(self._rng.integers(len(motion.choices)))
        self._kicks = self._kick_left = self._stalled = self._held_left = 0
        self._least = np.inf
        self.status: Literal["running", "reached", "gave_up"] = "running"
        self.node = -1
        self.belief = np.full(agent.num_nodes, 1.0 / agent.num_nodes)
        self.recovering = False
        self.is_familiar = True
        self.reason = ""

    @property
    def path(self) -> list[int]:
        """Nodes that the plan leads through, from the present one to the goal; [] if to none."""
        if self._situation is None:
            return []
        situation, path, least, waited = self._situation, [self.node], NEVER, 0
        while waited < WAIT:
            prospect, cost = self._weigh(situation)
            choice = cost.argmin()
            course = prospect.trace[0, choice, : prospect.num_steps[0, choice]]
            is_near = self._target.distance(course) <= 1.0
            if is_near.any():
                course = course[: is_near.argmax()]
            path += self._motion.nearest_node(course).tolist()
            if is_near.any():
                path.append(self.goal)
                return [node for i, node in enumerate(path) if i == 0 or node != path[i - 1]]
            waited = 0 if cost[choice] < least - 1.0 else waited + 1
            situation, least = course[-1], min(least, cost[choice])
        return []

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action of this control step, (A,), inside the action space."""
        self.watch(observation)
        if self._situation is not None:  # one observation tells nothing of how things go
            if self.status == "running":
                self._last = self._pursue(self._situation)
            if self.status == "reached":
                self._last = self._stay(self._situation)
        if self.status == "gave_up":
            return self._agent.actions.rest
        low, high = self._agent.actions
        action = low + self._motion.choices[self._last] * (high - low)
        return np.clip(action, low, high).astype(np.float32)

    def watch(
        self, observation: NDArray[np.float32], action: NDArray[np.float32] | None = None
    ) -> None:
        """Follow where the robot is while someone else chooses its actions; see BeliefExecutor."""
        normal = self._agent.readings.normalize(observation)
        now = self._recognize(normal)
        self.is_familiar = self._agent.strangeness(now, self.node) <= 1.0
        before, self._before = self._before, now
        if before is not None:
            self._situation = np.concatenate([now, now - before])

    def _center(self, node: int) -> Array:
        """Where a node is; one that the log only starts or ends in is taken to be at rest."""
        center = None if self._motion.is_shown else self._motion.center(node)
        rest = np.concatenate([self._mean[node], np.zeros_like(self._mean[node])])
        return rest if center is None else center

    def _recognize(self, normal: Array) -> Array:
        """Filter the belief; return the observation with what it expects of missing readings."""
        teleport = self._agent.config.executor.teleport
        belief, _ = inference.filter_step(self._agent.chain, self._filter, normal, teleport)
        self.belief = belief.astype(np.float64)
        self.node = int(belief.argmax())
        return np.where(np.isnan(normal), self.belief @ self._mean, normal)

    def _weigh(self, situation: Array) -> tuple[Prospect, Array]:
        """Look ahead from a situation (2 E,); the expected steps to the goal by each choice."""
        prospect = self._motion.look_ahead(situation[None])
        cost, is_open = _cost_to_pass(self._motion, self._target, prospect)
        near, weight = self._motion.interpolate(prospect.end[0])
        return prospect, cost[0] + is_open[0] * (weight * self._time[near]).sum(1)

    def _pursue(self, situation: Array) -> int:
        """The choice to take; notes if the goal is reached, or out of reach."""
        prospect, cost = self._weigh(situation)
        best = int(cost.argmin())
        self.recovering = self._kick_left > 0
        distance = self._target.distance(situation)
        if distance <= 1.0:
            ahead = np.where(prospect.is_held, self._target.distance(prospect.trace), np.inf)[0]
            best = int(ahead.min(1).argmin())
            if ahead[best].min() > distance - CLOSER:
                self.status = "reached"
            return best
        if self.recovering:
            self._kick_left -= 1
            return self._last
        self._correct(situation, cost[best])
        self._stalled += 1
        if cost[best] < self._least - 1.0:
            self._least, self._stalled = cost[best], 0
        if self._stalled > STALLED + self._least / 2:
            return self._kick()
        self._held_left -= 1
        if self._held_left > 0 and cost[best] > cost[self._last] - self._held_left:
            return self._last
        self._held_left = int(prospect.num_steps[0, best])
        return best

    def _correct(self, situation: Array, cost: float) -> None:
        """Raise the plan here to what the best choice costs: between landmarks it may be less.

        So a place that only looks good, for lying between good ones, fills up and is left.
        """
        near, weight = self._motion.interpolate(situation[None])
        excess = cost - float(weight[0] @ self._time[near[0]])
        if excess > 0:
            self._time[near[0]] += excess * weight[0] / float(weight[0] @ weight[0])

    def _kick(self) -> int:
        """A choice at random, to be held for a while: where the plan stands still it misleads."""
        self._kicks += 1
        self._kick_left = int(self._rng.integers(*KICK))
        self._least, self._stalled, self._held_left = np.inf, 0, 0
        if self._kicks > self._agent.config.executor.max_plans:
            self.status = "gave_up"
            self.reason = f"no closer to the goal after {self._kicks - 1} kicks"
        return int(self._rng.integers(len(self._motion.choices)))

    def _stay(self, situation: Array) -> int:
        """The choice that keeps what is seen close to the goal's, HOLD_DEPTH choices ahead."""
        if self._regret is None:
            self._regret = regret_at_goal(self._motion, self._target)
        num, first = len(self._motion.choices), np.arange(1)
        ends = situation[None]
        total, discount = np.zeros(1), np.ones(1)
        for depth in range(HOLD_DEPTH):
            prospect = self._motion.look_ahead(ends)
            cost, factor = _cost_of_absence(self._target, prospect)
            total = (total[:, None] + discount[:, None] * cost).ravel()
            discount = (discount[:, None] * factor).ravel()
            first = np.arange(num) if depth == 0 else np.repeat(first, num)
            ends = prospect.end.reshape(len(total), -1)
        near, weight = self._motion.interpolate(ends)
        total += discount * (weight * self._regret[near]).sum(1)
        return int(first[total.argmin()])
