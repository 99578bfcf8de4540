"""An error says four things, keeps them, and survives the way to another process."""

import copy
import pickle

import pytest

import covocp as co

PARTS = {"expected": "a number", "received": "'x'", "remedy": "correct gain="}


@pytest.mark.parametrize("kind", [co.CovocpError, co.ProblemError, co.ExportError, co.SolveError])
def test_the_message_has_a_line_for_each_part(kind):
    error = kind("The gain is wrong.", **PARTS)
    lines = str(error).splitlines()
    assert lines == ["The gain is wrong.", "  expected: a number", "  received: 'x'", "  remedy:   correct gain="]
    assert (error.problem, error.expected, error.received, error.remedy) == ("The gain is wrong.", *PARTS.values())


def test_parts_that_are_not_given_leave_no_line():
    assert str(co.ProblemError("It is wrong.", remedy="mend it")) == "It is wrong.\n  remedy:   mend it"
    assert str(co.ProblemError("It is wrong.")) == "It is wrong."


def test_an_error_that_was_sent_to_another_process_is_the_same():
    error = co.SolveError("It was not solved.", **PARTS, violations={"x": 0.3})
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is co.SolveError
    assert str(again) == str(error)
    assert vars(again) == vars(error)


class _Symbols:
    """As a solution: made of what cannot be pickled."""

    cost = 3.0

    def __reduce__(self):
        raise co.ProblemError("Solutions cannot be pickled.")


@pytest.mark.parametrize("kind", [co.SolveError, co.Interrupted])
def test_what_cannot_be_pickled_stays_behind_and_the_rest_of_the_error_arrives(kind):
    numbers = {"violations": {"x": 0.3}} if kind is co.SolveError else {}
    error = kind("It was not solved.", solution=_Symbols(), **numbers)
    error.add_note("point 7 of the sweep")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert str(again) == "It was not solved."
    assert again.__notes__ == ["point 7 of the sweep"]
    assert {name: getattr(again, name) for name in numbers} == numbers
    assert not again.solution
    assert "error.solution.save(path)" in str(again.solution)
    assert not hasattr(again.solution, "cost")
    for ask in (lambda: again.solution.cost, lambda: again.solution["x"]):
        with pytest.raises(
            co.ProblemError, match=r"stayed in the process(?s:.*)remedy: .*call error\.solution\.save\(path\)"
        ):
            ask()
    assert str(pickle.loads(pickle.dumps(again)).solution) == str(again.solution)  # of a process within a process


@pytest.mark.parametrize("kind", [co.SolveError, co.Interrupted])
def test_a_copy_within_the_process_has_all_of_an_error(kind):
    error = kind("It was not solved.", solution=_Symbols())
    for again in (copy.copy(error), copy.deepcopy(error)):
        assert type(again) is kind
        assert vars(again) == vars(error)
