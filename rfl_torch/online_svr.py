"""Support vector regression that learns and forgets one sample at a time, and a bank of it.

The function is the controller's estimator, eqs. 13 and 14 of the paper. It is trained by
accurate online support vector regression (Ma, Theiler and Perkins 2003, "Accurate on-line
support vector regression", Neural Computation 15), which after every sample holds the exact
solution of the batch problem: minimise

    1/2 theta' Q theta - y' theta + epsilon |theta|_1   with  sum theta = 0, |theta_i| <= C.

Their symbols, and the paper's, are ours as follows.

    K(x_i, x)   exp(-|x_i - x|^2 / (2 bandwidth^2)), eq. 14; Q is its matrix over the samples
    sigma       bandwidth, in the units of the inputs
    C, epsilon  cost, tube
    y           prediction, eq. 13 (Ma et al. write f(x) and keep y for the target)
    alpha_i     dual_coef[i], eq. 13; Ma et al. call it theta_i, the difference of two multipliers
    b           bias, eq. 13
    h(x_i)      residual[i] = prediction - target
    S, E, R     support, error and remaining set, the classes of the optimality conditions:
                S: |h| = epsilon, 0 <= |theta| <= C;  E: |theta| = C, |h| >= epsilon;
                R: theta = 0, |h| <= epsilon; everywhere theta and h have opposite signs
    R (matrix)  inverse: of [[0, 1'], [1, Q_SS]], grown and shrunk by one row at a time
    beta        sensitivity: change of (b, theta_S) per unit of the moving sample's theta_c that
                keeps h_S still and sum theta zero
    gamma       rate of h per unit of theta_c; of the sample itself, the Schur complement of Q_SS

Four situations that the article leaves open are settled here. While S is empty no theta can
move, so the bias moves alone, towards the moving sample, until some sample reaches the edge of
its class; a solution that ends without a free theta takes the middle of the interval of optimal
biases, as libsvm does. A repeated input would make the inverse singular, so Q carries a ridge of
1e-9 on its diagonal, which violates the conditions by no more than 1e-9 C; repeated samples then
share their theta. Ties go to the moving sample, then to the lowest index, against cycles. On
inputs that nearly repeat each other, with targets that contradict, rounding can make the path
cycle all the same: a path of more events than samples is given up, and the batch problem is
solved from there by an active-set method in which every step lowers the objective.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist
from torch import Tensor, nn

Vector = NDArray[np.float64]

SUPPORT, ERROR, REMAINING, MOVING = range(4)

INITIAL_BIAS = 0.5  # the stop action, when actions are scaled to [0, 1]
RIDGE = 1e-9  # added to Q_ii = 1, or a repeated input would make the inverse singular
STILL = 1e-13  # rates below this times max(1, |theta rates|_1) are rounding, not motion
TIE = 1e-12  # steps closer than this happen together
SOLVER_TOLERANCE = 1e-11  # times max(1, cost), in units of the target: a violation left as it is
STEPS_PER_SAMPLE = 20  # of one refit; usually two are enough
KKT_TOLERANCE = 1e-10  # times max(1, cost), in units of the target; rounding leaves 1e-13
PADDING = 8  # the bank's sample axis grows by this many rows, so that few steps reallocate it
MAX_GATHERED = 2**24  # numbers (128 MiB) that one piece of a forward pass may gather


class _Rates(NamedTuple):
    """Derivatives along one piece of the path, per unit of the moving theta (or of the bias)."""

    bias: float
    theta: Vector
    residual: Vector


class OnlineSVR:
    """Epsilon-insensitive regression of a scalar, exact after every sample.

    Adding or removing a sample costs a few products of an n x n matrix with a vector, n being
    the number of samples kept; there is no limit on n, `remove` is how to keep it small.
    """

    def __init__(
        self,
        *,
        bandwidth: float,
        cost: float = 10.0,
        tube: float = 0.02,
        initial_bias: float = INITIAL_BIAS,
    ) -> None:
        """Start without samples.

        Args:
            bandwidth: sigma of the kernel, in the units of the inputs.
            cost: C, the bound of a sample's dual coefficient.
            tube: epsilon, the error that costs nothing, in the units of the target.
            initial_bias: the prediction while there is no sample.

        Raises:
            ValueError: if bandwidth or cost is not positive, or the tube is negative.
        """
        if not (bandwidth > 0 and cost > 0 and tube >= 0):
            raise ValueError(
                f"found bandwidth={bandwidth}, cost={cost}, tube={tube}; bandwidth and cost must "
                "be positive and tube not negative; try the median input distance, 10 and 0.02."
            )
        self.bandwidth, self.cost, self.tube = float(bandwidth), float(cost), float(tube)
        self.initial_bias = float(initial_bias)
        self._inputs = np.zeros((0, 0))
        self._targets = np.zeros(0)
        self._support: list[int] = []  # S in the order of the rows of the inverse
        self.num_events = 0  # pieces of paths and steps of refits so far, a measure of the work
        self._forget_solution()

    def resume(
        self, inputs: ArrayLike, targets: ArrayLike, dual_coef: ArrayLike, bias: float
    ) -> None:
        """Replace everything by a solution found earlier; one that does not hold is refitted.

        Args:
            inputs: (n, input_dim), all samples, those of the remaining set too.
            targets: (n,).
            dual_coef: (n,), zero in the remaining set.
            bias: b of eq. 13.
        """
        self._inputs = np.array(inputs, np.float64)
        self._targets = np.array(targets, np.float64)
        self._forget_solution()
        self._theta[:] = dual_coef
        self._bias = float(bias)
        self._classify()
        self._refactor()
        self._verify()

    def __len__(self) -> int:
        """Return the number of samples kept."""
        return len(self._targets)

    @property
    def bias(self) -> float:
        """The constant b of eq. 13, in the units of the target."""
        return float(self._bias)

    @property
    def dual_coef(self) -> Vector:
        """The weights alpha of eq. 13 of all samples, (n,); zero in the remaining set."""
        return self._theta.copy()

    @property
    def support_set(self) -> NDArray[np.intp]:
        """Indices of S: samples on the edge of the tube that pull with part of their cost."""
        return np.flatnonzero(self._group == SUPPORT)

    @property
    def error_set(self) -> NDArray[np.intp]:
        """Indices of E: samples on or outside the tube that pull with all of their cost."""
        return np.flatnonzero(self._group == ERROR)

    @property
    def remaining_set(self) -> NDArray[np.intp]:
        """Indices of R: samples on or inside the tube that do not pull."""
        return np.flatnonzero(self._group == REMAINING)

    def predict(self, x: ArrayLike) -> Vector:
        """Return eq. 13 at `x` (..., input_dim), shape (...)."""
        x = np.asarray(x, np.float64)
        if not len(self):
            return np.full(x.shape[:-1], self._bias)
        kernel = self._kernel_to(x.reshape(-1, x.shape[-1]))
        return (kernel @ self._theta + self._bias).reshape(x.shape[:-1])

    def add(self, x: ArrayLike, y: float) -> None:
        """Learn that the function is `y` at `x` (input_dim,).

        Raises:
            ValueError: if a number is not finite or the dimension differs from earlier samples.
        """
        x, y = np.asarray(x, np.float64), float(y)
        if not (np.isfinite(x).all() and np.isfinite(y)):
            raise ValueError(
                f"sample {len(self)} is x={x}, y={y}; a regression needs finite numbers; "
                "drop the sample or mask the sensor that failed."
            )
        if x.ndim != 1 or (len(self) and x.shape != self._inputs[0].shape):
            raise ValueError(
                f"sample {len(self)} has shape {x.shape}, needs ({self._inputs.shape[1]},) as "
                "the samples before it (one axis if it is the first); add samples one by one."
            )
        self._append(x, y)
        self._advance(len(self) - 1)
        self._verify()

    def remove(self, index: int) -> None:
        """Forget sample `index`, as if it had never been added; later indices drop by one.

        Raises:
            IndexError: if there is no such sample.
        """
        if not 0 <= index < len(self):
            raise IndexError(
                f"sample {index} does not exist, {len(self)} are kept; indices start at 0 and "
                "drop by one after each removal before them."
            )
        if index in self._support:
            self._shrink(index)
        self._place(index, MOVING)
        self._retreat(index)
        self._delete(index)
        self._verify()

    def kkt_residual(self) -> float:
        """Return the largest violation of the optimality conditions, from the samples alone."""
        if not len(self):
            return 0.0
        theta, side = self._theta, np.sign(self._theta)
        residual = self._kernel_to(self._inputs) @ theta + self._bias - self._targets
        free = np.abs(residual + side * self.tube)
        bounded = np.maximum(0, side * residual + self.tube)
        inside = np.maximum(0, np.abs(residual) - self.tube)
        at_bound = np.abs(theta) >= self.cost
        violation = np.where(side == 0, inside, np.where(at_bound, bounded, free))
        excess = np.abs(theta).max() - self.cost
        return float(max(violation.max(), abs(theta.sum()), excess))

    def _advance(self, c: int) -> None:
        """Move theta of the new sample `c` from zero until it satisfies its conditions."""
        if abs(self._residual[c]) <= self.tube:
            self._place(c, REMAINING)
            return
        q = -np.sign(self._residual[c])
        for _ in self._patience():
            rates = self._rates(c, q)
            to_edge = (abs(self._residual[c]) - self.tube) / abs(rates.residual[c])
            to_bound = np.inf if rates.theta[c] == 0 else self.cost - abs(self._theta[c])
            if not self._step(rates, min(to_edge, to_bound)):
                continue
            if to_edge <= to_bound:
                self._admit(c, q)
            else:
                self._theta[c] = q * self.cost
                self._place(c, ERROR, q)
            return

    def _retreat(self, c: int) -> None:
        """Move theta of the leaving sample `c` to zero."""
        q = -np.sign(self._theta[c])
        for _ in self._patience():
            if self._theta[c] == 0:
                return
            rates = self._rates(c, q)
            to_zero = np.inf if rates.theta[c] == 0 else abs(self._theta[c])
            if self._step(rates, to_zero):
                self._theta[c] = 0.0

    def _patience(self) -> range:
        """Bound the events of one path, usually fewer than |S|; beyond it `_verify` refits."""
        return range(len(self) + 10)

    def _rates(self, c: int, q: float) -> _Rates:
        """Return how everything changes as theta_c moves in direction `q` (+1 or -1)."""
        theta = np.zeros(len(self))
        if not self._support:  # nothing could balance theta_c: the bias moves alone
            return _Rates(q, theta, np.full(len(self), q))
        beta = q * self._sensitivity(c)
        theta[self._support] = beta[1:]
        theta[c] = q
        return _Rates(beta[0], theta, beta[0] + self._kernel @ theta)

    def _step(self, rates: _Rates, own_step: float) -> bool:
        """Move to the next event; True if that is the moving sample's own, `own_step` away."""
        self.num_events += 1
        in_support = self._group == SUPPORT
        position = np.where(in_support, self._theta, self._residual)
        velocity = np.where(in_support, rates.theta, rates.residual)
        room = np.where(velocity > 0, self._high - position, position - self._low)
        speed = np.abs(velocity)
        step = np.full(len(self), np.inf)
        moves = speed > STILL * max(1.0, np.abs(rates.theta).sum())
        step[moves] = np.maximum(room[moves], 0) / speed[moves]
        shortest = step.min()
        tie = TIE * (1 + shortest)
        is_own = own_step <= shortest + tie
        length = own_step if is_own else shortest
        self._bias += length * rates.bias
        self._theta += length * rates.theta
        self._residual += length * rates.residual
        if not is_own:
            first = int(np.argmax(step <= shortest + tie))
            self._cross(first, float(velocity[first]))
        return bool(is_own)

    def _cross(self, i: int, velocity: float) -> None:
        """Move sample `i`, which reached the edge of its class, to the next one."""
        if self._group[i] == SUPPORT:
            self._leave(i, self._high[i] if velocity > 0 else self._low[i])
        elif self._group[i] == REMAINING:
            self._admit(i, -np.sign(velocity))
        else:
            self._admit(i, np.sign(self._theta[i]))

    def _leave(self, i: int, bound: float) -> None:
        """Take `i` out of S with its theta at `bound`: zero, or plus or minus the cost."""
        self._shrink(i)
        self._theta[i] = bound
        self._place(i, ERROR if bound else REMAINING, np.sign(bound))

    def _admit(self, i: int, side: float) -> None:
        """Bring `i`, on the edge of the tube, into S, where its theta has the sign `side`."""
        if self._support:
            self._expand(i)
        else:
            self._inverse = np.array([[-self._kernel[i, i], 1.0], [1.0, 0.0]])
            self._support = [i]
        self._place(i, SUPPORT, side)

    def _sensitivity(self, c: int) -> Vector:
        """Return d(b, theta_S) / d theta_c with h_S and sum theta kept, (1 + |S|,)."""
        target = -np.concatenate(([1.0], self._kernel[c, self._support]))
        beta = self._inverse @ target
        # One refinement keeps rounding below STILL when the inverse has grown large.
        return beta + self._inverse @ (target - self._bordered() @ beta)

    def _bordered(self) -> Vector:
        """Return [[0, 1'], [1, Q_SS]]."""
        size = len(self._support) + 1
        matrix = np.ones((size, size))
        matrix[0, 0] = 0.0
        matrix[1:, 1:] = self._kernel[np.ix_(self._support, self._support)]
        return matrix

    def _expand(self, i: int) -> None:
        """Append `i` to S: a rank-one update of the inverse."""
        beta = self._sensitivity(i)
        schur = self._kernel[i, i] + beta[0] + self._kernel[i, self._support] @ beta[1:]
        column = np.append(beta, 1.0)
        grown = np.zeros((len(column), len(column)))
        grown[:-1, :-1] = self._inverse
        self._inverse = grown + np.outer(column, column / schur)
        self._support.append(i)

    def _shrink(self, i: int) -> None:
        """Take `i` out of S: the same update backwards."""
        if len(self._support) == 1:  # the border alone is singular; `_admit` starts it anew
            self._support, self._inverse = [], np.zeros((1, 1))
            return
        k = self._support.index(i) + 1
        keep = np.arange(len(self._support) + 1) != k
        column = self._inverse[keep, k]
        outer = np.outer(column, column / self._inverse[k, k])
        self._inverse = self._inverse[np.ix_(keep, keep)] - outer
        del self._support[k - 1]

    def _forget_solution(self) -> None:
        n = len(self._targets)
        self._theta = np.zeros(n)
        self._bias = self.initial_bias
        self._kernel = self._kernel_to(self._inputs) + RIDGE * np.eye(n)
        self._residual = self._bias - self._targets
        self._group = np.full(n, MOVING, np.int8)
        self._low, self._high = np.full(n, -np.inf), np.full(n, np.inf)
        self._support, self._inverse = [], np.zeros((1, 1))

    def _kernel_to(self, x: Vector) -> Vector:
        """Return eq. 14 between rows of `x` and all samples, (len(x), n)."""
        return np.exp(cdist(x, self._inputs, "sqeuclidean") / (-2 * self.bandwidth**2))

    def _place(self, i: int, group: int, side: float = 0.0) -> None:
        """Put `i` in a class and note the range of its free number: theta in S, h elsewhere."""
        cost, tube = self.cost, self.tube
        if group == SUPPORT:
            low, high = (0.0, cost) if side > 0 else (-cost, 0.0)
        elif group == ERROR:
            low, high = (-np.inf, -tube) if side > 0 else (tube, np.inf)
        elif group == REMAINING:
            low, high = -tube, tube
        else:
            low, high = -np.inf, np.inf
        self._group[i], self._low[i], self._high[i] = group, low, high

    def _append(self, x: Vector, y: float) -> None:
        n = len(self)
        self._inputs = np.concatenate((self._inputs.reshape(n, -1 if n else len(x)), x[None]))
        self._targets = np.append(self._targets, y)
        row = self._kernel_to(x[None])[0]
        row[n] += RIDGE
        kernel = np.empty((n + 1, n + 1))
        kernel[:n, :n], kernel[n], kernel[:, n] = self._kernel, row, row
        self._kernel = kernel
        self._theta = np.append(self._theta, 0.0)
        self._residual = np.append(self._residual, row @ self._theta + self._bias - y)
        self._group = np.append(self._group, np.int8(MOVING))
        self._low, self._high = np.append(self._low, -np.inf), np.append(self._high, np.inf)

    def _delete(self, index: int) -> None:
        for name in ("_inputs", "_targets", "_theta", "_residual", "_group", "_low", "_high"):
            setattr(self, name, np.delete(getattr(self, name), index, axis=0))
        self._kernel = np.delete(np.delete(self._kernel, index, axis=0), index, axis=1)
        self._support = [i - (i > index) for i in self._support]
        if not len(self):
            self._bias = self.initial_bias

    def _fresh_residual(self) -> Vector:
        return self._kernel @ self._theta + self._bias - self._targets

    def _verify(self) -> None:
        """Remove the rounding of the last path; refit if the solution does not hold.

        The residuals are recomputed, which costs as much as one step of the path. Beyond the
        tolerance the inverse is factored anew, and if that is not enough the batch problem is
        solved from the present theta.
        """
        self._polish()
        if not self._holds():
            self._refactor()
            self._polish()
        if not self._holds():
            self._refit()

    def _holds(self) -> bool:
        return self._violation() <= KKT_TOLERANCE * max(1.0, self.cost)

    def _polish(self) -> None:
        """Make h_S and sum theta exact by one Newton step, or centre the bias if S is empty.

        A member of S that the step takes to its bound (or beyond, by rounding) leaves S first.
        """
        while self._support:
            self._residual = self._fresh_residual()
            members = np.array(self._support)
            low, high = self._low[members], self._high[members]
            change = -self._inverse @ self._support_error()
            theta = self._theta[members] + change[1:]
            at_bound = np.minimum(theta - low, high - theta) <= TIE * self.cost
            for k in np.flatnonzero(at_bound):
                bound = low[k] if theta[k] - low[k] < high[k] - theta[k] else high[k]
                self._leave(members[k], bound)
            if not at_bound.any():
                self._theta[members] = theta
                self._bias += change[0]
                break
        self._residual = self._fresh_residual()
        if len(self) and not self._support and (self._group != MOVING).all():
            self._centre_bias()

    def _centre_bias(self) -> None:
        """Take the middle of the interval of optimal biases, or of the gap if there is none."""
        below, above = np.max(self._low - self._residual), np.min(self._high - self._residual)
        self._bias += (below + above) / 2
        self._residual += (below + above) / 2

    def _support_error(self) -> Vector:
        """Return sum theta and how far h_S is from the tube's edge, (1 + |S|,)."""
        edge = np.where(self._high[self._support] > 0, -self.tube, self.tube)
        return np.append(self._theta.sum(), self._residual[self._support] - edge)

    def _violation(self) -> float:
        """Return the largest distance of a sample from the conditions of its class."""
        if not len(self):
            return 0.0
        if (self._group == MOVING).any():
            return np.inf
        outside = np.maximum(self._low - self._residual, self._residual - self._high)
        support = self._support
        side = np.where(self._high[support] > 0, 1.0, -1.0)
        outside[support] = np.abs(self._residual[support] + side * self.tube)
        return float(max(outside.max(), abs(self._theta.sum())))

    def _refactor(self) -> None:
        """Invert the bordered matrix from scratch."""
        self._inverse = np.linalg.inv(self._bordered()) if self._support else np.zeros((1, 1))

    def _refit(self) -> None:
        """Solve the batch problem by a primal active-set method, from where theta stands.

        Every step lowers the objective: theta_S goes to its optimum given the rest, or as far as
        the first member that reaches its bound, which leaves S; from an optimum, the sample that
        violates its conditions most enters. Rounding cannot mislead it as it misleads the path,
        for no direction is followed that does not pay more than rounding.
        """
        self._balance()
        self._classify()
        tolerance = SOLVER_TOLERANCE * max(1.0, self.cost)
        for _ in range(STEPS_PER_SAMPLE * (len(self) + 10)):
            self.num_events += 1
            if self._descend():
                continue
            outside = np.maximum(self._low - self._residual, self._residual - self._high)
            outside[self._support] = -np.inf
            if outside.max() <= tolerance:
                break
            if self._support:
                worst = [int(outside.argmax())]
            else:  # the bias is centred: theta moves from the one end to the other
                below, above = self._low - self._residual, self._residual - self._high
                worst = [int(below.argmax()), int(above.argmax())]
            for i in worst:
                side = 1.0 if self._residual[i] < self._low[i] else -1.0
                side = np.sign(self._theta[i]) or side
                self._place(i, SUPPORT, side)
                self._support.append(i)
        self._refactor()
        self._polish()

    def _descend(self) -> bool:
        """Move theta_S towards its optimum given the rest; True if a bound came first."""
        self._residual = self._fresh_residual()
        if not self._support:
            self._centre_bias()
            return False
        members = np.array(self._support)
        theta, low, high = self._theta[members], self._low[members], self._high[members]
        change = -np.linalg.solve(self._bordered(), self._support_error())
        step = change[1:]
        room = np.where(step > 0, high - theta, low - theta)
        blocked = (step != 0) & (np.abs(step) >= np.abs(room))
        if not blocked.any():
            self._theta[members] += step
            self._bias += change[0]
            self._residual = self._fresh_residual()
            return False
        fraction = np.full(len(members), np.inf)
        fraction[blocked] = room[blocked] / step[blocked]
        k = int(fraction.argmin())
        self._theta[members] = np.clip(theta + fraction[k] * step, low, high)
        self._bias += fraction[k] * change[0]
        bound = high[k] if step[k] > 0 else low[k]
        self._theta[members[k]] = bound
        self._place(members[k], ERROR if bound else REMAINING, np.sign(bound))
        del self._support[k]
        return True

    def _balance(self) -> None:
        """Make theta feasible: inside its bounds, and of sum zero."""
        self._theta = np.clip(self._theta, -self.cost, self.cost)
        excess = self._theta.sum()
        size = np.abs(self._theta)
        free = (size > 0) & (size < self.cost)
        for i in np.argsort(~free, kind="stable"):
            if abs(excess) <= TIE * self.cost:
                return
            theta = np.clip(self._theta[i] - excess, -self.cost, self.cost)
            excess += theta - self._theta[i]
            self._theta[i] = theta

    def _classify(self) -> None:
        """Put every sample in the class of its theta; the inverse is not touched."""
        for i, theta in enumerate(self._theta):
            group = REMAINING if theta == 0 else ERROR if abs(theta) >= self.cost else SUPPORT
            self._place(i, group, np.sign(theta))
        self._support = self.support_set.tolist()


class SVRBank(nn.Module):
    """One `OnlineSVR` per node and action dimension, evaluated together as a batch.

    The buffers hold every sample, not only those of S and E, padded along the sample axis to the
    longest node; they are the whole state, so a loaded bank learns on exactly as the saved one
    would have. Learning runs on the CPU in float64 whatever the buffers' device and type are;
    buffers of less than float64 keep less of the solution, which is then refitted when learning
    resumes. A sample axis of any length is accepted by `load_state_dict`.

    Buffers:
        support_input: (num_nodes, samples, input_dim), inputs x_i.
        target: (num_nodes, samples, action_dim).
        dual_coef: (num_nodes, samples, action_dim), alpha_i of eq. 13; zero where there is none.
        bias: (num_nodes, action_dim), b of eq. 13; 0.5, the stop action, without samples.
        num_samples: (num_nodes,), int64, samples of each node before the padding.
    """

    support_input: Tensor
    target: Tensor
    dual_coef: Tensor
    bias: Tensor
    num_samples: Tensor

    def __init__(
        self,
        num_nodes: int,
        input_dim: int,
        action_dim: int,
        *,
        bandwidth: float,
        cost: float = 10.0,
        tube: float = 0.02,
    ) -> None:
        """Start with no samples in any node; see `OnlineSVR` for the three numbers."""
        super().__init__()
        self.input_dim, self.action_dim = input_dim, action_dim
        self.bandwidth, self.cost, self.tube = bandwidth, cost, tube
        self._new_svr()  # fails early on a bad number
        self.register_buffer("support_input", torch.zeros(num_nodes, 0, input_dim).double())
        self.register_buffer("target", torch.zeros(num_nodes, 0, action_dim).double())
        self.register_buffer("dual_coef", torch.zeros(num_nodes, 0, action_dim).double())
        self.register_buffer("bias", torch.full((num_nodes, action_dim), INITIAL_BIAS).double())
        self.register_buffer("num_samples", torch.zeros(num_nodes, dtype=torch.int64))

    def forward(self, inputs: Tensor, node: Tensor) -> Tensor:
        """Return what each input's own node predicts, eq. 13; not clipped to the action range.

        Args:
            inputs: (B, input_dim).
            node: (B,) int64.

        Returns:
            (B, action_dim), in the type of `inputs`.
        """
        x = inputs.to(self.support_input.dtype)
        rows = max(1, MAX_GATHERED // max(1, self.support_input[0].numel()))
        pieces = zip(x.split(rows), node.split(rows), strict=True)
        return torch.cat([self._evaluate(x, node) for x, node in pieces]).to(inputs.dtype)

    def at(self, row: NDArray[np.float32], node: int) -> NDArray[np.float32]:
        """Return what one node predicts at one row (input_dim,), (action_dim,)."""
        away = row - self.support_input[node].numpy()
        kernel = np.exp(np.einsum("mi,mi->m", away, away) / (-2 * self.bandwidth**2))
        action = kernel @ self.dual_coef[node].numpy() + self.bias[node].numpy()
        return action.astype(np.float32)

    def fit(self, inputs: Tensor, targets: Tensor, node: Tensor) -> float:
        """Forget everything, then learn as `partial_fit` does."""
        self.reset()
        return self.partial_fit(inputs, targets, node)

    def reset(self) -> None:
        """Forget every sample of every node."""
        for name in ("support_input", "target", "dual_coef"):
            setattr(self, name, getattr(self, name)[:, :0].clone())
        self.bias.fill_(INITIAL_BIAS)
        self.num_samples.zero_()

    @torch.no_grad()
    def partial_fit(self, inputs: Tensor, targets: Tensor, node: Tensor) -> float:
        """Add samples in order to the solutions of their nodes.

        Args:
            inputs: (B, input_dim).
            targets: (B, action_dim), actions scaled to [0, 1].
            node: (B,) int64.

        Returns:
            Mean absolute error of the B samples after learning, in units of the targets; 0.0
            for no samples.

        Raises:
            ValueError: if the shapes do not belong together, or a number is not finite.
        """
        self._check(inputs, targets, node)
        if not len(inputs):
            return 0.0
        index = node.to(self.num_samples.device)
        total = self.num_samples + torch.bincount(index, minlength=len(self.num_samples))
        self._reserve(int(total.max()))
        x, y = (value.detach().cpu().double().numpy() for value in (inputs, targets))
        group = node.cpu().numpy()
        for k in np.unique(group):
            self._learn(int(k), x[group == k], y[group == k])
        return float((self(inputs, node) - targets).abs().mean())

    def _evaluate(self, x: Tensor, node: Tensor) -> Tensor:
        square_distance = (x[:, None] - self.support_input[node]).square().sum(-1)
        kernel = torch.exp(square_distance / (-2 * self.bandwidth**2))
        return torch.einsum("bm,bma->ba", kernel, self.dual_coef[node]) + self.bias[node]

    def _new_svr(self) -> OnlineSVR:
        return OnlineSVR(bandwidth=self.bandwidth, cost=self.cost, tube=self.tube)

    def _learn(self, k: int, x: Vector, y: Vector) -> None:
        """Add samples to node `k`: x (n, input_dim), y (n, action_dim)."""
        old = int(self.num_samples[k])
        new = old + len(x)
        inputs = np.concatenate((_array(self.support_input[k, :old]), x))
        targets = np.concatenate((_array(self.target[k, :old]), y))
        dual_coef, bias = _array(self.dual_coef[k, :old]), _array(self.bias[k])
        solutions = []
        for a in range(self.action_dim):
            svr = self._new_svr()
            if old:
                svr.resume(inputs[:old], targets[:old, a], dual_coef[:, a], bias[a])
            for i in range(old, new):
                svr.add(inputs[i], targets[i, a])
            solutions.append(svr)
        self.support_input[k, :new] = torch.from_numpy(inputs)
        self.target[k, :new] = torch.from_numpy(targets)
        stacked = np.stack([svr.dual_coef for svr in solutions], axis=-1)
        self.dual_coef[k, :new] = torch.from_numpy(stacked)
        self.bias[k] = torch.tensor([svr.bias for svr in solutions], dtype=torch.float64)
        self.num_samples[k] = new

    def _reserve(self, num_samples: int) -> None:
        """Lengthen the padding for nodes of up to `num_samples`, in multiples of `PADDING`."""
        missing = num_samples - self.support_input.shape[1]
        if missing <= 0:
            return
        missing = math.ceil(missing / PADDING) * PADDING
        for name in ("support_input", "target", "dual_coef"):
            setattr(self, name, nn.functional.pad(getattr(self, name), (0, 0, 0, missing)))

    def _check(self, inputs: Tensor, targets: Tensor, node: Tensor) -> None:
        batch = len(node)
        found = tuple(inputs.shape), tuple(targets.shape), tuple(node.shape)
        needed = (batch, self.input_dim), (batch, self.action_dim), (batch,)
        if found != needed:
            raise ValueError(
                f"inputs, targets and node have shapes {found}, need {needed}; "
                "give one row and one node index per sample."
            )
        finite = torch.isfinite(inputs).all(1) & torch.isfinite(targets).all(1)
        if not finite.all():
            raise ValueError(
                f"sample {int(torch.nonzero(~finite)[0])} has a number that is not finite; "
                "drop the sample or mask the sensor that failed."
            )
        num_nodes = len(self.num_samples)
        bad = torch.nonzero((node < 0) | (node >= num_nodes)).flatten()
        if len(bad):
            raise ValueError(
                f"node[{int(bad[0])}] is {int(node[bad[0]])}, needs 0 to {num_nodes - 1}; "
                "drop samples without a node first."
            )

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        """Take the sample axis of the saved buffers, then load as usual."""
        for name in ("support_input", "target", "dual_coef"):
            saved, own = state_dict.get(prefix + name), getattr(self, name)
            if saved is not None and saved.ndim == own.ndim:
                setattr(self, name, own.new_zeros(own.shape[0], saved.shape[1], own.shape[2]))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def _array(tensor: Tensor) -> Vector:
    return tensor.detach().cpu().double().numpy()
