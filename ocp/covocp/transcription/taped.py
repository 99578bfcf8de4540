"""Slopes of a program past passages that CasADi does not differentiate: each is gone back through by its own function.

CasADi differentiates what is between them: the run of the nominal, what passages are given, what follows from them.
"""

from __future__ import annotations

from typing import Any, Protocol

import casadi as ca

from covocp.base.expressions import Expr
from covocp.passage.written import Tape
from covocp.statement.interval import Interval
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.shooting import nominal_run, shoot


class Variables(Protocol):
    """Of a program: the column of all, parameters, the intervals, and what `shoot` reads."""

    w: Any
    p: Any

    @property
    def intervals(self) -> Interval:
        """Of the mesh."""


class Taped:
    """The nodes of a program, and the slopes of what follows from them.

    Args:
        statement: the problem.
        mesh: of it; its matrices pass apart from the nominal.
        variables: of the program.
        tape: takes the passages.

    Attributes:
        given: what `shoot` returns where the run and the passages are symbols.
        nodes: what it returns of the run and the passages themselves.
    """

    def __init__(self, statement: Statement, mesh: Mesh, variables: Variables, tape: Tape) -> None:
        """Run the nominal and all passages."""
        run = nominal_run(statement, mesh, variables, variables.intervals)
        symbols = [ca.MX.sym(name, *value.shape) for name, value in zip(("ends", "fine", "cost"), run, strict=True)]
        self.given = shoot(statement, mesh, variables, passage=tape.passed_by, run=(symbols[0], symbols[1], symbols[2]))
        self._calls = tape.calls
        self._run = ca.Function("nominal_run", [variables.w, variables.p], list(run))
        self._symbols = [variables.w, variables.p, *symbols]
        self._values = [variables.w, variables.p, *run]
        self._before: list[ca.Function] = []
        self._arguments: list[list[Any]] = []
        self._passed: list[Any] = []
        for k, call in enumerate(self._calls):
            before = ca.Function(f"before_passage_{k}", list(self._symbols), [ca.densify(a) for a in call.arguments])
            arguments = before.call(self._values)
            passed = call.forward(*arguments)
            after = ca.reshape(passed[: call.after.numel()], *call.after.shape)
            self._before.append(before)
            self._arguments.append(arguments)
            self._passed.append(passed)
            self._symbols.append(call.after)
            self._values.append(after)
        named = {name: value for name, value in self.given.items() if name != "run"}
        function = ca.Function("after_passages", self._symbols, list(named.values()))
        values = function.call(self._values, True, False)
        self.nodes: dict[str, Any] = {**dict(zip(named, values, strict=True)), "run": run}

    def slopes(self, number: Expr, rows: Expr) -> tuple[Any, Any]:
        """The gradient of a number and the Jacobian of some rows by the variables, dense.

        Args:
            number: an expression of `given`.
            rows: the same.
        """
        of = ca.vertcat(number, rows)
        count = of.shape[0]
        back = self._back(of)
        given = [*self._values, *(a for arguments in self._arguments for a in arguments), *self._passed]
        columns = [back(*given, column) for column in ca.horzsplit(ca.DM.eye(count))]
        return columns[0], ca.horzcat(ca.DM(columns[0].shape[0], 0), *columns[1:]).T

    def _back(self, of: Expr) -> ca.Function:
        """(values of the symbols, arguments of the passages, what they returned, seeds) -> slopes by the variables."""
        seed = ca.MX.sym("seed", of.shape[0])
        arguments = [[ca.MX.sym("argument", *a.shape) for a in given] for given in self._arguments]
        passed = [ca.MX.sym("passed", *value.shape) for value in self._passed]
        after = ca.Function("after", self._symbols, [ca.densify(of)])
        own = _gone_back(after, self._symbols, [seed])
        first = len(self._symbols) - len(self._calls)
        for k in range(len(self._calls) - 1, -1, -1):
            call = self._calls[k]
            column = call.slopes(*arguments[k][1:], passed[k], ca.densify(own.pop()))
            moved = _gone_back(self._before[k], self._symbols[: first + k], call.split(column))
            own = [one + other for one, other in zip(own, moved, strict=True)]
        by_w = own[0] + _gone_back(self._run, self._symbols[:2], own[2:])[0]
        inputs = [*self._symbols, *(a for given in arguments for a in given), *passed, seed]
        return ca.Function("gone_back", inputs, [ca.densify(by_w)])


def _gone_back(function: ca.Function, arguments: list[Any], seeds: list[Any]) -> list[Any]:
    """Slopes by the arguments of a function, of its results weighed by seeds."""
    results = [ca.DM(*function.size_out(i)) for i in range(function.n_out())]
    return function.reverse(1).call([*arguments, *results, *seeds], True, False)
