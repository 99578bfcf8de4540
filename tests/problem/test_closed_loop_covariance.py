"""The covariance of the closed loop as a symbol: its entries, the choice of the gain, what is refused."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co


def stated(**expected):
    """A plant of two states, an unknown and two controls, and its X."""
    ocp = co.Problem(2.0, "plant")
    x = ocp.state("x", 2, initial=[1.0, 0.0], variance=[0.5, 0.0])
    b = ocp.unknown("b", 1.0, 0.3)
    u = ocp.control("u", 2)
    ocp.dynamics(x, ca.vertcat(x[1], -b * x[0]) + u, noise=[0.0, 0.1])
    ocp.measurement("m", x[0], noise=0.1)
    X = ocp.closed_loop_covariance()
    ocp.minimize_expected(**{"running": ca.sumsqr(u) + ca.sumsqr(x), **expected})
    return ocp, x, b, u, X


def test_entries_are_those_of_error_estimate_and_gain():
    ocp, x, b, u, X = stated()
    wanted = [X.matrix, X[x, b], X["x[1]", u], X[u, u], X[x[0] + u[1], x[0] + u[1]], X.deviation(u)]
    ocp.subject_to(X[b, b], upper=9.0, name="asks for the free gain")
    statement = ocp.statement()
    rng = np.random.default_rng(1)
    E, Xhat = (a @ a.T for a in rng.normal(size=(2, 3, 3)))
    C, half = rng.normal(size=(2, 3)), np.tril_indices(3)
    pack = lambda m: m.T[np.triu_indices(3)]  # noqa: E731
    point = (np.zeros(2), np.append(np.zeros(2), C.ravel(order="F")), np.append(pack(E), pack(Xhat)), 0.0, 2.0, 1.0)
    values = [np.asarray(statement.expression(w)(*point).full()) for w in wanted]
    joint = np.block([[E + Xhat, -Xhat @ C.T], [-C @ Xhat, C @ Xhat @ C.T]])
    row = np.array([1.0, 0, 0, 0, 1.0])
    truth = [joint[:3, :3], joint[:2, 2:3], joint[1:2, 3:], joint[3:, 3:], row @ joint @ row]
    assert half[0].size == 6
    for value, number in zip(values, [*truth, np.sqrt(np.diag(joint)[3:])[:, None]], strict=True):
        assert value == pytest.approx(np.asarray(number).reshape(value.shape), rel=1e-12)


def test_roots_have_slopes_where_nothing_scatters():
    ocp, _, _, u, X = stated()
    ocp.subject_to(ca.sqrt(X[u[0], u[0]]) + X.deviation(u[1]) + ca.sqrt(X["x[1]", "x[1]"]), upper=1.0)
    statement = ocp.statement()
    point = [np.zeros(2), np.zeros(8), np.zeros(12), 0.0, 2.0, 1.0]
    inputs = [ca.MX.sym(f"a{i}", np.size(value)) for i, value in enumerate(point)]
    value = statement.path.function(*inputs)
    slopes = [ca.jacobian(value, s) for s in inputs[:3]] + [ca.hessian(value, ca.vertcat(*inputs[1:3]))[0] for _ in ()]
    second = ca.hessian(statement.path.function(*inputs), inputs[1])[0]
    for number in ca.Function("at", inputs, [value, *slopes, second])(*point):
        assert np.isfinite(number.full()).all()


def test_gain_is_chosen_by_what_asks_for_it():
    free, best = "free, for X in", "the best one"
    ocp, x, _, u, X = stated()
    assert best in str(ocp)
    assert ocp.statement().behind
    ocp.subject_to(X[x[0], x[0]], upper=1.0, at="final", name="end")
    assert f"{free} 'end'" in str(ocp)
    assert not ocp.statement().behind
    assert "X[x[0], x[0]] <= 1" in str(ocp)


def test_linear_costs_keep_the_best_gain_and_others_ask_for_a_free_one():
    def of(cost):
        ocp = co.Problem(1.0)
        x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u")
        ocp.dynamics(x, u)
        X = ocp.closed_loop_covariance()
        ocp.minimize_expected(running=u**2 + cost(x, u, X))
        return ocp

    assert of(lambda x, u, X: 3 * X[x, x] + X[u, u] - 0.1 * X[x, u]).statement().behind
    assert of(lambda x, u, X: x * X[x, x]).statement().behind  # along the nominal it is a weight
    assert not of(lambda x, u, X: X[x, x] ** 2).statement().behind
    assert "X in the running cost" in str(of(lambda x, u, X: X.deviation(u)))


def cost_of_the_end(by):
    """Of a double integrator with a terminal cost by(X, x)."""
    ocp = co.Problem(1.0)
    x = ocp.state("x", 2, initial=[0.0, 0.0], variance=[0.4, 0.1])
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u), noise=[0.0, 0.5])
    ocp.measurement("m", x[0], noise=0.2)
    X = ocp.closed_loop_covariance()
    ocp.minimize_expected(running=u**2, terminal=by(X, x))
    return co.solve(ocp, intervals=10, progress=False).cost


def test_a_variance_is_the_entry_of_its_block_in_a_terminal_cost():
    """Written out by component it has no entry of a control, which costs nothing at one instant."""

    wanted = cost_of_the_end(lambda X, x: 5 * X[x, x][0, 0])
    assert cost_of_the_end(lambda X, x: 5 * X[x[0], x[0]]) == pytest.approx(wanted, rel=1e-9)
    assert cost_of_the_end(lambda X, x: 5 * X[2 * x[0], x[0] / 2]) == pytest.approx(wanted, rel=1e-9)
    free = cost_of_the_end(lambda X, x: 5 * X.deviation(x[0]) ** 2)  # a gain of pieces, of second order
    assert free == pytest.approx(wanted, rel=1e-4)


def test_factors_of_what_is_singular_where_nothing_scatters():
    """Determinant and inverse by CasADi's factorisations are those written out."""

    det = lambda V: V[0, 0] * V[1, 1] - V[0, 1] ** 2  # noqa: E731
    pairs = {
        "det": (ca.det, det),
        "inv": (lambda V: 0.01 * ca.trace(ca.inv(V)), lambda V: 0.01 * ca.trace(V) / det(V)),
        "solve": (lambda V: 0.01 * ca.solve(V, ca.DM([1.0, 0.0]))[0], lambda V: 0.01 * V[1, 1] / det(V)),
    }
    for name, pair in pairs.items():
        factored, written = (cost_of_the_end(lambda X, x, of=of: of(X[x, x])) for of in pair)
        assert factored == pytest.approx(written, rel=1e-6), name


def test_a_weight_of_the_control_that_X_makes_negative_is_named():
    """0.2 of the running cost, less 0.6: what is fed back would pay."""

    def weighed(by):
        ocp = co.Problem(1.0)
        x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("push")
        ocp.dynamics(x, u, noise=0.1)
        ocp.measurement("m", x, noise=0.1)
        X = ocp.closed_loop_covariance()
        ocp.minimize_expected(running=0.1 * u**2 + by * X[u, u])
        return ocp.statement()

    weighed(-0.09)
    for by in (-0.3, -0.1):
        with pytest.raises(
            co.ProblemError, match=r"X in the running cost.*control 'push'.*\n.*\n.*\n.*control_weight="
        ):
            weighed(by)


def _after(call):
    ocp, *rest = stated()
    call(ocp, *rest)
    ocp.statement()


def test_wrong_uses_are_refused_by_name():
    cases = {
        "deviation of the control 'u": lambda: stated_with(terminal=lambda X, u: X[u[0], u[0]]),
        "after closed_loop_covariance": lambda: _after(
            lambda ocp, *_: ocp.dynamics(ocp.state("late", initial=0.0), 0.0)
        ),
        "'X' is used twice": lambda: _after(lambda ocp, *_: ocp.closed_loop_covariance()),
        "name 'X' is used twice": lambda: _after(lambda ocp, *_: ocp.state("X", initial=0.0)),
        "noise of 'x'|rate of 'y'": lambda: rate_of_spread(),
        "not part of the closed loop": lambda: _after(lambda ocp, x, b, u, X: X[ca.MX.sym("other"), x]),
        "indexed by two symbols": lambda: _after(lambda ocp, x, b, u, X: X[x]),
        "smallest deviation": lambda: _after(lambda ocp, x, b, u, X: X.deviation(u, -1.0)),
        "nothing is fed back": lambda: without_feedback(),
        "no control whose": lambda: bare(control=False),
        "no state whose": lambda: co.Problem(1.0).closed_loop_covariance(),
    }
    for words, call in cases.items():
        with pytest.raises(co.ProblemError, match=words):
            call()


def stated_with(terminal):
    ocp = bare()
    X = ocp.closed_loop_covariance()
    u = ocp.controls[0].symbol
    ocp.minimize_expected(running=u**2, terminal=terminal(X, u))
    return ocp.statement()


def rate_of_spread():
    ocp = bare()
    X = ocp.closed_loop_covariance()
    u = ocp.controls[0].symbol
    ocp.dynamics(ocp.states[1].symbol, X["x", "x"])
    ocp.minimize_expected(running=u**2)
    return ocp.statement()


def without_feedback():
    ocp = bare()
    X = ocp.closed_loop_covariance()
    ocp.dynamics("y", 0.0)
    ocp.minimize(running=ocp.controls[0].symbol ** 2)
    ocp.subject_to(X["x", "x"], upper=1.0)
    return ocp.statement()


def bare(*, control=True):
    ocp = co.Problem(1.0)
    x = ocp.state("x", initial=0.0, variance=1.0)
    ocp.state("y", initial=0.0)
    if control:
        u = ocp.control("u")
        ocp.dynamics(x, u)
        return ocp
    return ocp.closed_loop_covariance()
