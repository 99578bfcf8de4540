"""Expected costs of linear plants in phases, whose optimum the deterministic problem has, against exact recursions."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import simpson
from scipy.linalg import block_diag, expm

import covocp as co

QUIET: dict[str, Any] = {"progress": False}
# Of the truth in each phase, exact steps, the shorter the nearer to its ends, where E and S change quickly.
SHARES = np.linspace(0.0, 1.0, 401)
NODES = SHARES**4 * (35 - 84 * SHARES + 70 * SHARES**2 - 20 * SHARES**3)
SPEEDS = 140 * SHARES**3 * (1 - SHARES) ** 3


class Drawn:
    """A random plant that may be unstable, with a prior, a sensor, and weights of several orders of magnitude."""

    def __init__(self, seed: int, size: int, inputs: int, duration: float) -> None:
        r = np.random.default_rng(seed)
        F = r.normal(size=(size, size))
        self.F = F - np.eye(size) * (np.linalg.eigvals(F).real.max() - 5.0 / duration)
        self.G, self.H = r.normal(size=(size, inputs)), r.normal(size=(1, size))
        self.A, self.B, self.end = spread(r, size, 1.0), spread(r, inputs, 0.1), spread(r, size, 10.0)
        self.E, self.Q, self.U = spread(r, size, 10.0), spread(r, size, 0.01), np.array([[0.1]])
        self.start = 10.0 * r.normal(size=size)
        self.J = np.eye(size) + 0.3 * r.normal(size=(size, size))  # between the phases
        self.c, self.N = r.normal(size=size), spread(r, size, 0.1)

    def phase(self, duration: float, *, first: bool, last: bool) -> tuple[co.Problem, ca.MX]:
        p = co.Problem(duration, name="first" if first else "second")
        x = p.state("x", len(self.F), initial=self.start if first else None, variance=self.E if first else None)
        u = p.control("u", self.G.shape[1])
        p.dynamics(x, self.F @ x + self.G @ u, noise=self.Q)
        p.measurement("reading", self.H @ x, noise=self.U)
        terminal = x.T @ self.end @ x / 2 if last else 0
        p.minimize_expected(running=x.T @ self.A @ x / 2 + u.T @ self.B @ u / 2, terminal=terminal)
        return p, x

    def cost(self, durations: tuple[float, ...], *, jump: bool) -> tuple[float, np.ndarray]:
        """The least expected cost by the separation theorem, and E at the end."""
        weight, shift = block_diag(self.end, 0.0), np.eye(len(self.F) + 1)
        if jump:
            shift[:-1, :-1], shift[:-1, -1] = self.J, self.c
        F, G = block_diag(self.F, 0.0), np.vstack([self.G, np.zeros((1, self.G.shape[1]))])  # with a state that is 1
        control = G @ np.linalg.solve(self.B, G.T)
        weights = []
        for k, duration in enumerate(reversed(durations)):
            weight = shift.T @ weight @ shift if k else weight
            weights.append(riccati(F.T, block_diag(self.A, 0.0), control, weight, duration)[::-1])
            weight = weights[-1][0]
        weights.reverse()
        z = np.append(self.start, 1.0)
        cost = (z @ weights[0][0] @ z + np.trace(weights[0][0][:-1, :-1] @ self.E)) / 2
        E, information = self.E, self.H.T @ np.linalg.solve(self.U, self.H)
        for k, (duration, S) in enumerate(zip(durations, weights, strict=True)):
            if k and jump:
                E = self.J @ E @ self.J.T + self.N
                cost += np.trace(S[0][:-1, :-1] @ self.N) / 2
            own = S[:, :-1, :-1]
            along = riccati(self.F, self.Q, information, E, duration)
            fed = own @ control[:-1, :-1] @ own
            rate = np.trace(own @ self.Q, axis1=1, axis2=2) + np.trace(fed @ along, axis1=1, axis2=2)
            cost, E = cost + simpson(rate * SPEEDS, x=SHARES) * duration / 2, along[-1]
        return float(cost), E


def spread(r: np.random.Generator, size: int, scale: float) -> np.ndarray:
    M = r.normal(size=(size, size))
    return scale * (M @ M.T / size + 0.1 * np.eye(size))


def riccati(F: np.ndarray, Q: np.ndarray, W: np.ndarray, E: np.ndarray, duration: float) -> np.ndarray:
    """E' = F E + E F' + Q - E W E at the nodes, each step by a matrix exponential."""
    n, H = len(F), np.block([[-F.T, W], [Q, F]])
    found = [E]
    for length in np.diff(NODES) * duration:
        Z = expm(H * length) @ np.vstack([np.eye(n), found[-1]])
        own = np.linalg.solve(Z[:n].T, Z[n:].T)
        found.append((own + own.T) / 2)
    return np.array(found)


def cut(drawn: Drawn, durations: tuple[float, float], *, jump: bool = False) -> co.Phases:
    one, x = drawn.phase(durations[0], first=True, last=False)
    two, later = drawn.phase(durations[1], first=False, last=True)
    phases = co.Phases([one, two])
    if jump:
        phases.jump(later, drawn.J @ x + drawn.c, noise=drawn.N)
    return phases


# Seed, states, controls, durations: 30 to 140 s by a Hessian of limited memory.
CASES = [(1, 3, 2, (1.2, 2.3)), (3, 3, 1, (4.0, 1.0))]


@pytest.mark.parametrize("jump", [False, True])
@pytest.mark.parametrize(("seed", "size", "inputs", "durations"), CASES)
def test_the_cost_is_that_of_the_separation_theorem(
    seed: int, size: int, inputs: int, durations: tuple[float, float], jump: bool
) -> None:
    drawn = Drawn(seed, size, inputs, sum(durations))
    solution = co.solve(cut(drawn, durations, jump=jump), **QUIET)
    cost, E = drawn.cost(durations, jump=jump)
    assert solution.cost == pytest.approx(cost, rel=1e-5)
    units = np.outer(*2 * [np.sqrt(np.diag(E))])
    np.testing.assert_allclose(solution["second"].loop.E[-1] / units, E / units, atol=1e-6)
    assert max(solution.link_residuals) < 1e-8
    assert max(phase.optimality.stationarity for phase in solution) < 1e-3
    assert solution.stats["iterations"] < 5


def oscillator(duration: float, *, first: bool = True, last: bool = True) -> co.Problem:
    p = co.Problem(duration, name="first" if first else "second")
    start = {"initial": [10.0, 0.0], "variance": np.diag([100.0, 1.0])} if first else {"initial": None}
    x = p.state("x", 2, **start)
    u = p.control("u", lower=-2.0, upper=2.0)
    p.dynamics(x, ca.vertcat(x[1], -0.2 * x[0] + u), noise=[0.0, 0.01])
    p.measurement("place", x[0], noise=0.1)
    p.minimize_expected(running=u**2 + x[0] ** 2, terminal=10.0 * ca.sumsqr(x) if last else 0)
    return p


@pytest.mark.parametrize("control", ["constant", "linear"])
def test_a_limited_control_in_phases_costs_what_it_costs_in_one_problem(control: str) -> None:
    whole = co.solve(oscillator(6.0), intervals=100, control=control, **QUIET)
    parts = [oscillator(2.4, last=False), oscillator(3.6, first=False)]
    phases = co.solve(co.Phases(parts), intervals=[40, 60], control=control, **QUIET)
    assert np.abs(whole["u"]).max() == pytest.approx(2.0, rel=1e-6)
    assert phases.cost == pytest.approx(whole.cost, rel=1e-6)
    assert max(phase.optimality.stationarity for phase in phases) < 1e-4


def test_a_limit_of_iterations_is_kept() -> None:
    drawn = Drawn(1, 3, 2, 3.5)
    found = co.solve(cut(drawn, CASES[0][-1]), max_iterations=2, allow_failure=True, **QUIET)
    assert not found.converged
    assert found.stats["iterations"] <= 2


def pushed(first: bool, limit: float = np.inf) -> tuple[co.Problem, ca.MX, ca.MX]:
    p = co.Problem(1.0, name="first" if first else "second")
    b = p.unknown("b", mean=0.5, variance=0.05)
    x = p.state("x", initial=1.0 if first else None, variance=1e-4 if first else None)
    u = p.control("u")
    p.dynamics(x, u, noise=1e-4)
    p.measurement("y", x, noise=0.01)
    if not first and limit < np.inf:
        p.subject_to(x + b, upper=limit, at="final", name="wall")
    p.minimize_expected(running=u**2 / 2 + (x**2 if limit == np.inf else (x - 2.0) ** 2 / 2))
    return p, x, b


@pytest.mark.parametrize("method", ["ipopt", "auto"])
def test_the_mean_of_what_is_unknown_moves_the_nominal(method: str) -> None:
    """x' = u, x+ = x + b, cost u^2/2 + x^2: a leg from y to z costs q ((y^2 + z^2) cosh q - 2 y z) / (2 sinh q)."""
    (one, x, b), (two, later, _) = pushed(True), pushed(False)
    phases = co.Phases([one, two])
    phases.jump(later, x + b)
    found = co.solve(phases, method, intervals=20, **QUIET)
    q = np.sqrt(2.0)
    ratio, rest = q / np.sinh(q), q * np.tanh(q)  # of the first leg; of the second, whose end is free
    end = (ratio - 0.5 * rest) / (q / np.tanh(q) + rest)
    assert found["first"]["x"][-1].item() == pytest.approx(end, abs=1e-4)
    assert found["second"]["x"][0].item() == pytest.approx(end + 0.5, abs=1e-4)
    assert found.stats["iterations"] < 5


def test_a_wall_at_an_unknown_place_is_kept() -> None:
    (one, _, _), (two, _, _) = pushed(True, 1.0), pushed(False, 1.0)
    found = co.solve(co.Phases([one, two]), intervals=20, **QUIET)
    assert found["second"]["x"][-1].item() == pytest.approx(0.5, abs=1e-6)
    other = co.solve(co.Phases([one, two]), intervals=20, max_iterations=3000, **QUIET)
    assert found.cost == pytest.approx(other.cost, rel=1e-6)
