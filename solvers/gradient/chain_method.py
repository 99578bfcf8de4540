"""The gradient method for several phases: what it takes of the options, and the outcome as data."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from covocp.base.errors import OutsideDomainError, ProblemError, shown
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.decisions import with_tied_multipliers
from covocp.extremal.extremal import Extremal, Guess
from covocp.extremal.links import ChainOutcome
from covocp.solvers.gradient.chain import ChainIterate, ChainLinear, ChainSpace, chain_space, given_entries
from covocp.solvers.gradient.influence import Sweeps, build_sweeps, terminal_conditions
from covocp.solvers.gradient.iterate import Space, make_space, point_of
from covocp.solvers.gradient.lengths import lengths
from covocp.solvers.gradient.penalty import penalty_groups
from covocp.solvers.gradient.search import Search, Settings
from covocp.solvers.gradient.statuses import Status
from covocp.statement.chain import Chain, Link
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.nlp import check_costs
from covocp.transcription.program import Arrays
from covocp.transcription.trajectory import Trajectory


def check_phases(chain: Chain, settings: Settings) -> None:
    """What the method does not do for phases, by name.

    Raises:
        ProblemError: bounds of a decision that differ, the chord variant, a metric that is an array.
    """
    for link, before, after in zip(chain.links, chain.statements[:-1], chain.statements[1:], strict=True):
        _check_decisions(link, before, after)
    if settings.variant != "gradient" or (not isinstance(settings.weight, str) and np.ndim(settings.weight) > 0):
        chord = settings.variant != "gradient"
        raise ProblemError(
            f"The option '{'variant' if chord else 'weight'}' of the gradient method does not apply to phases.",
            expected="variant='gradient'; weight='adaptive', 'curvature' or one number",
            received=shown(settings.variant if chord else settings.weight),
            remedy="leave it out",
        )


def _check_decisions(link: Link, before: Statement, after: Statement) -> None:
    """A decision has its bounds in the first phase that has it.

    Raises:
        ProblemError: a later phase has others.
    """
    for k in set(after.decisions) & set(link.states):
        name = after.state_names[k]
        place = before.state_names.index(name)
        one, other = ([float(bound[i]) for bound in st.state_bounds] for st, i in ((before, place), (after, k)))
        if one != other:
            raise ProblemError(
                f"The bounds of the decision '{name}' in '{before.name}' and '{after.name}' differ.",
                expected="the same bounds in all phases, for the gradient method",
                received=f"{one} and {other}",
                remedy="give the tighter ones in both, or use method='ipopt'",
            )


class GradientChainSolver:
    """The compiled sweeps of all phases with the settings of the method."""

    def __init__(
        self, chain: Chain, options: tuple[Options, ...], meshes: tuple[Mesh, ...], settings: Settings
    ) -> None:
        """Keep the settings; the sweeps are compiled at the first call of `solve`."""
        self._chain, self._options, self._meshes, self._settings = chain, options, meshes, settings
        self._pairs = (0,) * len(meshes)
        self._sweeps: list[Sweeps] = []

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        """The resolved meshes."""
        return self._meshes

    def solve(self, parameters: Arrays, guesses: tuple[Guess, ...], progress: Progress) -> ChainOutcome:
        """Solve for these parameters from these guesses; the last iterate is returned whatever happens."""
        begin = time.perf_counter()
        misled = self._suited(parameters)
        space = self._space(parameters, guesses)
        built = time.perf_counter()
        pairs = zip(space.parts, guesses, strict=True)
        current = space.at(np.concatenate([point_of(part, guess.trajectory) for part, guess in pairs]))
        self._check(current, misled)
        search = Search(space, self._settings, progress)
        end = search.run(current)
        counts = {
            "iterations": search.control.iterations,
            "build_seconds": built - begin,
            "solve_seconds": time.perf_counter() - built,
            "return_status": str(end.status),
            "variant": self._settings.variant,
            "weight": search.control.weight,
            "passes": search.passes,
            "backward_steps": self._pairs,
            "history": tuple(search.control.history),
        }
        iterate, measures = end.iterate, end.measures
        judged = search.space
        assert isinstance(iterate, ChainIterate)
        assert isinstance(judged, ChainSpace)
        linear = space.linearise(iterate)
        assert isinstance(linear, ChainLinear)
        found, at_ends = space.multipliers(iterate, linear, measures)
        parts = zip(iterate.spaces, iterate.parts, found, strict=True)
        extremals = tuple(
            with_tied_multipliers(
                Extremal(
                    stated=part.sweeps.statement,
                    mesh=part.sweeps.mesh,
                    trajectory=_trajectory(part, own),
                    parameters=part.parameters,
                    multipliers=multipliers,
                )
            )
            for part, own, multipliers in parts
        )
        return ChainOutcome(
            extremals=extremals,
            link_multipliers=space.link_multipliers(iterate, linear, measures),
            bounds_at_ends=tuple((np.zeros_like(last), last) for last in at_ends),
            cost_terms=tuple({"terminal": own.run.terminal, "running": own.run.running} for own in iterate.parts),
            converged=end.status is Status.SOLVED,
            message=end.status.told(misled),
            violations=judged.violations(iterate, self._settings.violation_tolerance),
            stats=counts,
        )

    def _suited(self, parameters: Arrays) -> str:
        """Take the backward steps that these values need; what is too long nonetheless, in words."""
        parts = list(zip(self._chain.statements, self._meshes, self._options, parameters, strict=True))
        found = [lengths(st, mesh, own, values) for st, mesh, own, values in parts]
        wanted = tuple(one.pairs(mesh) for one, mesh in zip(found, self._meshes, strict=True))
        if any(new > old for new, old in zip(wanted, self._pairs, strict=True)):
            self._pairs, self._sweeps = wanted, []
        reasons = [one.reason(mesh, pairs) for one, mesh, pairs in zip(found, self._meshes, self._pairs, strict=True)]
        said = [f"in '{st.name}' {words}" for (st, *_), words in zip(parts, reasons, strict=True) if words]
        return said[0] if said else ""

    def _space(self, parameters: Arrays, guesses: tuple[Guess, ...]) -> ChainSpace:
        """The unknowns of all phases for these parameters, with the compiled sweeps."""
        statements = self._chain.statements
        if not self._sweeps:
            further, by_matrices = 0, False
            for st, mesh, pairs in reversed(list(zip(statements, self._meshes, self._pairs, strict=True))):
                self._sweeps.insert(0, build_sweeps(st, mesh, pairs, further, by_matrices=by_matrices))
                end = terminal_conditions(st)
                further, by_matrices = further + len(end.names), by_matrices or end.matrices
        parts: list[Space] = []
        for i, (sweeps, own, guess) in enumerate(zip(self._sweeps, parameters, guesses, strict=True)):
            st = sweeps.statement
            given = given_entries(self._chain.links[i - 1], st.nx) if i else ()
            groups = penalty_groups(st, sweeps.mesh, sweeps.terminal.rows, follows=i > 0)
            parts.append(make_space(sweeps, groups, own, guess, given))
        return chain_space(tuple(parts), self._chain.links)

    def _check(self, current: ChainIterate, misled: str) -> None:
        """The first trajectory must stay in the domain of the model."""
        for space, own in zip(current.spaces, current.parts, strict=True):
            if np.isfinite(own.run.z).all():
                check_costs(space.sweeps.statement, _trajectory(space, own), own.run.running, own.run.terminal)
        check_domain(current.run.finite, misled)


def check_domain(finite: bool, misled: str) -> None:
    """The first trajectory must be numbers. `misled`: that its steps are too long, where they are.

    Raises:
        OutsideDomainError: it leaves the domain of the model.
        ProblemError: its steps are too long.
    """
    if finite:
        return
    if misled:
        reason, _, remedy = misled.partition(": ")
        raise ProblemError(
            "The trajectory of the first control is NaN or inf.",
            expected="integration steps that are short enough for these values of the parameters",
            received=reason,
            remedy=remedy,
        )
    raise OutsideDomainError(
        "The trajectory of the first control is NaN or inf.",
        expected="a first control along which the model stays in its domain",
        received="a forward integration that diverges",
        remedy="give another guess of the controls, more intervals, or use method='ipopt'",
    )


def _trajectory(space: Space, iterate: Any) -> Trajectory:
    """The run of a phase as data."""
    run, nx = iterate.run, space.sweeps.statement.nx
    u: Array = space.sweeps.mesh.acting(run.u.T).T
    return Trajectory(x=run.z[:, :nx], u=u, e=run.z[:, nx:], duration=run.duration)
