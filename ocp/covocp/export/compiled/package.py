"""A package of C sources on the disk: compiled, compared with Python, timed, called."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np

from covocp.base.arguments import MOST, checked, is_whole, positive, text, texts
from covocp.base.dataclass import dataclass
from covocp.base.errors import ExportError
from covocp.base.expressions import Given
from covocp.base.pages import lines_as_html
from covocp.base.threads import methods_one_at_a_time
from covocp.export.compiled.building import TIMEOUT, Build, Sources, build
from covocp.export.compiled.library import Laws, Library, laws_of
from covocp.export.laws.law import CODES, Law, span
from covocp.export.text.self_test import POINTS, SEED, reference

TIMED_SECONDS = 0.2  # of each law in `time`
LEAST_CALLS, MOST_CALLS = 3, 2_000_000
PLURAL = ("flags", "samples")


@dataclass(frozen=True, kw_only=True)
class LawCheck:
    """C against Python for one law.

    Attributes:
        points: number of points.
        deviation: largest relative one; infinite where a status differs.
        tolerance: allowed.
        worst: inputs of the point with the largest deviation, stacked.
    """

    points: int
    deviation: float
    tolerance: float
    worst: tuple[float, ...]

    @property
    def ok(self) -> bool:
        """Whether the deviation is allowed."""
        return self.deviation <= self.tolerance


@dataclass(frozen=True, kw_only=True)
class Check:
    """C against Python.

    Attributes:
        laws: by name.
        self_test: whether the self-test in C passed.
        build: what was compiled.
    """

    laws: Mapping[str, LawCheck]
    self_test: bool
    build: Build

    @property
    def deviation(self) -> float:
        """Largest relative deviation of all laws."""
        return max(law.deviation for law in self.laws.values())

    @property
    def ok(self) -> bool:
        """Whether all deviations are allowed and the self-test passed."""
        return self.self_test and all(law.ok for law in self.laws.values())

    def __str__(self) -> str:
        """One line a law."""
        lines = [
            f"{name}: {law.points} points, largest relative deviation {law.deviation:.2g} "
            f"(allowed {law.tolerance:.0e}): {'ok' if law.ok else 'FAILED'}"
            for name, law in self.laws.items()
        ]
        lines.append(f"self-test in C: {'passed' if self.self_test else 'FAILED'}")
        return "\n".join([*lines, self.build.sizes])


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Nanoseconds a call.

    Attributes:
        c: of the C function, called from C.
        python: of CasADi's function, called from Python with numpy arrays.
        virtual_machine: of CasADi's function, without what Python adds.
    """

    c: float
    python: float
    virtual_machine: float

    def __str__(self) -> str:
        """A line."""
        times = (self.c, self.virtual_machine, self.python)
        in_c, machine, python = (_duration(nanoseconds) for nanoseconds in times)
        return f"{in_c} a call in C, {machine} in CasADi, {python} from Python"


class Timings(dict[str, Timing]):
    """Times of the laws of a package by name."""

    def __str__(self) -> str:
        """One line a law."""
        return "\n".join(f"{name}: {timing}" for name, timing in self.items())


@methods_one_at_a_time
@dataclass(frozen=True, kw_only=True)
class CPackage:
    """C sources that `export_c` has written.

    Attributes:
        name: of the package; its functions, types and files begin with it.
        directory: where it is.
        precision: "double" or "single".
        laws: what it contains.
        work_bytes: memory that the laws work in, by name: on the stack, of a solver in the workspace of the caller.
        sources: what is compiled.
        tolerance: largest relative deviation that counts as agreement; None: that of each law.
    """

    name: str
    directory: Path
    precision: str
    laws: tuple[Law, ...] = field(repr=False)
    work_bytes: Mapping[str, int]
    sources: Sources = field(repr=False)
    tolerance: float | None = None
    _kept: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    @checked(tool=text)
    def build(self, tool: str = "auto", flags: Sequence[str] = ()) -> Build:
        """Compile the package in its folder "build".

        Args:
            tool: "cc", "cmake", or "auto": the C compiler itself where there is one.
            flags: more flags for the C compiler.

        Returns:
            Library, self-test, size of the object code, need of stack.

        Raises:
            ExportError: no compiler, or it failed (with its message).
        """
        if texts(flags):
            raise self._wrong("flags", "a list of flags, such as ['-Werror']", flags)
        for what in ("library", "build"):  # whose files are replaced, or lost where the compiler fails
            self._kept.pop(what, None)
        self._kept["build"] = build(self.sources, tool, flags)
        built: Build = self._kept["build"]
        return built

    def check(self, samples: int = 1000, seed: int = SEED) -> Check:
        """Compare C with Python at seeded random points and at edges: ends of the time range and beyond, NaN, inf.

        Args:
            samples: number of points of each law (of solvers less).
            seed: of the random points.

        Returns:
            Deviations; `.ok` tells whether all are allowed, `.deviation` is the largest.

        Raises:
            ExportError: the package cannot be compiled or loaded.
        """
        for name, number, least in (("samples", samples, 1), ("seed", seed, 0)):
            if not is_whole(number, least, MOST if name == "samples" else None):
                raise self._wrong(name, f"a whole number, {least} or more", number)
        library = self._library()
        results = {law.name: self._compared(law, library, int(samples), int(seed)) for law in self.laws}
        done = subprocess.run([str(self._built.self_test)], capture_output=True, text=True, timeout=TIMEOUT)
        self._kept["check"] = Check(laws=results, self_test=done.returncode == 0, build=self._built)
        check: Check = self._kept["check"]
        return check

    @property
    def deviation(self) -> float:
        """Largest relative deviation of the last `check`, which is made where there was none."""
        return self._last_check.deviation

    @property
    def ok(self) -> bool:
        """Whether the last `check` was passed; it is made where there was none."""
        return self._last_check.ok

    @checked(seconds=positive)
    def time(self, seconds: float = TIMED_SECONDS) -> Timings:
        """Time the laws at their reference points.

        Args:
            seconds: of each measurement, about.

        Returns:
            By name of the law, nanoseconds a call in C, in Python, in CasADi's virtual machine; printed with units.

        Raises:
            ExportError: the package cannot be compiled, or its self-test fails.
        """
        first = self._in_c(LEAST_CALLS)
        slowest = max(max(first.values()), 1.0)
        in_c = self._in_c(int(np.clip(seconds * 1e9 / slowest, LEAST_CALLS, MOST_CALLS)))
        return Timings({law.name: self._timed(law, in_c[law.name], seconds) for law in self.laws})

    def python(self) -> Laws:
        """The compiled laws as functions of Python, through ctypes.

        Each law by its name, as an item, or as an attribute where a mapping has none of that name (such as `items` or
        `get`) and it is not `principal`; calling the whole calls the controller, else the solver, else the first law.
        A controller has `init()`, `step(measurement, time)`, `state`; every law `status`.

        The arguments of a solver are numbers or arrays, by position or by name, and those that are left out are those
        of the export: `initial_<state>` for each state with a fixed initial value, `initial_<matrix>` for each matrix
        with one (`initial_E` for the estimation covariance, whole, not as a half-vector), each parameter (but not
        those that only the start depends on: give the start) and each mean of an unknown by its own name, `duration`
        where it may change, and `guess`, the `variables` of an earlier plan.
        The plan is a dict of arrays, with its "status". That of a problem with an expected cost is the nominal only:
        it has no gains and cannot be flown in closed loop by itself.

        Raises:
            ExportError: the package cannot be compiled or loaded.
        """
        return laws_of(self.laws, self._library())

    def reference(self) -> Laws:
        """The same laws with the same interface, evaluated by CasADi."""
        return laws_of(self.laws, None)

    def __str__(self) -> str:
        """What there is, what to know of it, and the last check where there was one."""
        listed = ", ".join(f"{self.name}_{law.name}" for law in self.laws)
        lines = [f"C package '{self.name}' in {self.directory}: {listed} ({self.precision} precision)"]
        lines += [f"{law.name}: {note}" for law in self.laws for note in law.notes]
        lines += [str(self._kept["check"])] if "check" in self._kept else []
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """What a notebook shows: the same lines."""
        return lines_as_html(str(self))

    @property
    def _built(self) -> Build:
        if "build" not in self._kept:
            self.build()
        result: Build = self._kept["build"]
        return result

    @property
    def _last_check(self) -> Check:
        result: Check = self._kept["check"] if "check" in self._kept else self.check()
        return result

    def _library(self) -> Library:
        if "library" not in self._kept:
            self._kept["library"] = Library(self._built.library, self.name, self.precision)
        result: Library = self._kept["library"]
        return result

    def _compared(self, law: Law, library: Library, samples: int, seed: int) -> LawCheck:
        """One law at its points; a controller also at its start."""
        known = reference(law, samples, seed, self.precision)
        call = library.backend(law)
        pairs = [call(row) for row in known.rows]
        deviations = known.deviations(np.array([values for values, _ in pairs]), np.array([s for _, s in pairs]))
        tolerance = law.tolerance if self.tolerance is None else self.tolerance
        if law.kind == "controller":
            size = np.maximum(np.abs(law.start), np.finfo(float).tiny)
            begun = float((np.abs(library.started(law) - law.start) / size).max(initial=0.0))
            deviations = np.maximum(deviations, begun)
        worst = int(np.argmax(deviations))
        return LawCheck(
            points=known.rows.shape[0],
            deviation=float(deviations[worst]),
            tolerance=tolerance,
            worst=tuple(known.rows[worst].tolist()),
        )

    def _in_c(self, calls: int) -> dict[str, float]:
        """Nanoseconds a call as the self-test measures them."""
        command = [str(self._built.self_test), "--time", str(calls)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT)
        found = {name: float(number) for name, number in re.findall(r"^(\w+): ([\d.]+) ns$", done.stdout, re.MULTILINE)}
        if set(found) != {law.name for law in self.laws}:
            raise self._wrong("self-test", "a time for each law", (done.stdout + done.stderr)[-500:])
        return found

    def _timed(self, law: Law, in_c: float, seconds: float) -> Timing:
        """Python and the virtual machine."""
        known = reference(law, POINTS, SEED, self.precision)
        rows = known.rows[known.status == CODES["OK"]] if (known.status == CODES["OK"]).any() else known.rows
        columns = [[row[span(law.inputs, port.name)] for port in law.inputs] for row in rows]

        def calls(count: int) -> float:
            begin = time.perf_counter()
            for i in range(count):
                law.core(*columns[i % len(columns)])
            return (time.perf_counter() - begin) / count

        python = calls(int(np.clip(seconds / calls(LEAST_CALLS), LEAST_CALLS, MOST_CALLS)))
        made: Any = law.core.buffer()
        buffer, trigger = made
        arrays: list[Any] = [np.ascontiguousarray(value) for value in columns[0]]
        results: list[Any] = [np.zeros(law.core.nnz_out(i)) for i in range(law.core.n_out())]
        for i, value in enumerate(arrays):
            buffer.set_arg(i, memoryview(value))
        for i, value in enumerate(results):
            buffer.set_res(i, memoryview(value))
        count = int(np.clip(seconds / python, LEAST_CALLS, MOST_CALLS))
        begin = time.perf_counter()
        for _ in range(count):
            trigger()
        machine = (time.perf_counter() - begin) / count
        return Timing(c=in_c, python=1e9 * python, virtual_machine=1e9 * machine)

    def _wrong(self, what: str, expected: str, received: Given) -> ExportError:
        return ExportError(
            f"The {what} of the package '{self.name}' {'do' if what in PLURAL else 'does'} not fit.",
            expected=expected,
            received=str(received)[:500],
            remedy=f"correct {what}" if what != "self-test" else "build() again; is the folder complete?",
        )


def _duration(nanoseconds: float) -> str:
    """A time in the unit in which it has one to three digits before the point."""
    for size, unit in ((1e9, "s"), (1e6, "ms"), (1e3, "us")):
        if nanoseconds >= 0.9995 * size:  # what would be rounded to 1000 of the smaller unit
            return f"{nanoseconds / size:.3g} {unit}"
    return f"{nanoseconds:.3g} ns"
