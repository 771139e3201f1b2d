"""The short definition of inference in a sparse HMM, that the compiled engine is compared with.

Plain log-space, one step after another, on any device. `inference` does the same work some
hundred times faster; here every line can be held against its equation.

    pi_i          chain.log_initial       (N,)
    a_ij          chain.log_transition    (N, K), edge k of node i leads to chain.successor[i, k]
    b_j(o_t)      emission_log_prob       (T, N), eq. 1
    alpha_t(i)    forward                 eqs. 2, 3; log p(o_1..t, node i at t)
    beta_t(i)     backward                eqs. 4, 5; log p(o_t+1..T | node i at t)
    L             log_likelihood          eq. 6
    gamma_t(i)    smoothed                alpha beta / exp L, of eqs. 7-10
    sum_t xi_t    expected_counts.edge    numerator of eq. 8
    delta, s(t)   most_likely_path        section 2.3, as maxima of log-probabilities
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor


class LogChain(NamedTuple):
    """A sparse Markov chain in natural logs; where `mask` is False there is no edge."""

    log_initial: Tensor
    log_transition: Tensor
    successor: Tensor
    mask: Tensor

    def flow(self, log_source: Tensor) -> Tensor:
        """What each edge carries, log_source(i) + log a_ij, (N, K)."""
        return (log_source[:, None] + self.log_transition).masked_fill(~self.mask, -torch.inf)


class ExpectedCounts(NamedTuple):
    """Expected visits: of the first node and of all steps (N,), of every edge (N, K)."""

    initial: Tensor
    node: Tensor
    edge: Tensor


def emission_log_prob(observations: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    """Log-densities of diagonal Gaussians (eq. 1), (T, N); a NaN reading is marginalised.

    Args:
        observations: (T, D).
        mean: (N, D).
        scale: standard deviations, (N, D).
    """
    distance = (observations[:, None] - mean) / scale  # (T, N, D)
    log_prob = -0.5 * distance**2 - scale.log() - 0.5 * math.log(2 * math.pi)
    return torch.where(observations[:, None].isnan(), 0.0, log_prob).sum(-1)


def forward(chain: LogChain, emission_log_prob: Tensor) -> Tensor:
    """Run log alpha_t(i) ahead, (T, N) (eqs. 2, 3)."""
    rows = [chain.log_initial + emission_log_prob[0]]
    for log_b in emission_log_prob[1:]:
        rows.append(_sum_into_target(chain, chain.flow(rows[-1])) + log_b)
    return torch.stack(rows)


def _sum_into_target(chain: LogChain, flow: Tensor) -> Tensor:
    """Logarithm of the sum of exp(flow) over the edges that enter each node, (N,)."""
    target, flow = chain.successor.flatten(), flow.flatten()
    largest = torch.full_like(chain.log_initial, -torch.inf)
    largest = largest.scatter_reduce(0, target, flow.detach(), "amax")
    largest = torch.where(largest.isfinite(), largest, 0.0)  # else -inf - -inf is NaN
    total = torch.zeros_like(largest).index_add(0, target, (flow - largest[target]).exp())
    return total.log() + largest


def backward(chain: LogChain, emission_log_prob: Tensor) -> Tensor:
    """Run log beta_t(i) back, (T, N) (eqs. 4, 5)."""
    rows = [torch.zeros_like(chain.log_initial)]
    for log_b in emission_log_prob[1:].flip(0):
        onward = (log_b + rows[-1])[chain.successor]  # (N, K)
        rows.append((chain.flow(torch.zeros_like(log_b)) + onward).logsumexp(1))
    return torch.stack(rows[::-1])


def log_likelihood(chain: LogChain, emission_log_prob: Tensor) -> Tensor:
    """Natural log of the observations' density, () [nat] (eq. 6)."""
    return forward(chain, emission_log_prob)[-1].logsumexp(0)


def filtered(chain: LogChain, emission_log_prob: Tensor) -> Tensor:
    """p(node at t | observations up to t), (T, N)."""
    return forward(chain, emission_log_prob).softmax(1)


def smoothed(chain: LogChain, emission_log_prob: Tensor) -> Tensor:
    """p(node at t | all observations), (T, N)."""
    return (forward(chain, emission_log_prob) + backward(chain, emission_log_prob)).softmax(1)


def expected_counts(chain: LogChain, emission_log_prob: Tensor) -> ExpectedCounts:
    """Sums of gamma_t and xi_t over the steps (eqs. 7-10)."""
    log_alpha, log_beta = forward(chain, emission_log_prob), backward(chain, emission_log_prob)
    gamma = (log_alpha + log_beta).softmax(1)
    edge = torch.zeros_like(chain.log_transition)
    for t in range(len(gamma) - 1):
        onward = (emission_log_prob[t + 1] + log_beta[t + 1])[chain.successor]
        log_xi = chain.flow(log_alpha[t]) + onward
        edge += log_xi.flatten().softmax(0).view_as(edge)  # the sum of exp(log_xi) is exp L
    return ExpectedCounts(gamma[0], gamma.sum(0), edge)


def most_likely_path(chain: LogChain, emission_log_prob: Tensor) -> Tensor:
    """Viterbi's path, int64 (T,) (section 2.3)."""
    rows = [chain.log_initial + emission_log_prob[0]]  # delta
    for log_b in emission_log_prob[1:]:
        best = torch.full_like(log_b, -torch.inf)
        flow = chain.flow(rows[-1])
        best = best.scatter_reduce(0, chain.successor.flatten(), flow.flatten(), "amax")
        rows.append(best + log_b)
    path = [rows[-1].argmax()]
    for log_delta in rows[-2::-1]:
        leads_on = chain.successor == path[-1]
        flow = chain.flow(log_delta).masked_fill(~leads_on, -torch.inf)
        path.append(flow.amax(1).argmax())
    return torch.stack(path[::-1])
