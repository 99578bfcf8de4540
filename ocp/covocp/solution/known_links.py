"""What files know of what passes from each phase to the next: its names, and its values at points kept with them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.matrices import Array
from covocp.base.pieces import expanded, operands_of
from covocp.base.short_repr import short_repr
from covocp.solution.points import ALONG, apart, evaluated, one_number, same_columns, spread_points
from covocp.solution.solution import Solution
from covocp.statement.chain import Link

# Arguments of the function of a link, in their order; the third one is a time.
INPUTS = ("x", "e", "T", "p", "later")


@dataclass(frozen=True, kw_only=True)
class KnownLink:
    """Of a link, as plain data.

    Attributes:
        casadi: the version that evaluated the functions.
        names: of the rows.
        points: arguments of its function, a row each in the order of `INPUTS`.
        values: of its rows at the points, (K, rows).
        operands: what its pieces compare, round or choose at the points, (K, operands).
    """

    casadi: str
    names: tuple[str, ...]
    points: Annotated[Array, "points any"]
    values: Annotated[Array, "points any"]
    operands: Annotated[Array, "points any"]

    __repr__ = short_repr


def known_link(link: Link, before: Solution, after: Solution) -> KnownLink:
    """What tells a link from others.

    Args:
        link: between two phases.
        before: solution of the phase that ends there; points lie along it, around it and far from it.
        after: solution of the phase that begins there.
    """
    t = before.trajectory
    rows = np.unique(np.linspace(t.x.shape[0] - 1, 0, ALONG).round().astype(int))
    constants = np.concatenate([[t.duration], before.parameters, after.parameters])
    along = np.hstack([t.x[rows], t.e[rows], np.tile(constants, (rows.size, 1))])
    time = t.x.shape[1] + t.e.shape[1]
    return _at(link, spread_points(along, slice(time, time + 1)))


def check_links(known: Sequence[KnownLink], links: Sequence[Link]) -> None:
    """Links must be those that are known.

    Raises:
        ProblemError: the first row that differs, or a place where a jump switches.
    """
    for own, link in zip(known, links, strict=True):
        if own.names != link.names:
            stored, given = (", ".join(set(a) - set(b)) for a, b in ((own.names, link.names), (link.names, own.names)))
            raise _of_others(given or stored, stored or "not there", given or "not there")
        if own.points.shape[1] != sum(_sizes(link).values()):
            raise _of_others("number of symbols", str(own.points.shape[1]), str(sum(_sizes(link).values())))
        found = _at(link, own.points)
        differ = apart(own.values, found.values)
        if differ.any():
            entry, row = np.argwhere(differ.T)[0]  # the first row of the link, states before covariances
            old, new = (one_number(values[row, entry]) for values in (own.values, found.values))
            raise _of_others(link.names[entry], old, new)
        if own.casadi == found.casadi and not same_columns(own.operands, found.operands):
            raise _of_others("place where a jump switches", "elsewhere", "the given one")


def _sizes(link: Link) -> dict[str, int]:
    return {name: link.function.size1_in(i) for i, name in enumerate(INPUTS)}


def _at(link: Link, points: Array) -> KnownLink:
    """The names, and the values at these points."""
    sizes, function = _sizes(link), expanded(link.function)
    operands = operands_of(function)
    return KnownLink(
        casadi=ca.CasadiMeta.version(),
        names=link.names,
        points=points,
        values=np.hstack(evaluated(function, points, sizes)),
        operands=np.zeros((points.shape[0], 0)) if operands is None else np.abs(evaluated(operands, points, sizes)[0]),
    )


def _of_others(what: str, stored: str, given: str) -> ProblemError:
    """The error that names what differs."""
    return ProblemError(
        f"The stored solution is of other phases: the {what} differs.",
        expected=f"as stored: {stored}",
        received=f"as given: {given}",
        remedy="give the phases that were solved, with their jumps, or load without them",
    )
