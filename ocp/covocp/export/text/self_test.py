"""The self-test of a package: reference vectors that Python has written, compared with what the C functions return."""

from __future__ import annotations

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ExportError
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.export.laws.law import CODES, RETURNED, Law, Port, span, stacked_size
from covocp.export.text.header import struct_name
from covocp.export.text.numbers import code, row, table, wrapped

# Share of the middle value of an entry below which its deviation counts as that of a value of this size. In single
# precision all of it: what nearly cancels keeps the rounding of what it came from.
FLOORS = {"double": 1e-3, "single": 1.0}
SEED = 1971
POINTS = 40
# Points of functions that are not random, at which some of them fail.
EDGES = 4
MAIN = """\
static volatile {real} sink_;

/* Largest deviation of the results, relative to the expected ones where these are not small. */
static double deviation_of(const {real} *got, const {real} *expected, const double *smallest, int count)
{{
    double largest = 0.0;
    int i;
    for (i = 0; i < count; ++i) {{
        const double a = (double)got[i], b = (double)expected[i];
        double size = fabs(b) > smallest[i] ? fabs(b) : smallest[i], one;
        if (a == b || (isnan(a) && isnan(b))) {{
            continue;
        }}
        one = isfinite(a) && isfinite(b) && size > 0.0 ? fabs(a - b) / size : HUGE_VAL;
        largest = one > largest ? one : largest;
    }}
    return largest;
}}

static int finish(const char *name, int rows, double deviation, double tolerance, int wrong)
{{
    const int failed = wrong > 0 || !(deviation <= tolerance);
    printf("%s: %d points, largest deviation %.3g (allowed %.3g), %d wrong status: %s\\n", name, rows, deviation,
        tolerance, wrong, failed ? "FAILED" : "passed");
    return failed;
}}

int main(int argc, char **argv)
{{
    const long count = argc > 2 && strcmp(argv[1], "--time") == 0 ? atol(argv[2]) : 0;
    int failures = 0;
{calls}
    return failures == 0 ? 0 : 1;
}}
"""
TEST = """\
static int test_{law}(void)
{{
    {real} got[{outputs}] = {{0}};
    double largest = 0.0, one;
    int row, wrong = 0;
    for (row = 0; row < {rows}; ++row) {{
        if (call_{law}({law}_in[row], got) != {law}_status[row]) {{
            ++wrong;
            continue;
        }}
        if ({law}_status[row] == {unwritten}) {{
            continue;
        }}
        one = deviation_of(got, {law}_out[row], {law}_smallest, {outputs});
        largest = one > largest ? one : largest;
    }}
    return finish("{law}", {rows}, largest, {tolerance}, wrong);
}}

static void speed_{law}(long count)
{{
    {real} got[{outputs}] = {{0}};
    const clock_t begin = clock();
    long i;
    int row = 0, tried;
    for (i = 0; i < count; ++i) {{
        for (tried = 0; tried < {rows}; ++tried) {{ /* the next point where nothing is wrong */
            row = (row + 1) % {rows};
            if ({law}_status[row] == 0) {{
                break;
            }}
        }}
        call_{law}({law}_in[row], got);
        sink_ = got[0];
    }}
    printf("{law}: %.2f ns\\n", 1e9 * (double)(clock() - begin) / CLOCKS_PER_SEC / (double)count);
}}"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """What a law returns at some points, as the C function should.

    rows: inputs, one row a point; values: results without the status; status; smallest: sizes below which an entry of
    the results counts as of this size, from all points.
    """

    rows: Array
    values: Array
    status: Array
    smallest: Array

    __repr__ = short_repr

    def deviations(self, values: Array, status: Array) -> Array:
        """Largest relative deviation at each point; infinite where the status is another one."""
        size = np.maximum(np.abs(self.values), self.smallest)
        with np.errstate(invalid="ignore", divide="ignore"):
            error = np.abs(values - self.values) / size
        same = (values == self.values) | (np.isnan(values) & np.isnan(self.values))
        error = np.where(same, 0.0, np.where(np.isfinite(error), error, np.inf))
        unwritten = self.status == CODES["RESULT_NOT_FINITE"]
        worst = np.where(unwritten, 0.0, error.max(axis=1, initial=0.0))
        return np.where(status == self.status, worst, np.inf)


def reference(law: Law, count: int, seed: int, precision: str) -> Reference:
    """Points, and what the law returns there.

    Args:
        law: to be compared.
        count: number of points.
        seed: of the random ones.
        precision: inputs are rounded to it.

    Raises:
        ExportError: a function that cannot be evaluated at most of its points, or is finite at none.
    """
    rows, values = _evaluated(law, min(count, law.most), seed, precision)
    if law.kind == "function":
        if not np.isfinite(values).all(axis=1).any():  # the last point becomes one at which something is compared
            rows[-1], values[-1] = _finite_point(law, 2 * max(count, POINTS), seed, precision)
        broken = ~np.isfinite(values).all(axis=1)
        status = np.where(broken, CODES["RESULT_NOT_FINITE"], CODES["OK"])
    else:
        status, values = values[:, -1], values[:, :-1]
    finite = np.where(np.isfinite(values), np.abs(values), 0.0)
    least = np.repeat([port.least for port in law.results], [port.size for port in law.results])
    smallest = np.maximum(FLOORS[precision] * np.median(finite, axis=0), least)
    return Reference(rows=rows, values=values, status=status.astype(int), smallest=smallest)


def _evaluated(law: Law, count: int, seed: int, precision: str) -> tuple[Array, Array]:
    """Points and the values there; of a function without those where it fails, as where a matrix has no inverse."""
    rows = _points(law, count, seed, precision)
    try:
        return rows, law.values(rows)
    except RuntimeError as error:
        if law.kind != "function":
            raise
        reason = str(error).strip().splitlines()[-1]
    rows = _points(law, 2 * count + EDGES, seed, precision)
    known = [(row, values) for row in rows if (values := _value(law, row)) is not None]
    if len(known) < count:
        raise ExportError(
            f"The function '{law.name}' cannot be evaluated at most points at which C is to be compared with it.",
            expected=f"{count} of {len(rows)} points between the ranges, or of normal numbers, where it has a value",
            received=f"{len(known)}; at the others: {reason}"[:200],
            remedy="give ranges= of its inputs within which it has values: no singular matrices",
        )
    return np.array([row for row, _ in known[:count]]), np.array([values for _, values in known[:count]])


def _finite_point(law: Law, count: int, seed: int, precision: str) -> tuple[Array, Array]:
    """A point at which all results of a function are finite, and what they are.

    Raises:
        ExportError: there is none among some.
    """
    rows, values = _evaluated(law, count, seed, precision)
    finite = np.isfinite(values).all(axis=1)
    if finite.any():
        first = int(np.argmax(finite))
        return rows[first], values[first]
    sizes = np.cumsum([port.size for port in law.results])[:-1]
    never = [
        f"'{port.name}' is {'finite at none' if not finite.any() else 'not always finite'}"
        for port, part in zip(law.results, np.split(values, sizes, axis=1), strict=True)
        if not (finite := np.isfinite(part).all(axis=1)).all()
    ]
    raise ExportError(
        f"The function '{law.name}' has finite results at no point at which C is to be compared with it.",
        expected="points between the ranges, or of normal numbers, where all of its results are finite",
        received=f"of {len(values)} points none: {', '.join(never)}"[:200],
        remedy="give ranges= of its inputs within which it has values",
    )


def _points(law: Law, count: int, seed: int, precision: str) -> Array:
    """Points as a machine of this precision has them."""
    rows = law.points(np.random.default_rng(seed), count)
    if precision == "single":
        with np.errstate(over="ignore"):
            rows = rows.astype(np.float32).astype(float)
    return rows


def _value(law: Law, row: Array) -> Array | None:
    """What a law returns at one point; None where it fails."""
    try:
        return np.asarray(law.values(row[None, :])[0])
    except RuntimeError:
        return None


def self_test(package: str, laws: tuple[Law, ...], precision: str, tolerance: float | None = None) -> str:
    """The text of main.c.

    Args:
        package: its name.
        laws: of the package.
        precision: "double" or "single".
        tolerance: largest relative deviation; None: that of each law.
    """
    parts = [
        f"/* Compares {package} with reference vectors written by Python; returns 0 where they agree.\n"
        " * With --time N: nanoseconds of processor time a call, over N calls. */\n"
        f'#include "{package}.h"\n\n#include <math.h>\n#include <stdio.h>\n#include <stdlib.h>\n#include <string.h>\n'
        "#include <time.h>"
    ]
    calls = []
    tests = []
    for law in laws:
        known = reference(law, POINTS, SEED, precision)
        real = f"{package}_real"
        parts.append(_data(package, law, known))
        parts.append(_call(package, law))
        tests.append(
            TEST.format(
                law=law.name,
                real=real,
                outputs=stacked_size(law.results),
                rows=known.rows.shape[0],
                unwritten=code(package, "RESULT_NOT_FINITE") if "RESULT_NOT_FINITE" in law.statuses else -1,
                tolerance=repr(law.tolerance if tolerance is None else tolerance),
            )
        )
        calls += [
            f"    failures += test_{law.name}();",
            "    if (count > 0) {",
            f"        speed_{law.name}(count);",
            "    }",
        ]
    main = MAIN.format(real=f"{package}_real", calls="\n".join(calls))
    head, tail = main.split("\nint main(")
    return "\n\n".join([*parts, head.rstrip(), *tests, "int main(" + tail])


def _data(package: str, law: Law, known: Reference) -> str:
    """Reference vectors as constant arrays."""
    real, name = f"{package}_real", law.name
    status = "{" + ", ".join(str(s) for s in known.status) + "}"
    return "\n".join(
        [
            table(f"{name}_in", known.rows if known.rows.shape[1] else np.zeros((len(known.rows), 1)), real),
            table(f"{name}_out", known.values, real),
            f"static const int {name}_status[{known.status.size}] =\n{wrapped(status)};",
            f"static const double {name}_smallest[{known.smallest.size}] =\n{wrapped(row(known.smallest))};",
        ]
    )


def _call(package: str, law: Law) -> str:
    """A C function that calls the law with flat arrays."""
    real = f"{package}_real"

    def given(port: Port) -> str:
        offset = span(law.inputs, port.name).start
        return f"in[{offset}]" if port.scalar else f"in + {offset}"

    results = [f"out + {span(law.results, port.name).start}" for port in law.results]
    arguments = [given(port) for port in law.arguments]
    lines: list[str] = []
    function = f"{package}_{law.name}"
    if law.kind == "function":
        lines = [] if arguments else ["(void)in;"]
        lines += [f"return {function}({', '.join([*arguments, *results])});"]
    elif law.kind == "solver":
        lines = [f"static {struct_name(package, law)} workspace;"]
        lines.append(f"return {function}({', '.join(['&workspace', *arguments, *results])});")
    elif law.kind == "sample":
        lines = [
            f"{struct_name(package, law)} point;",
            f"const int status = {function}({', '.join([*arguments, '&point'])});",
        ]
        lines += [_flat_copy(port, "point", law) for port in law.results]
        lines.append("return status;")
    else:
        lines = [f"{struct_name(package, law)} self;", f"{real} control[{_size(law, 'control')}];", "int status;"]
        lines.append(f"{package}_init(&self);")
        for port in law.inputs:
            if port.name in law.held:
                offset = span(law.inputs, port.name).start
                kept = law.held[port.name]
                if port.scalar:
                    whole = any(own.name == kept and own.whole for own in law.outputs)
                    lines.append(f"self.{kept} = {'(int)' if whole else ''}in[{offset}];")
                else:
                    lines.append(f"memcpy(self.{kept}, in + {offset}, sizeof(self.{kept}));")
        lines.append(f"status = {function}({', '.join(['&self', *arguments, 'control'])});")
        lines += [_flat_copy(port, "self", law) for port in law.results]
        lines.append("return status;")
    body = "\n".join(f"    {line}" for line in lines)
    return f"static int call_{law.name}(const {real} *in, {real} *out)\n{{\n{body}\n}}"


def _size(law: Law, name: str) -> int:
    return next(port.size for port in law.outputs if port.name == name)


def _flat_copy(port: Port, owner: str, law: Law) -> str:
    offset = span(law.results, port.name).start
    if port.name == RETURNED:
        return f"memcpy(out + {offset}, control, sizeof(control));"
    if port.scalar:
        return f"out[{offset}] = {owner}.{port.name};"
    return f"memcpy(out + {offset}, {owner}.{port.name}, sizeof({owner}.{port.name}));"
