"""What plain.py runs in its processes: a plain problem by covocp, by hand in CasADi, by rockit, maptor, yapss."""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np
from plain_problems import FREE, PLAIN, Plain, stated

# Equal meshes on which the script by hand is tried.
MESHES = (10, 25, 50, 100, 200, 400, 800, 1600, 3200, 6400)
# Points on which yapss is tried, ten to a segment.
POINTS = (50, 100, 200, 400, 800)


def covocp_solve(case: dict[str, Any]) -> dict[str, Any]:
    """By covocp, on a mesh that refines itself or on the default one."""
    import importlib

    import covocp as co

    importlib.import_module("covocp.solvers.ipopt")  # looked up by name when it is first asked for
    start = time.process_time()
    problem = stated(case["problem"])
    built = time.process_time()
    solution = co.solve(problem, progress=False, **({"refine": case["refine"]} if "refine" in case else {}))
    return _result(case, start, built, solution.cost, solution.mesh.intervals, str(solution.status))


def _result(
    case: dict[str, Any], start: float, built: float, cost: float, intervals: int, status: str
) -> dict[str, Any]:
    error = abs(cost / PLAIN[case["problem"]].optimum - 1.0)
    seconds = {"build": built - start, "solve": time.process_time() - built}
    return {"cost": float(cost), "off": float(error), "intervals": intervals, "status": status, **seconds}


def _guesses(own: Plain, shares: Any) -> tuple[Any, Any]:
    """A straight line between the ends, and controls of zero within their bounds."""
    first, last = np.array(own.initial), np.array(own.final)
    return first[:, None] + (last - first)[:, None] * shares, np.clip(0.0, own.lower, own.upper)


def hand(case: dict[str, Any]) -> dict[str, Any]:
    """By hand: multiple shooting, one classical Runge-Kutta step an interval, linear controls, exact Hessian."""
    import casadi as ca

    own, n = PLAIN[case["problem"]], case["intervals"]
    start = time.process_time()
    nx, nu = len(own.initial), len(own.lower)
    x, a, b, h = ca.SX.sym("x", nx), ca.SX.sym("a", nu), ca.SX.sym("b", nu), ca.SX.sym("h")

    def rate(z: Any, c: float) -> Any:
        states, u = ca.vertsplit(z)[:nx], ca.vertsplit((1 - c) * a + c * b)
        return ca.vertcat(*own.rates(states, u), own.running(states, u))

    z = ca.vertcat(x, 0.0)
    k1 = rate(z, 0.0)
    k2 = rate(z + h / 2 * k1, 0.5)
    k3 = rate(z + h / 2 * k2, 0.5)
    end = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(z + h * k3, 1.0))
    step = ca.Function("step", [x, a, b, h], [end[:nx], end[nx]]).map(n)
    X, U, T = ca.MX.sym("X", nx, n + 1), ca.MX.sym("U", nu, n + 1), ca.MX.sym("T")
    ends, costs = step(X[:, :-1], U[:, :-1], U[:, 1:], ca.repmat(T / n, 1, n))
    f = T if own.fastest else ca.sum2(costs)
    w = ca.vertcat(ca.vec(X), ca.vec(U), T)
    lower = np.full((nx, n + 1), -np.inf)
    upper = np.tile(np.array(own.highest)[:, None], n + 1)
    lower[:, 0] = upper[:, 0] = own.initial
    lower[:, -1] = upper[:, -1] = own.final
    times = (1e-3, np.inf) if own.duration is FREE else (own.duration, own.duration)
    bounds = [
        np.concatenate([rows.ravel(order="F"), np.tile(limit, n + 1), [time_limit]])
        for rows, limit, time_limit in ((lower, own.lower, times[0]), (upper, own.upper, times[1]))
    ]
    line, control = _guesses(own, np.linspace(0.0, 1.0, n + 1))
    guess = np.concatenate([line.ravel(order="F"), np.tile(control, n + 1), [own.duration or own.guess]])
    options = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.max_iter": 500}
    solver = ca.nlpsol("solver", "ipopt", {"x": w, "f": f, "g": ca.vec(ends - X[:, 1:])}, options)
    built = time.process_time()
    found = solver(x0=guess, lbx=bounds[0], ubx=bounds[1], lbg=0.0, ubg=0.0)
    return _result(case, start, built, float(found["f"]), n, str(solver.stats()["return_status"]))


def opti(case: dict[str, Any]) -> dict[str, Any]:
    """A script of casadi.Opti: the same transcription, its Runge-Kutta steps mapped, or written in a loop."""
    import casadi as ca

    own, n = PLAIN[case["problem"]], case["intervals"]
    start = time.process_time()
    nx, nu = len(own.initial), len(own.lower)
    problem = ca.Opti()
    X, U = problem.variable(nx, n + 1), problem.variable(nu, n + 1)
    T = problem.variable() if own.duration is FREE else own.duration

    def rate(x: Any, u: Any) -> tuple[Any, Any]:
        states, controls = ca.vertsplit(x), ca.vertsplit(u)
        return ca.vertcat(*own.rates(states, controls)), own.running(states, controls)

    def step(x: Any, a: Any, b: Any, h: Any) -> tuple[Any, Any]:
        k1, l1 = rate(x, a)
        k2, l2 = rate(x + h / 2 * k1, (a + b) / 2)
        k3, l3 = rate(x + h / 2 * k2, (a + b) / 2)
        k4, l4 = rate(x + h * k3, b)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), h / 6 * (l1 + 2 * l2 + 2 * l3 + l4)

    if case["mapped"]:
        symbols = [ca.MX.sym("x", nx), ca.MX.sym("a", nu), ca.MX.sym("b", nu), ca.MX.sym("h")]
        every = ca.Function("step", symbols, list(step(*symbols))).map(n)
        ends, costs = every(X[:, :-1], U[:, :-1], U[:, 1:], ca.repmat(ca.MX(T / n), 1, n))
        problem.subject_to(X[:, 1:] == ends)
        cost = ca.sum2(costs)
    else:
        cost = 0
        for k in range(n):
            end, part = step(X[:, k], U[:, k], U[:, k + 1], T / n)
            problem.subject_to(X[:, k + 1] == end)
            cost += part
    problem.minimize(T if own.fastest else cost)
    _opti_limits(problem, own, X, U, T)
    problem.solver("ipopt", {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.max_iter": 500})
    built = time.process_time()
    found = problem.solve()
    status = str(problem.stats()["return_status"])
    return _result(case, start, built, float(found.value(problem.f)), n, status)


def _opti_limits(problem: Any, own: Plain, X: Any, U: Any, T: Any) -> None:
    """Bounds, values at the ends, and the guess."""
    for i, (low, high) in enumerate(zip(own.lower, own.upper, strict=True)):
        if np.isfinite(low):
            problem.subject_to(problem.bounded(low, U[i, :], high))
    for i, high in enumerate(own.highest):
        if np.isfinite(high):
            problem.subject_to(X[i, :] <= high)
    problem.subject_to(X[:, 0] == np.array(own.initial))
    problem.subject_to(X[:, -1] == np.array(own.final))
    if own.duration is FREE:
        problem.subject_to(T >= 1e-3)
        problem.set_initial(T, own.guess)
    line, control = _guesses(own, np.linspace(0.0, 1.0, X.shape[1]))
    problem.set_initial(X, line)
    problem.set_initial(U, np.tile(control[:, None], X.shape[1]))


def hand_to_accuracy(case: dict[str, Any]) -> dict[str, Any]:
    """By hand, on the coarsest of some equal meshes whose error is what was asked for; only that one is timed."""
    return hand({**case, "intervals": _coarsest("hand", MESHES, case)})


def hand_until_settled(case: dict[str, Any]) -> dict[str, Any]:
    """By hand, on one mesh after the other until the cost no longer changes by what is asked for; all are timed."""
    return _until_settled(hand, MESHES, case)


def yapss_to_accuracy(case: dict[str, Any]) -> dict[str, Any]:
    """By yapss, on the coarsest of some equal meshes whose error is what was asked for; only that one is timed."""
    return yapss({**case, "intervals": _coarsest("yapss", POINTS, case)})


def yapss_until_settled(case: dict[str, Any]) -> dict[str, Any]:
    """By yapss, on one mesh after the other until the cost no longer changes by what is asked for; all are timed."""
    return _until_settled(yapss, POINTS, case)


def _coarsest(name: str, sizes: tuple[int, ...], case: dict[str, Any]) -> int:
    """The coarsest mesh of the error that is asked for, else the last, found in another process: first solves count."""
    with ProcessPoolExecutor(1, get_context("spawn")) as other:
        return other.submit(_exact_enough, name, sizes, case).result()


def _exact_enough(name: str, sizes: tuple[int, ...], case: dict[str, Any]) -> int:
    solve: Callable[[dict[str, Any]], dict[str, Any]] = globals()[name]
    with contextlib.redirect_stdout(io.StringIO()):
        return next((n for n in sizes if solve({**case, "intervals": n})["off"] <= case["refine"]), sizes[-1])


def _until_settled(
    solve: Callable[[dict[str, Any]], dict[str, Any]], sizes: tuple[int, ...], case: dict[str, Any]
) -> dict[str, Any]:
    seconds, last = {"build": 0.0, "solve": 0.0}, np.inf
    for n in sizes:
        found = solve({**case, "intervals": n})
        seconds = {name: seconds[name] + found[name] for name in seconds}
        if abs(found["cost"] - last) <= case["refine"] * abs(found["cost"]):
            break
        last = found["cost"]
    return {**found, **seconds}


def rockit(case: dict[str, Any]) -> dict[str, Any]:
    """By rockit: multiple shooting, Runge-Kutta, piecewise constant controls, its usual form."""
    import casadi as ca
    import rockit as tool

    own, n = PLAIN[case["problem"]], case["intervals"]
    start = time.process_time()
    ocp = tool.Ocp(T=tool.FreeTime(own.guess) if own.duration is FREE else own.duration)
    x, u = [ocp.state() for _ in own.initial], [ocp.control() for _ in own.lower]
    for state, rate, first, last, highest in zip(x, own.rates(x, u), own.initial, own.final, own.highest, strict=True):
        ocp.set_der(state, rate)
        ocp.subject_to(ocp.at_t0(state) == first)
        ocp.subject_to(ocp.at_tf(state) == last)
        if np.isfinite(highest):
            ocp.subject_to(state <= highest)
        ocp.set_initial(state, np.linspace(first, last, n + 1))
    for control, low, high in zip(u, own.lower, own.upper, strict=True):
        if np.isfinite(low):
            ocp.subject_to((low <= control) <= high)
    ocp.add_objective(ocp.T if own.fastest else ocp.integral(own.running(x, u)))
    options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 500}
    ocp.solver("ipopt", options)
    ocp.method(tool.MultipleShooting(N=n, M=1, intg="rk"))
    built = time.process_time()
    solution = ocp.solve()
    cost = float(np.asarray(ca.DM(solution.value(ocp.objective))).item())
    return _result(case, start, built, cost, n, str(solution.stats["return_status"]))


def yapss(case: dict[str, Any]) -> dict[str, Any]:
    """By yapss: Legendre-Gauss-Lobatto collocation on segments of equal length."""
    import yapss as tool

    own, n = PLAIN[case["problem"]], case["intervals"]
    start = time.process_time()
    nx, nu = len(own.initial), len(own.lower)
    integrals = 0 if own.fastest else 1
    problem = tool.Problem(name=case["problem"], nx=[nx], nu=[nu], nq=[integrals])

    def objective(arg: Any) -> None:
        arg.objective = arg.phase[0].final_time if own.fastest else arg.phase[0].integral[0]

    def continuous(arg: Any) -> None:
        phase = arg.phase[0]
        x, u = tuple(phase.state), tuple(phase.control)
        phase.dynamics[:] = tuple(own.rates(x, u))
        if integrals:
            phase.integrand[:] = (own.running(x, u),)

    problem.functions.objective, problem.functions.continuous = objective, continuous
    bounds = problem.bounds.phase[0]
    bounds.initial_time.lower = bounds.initial_time.upper = 0.0
    bounds.final_time.lower = 1e-3 if own.duration is FREE else own.duration
    bounds.final_time.upper = 1e3 if own.duration is FREE else own.duration
    bounds.initial_state.lower[:] = bounds.initial_state.upper[:] = own.initial
    bounds.final_state.lower[:] = bounds.final_state.upper[:] = own.final
    bounds.state.upper[:] = own.highest
    bounds.control.lower[:], bounds.control.upper[:] = own.lower, own.upper
    guess = problem.guess.phase[0]
    guess.time = [0.0, own.duration or own.guess]
    line, control = _guesses(own, np.array([0.0, 1.0]))
    guess.state, guess.control = line.tolist(), [[float(c)] * 2 for c in control]
    mesh = problem.mesh.phase[0]
    points = 10
    mesh.collocation_points, mesh.fraction = (points,) * (n // points), (points / n,) * (n // points)
    problem.derivatives.method, problem.derivatives.order = "auto", "second"
    problem.ipopt_options.print_level, problem.ipopt_options.max_iter = 0, 500
    built = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):
        solution = problem.solve()
    return _result(case, start, built, float(solution.objective), n, str(solution.nlp_info.ipopt_status))


def maptor(case: dict[str, Any]) -> dict[str, Any]:
    """By maptor: Legendre-Gauss-Radau collocation on meshes that refine themselves; its defaults but the tolerance."""
    import maptor as tool

    own = PLAIN[case["problem"]]
    start = time.process_time()
    problem = tool.Problem(case["problem"])
    phase = problem.set_phase(1)
    free = own.duration is FREE
    end = phase.time(initial=0.0, final=(1e-3, 1e3) if free else own.duration).final
    highest = [None if np.isinf(most) else (None, most) for most in own.highest]
    x = [
        phase.state(f"x{i}", initial=first, final=last, boundary=most)
        for i, (first, last, most) in enumerate(zip(own.initial, own.final, highest, strict=False))
    ]
    bounds = [None if np.isinf(low) else (low, high) for low, high in zip(own.lower, own.upper, strict=True)]
    u = [phase.control(f"u{i}", boundary=limits) for i, limits in enumerate(bounds)]
    phase.dynamics(dict(zip(x, own.rates(x, u), strict=True)))
    problem.minimize(end if own.fastest else phase.add_integral(own.running(x, u)))
    degrees = [5] * 4
    ends = np.linspace(0.0, 1.0, len(degrees) + 1)
    phase.mesh(degrees, 2.0 * ends - 1.0)
    parts = zip(ends[:-1], ends[1:], degrees, strict=True)
    states = [_guesses(own, np.linspace(a, b, degree + 1))[0] for a, b, degree in parts]
    controls = [np.tile(_guesses(own, ends)[1][:, None], (1, degree)) for degree in degrees]
    phase.guess(states=states, controls=controls, initial_time=0.0, terminal_time=own.duration or own.guess)
    options = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.max_iter": 500}
    built = time.process_time()
    tolerances = {"error_tolerance": case["refine"], "nlp_options": options, "show_summary": False}
    with contextlib.redirect_stdout(io.StringIO()):
        solution = tool.solve_adaptive(problem, **tolerances)
    count = int(solution.phases[1]["mesh"]["num_intervals"])
    return _result(case, start, built, float(solution.status["objective"]), count, str(solution.status["message"]))
