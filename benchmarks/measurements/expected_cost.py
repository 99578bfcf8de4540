"""The expected cost with default settings: random linear systems against scipy, a free duration, `worth`.

Linear systems with quadratic cost: the expected cost is that of the nominal, zero here, and that of the deviations,

    J = 1/2 tr S(0) E(0) + 1/2 int tr(S Q + C'B C E) dt,

both Riccati equations integrated by scipy. 40 of them, 2 to 4 states, priors of 1 to 1e4 times the variance in steady
state, sensors of densities 1e-4 to 1, terminal weights up to 1e4, 100 intervals. Right is an error of the cost below
1e-3, or a warning with an error within a factor of 3 of the true one.

    python benchmarks/measurements/expected_cost.py [seeds]
"""

from __future__ import annotations

import sys
import time
import warnings
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

import covocp as co

TOLERANCE = 1e-3
FACTOR = 3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class System:
    """dx = (F x + G u) dt + n, measured M x + v; cost 1/2 int (x'A x + u'B u) dt + 1/2 x'S x at the end."""

    F: np.ndarray
    G: np.ndarray
    M: np.ndarray
    Q: np.ndarray
    U: np.ndarray
    A: np.ndarray
    B: np.ndarray
    end: np.ndarray
    prior: np.ndarray
    duration: float


def random_system(seed: int) -> System:
    """One of the set."""
    r = np.random.default_rng(seed)
    n, m, k = int(r.integers(2, 5)), int(r.integers(1, 3)), int(r.integers(1, 3))
    F = r.normal(size=(n, n)) * 0.6 - np.eye(n) * float(r.uniform(-0.2, 1.0))
    G, M = r.normal(size=(n, m)), r.normal(size=(k, n))
    Q = np.diag(10.0 ** r.uniform(-3, 0, n))
    U = np.diag(10.0 ** r.uniform(-4, 0, k))
    A = np.diag(r.uniform(0, 1, n)) if r.random() < 0.5 else np.zeros((n, n))
    steady = solve_continuous_are(F.T, M.T, Q, U)
    prior = np.diag(np.diagonal(steady)) * 10.0 ** r.uniform(0, 4)
    end = np.diag(10.0 ** r.uniform(-2, 4, n))
    return System(
        F=F, G=G, M=M, Q=Q, U=U, A=A, B=np.eye(m), end=end, prior=prior, duration=float(10.0 ** r.uniform(-0.3, 1.3))
    )


def problem(system: System) -> co.Problem:
    """Its statement."""
    ocp = co.Problem(system.duration, name="random linear system")
    n = system.F.shape[0]
    x = ocp.state("x", n, initial=np.zeros(n), variance=system.prior)
    u = ocp.control("u", system.G.shape[1])
    ocp.dynamics(x, ca.DM(system.F) @ x + ca.DM(system.G) @ u, noise=system.Q)
    ocp.measurement("m", ca.DM(system.M) @ x, noise=system.U)
    running = 0.5 * (x.T @ ca.DM(system.A) @ x + u.T @ ca.DM(system.B) @ u)
    ocp.minimize_expected(running=running, terminal_weight={x: system.end})
    return ocp


def exact(system: System) -> float:
    """Expected cost of the deviations by scipy."""
    s, n = system, system.F.shape[0]
    W, V = s.M.T @ np.linalg.solve(s.U, s.M), s.G @ np.linalg.solve(s.B, s.G.T)

    def feedback(_: float, z: np.ndarray) -> np.ndarray:
        S = z.reshape(n, n)
        return (s.F.T @ S + S @ s.F + s.A - S @ V @ S).ravel()

    def forward(t: float, z: np.ndarray) -> np.ndarray:
        E, S = z[:-1].reshape(n, n), past.sol(s.duration - t).reshape(n, n)
        rate = s.F @ E + E @ s.F.T + s.Q - E @ W @ E
        return np.append(rate.ravel(), 0.5 * np.trace(S @ s.Q) + 0.5 * np.trace(S @ V @ S @ E))

    settings = {"method": "LSODA", "rtol": 1e-9}
    past = solve_ivp(feedback, (0, s.duration), s.end.ravel(), atol=1e-11, dense_output=True, **settings)
    start = np.append(s.prior.ravel(), 0.0)
    run = solve_ivp(forward, (0, s.duration), start, atol=1e-12, **settings)
    return float(0.5 * np.trace(past.y[:, -1].reshape(n, n) @ s.prior) + run.y[-1, -1])


def stated(messages: list[str]) -> float | None:
    """The error that a warning of the mesh states."""
    for message in messages:
        if "mesh" in message:
            words = message.replace(",", " ").split()
            numbers = [w.rstrip(".") for w in words if "e-" in w or "e+" in w]
            return float(numbers[0]) if numbers else float("inf")
    return None


def one(seed: int, **options: object) -> tuple[float, float | None, co.Solution, float]:
    """Error of the cost, the error stated, the solution, seconds."""
    system = random_system(seed)
    truth = exact(system)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        begin = time.perf_counter()
        solution = co.solve(problem(system), progress=False, **options)
        seconds = time.perf_counter() - begin
    return solution.cost / truth - 1.0, stated([str(w.message) for w in caught]), solution, seconds


def right(error: float, said: float | None) -> bool:
    """Whether the cost is right, or what is said of its error."""
    if said is None:
        return abs(error) <= TOLERANCE
    return abs(error) <= TOLERANCE or said / FACTOR <= abs(error) <= FACTOR * said


def main() -> None:
    """Print the tables."""
    seeds = range(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
    print("| system | states | intervals | error of the cost | mesh error | warned of | right | identity | s |")
    print("|---|---|---|---|---|---|---|---|---|")
    errors = []
    for seed in seeds:
        error, said, solution, seconds = one(seed)
        errors.append((error, right(error, said)))
        print(
            f"| {seed} | {solution['x'].shape[1]} | {solution.mesh.intervals} | {error:+.1e} "
            f"| {solution.mesh_error:.1e} | {'-' if said is None else f'{said:.1e}'} "
            f"| {'yes' if errors[-1][1] else 'NO'} | {solution.optimality.cost_identity:.1e} | {seconds:.2f} |",
            flush=True,
        )
    sizes = np.abs([error for error, _ in errors])
    print(f"\n{sum(ok for _, ok in errors)} of {len(errors)} right; error: median {np.median(sizes):.1e}, ", end="")
    print(f"largest {sizes.max():.1e}")


if __name__ == "__main__":
    main()
