"""The C file of a package: around each function of CasADi's one that checks, keeps and copies."""

from __future__ import annotations

from textwrap import indent

from covocp.base.matrices import Array
from covocp.export.laws.law import RETURNED, Law, Port, span
from covocp.export.text.casadi_code import Sizes, core_name
from covocp.export.text.header import signature, struct_name
from covocp.export.text.numbers import code, row, table

FINITE = """\
/* Whether all numbers are finite. */
static int all_finite(const {real} *values, int count)
{{
    int i;
    for (i = 0; i < count; ++i) {{
        if (!isfinite(values[i])) {{
            return 0;
        }}
    }}
    return 1;
}}"""


def source(package: str, laws: tuple[Law, ...], sizes: dict[str, Sizes]) -> str:
    """The text of the C file."""
    real = f"{package}_real"
    prototypes = "\n".join(
        f"int {core_name(package, law)}(const {real} **arg, {real} **res, int *iw, {real} *w, int mem);" for law in laws
    )
    parts = [f'/* See {package}.h. */\n#include "{package}.h"\n\n#include <math.h>\n#include <string.h>', prototypes]
    if any(law.kind in ("function", "solver") for law in laws):
        parts.append(FINITE.format(real=real))
    writers = {"function": _function, "sample": _sample, "controller": _controller, "solver": _solver}
    parts += [writers[law.kind](package, law, sizes[law.name]) for law in laws]
    return "\n\n".join(parts) + "\n"


def _work(package: str, sizes: Sizes, *, arrays: bool = True) -> list[str]:
    """Declarations of the work arrays."""
    real = f"{package}_real"
    lines = [f"const {real} *arg_[{max(sizes.arguments, 1)}];", f"{real} *res_[{sizes.results}];"]
    if arrays:
        lines += [f"int iw_[{sizes.integers + 1}];", f"{real} w_[{sizes.reals + 1}];"]
    return lines


def _called(package: str, law: Law, work: str = "iw_, w_") -> str:
    return f"{core_name(package, law)}(arg_, res_, {work}, 0) != 0"


def _body(lines: list[str]) -> str:
    return indent("\n".join(lines), "    ")


def _address(port: Port, owner: str = "") -> str:
    """Pointer to the first number of a parameter, or of a field of a struct (owner: "self->")."""
    if port.scalar:
        return f"&{owner}{port.name}"
    return f"&{owner}{port.name}[0][0]" if owner and port.columns > 1 else f"{owner}{port.name}"


def _copied(port: Port, origin: str) -> str:
    """A result handed to the caller."""
    if port.scalar:
        return f"*{port.name} = {origin}[0];"
    return f"memcpy({port.name}, {origin}, {port.size} * sizeof({port.name}[0]));"


def _function(package: str, law: Law, sizes: Sizes) -> str:
    """Arguments in, results out, written only where all of them are finite."""
    buffers = [(port, f"out{i}_") for i, port in enumerate(law.outputs)]
    lines = _work(package, sizes)
    lines += [f"{package}_real {name}[{port.size}];" for port, name in buffers]
    lines += [f"arg_[{i}] = {_address(port)};" for i, port in enumerate(law.inputs)]
    lines += [f"res_[{i}] = {name};" for i, (_, name) in enumerate(buffers)]
    lines += [f"if ({_called(package, law)}) {{", f"    return {code(package, 'FAILED')};", "}"]
    finite = " && ".join(f"all_finite({name}, {port.size})" for port, name in buffers)
    lines += [f"if (!({finite})) {{", f"    return {code(package, 'RESULT_NOT_FINITE')};", "}"]
    lines += [_copied(port, name) for port, name in buffers]
    lines.append(f"return {code(package, 'OK')};")
    return f"{signature(package, law)}\n{{\n{_body(lines)}\n}}"


def _sample(package: str, law: Law, sizes: Sizes) -> str:
    """A time in, a struct out."""
    lines = [*_work(package, sizes), f"{package}_real status_;"]
    whole = [port.name for port in law.results if port.whole]
    lines += [f"{package}_real {name}_whole_;" for name in whole]
    lines += [f"arg_[{i}] = {_address(port)};" for i, port in enumerate(law.inputs)]
    lines += [
        f"res_[{i}] = " + (f"&{port.name}_whole_;" if port.whole else f"{_address(port, 'point->')};")
        for i, port in enumerate(law.results)
    ]
    lines += [f"res_[{len(law.results)}] = &status_;"]
    failed = code(package, "FAILED")
    lines += [f"if ({_called(package, law)}) {{", f"    point->status = {failed};", f"    return {failed};", "}"]
    lines += [f"point->{name} = (int){name}_whole_;" for name in whole]
    lines += ["point->status = (int)status_;", "return point->status;"]
    return f"{signature(package, law)}\n{{\n{_body(lines)}\n}}"


def _controller(package: str, law: Law, sizes: Sizes) -> str:
    """The struct before a step in, the one after it out."""
    kind = struct_name(package, law)
    whole = {port.name for port in law.results if port.whole}
    ports = {port.name: port for port in law.fields}
    lines = [f"{kind} next_;", *_work(package, sizes), f"{package}_real status_;"]
    lines += [f"{package}_real {name}_after_;" for name in sorted(whole)]
    lines += [f"{package}_real {name}_before_;" for name in sorted(whole & set(law.held.values()))]
    own = law.returned == RETURNED  # through an array, as the caller's may be that of an argument
    lines += [f"{package}_real {RETURNED}_[{ports['control'].size}];"] if own else []
    lines.append("do {")
    inner = []
    for i, port in enumerate(law.inputs):
        kept = law.held.get(port.name)
        if kept in whole:
            inner += [f"{kept}_before_ = ({package}_real)self->{kept};", f"arg_[{i}] = &{kept}_before_;"]
        else:
            inner.append(f"arg_[{i}] = {_address(ports[kept], 'self->') if kept else _address(port)};")
    for i, port in enumerate(law.results):
        target = f"&{port.name}_after_" if port.name in whole else _address(port, "next_.")
        target = f"{RETURNED}_" if port.name == RETURNED else target
        inner.append(f"res_[{i}] = {target};")
    inner.append(f"res_[{len(law.results)}] = &status_;")
    inner += [f"if ({_called(package, law)}) {{", f"    self->status = {code(package, 'FAILED')};", "    break;", "}"]
    inner += [f"next_.{name} = (int){name}_after_;" for name in sorted(whole)]
    inner += ["next_.status = (int)status_;", "*self = next_;"]
    lines += [f"    {line}" for line in inner]
    lines += ["} while (self->status < 0);"]
    control = ports["control"]
    kept = _copied(control, f"({_address(control, 'self->')})")
    if own:
        failed = f"if (self->status == {code(package, 'FAILED')}) {{"
        lines += [failed, f"    {kept}", "} else {", f"    {_copied(control, f'{RETURNED}_')}", "}"]
    else:
        lines.append(kept)
    lines.append("return self->status;")
    step = f"{signature(package, law)}\n{{\n{_body(lines)}\n}}"
    begin = f"    static const {kind} start_ = {{\n        {_initial(law)}\n    }};\n    *self = start_;"
    return f"void {package}_init({kind} *self)\n{{\n{begin}\n}}\n\n{step}"


def _initial(law: Law) -> str:
    """First values of the fields, nested as the struct is."""
    fields = []
    for port in law.fields:
        values = law.start[span(law.outputs, port.name)]
        if port.whole:
            fields.append(str(int(values[0])))
        elif port.scalar:
            fields.append(row(values)[1:-1])
        elif port.columns == 1:
            fields.append(row(values))
        else:
            fields.append("{" + ", ".join(row(v) for v in values.reshape(port.shape)) + "}")
    return ",\n        ".join(fields)


def _solver(package: str, law: Law, sizes: Sizes) -> str:
    """Works in the caller's workspace; where no plan is found that of the export is returned."""
    real = f"{package}_real"
    lines = [*_work(package, sizes, arrays=False), f"{real} *const out_ = workspace->results;"]
    lines += ["int status_ = " + code(package, "OK") + ";"]
    lines += [
        f"arg_[{i}] = "
        + (f"{port.name} != 0 ? {port.name} : {package}_guess;" if port.name == "guess" else f"{_address(port)};")
        for i, port in enumerate(law.inputs)
    ]
    finite = " && ".join(f"all_finite(arg_[{i}], {port.size})" for i, port in enumerate(law.inputs))
    offsets = [span(law.outputs, port.name).start for port in law.outputs]
    inner = [f"res_[{i}] = out_ + {offset};" for i, offset in enumerate(offsets)]
    inner.append(f"if ({_called(package, law, 'workspace->integers, workspace->reals')}")
    inner.append(f"    || !all_finite(out_, {offsets[-1] + 1})) {{")
    inner += [f"    status_ = {code(package, 'FAILED')};", "} else {", f"    status_ = (int)out_[{offsets[-1]}];", "}"]
    lines += [f"if (!({finite})) {{", f"    status_ = {code(package, 'ARGUMENT_NOT_FINITE')};", "} else {"]
    lines += [*(f"    {line}" for line in inner), "}"]
    stops = " || ".join(f"status_ == {code(package, name)}" for name in ("ARGUMENT_NOT_FINITE", "FAILED"))
    lines += [f"if ({stops}) {{", f"    memcpy(out_, {package}_safe_, sizeof({package}_safe_));", "}"]
    lines += [_copied(port, f"(out_ + {offset})") for port, offset in zip(law.results, offsets, strict=False)]
    lines.append("return status_;")
    values = law.safe[:-1]
    constants = [
        f"const int {package}_workspace_bytes = (int)sizeof({struct_name(package, law)});",
        table(f"{package}_guess", _part(law, "variables"), real, "const"),
        "/* The plan made at the export. */\n" + table(f"{package}_safe_", values, real),
    ]
    return "\n\n".join(constants) + f"\n\n{signature(package, law)}\n{{\n{_body(lines)}\n}}"


def _part(law: Law, name: str) -> Array:
    return law.safe[span(law.outputs, name)]
