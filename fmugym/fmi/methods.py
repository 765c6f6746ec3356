"""The methods of integration for model exchange, step by step the arithmetic of those in C.

All take one step from one state, so that nothing else has to be saved with it. The native pool has
the same in ``native/euler.c``, ``rk4.c``, ``dormand_prince.c`` and ``rosenbrock.c``; the two give
the same numbers to the last bit.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Final, Protocol

__all__ = ["METHODS", "DormandPrince", "Equations", "Euler", "Method", "Rosenbrock", "RungeKutta4"]

State = list[float]


class Equations(Protocol):
    """What a method asks of the solver."""

    x: State
    rates: State

    @property
    def time(self) -> float:
        """The time of ``x`` and ``rates``, where the step begins."""

    def rates_at(self, time: float, x: State) -> State:
        """The derivatives of the states."""

    def differentiate(self, step: float) -> tuple[list[State], State]:
        """The derivatives of the rates by the states, row by row, and by the time."""

    def norm(self, errors: State, end: State) -> float:
        """The root mean square of errors, each divided by the tolerance of its state."""


class Method(ABC):
    """A method of integration, with what it keeps of its last step.

    Attributes:
        order: Of the estimate of the error; 0 if there is none.
        end_rates: The derivatives at the end of the step, or None if the method does not need them.
    """

    name: ClassVar[str]
    order: ClassVar[int] = 0
    end_rates: State | None = None

    @abstractmethod
    def step(self, me: Equations, end: float) -> tuple[State, float]:
        """Return the states at this time, and the norm of the error: above 1 it is too large."""

    @abstractmethod
    def between(self, me: Equations, end: float, fraction: float) -> State:
        """Return the states at a fraction of the step from the time of the equations to the end."""


class Euler(Method):
    """The explicit Euler method."""

    name = "euler"

    def step(self, me: Equations, end: float) -> tuple[State, float]:
        """See ``Method.step``."""
        return self.between(me, end, 1.0), 0.0

    def between(self, me: Equations, end: float, fraction: float) -> State:
        """See ``Method.between``."""
        step = (end - me.time) * fraction
        return _moved(me.x, step, me.rates)


class RungeKutta4(Method):
    """The classical Runge-Kutta method of order 4."""

    name = "rk4"

    def step(self, me: Equations, end: float) -> tuple[State, float]:
        """See ``Method.step``."""
        return self.between(me, end, 1.0), 0.0

    def between(self, me: Equations, end: float, fraction: float) -> State:
        """See ``Method.between``; a shorter step gives the state in between."""
        time, k1 = me.time, me.rates
        step = (end - time) * fraction
        k2 = me.rates_at(time + 0.5 * step, _moved(me.x, 0.5 * step, k1))
        k3 = me.rates_at(time + 0.5 * step, _moved(me.x, 0.5 * step, k2))
        k4 = me.rates_at(time + step, _moved(me.x, step, k3))
        sixth = step / 6.0
        return [
            x + sixth * (a + 2.0 * b + 2.0 * c + d)
            for x, a, b, c, d in zip(me.x, k1, k2, k3, k4, strict=True)
        ]


class DormandPrince(Method):
    """The method of Dormand and Prince of order 5 with an estimate of order 4 and dense output.

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, sections II.5 and
    II.6.
    """

    name = "dormand_prince"
    order = 5

    _NODES: Final = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
    _WEIGHTS: Final = (
        (),
        (1 / 5,),
        (3 / 40, 9 / 40),
        (44 / 45, -56 / 15, 32 / 9),
        (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
        (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
        (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
    )
    """The last row also gives the result, so that the last stage is the rates at the end."""
    _ERRORS: Final = (
        *(71 / 57600, 0.0, -71 / 16695, 71 / 1920),
        *(-17253 / 339200, 22 / 525, -1 / 40),
    )
    _DENSE: Final = (
        *(-12715105075 / 11282082432, 0.0, 87487479700 / 32700410799),
        *(-10690763975 / 1880347072, 701980252875 / 199316789632),
        *(-1453857185 / 822651844, 69997945 / 29380423),
    )

    def step(self, me: Equations, end: float) -> tuple[State, float]:
        """See ``Method.step``."""
        time, size = me.time, end - me.time
        self._stages, self._next = [me.rates], me.x
        for node, weights in zip(self._NODES[1:], self._WEIGHTS[1:], strict=True):
            self._next = _moved(me.x, size, _sums(weights, self._stages, len(me.x)))
            at = end if node == 1.0 else time + node * size
            self._stages.append(me.rates_at(at, self._next))
        self.end_rates = self._stages[-1]
        errors = [size * s for s in _sums(self._ERRORS, self._stages, len(me.x))]
        return self._next, me.norm(errors, self._next)

    def between(self, me: Equations, end: float, fraction: float) -> State:
        """See ``Method.between``."""
        size, rest = end - me.time, 1.0 - fraction
        found = []
        sums = _sums(self._DENSE, self._stages, len(me.x))
        rows = zip(me.x, self._next, self._stages[0], self._stages[-1], sums, strict=True)
        for x, after, rate, last, total in rows:
            change = after - x
            first = size * rate - change
            second = change - size * last - first
            third = size * total
            inner = first + fraction * (second + rest * third)
            found.append(x + fraction * (change + rest * inner))
        return found


class Rosenbrock(Method):
    """Rodas5P, a stiffly accurate Rosenbrock method of order 5 for stiff equations.

    Its estimate of the error has order 4, and it has dense output. Source: Steinebach, Construction
    of Rosenbrock-Wanner method Rodas5P and numerical benchmarks within the Julia Differential
    Equations package, BIT Numerical Mathematics 63:27 (2023). The coefficients are those of the
    transformed form, which needs no product of matrix and vector: Hairer, Wanner, Solving Ordinary
    Differential Equations II, section IV.7.
    """

    name = "rosenbrock"
    order = 5

    _GAMMA: Final = 0.21193756319429014
    _NODES: Final = (
        *(0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664),
        *(1.0, 1.0, 1.0),
    )
    _SLOPES: Final = (
        *(0.21193756319429014, -0.42387512638858027, -0.3384627126235924),
        *(1.8046452872882734, 2.325825639765069, 0.0, 0.0, 0.0),
    )
    _SIXTH: Final = (
        *(-7.502846399306121, 2.561846144803919, -11.627539656261098),
        *(-0.18268767659942256, 0.030198172008377946),
    )
    _WEIGHTS: Final = (
        (),
        (3.0,),
        (2.849394379747939, 0.45842242204463923),
        (-6.954028509809101, 2.489845061869568, -10.358996098473584),
        (2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641),
        _SIXTH,
        (*_SIXTH, 1.0),
        (*_SIXTH, 1.0, 1.0),
    )
    """The last row plus the last stage gives the result; the last stage is the error."""
    _COUPLINGS: Final = (
        (),
        (-14.155112264123755,),
        (-17.97296035885952, -2.859693295451294),
        (147.12150275711716, -1.41221402718213, 71.68940251302358),
        (165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306),
        (
            *(24.854864614690072, -3.0009227002832186, 47.4931110020768),
            *(5.5814197821558125, -0.6610691825249471),
        ),
        (
            *(30.91273214028599, -3.1208243349937974, 77.79954646070892),
            *(34.28646028294783, -19.097331116725623, -28.087943162872662),
        ),
        (
            *(37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047),
            *(-40.06618937091002, -54.66780262877968, -9.48861652309627),
        ),
    )
    _DENSE: Final = (
        (
            *(25.948786856663858, -2.5579724845846235, 10.433815404888879, -2.3679251022685204),
            *(0.524948541321073, 1.1241088310450404, 0.4272876194431874, -0.17202221070155493),
        ),
        (
            *(-9.91568850695171, -0.9689944594115154, 3.0438037242978453, -24.495224566215796),
            *(20.176138334709044, 15.98066361424651, -6.789040303419874, -6.710236069923372),
        ),
        (
            *(11.419903575922262, 2.8879645146136994, 72.92137995996029, 80.12511834622643),
            *(-52.072871366152654, -59.78993625266729, -0.15582684282751913, 4.883087185713722),
        ),
    )

    def step(self, me: Equations, end: float) -> tuple[State, float]:
        """See ``Method.step``."""
        size = end - me.time
        jacobian, slope = me.differentiate(size)
        diagonal = 1.0 / (size * self._GAMMA)
        matrix = [
            [-value + diagonal if i == j else -value for j, value in enumerate(row)]
            for i, row in enumerate(jacobian)
        ]
        pivots = factorize(matrix)
        self._stages: list[State] = []
        for stage in range(len(self._NODES)):
            self._next = self._do_stage(me, stage, end, slope)
            solve(matrix, pivots, self._stages[-1])
        errors = self._stages[-1]
        self._next = [x + error for x, error in zip(self._next, errors, strict=True)]
        return self._next, me.norm(errors, self._next)

    def _do_stage(self, me: Equations, stage: int, end: float, slope: State) -> State:
        """Add the right-hand side of a stage to the stages; return the states where it is."""
        time, size, n = me.time, end - me.time, len(me.x)
        inverse, shift = 1.0 / size, size * self._SLOPES[stage]
        sums = _sums(self._WEIGHTS[stage], self._stages, n)
        at = [x + s for x, s in zip(me.x, sums, strict=True)]
        node = self._NODES[stage]
        rates = me.rates
        if stage:
            rates = me.rates_at(end if node == 1.0 else time + node * size, at)
        couplings = _sums(self._COUPLINGS[stage], self._stages, n)
        rows = zip(rates, couplings, slope, strict=True)
        self._stages.append([rate + (c * inverse + shift * s) for rate, c, s in rows])
        return at

    def between(self, me: Equations, end: float, fraction: float) -> State:
        """See ``Method.between``."""
        rest, n = 1.0 - fraction, len(me.x)
        sums = (_sums(row, self._stages, n) for row in self._DENSE)
        return [
            x * rest + fraction * (after + rest * (first + fraction * (second + fraction * third)))
            for x, after, first, second, third in zip(me.x, self._next, *sums, strict=True)
        ]


def _moved(x: State, step: float, rates: State) -> State:
    return [value + step * rate for value, rate in zip(x, rates, strict=True)]


def _sums(factors: Sequence[float], stages: list[State], n: int) -> State:
    """The weighted sum of the first stages, state by state, added in their order."""
    if not factors:
        return [0.0] * n
    sums = [factors[0] * value for value in stages[0]]
    for factor, stage in zip(factors[1:], stages[1:], strict=False):
        sums = [total + factor * value for total, value in zip(sums, stage, strict=True)]
    return sums


def _reciprocal(value: float) -> float:
    """Not a number for 0, so that the step is refused."""
    return 1.0 / value if value else math.nan


def factorize(matrix: list[State]) -> list[int]:
    """Factorize a square matrix in place, with partial pivoting; return the pivots.

    The diagonal then holds reciprocals, because divisions are slow.
    """
    n, pivots = len(matrix), []
    for k in range(n):
        best = k
        for row in range(k + 1, n):
            if abs(matrix[row][k]) > abs(matrix[best][k]):
                best = row
        pivots.append(best)
        matrix[k], matrix[best] = matrix[best], matrix[k]
        matrix[k][k] = _reciprocal(matrix[k][k])
        for row in range(k + 1, n):
            factor = matrix[row][k] = matrix[row][k] * matrix[k][k]
            for i in range(k + 1, n):
                matrix[row][i] -= factor * matrix[k][i]
    return pivots


def solve(matrix: list[State], pivots: list[int], b: State) -> None:
    """Solve a system of equations with a factorized matrix, in place."""
    n = len(b)
    for k, pivot in enumerate(pivots):
        b[k], b[pivot] = b[pivot], b[k]
    for row in range(1, n):
        for i in range(row):
            b[row] -= matrix[row][i] * b[i]
    for row in reversed(range(n)):
        for i in range(row + 1, n):
            b[row] -= matrix[row][i] * b[i]
        b[row] *= matrix[row][row]


METHODS: Final[dict[str, type[Method]]] = {
    method.name: method for method in (DormandPrince, Euler, RungeKutta4, Rosenbrock)
}
"""By the names of ``fmugym.pool.spec.SOLVERS``."""
