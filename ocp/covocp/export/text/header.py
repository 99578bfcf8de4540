"""The header of a package: types, sizes, status codes and the functions that the user calls."""

from __future__ import annotations

from covocp.export.laws.law import Law, Port, stacked_size
from covocp.export.text.casadi_code import Generated, Sizes
from covocp.export.text.numbers import code, comment, constant, described, real, size_names, status_lines

STRUCTS = {"sample": "point", "controller": "controller", "solver": "workspace"}


def struct_name(package: str, law: Law) -> str:
    """The type that a law fills, keeps or works in; of the sample of a part, `sample_<part>`, that of the part."""
    part = law.name.removeprefix("sample_") + "_" if law.kind == "sample" and law.name != "sample" else ""
    return f"{package}_{part}{STRUCTS[law.kind]}"


def header(package: str, title: tuple[str, ...], laws: tuple[Law, ...], generated: Generated, real: str) -> str:
    """The text of the header.

    Args:
        package: name of the package.
        title: lines of the first comment.
        laws: that the package has.
        generated: code of the laws, for their work arrays.
        real: "double" or "float".
    """
    guard = constant(package, "h")
    statuses = {name for law in laws for name in law.statuses}
    parts = [
        comment(title),
        f"#ifndef {guard}\n#define {guard}",
        '#ifdef __cplusplus\nextern "C" {\n#endif',
        f"/* Every real number of this package. */\ntypedef {real} {package}_real;",
        "/* What the functions return. */\n" + "\n".join(status_lines(package, statuses)),
        *(_declared(package, law, generated) for law in laws),
        "#ifdef __cplusplus\n}\n#endif",
        f"#endif /* {guard} */",
    ]
    return "\n\n".join(parts) + "\n"


def parameters(package: str, law: Law) -> list[str]:
    """Declarations of the parameters of the C function of a law."""
    names, real = size_names(package, law), f"{package}_real"

    def into(port: Port) -> str:
        return f"{real} {port.name}" if port.scalar else f"const {real} {port.name}[{' * '.join(names[port.name])}]"

    def out(port: Port) -> str:
        return f"{real} *{port.name}" if port.scalar else f"{real} {port.name}[{' * '.join(names[port.name])}]"

    given = [into(port) for port in law.arguments]
    if law.kind == "sample":
        return [*given, f"{struct_name(package, law)} *point"]
    if law.kind == "controller":
        return [f"{struct_name(package, law)} *self", *given, *(out(p) for p in law.outputs if p.name == "control")]
    results = [out(port) for port in law.results]
    first = [f"{struct_name(package, law)} *workspace"] if law.kind == "solver" else []
    return [*first, *given, *results]


def signature(package: str, law: Law) -> str:
    """The C function of a law, without the semicolon."""
    listed = parameters(package, law)
    text = f"int {package}_{law.name}({', '.join(listed) or 'void'})"
    if len(text) <= 110:
        return text
    return f"int {package}_{law.name}(\n    " + ",\n    ".join(listed) + ")"


def _declared(package: str, law: Law, generated: Generated) -> str:
    """Sizes, type and prototype of a law."""
    ports = {port.name: port for port in (*law.inputs, *law.fields)}
    defined = []
    for name, constants in size_names(package, law).items():
        for text, number in zip(constants, (ports[name].rows, ports[name].columns), strict=False):
            defined.append(f"#define {text} {number}")
    for name, value in law.constants.items():
        label, _, unit = name.partition(" ")
        signed = f"({real(value)})" if value < 0 else real(value)
        defined.append(f"#define {constant(package, label)} {signed}" + (f" /* {_plain(unit)} */" if unit else ""))
    parts = ["\n".join(defined)] if defined else []
    if law.kind in ("sample", "controller"):
        parts.append(_fields(package, law))
    if law.kind == "solver":
        parts.append(_workspace(package, law, generated.sizes[law.name]))
    if law.kind == "controller":
        parts.append(
            "/* Sets the struct to the start of the nominal, the estimate to the mean. */\n"
            f"void {package}_init({struct_name(package, law)} *self);"
        )
    if law.kind == "solver":
        guess = size_names(package, law)["guess"][0]
        parts.append(
            "/* Variables of the plan made at the export, where a solver may start. */\n"
            f"extern const {package}_real {package}_guess[{guess}];\n"
            f"extern const int {package}_workspace_bytes;"
        )
    parts.append(comment(_explained(package, law, generated.alone)) + f"\n{signature(package, law)};")
    return "\n\n".join(parts)


def _explained(package: str, law: Law, alone: bool) -> list[str]:
    """The comment of a function: what it does, its parameters, what it returns."""
    lines = [*law.about, ""]
    lines += [f"{port.name}: {described(port)}".rstrip(": ") for port in law.arguments]
    if law.kind in ("function", "solver"):
        lines += [f"{port.name} (result): {described(port)}".rstrip(": ") for port in law.results]
        lines.append("Results may be written over arguments.")
    if law.kind == "controller":
        lines += [f"self: kept from call to call; {package}_init() before the first one.", "control (result): see self"]
    if law.kind == "sample":
        lines.append("point (result): see there")
    if law.kind == "solver":
        at_once = (
            "one call at a time, whatever its workspace" if alone else "of calls at the same time each has its own"
        )
        lines.append(f"workspace: any, of the caller; {at_once}. guess may be NULL: that of the export.")
    return [*lines, "Returns: " + ", ".join(code(package, name) for name in law.statuses) + "."]


def _fields(package: str, law: Law) -> str:
    """The struct of a sample or a controller."""
    names, lines = size_names(package, law), []
    for port in law.fields:
        kind = "int" if port.whole else f"{package}_real"
        dimensions = "".join(f"[{name}]" for name in names.get(port.name, ()))
        about = described(port).replace(", row by row", "")
        lines.append(f"    {kind} {port.name}{dimensions};" + (f" /* {_plain(about)} */" if about else ""))
    return "typedef struct {\n" + "\n".join(lines) + f"\n}} {struct_name(package, law)};"


def _workspace(package: str, law: Law, sizes: Sizes) -> str:
    """The struct that a solver works in."""
    return (
        "/* What the solver works in; the contents mean nothing to the caller. */\n"
        "typedef struct {\n"
        f"    {package}_real results[{stacked_size(law.outputs)}];\n"
        f"    {package}_real reals[{sizes.reals + 1}];\n"
        f"    int integers[{sizes.integers + 1}];\n"
        f"}} {struct_name(package, law)};"
    )


def _plain(text: str) -> str:
    """What may stand within a comment."""
    return text.replace("*/", "* /").replace("/*", "/ *").encode("ascii", "replace").decode()
