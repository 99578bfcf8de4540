"""Whether the names that a package gives to its macros, types and functions are different ones."""

from __future__ import annotations

from collections.abc import Iterator

from covocp.base.errors import ExportError
from covocp.export.laws.law import Law
from covocp.export.text.casadi_code import core_name
from covocp.export.text.header import STRUCTS, struct_name
from covocp.export.text.numbers import code, constant, size_names

# CasADi calls the functions of its runtime, casadi_copy, casadi_sq, ..., by the name of the package and these.
RUNTIME = "casadi_"


def check_identifiers(package: str, laws: tuple[Law, ...]) -> None:
    """Complain about two things of one name: C has one space of names for macros, types and functions.

    Raises:
        ExportError: with both.
    """
    known = {constant(package, "h"): "the header", f"{package}_real": "the type of all numbers"}
    known |= {code(package, name): f"the status {name}" for law in laws for name in law.statuses}
    for law in laws:
        for name, what in _names(package, law):
            if name in known:
                raise _twice(package, name, known[name], what)
            known[name] = what
    for law in laws:
        if law.name.startswith(RUNTIME):
            raise _runtime(package, law.name)
    for law in laws:  # a parameter or a field hides what it is called like, a macro replaces it
        for port in (*law.inputs, *law.outputs):
            if port.name in known:
                raise _twice(package, port.name, known[port.name], f"'{port.name}' of '{law.name}'")


def _runtime(package: str, name: str) -> ExportError:
    return ExportError(
        f"'{name}' cannot be the name of a function: that of the package would be that of one of CasADi's runtime.",
        expected=f"a name that does not begin with '{RUNTIME}'",
        received=f"{package}_{name}",
        remedy="rename the function",
    )


def _names(package: str, law: Law) -> Iterator[tuple[str, str]]:
    """What one law adds, with words for it."""
    yield f"{package}_{law.name}", f"the function of '{law.name}'"
    yield core_name(package, law), f"what CasADi generates for '{law.name}'"
    if law.kind in STRUCTS:
        yield struct_name(package, law), f"the type of '{law.name}'"
    if law.kind == "controller":
        yield f"{package}_init", "the function that starts the controller"
    for port, names in size_names(package, law).items():
        for name in names:
            yield name, f"the size of '{port}' of '{law.name}'"
    for label in law.constants:
        yield constant(package, label.partition(" ")[0]), f"a constant of '{law.name}'"


def _twice(package: str, name: str, first: str, second: str) -> ExportError:
    return ExportError(
        f"Two things of the package '{package}' would be called '{name}' in C.",
        expected="different names, in capitals too",
        received=f"{first}; {second}",
        remedy="rename one of the functions, inputs or outputs, or the package by name=",
    )
