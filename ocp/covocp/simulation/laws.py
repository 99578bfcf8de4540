"""A plant, a filter and a feedback law in one loop, simulated: accurately without noise, many runs at once with it.

For laws that are functions of an estimate and of time, as the blocks make them; the filters measure y = H x.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from covocp.base.arguments import a, a_function, checked, optional, positive, whole
from covocp.base.dataclass import dataclass
from covocp.base.errors import CovocpError, ProblemError, shown, warn_user
from covocp.base.expressions import Given
from covocp.base.gains import weighted
from covocp.base.matrices import pack, pack_symbolic, real_numbers, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.base.threads import one_at_a_time
from covocp.blocks import kalman, values
from covocp.blocks.algebraic import root
from covocp.simulation.divergence import farthest, in_range
from covocp.simulation.integrated import TURNED, Piece, integrated
from covocp.simulation.law_steps import Lost, Pace, held_noise_step, on_columns, seeing_steps
from covocp.simulation.vectorised import padded, vectorise

Array = NDArray[np.float64]
# A casadi.Function, or a Python function of arrays that returns an array.
LawFunction = Callable[..., Any]


@dataclass(frozen=True, kw_only=True)
class Filter:
    """What makes the estimate that the law is given.

    Attributes:
        rate: (state of the filter, t, u, y) -> its rate; a Python function where the gain is one.
        initial: its state at the start, (ns,).
        size: number of entries that the law is given, the first ones: the estimate and its integrals.
        H: measurement matrix, (p, n).
    """

    rate: LawFunction
    initial: Array
    size: int
    H: Array

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class LawSimulation:
    """Histories at K times; with runs every array but `t` has a first axis of runs.

    Attributes:
        t: (K,) [s].
        x: state of the plant, (K, n); NaN, as everything else, after a run has diverged.
        u: what the law asked for, (K, m).
        filter_state: state of the filter, (K, ns), the estimate first; x where there is no filter.
        cost: integral of the running cost up to each time, (K,); zero where none is given.
        diverged: whether a run left the range of numbers before the end: its plant grew 1e15 times beyond 1, its start
            and the way that its first rate makes of the duration, or something in the loop is no number any more;
            shape () or (runs,).
    """

    t: Array
    x: Array
    u: Array
    filter_state: Array
    cost: Array
    diverged: NDArray[np.bool_]

    __repr__ = short_repr


def _of_state_and_control(value: Given) -> str:
    """A function of state and control."""
    fits = isinstance(value, ca.Function) and (value.n_in(), value.n_out()) == (2, 1)
    return "" if fits else "a casadi.Function of (x, u)"


@one_at_a_time
@checked(
    plant=_of_state_and_control,
    law=a_function,
    observer=optional(a(Filter)),
    running=optional(_of_state_and_control),
    samples=whole(2, 10**7),
    runs=optional(whole(1, 10**7)),
    duration=positive,
    step=positive,
    seed=whole(0, None),
)
def simulate_law(
    plant: ca.Function,
    law: LawFunction,
    *,
    initial: ArrayLike,
    duration: float,
    observer: Filter | None = None,
    running: ca.Function | None = None,
    samples: int = 401,
    breaks: Sequence[float] = (),
    runs: int | None = None,
    step: float = 0.01,
    process_noise: ArrayLike = 0.0,
    measurement_noise: ArrayLike = 0.0,
    seed: int = 0,
) -> LawSimulation:
    """Plant, filter and law in one loop.

    Without `runs` there is no noise, and scipy integrates with an error of 1e-9 a step. With `runs` all the functions
    must be casadi.Functions: white noise is held over steps of classical Runge-Kutta, all runs at once.
    A run ends before its time, with a warning, where the loop has no value any more or where a law chatters: switches
    back and forth without end.

    Args:
        plant: (x, u) -> dx/dt, shape (n,).
        law: (estimate, t) -> u, shape (m,); a casadi.Function or a Python function of arrays.
        initial: state at the start, (n,).
        duration: [s].
        observer: the filter; None: the law is given x.
        running: (x, u) -> cost a second.
        samples: K, number of times, from 0 to the duration.
        breaks: times at which the law or its derivatives jump [s].
        runs: number of runs; None: one without noise.
        step: of the runs with noise, at most [s]; shorter where the law changes with the time faster, and where the
            loop is fast: a fifth of the time of its fastest mode, whose variance is then right to 0.4 %.
        process_noise: power spectral density, (n, n), or a number times the identity.
        measurement_noise: power spectral density, (p, p), or a number times the identity.
        seed: of the noise.

    Returns:
        The histories.

    Raises:
        ProblemError: an argument does not fit, or a Python function in runs with noise.
    """
    start = _numbers("initial", initial)
    if plant.size1_out(0) != plant.size1_in(0):
        raise values.wrong_argument("plant", "rates of all its states, (n,)", f"{plant}"[:100])
    if start.size != plant.size1_in(0):
        raise values.wrong_argument("initial", f"{plant.size1_in(0)} numbers, the state of the plant", f"{start.size}")
    pauses = _numbers("breaks", breaks)
    times = np.linspace(0.0, float(duration), int(samples))
    loop = _Loop(plant=plant, law=law, observer=observer, running=running, size=start.size)
    inside = sorted(b for b in pauses.tolist() if 0.0 < b < duration)
    if runs is None:
        return _accurate(loop, start, times, inside)
    noises = (
        _root("process_noise", process_noise, start.size),
        _root("measurement_noise", measurement_noise, loop.measured),
    )
    return _noisy(loop, np.tile(loop.start(start)[:, None], int(runs)), (times, inside), float(step), noises, seed)


@checked(dynamics=_of_state_and_control, gain=a_function)
def gain_filter(
    dynamics: ca.Function, gain: LawFunction, H: ArrayLike, initial: ArrayLike, *, integrate: ArrayLike | None = None
) -> Filter:
    """Filter d(e)/dt = dynamics(e, u) + gain(e, t) (y - H e) of the estimate e.

    Args:
        dynamics: (x, u) -> dx/dt, shape (n,).
        gain: (x, t) -> gain, (n, p); a casadi.Function or a Python function of arrays.
        H: measurement matrix, (p, n).
        initial: estimate at the start, (n,).
        integrate: rows, (r, n): their products with the estimate are integrated from zero, and the law is given the
            integrals after the estimate.

    Returns:
        The filter.
    """
    start = _numbers("initial", initial)
    size = start.size
    rows, sums = _rows("H", H, size), _rows("integrate", [] if integrate is None else integrate, size)

    def rate(state: Given, t: Given, u: Given, y: Given) -> Any:
        estimate = state[:size]
        gained = _value(gain, estimate, t)
        innovation = y - _times(rows, estimate)
        correction = gained @ innovation if isinstance(gained, ca.SX) else gained.reshape(size, -1) @ innovation
        return _stack(_value(dynamics, estimate, u) + correction, _times(sums, estimate))

    made: LawFunction = rate
    if isinstance(gain, ca.Function):
        made = _function(rate, [size + len(sums), 1, dynamics.size1_in(1), len(rows)])
    return Filter(rate=made, initial=np.append(start, np.zeros(len(sums))), size=size + len(sums), H=rows)


@checked(dynamics=_of_state_and_control)
def extended_filter(
    dynamics: ca.Function,
    H: ArrayLike,
    W: ArrayLike,
    V: ArrayLike,
    initial: ArrayLike,
    covariance: ArrayLike,
    *,
    integrate: ArrayLike | None = None,
) -> Filter:
    """Extended Kalman-Bucy filter; its state is the estimate, the integrals and the half-vector of the covariance.

    Args:
        dynamics: (x, u) -> dx/dt, shape (n,).
        H: measurement matrix, (p, n).
        W: power spectral density of the process noise, (n, n).
        V: power spectral density of the measurement noise, positive definite, (p, p).
        initial: estimate at the start, (n,).
        covariance: at the start, (n, n).
        integrate: as for `gain_filter`.

    Returns:
        The filter.
    """
    start = _numbers("initial", initial)
    size = start.size
    rows, sums = _rows("H", H, size), _rows("integrate", [] if integrate is None else integrate, size)
    half = pack(values.numeric("covariance", values.weight("covariance", covariance, size)))
    process = values.numeric("W", values.weight("W", W, size))
    noise = values.numeric("V", values.weight("V", V, len(rows), definite=True))
    seen = weighted(rows, noise)

    def rate(state: Given, t: Given, u: Given, y: Given) -> Any:
        estimate = ca.SX.sym("estimate", size)
        slope = dynamics(estimate, u)
        tangent = ca.substitute(ca.jacobian(slope, estimate), estimate, state[:size])
        slope = ca.substitute(slope, estimate, state[:size])
        P = unpack_symbolic(state[size + len(sums) :], size)
        correction = P @ ca.DM(seen) @ (y - ca.DM(rows) @ state[:size])
        growth = pack_symbolic(kalman.rate(P, tangent, rows, process, noise))
        return ca.vertcat(slope + correction, ca.DM(sums) @ state[:size], growth)

    made = _function(rate, [size + len(sums) + half.size, 1, dynamics.size1_in(1), len(rows)])
    whole = np.concatenate([start, np.zeros(len(sums)), half])
    return Filter(rate=made, initial=whole, size=size + len(sums), H=rows)


@dataclass(frozen=True, kw_only=True)
class _Loop:
    """The closed loop; its state is that of the plant, that of the filter and the cost."""

    plant: ca.Function
    law: LawFunction
    observer: Filter | None
    running: ca.Function | None
    size: int

    __repr__ = short_repr

    @property
    def measured(self) -> int:
        return 0 if self.observer is None else len(self.observer.H)

    def start(self, initial: Array) -> Array:
        own = np.zeros(0) if self.observer is None else self.observer.initial
        return np.concatenate([initial, own, [0.0]])

    def control(self, state: Given, t: Given) -> Any:
        if self.observer is None:
            return _value(self.law, state[: self.size], t)
        return _value(self.law, state[self.size : self.size + self.observer.size], t)

    def rate(self, state: Given, t: Given, process: Given = 0.0, measurement: Given = 0.0) -> Any:
        x, u = state[: self.size], self.control(state, t)
        parts = [_value(self.plant, x, u) + process]
        if self.observer is not None:
            y = _times(self.observer.H, x) + measurement
            parts.append(_value(self.observer.rate, state[self.size : -1], t, u, y))
        parts.append(_stack(0.0) if self.running is None else _value(self.running, x, u))
        return _stack(*parts)

    def functions(self) -> tuple[LawFunction, LawFunction]:
        """Rate and control; casadi.Functions where all the parts are."""
        parts = [self.law] if self.observer is None else [self.law, self.observer.rate]
        if not all(isinstance(part, ca.Function) for part in parts):
            return self.rate, self.control
        total = self.start(np.zeros(self.size)).size
        return _function(self.rate, [total, 1, self.size, self.measured]), _function(self.control, [total, 1])

    def simulation(self, times: Array, states: Array, controls: Array) -> LawSimulation:
        """Histories from the states of the loop, (..., K, total)."""
        diverged = ~np.isfinite(states).all(axis=(-2, -1))
        own = slice(0, self.size) if self.observer is None else slice(self.size, -1)
        return LawSimulation(
            t=times,
            x=states[..., : self.size],
            u=controls,
            filter_state=states[..., own],
            cost=states[..., -1],
            diverged=np.asarray(diverged),
        )


def _accurate(loop: _Loop, initial: Array, times: Array, breaks: list[float]) -> LawSimulation:
    """One run without noise, piece by piece between the breaks."""
    rate, control = loop.functions()
    none = (np.zeros(loop.size), np.zeros(loop.measured))

    def slope(t: float, state: Array) -> Array:
        return np.asarray(_value(rate, state, t, *none))

    state = loop.start(initial)
    limit = farthest(initial, slope(0.0, state)[: loop.size], times[-1])
    states = np.full((times.size, state.size), np.nan)
    states[0] = state
    for begin, end in pairwise([0.0, *breaks, float(times[-1])]):
        inside = np.flatnonzero((times > begin) & (times <= end))
        grid = np.unique(np.append(times[inside], end))
        piece = integrated(slope, begin, state, grid, lambda state: bool(in_range(state, loop.size, limit)))
        _tell_end(loop, control, piece)
        found = piece.states
        reached = min(len(found), inside.size)
        states[inside[:reached]] = found[:reached]
        if len(found) < grid.size:
            break
        state = found[-1]
    known = np.isfinite(states).all(axis=1)
    first = np.ravel(_value(control, states[0], 0.0))
    controls = np.full((times.size, first.size), np.nan)
    controls[known] = [np.ravel(_value(control, z, t)) for t, z in zip(times[known], states[known], strict=True)]
    return loop.simulation(times, states, controls)


def _tell_end(loop: _Loop, control: LawFunction, piece: Piece) -> None:
    """Warn of a run that ends before its time: where, of what, and what helps."""
    rest = "The rest is NaN and counts as diverged"
    if piece.ended == "stalled":
        warn_user(
            f"The run ends at {piece.time:.6g} s: no step is small enough for the loop that follows. {rest}; call the "
            "functions of the loop near that time, or name its jumps in 'breaks'."
        )
    elif piece.ended == "chatters":
        before, after = (np.ravel(_value(control, state, t)) for t, state in piece.around)
        k = int(np.argmax(np.abs(after - before)))
        jump = f"u[{k}] jumps between {before[k]:.4g} and {after[k]:.4g} and back"
        if not np.abs(after - before).max() > TURNED * np.abs(after).max():
            jump = "a rate of the plant or the filter jumps and jumps back"
        warn_user(
            f"The run ends at {piece.time:.6g} s: the loop chatters, {jump} faster than the steps follow. {rest}; make "
            "the jump a steep slope, such as tanh(x / width) for sign(x), or simulate with runs=, whose steps have a "
            "length."
        )
    elif piece.ended == "undefined":
        (t, state), *_ = piece.around
        warn_user(
            f"The run ends at {piece.time:.6g} s: beyond it {_undefined(loop, state, t)}. {rest}; keep what it depends "
            "on where it has a value, or end the run before (duration=)."
        )


def _undefined(loop: _Loop, state: Array, t: float) -> str:
    """What of the loop has no value at a state, in words."""
    u = np.ravel(_value(loop.control, state, t))
    rate = np.ravel(loop.rate(state, t))
    names = [f"the rate of x[{i}] (plant)" for i in range(loop.size)]
    names += [f"the rate of entry {i} of the filter" for i in range(rate.size - loop.size - 1)] + ["the running cost"]
    values = [(f"u[{i}] (law)", value) for i, value in enumerate(u)] + list(zip(names, rate, strict=True))
    name, value = next(((name, value) for name, value in values if not np.isfinite(value)), ("the rate", np.nan))
    where = ", ".join(f"{entry:.4g}" for entry in state[: loop.size][:6])
    return f"{name} is {value:g} (x = [{where}{', ...' if loop.size > 6 else ''}])"


def _noisy(
    loop: _Loop,
    state: Array,
    places: tuple[Array, list[float]],
    step: float,
    noises: tuple[Array, Array],
    seed: int,
) -> LawSimulation:
    """Runs with noise that is held over each step, all at once; `state` has a column for each run.

    `places`: times of the histories, and where steps end beside.
    """
    times, breaks = places
    rate, control = loop.functions()
    if not isinstance(rate, ca.Function) or not isinstance(control, ca.Function):
        raise values.wrong_argument(
            "law", "casadi.Functions, also in the filter, for runs with noise", "a Python function"
        )
    runs = state.shape[1]
    steps = seeing_steps(control, state[:, 0], times, int(np.ceil(times[1] / step)))
    pace = Pace(rate, times, float(times[1]) / steps)
    sizes = [rate.size1_in(i) for i in range(4)]
    advance = vectorise(_function(held_noise_step(rate), [sizes[0], 2, *sizes[2:]]), padded(runs), (1,))
    controls = vectorise(control, padded(runs), (1,))
    generator = np.random.default_rng(seed)
    first = rate(state[:, 0], 0.0, *(np.zeros(size) for size in sizes[2:])).full().ravel()[: loop.size]
    paces = np.append(first, noises[0].ravel() / np.sqrt(times[-1]))  # of the drift and of the noise
    limit = farthest(state[: loop.size, 0], paces, times[-1])
    states, given, lost = [state], [on_columns(controls, state, times[0])], Lost(runs)
    for start, end in pairwise(times):
        for begin, stop in pairwise([start, *(t for t in breaks if start < t < end), end]):
            time = begin
            while time < stop:
                h, count = pace.steps(state, time, stop)
                for _ in range(count):
                    shocks = [root @ generator.standard_normal((len(root), runs)) / np.sqrt(h) for root in noises]
                    before, state = state, on_columns(advance, state, (time, h), *shocks)
                    gone = in_range(before, loop.size, limit) & ~np.isfinite(state).all(axis=0)
                    lost.look(gone, time, before, h)
                    time = stop if stop - time < 1.5 * h else time + h
        state[:, ~in_range(state, loop.size, limit)] = np.nan
        states.append(state)
        given.append(on_columns(controls, state, end))
    pace.tell()
    if lost.count:
        found = (_undefined(loop, z, t) for z, t in lost.ahead(lambda z, t: np.ravel(loop.rate(z, t))))
        warn_user(
            f"{lost.count} of {runs} runs become NaN or inf in one step, the first at {lost.time:.6g} s: "
            f"{next(found, 'the loop has no value there')}. The rest of these runs is NaN and counts as diverged; keep "
            "what it depends on where it has a value."
        )
    return loop.simulation(times, np.array(states).transpose(2, 0, 1), np.array(given).transpose(2, 0, 1))


def _function(expression: LawFunction, sizes: Sequence[int]) -> ca.Function:
    """A function of columns of the sizes, expanded to SX."""
    symbols: Any = [ca.SX.sym(f"i{i}", size) for i, size in enumerate(sizes)]
    return ca.Function("part", symbols, [ca.densify(expression(*symbols))])


def _value(function: LawFunction, *arguments: Any) -> Any:
    """The value of a function, as an array where the arguments are numbers; columns are flat."""
    try:
        value = function(*arguments)
        if isinstance(value, ca.SX):
            return value
        numbers = real_numbers(value)
    except CovocpError:
        raise
    except Exception as error:  # whatever a function of the user raises
        raise ProblemError(
            "A function of the loop fails.",
            expected="functions as simulate_law() says: plant (x, u), law (estimate, t), running (x, u)",
            received=f"{type(error).__name__} in {shown(function, 60)}: {error}"[:300],
            remedy="call it by itself with a state and a control of these sizes",
        ) from error
    return numbers.ravel() if numbers.ndim < 2 or numbers.shape[1] == 1 else numbers


def _times(matrix: Array, vector: Given) -> Any:
    return ca.DM(matrix) @ vector if isinstance(vector, ca.SX) else matrix @ vector


def _stack(*parts: Any) -> Any:
    if any(isinstance(part, ca.SX) for part in parts):
        return ca.vertcat(*parts)
    return np.concatenate([np.ravel(part) for part in parts])


def _numbers(name: str, given: Given) -> Array:
    """Finite numbers in a row."""
    return values.numeric(name, values.matrix(name, given)).ravel()


def _rows(name: str, given: Given, size: int) -> Array:
    """Rows of finite numbers, (r, size); a row may be given by itself."""
    numbers = values.numeric(name, values.matrix(name, given))
    if numbers.shape[1] == 1 and numbers.shape[0] == size:
        numbers = numbers.T
    return (
        numbers.reshape(-1, size)
        if not numbers.size
        else values.numeric(name, values.matrix(name, numbers, (None, size)))
    )


def _root(name: str, density: ArrayLike, size: int) -> Array:
    """A square root of a power spectral density, (size, size)."""
    given = values.numeric(name, values.matrix(name, density))
    full = values.numeric(name, values.weight(name, given * np.eye(size) if given.size == 1 else given, size))
    return root(full)
