"""Ctrl-C within CasADi, which makes another error of it, is a KeyboardInterrupt of the call that it ended."""

import signal

import casadi as ca
import pytest

import covocp as co
from covocp.base.nodes import Node
from covocp.base.progress import Progress
from covocp.base.threads import one_at_a_time


class Pressed(Node):
    """The function y = x, during which Ctrl-C is pressed from a call of some number on."""

    def __init__(self, presses=1, after=0):
        self.presses, self.after = presses, after
        Node.__init__(self, "pressed", [ca.Sparsity.dense(1)], [ca.Sparsity.dense(1)], {"enable_fd": True})

    def eval_buffer(self, arguments, results):
        if results[0] is not None:
            memoryview(results[0])[:] = memoryview(self.filled(arguments)[0])
        self.after -= 1
        for _ in range(self.presses if self.after < 0 else 0):
            signal.raise_signal(signal.SIGINT)
        return 0


@one_at_a_time
def evaluated(node):
    return float(node(3.0))


def test_casadi_makes_another_error_of_it():
    with pytest.raises(RuntimeError):
        Pressed()(3.0)


def test_it_comes_out_as_it_was_and_the_handler_is_the_one_before():
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt) as caught:
        evaluated(Pressed())
    assert isinstance(caught.value.__cause__, RuntimeError)
    assert signal.getsignal(signal.SIGINT) is handler
    assert evaluated(Pressed(presses=0)) == 3.0


def test_no_fallback_for_errors_of_functions_hides_it():
    @one_at_a_time
    def whatever():
        try:
            return evaluated(Pressed())
        except RuntimeError:
            return None

    @one_at_a_time
    def at_once():
        try:
            return Pressed()(3.0)
        except RuntimeError:
            return None

    for call in (whatever, at_once):
        with pytest.raises(KeyboardInterrupt):
            call()


def test_the_second_one_while_iterating_too():
    @one_at_a_time
    def iterating(presses):
        with Progress("", show=False) as progress:
            Pressed(presses)(3.0)
            return progress.asked

    assert iterating(1)
    with pytest.raises(KeyboardInterrupt):
        iterating(2)


def test_a_handler_of_the_user_decides_what_it_means():
    heard = []
    before = signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    try:
        assert evaluated(Pressed()) == 3.0
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard == [signal.SIGINT]


@pytest.mark.parametrize("call", ["evaluate", "worth", "export"])
def test_in_whatever_is_called(call, tmp_path):
    node = Pressed()
    problem = co.Problem(1.0)
    x = problem.state("x", initial=0.0, variance=0.1)
    u = problem.control("u")
    problem.dynamics(x, u - x, noise=0.1)
    problem.measurement("y", node(x), noise=1.0)
    problem.minimize_expected(running=u**2, terminal=(x - 1) ** 2)
    calls = {
        "evaluate": lambda: co.evaluate(problem, nominal={"u": 0.1}, intervals=4),
        "worth": lambda: co.worth(problem, intervals=4),
        "export": lambda: co.export_c(problem, tmp_path / "c", intervals=4),
    }
    with pytest.raises(KeyboardInterrupt):
        calls[call]()
    assert not list(tmp_path.iterdir())
