"""The laws as Python calls them: of the compiled library through ctypes, or evaluated by CasADi, the same way."""

from __future__ import annotations

import copy
import ctypes
import shutil
import tempfile
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from covocp.base.errors import ExportError, shown, spelling
from covocp.base.expressions import Given
from covocp.base.matrices import Array, real_numbers
from covocp.base.threads import TURN
from covocp.export.laws.law import CODES, RETURNED, STATUSES, Law, Port, span, stacked_size
from covocp.export.text.header import struct_name

NAMES = tuple(STATUSES)
# What is done where a solver has no such argument.
OTHER_DURATION = (
    "export the problem with the other duration: the plan chooses this one, or something is read or holds at so many "
    "seconds, depends on the time, or was stated with the number of Problem.duration"
)


class Backend(Protocol):
    """What evaluates a law: all its inputs as a row -> results as a row, status."""

    def __call__(self, row: Array) -> tuple[Array, int]:
        """One point."""


def evaluated(law: Law) -> Backend:
    """A law evaluated by CasADi."""

    def call(row: Array) -> tuple[Array, int]:
        with TURN:
            try:
                values = law.values(row[None, :])[0]
            except RuntimeError:  # a matrix has no inverse there, by which C divides nevertheless
                if law.kind != "function":
                    raise
                values = np.full(stacked_size(law.results), np.nan)
        if law.kind == "function":
            finite = bool(np.isfinite(values).all())
            return values, CODES["OK" if finite else "RESULT_NOT_FINITE"]
        return values[:-1], int(values[-1])

    return call


class Library:
    """A shared library.

    Args:
        path: where it is.
        package: its name.
        precision: "double" or "single".

    Raises:
        ExportError: it cannot be loaded.
    """

    def __init__(self, path: Path, package: str, precision: str) -> None:
        """Load it."""
        self._made_from = (path, package, precision)
        self._lock = threading.Lock()
        self._package = package
        self._real: Any = ctypes.c_double if precision == "double" else ctypes.c_float
        try:
            # A copy: the loader takes a second library of the same path for the one that it has already.
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
                copy = shutil.copy2(path, Path(folder) / path.name)
                self._library = ctypes.CDLL(str(copy))
        except OSError as error:
            raise ExportError(
                f"The library of '{package}' cannot be loaded.",
                expected="a shared library for this machine, and what it is linked with",
                received=str(error),
                remedy="build() it here",
            ) from error

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process loads it from where it is."""
        return Library, self._made_from

    def backend(self, law: Law) -> Backend:
        """The C function of a law, which works in buffers of its own; threads take turns."""
        call, lock = self._with_struct(law) if law.kind in ("sample", "controller") else self._plain(law), self._lock

        def alone(row: Array) -> tuple[Array, int]:
            with lock:
                return call(row)

        return alone

    def _plain(self, law: Law) -> Backend:
        """A C function of arguments and results, with a workspace of its own where it needs one."""
        inputs, outputs = self._buffer(stacked_size(law.inputs)), self._buffer(stacked_size(law.results))
        function = getattr(self._library, f"{self._package}_{law.name}")
        function.restype = ctypes.c_int
        function.argtypes = None
        given, received = (np.frombuffer(buffer, dtype=self._real) for buffer in (inputs, outputs))
        first = [self._workspace()] if law.kind == "solver" else []
        results = [self._pointer(outputs, span(law.results, port.name).start) for port in law.results]
        sources = [(port, span(law.inputs, port.name).start) for port in law.arguments]
        pointers = [None if port.scalar else self._pointer(inputs, offset) for port, offset in sources]
        real = self._real

        def call(row: Array) -> tuple[Array, int]:
            given[: row.size] = row
            received[:] = np.nan
            arguments = [real(given[o]) if p is None else p for (_, o), p in zip(sources, pointers, strict=True)]
            status = function(*first, *arguments, *results)
            return received[: stacked_size(law.results)].astype(float), int(status)

        return call

    def started(self, law: Law) -> Array:
        """Fields of a controller's struct after init, stacked."""
        struct, views = self._struct(law)
        init = getattr(self._library, f"{self._package}_init")
        init.restype = None
        init(ctypes.byref(struct))
        return np.concatenate([views.get(port.name, views["control"]) for port in law.outputs]).astype(float)

    def _with_struct(self, law: Law) -> Backend:
        """A C function that fills or keeps a struct."""
        struct, views = self._struct(law)
        function = getattr(self._library, f"{self._package}_{law.name}")
        function.restype = ctypes.c_int
        inputs = self._buffer(stacked_size(law.inputs))
        given = np.frombuffer(inputs, dtype=self._real)
        real = self._real
        sources = [(port, span(law.inputs, port.name).start) for port in law.arguments]
        pointers = [None if port.scalar else self._pointer(inputs, offset) for port, offset in sources]
        kept = [(views[law.held[p.name]], span(law.inputs, p.name)) for p in law.inputs if p.name in law.held]
        controls = [port for port in law.outputs if port.name == "control"] if law.kind == "controller" else []
        control = [self._buffer(port.size) for port in controls]
        handed = [np.frombuffer(buffer, dtype=self._real) for buffer in control]
        fields = [handed[0] if port.name == RETURNED else views[port.name] for port in law.results]

        def call(row: Array) -> tuple[Array, int]:
            given[: row.size] = row
            for view, place in kept:
                view[:] = row[place]
            arguments = [real(given[o]) if p is None else p for (_, o), p in zip(sources, pointers, strict=True)]
            own = ctypes.byref(struct)
            status = function(*([own, *arguments, *control] if law.kind == "controller" else [*arguments, own]))
            return np.concatenate(fields).astype(float), int(status)

        return call

    def _buffer(self, size: int) -> Any:
        return (self._real * max(1, size))()

    def _pointer(self, buffer: Given, offset: int) -> Any:
        return ctypes.byref(buffer, offset * ctypes.sizeof(self._real))

    def _workspace(self) -> Any:
        size = ctypes.c_int.in_dll(self._library, f"{self._package}_workspace_bytes").value
        return (ctypes.c_double * (size // ctypes.sizeof(ctypes.c_double) + 1))()

    def _struct(self, law: Law) -> tuple[Any, dict[str, Any]]:
        """A struct of a law as ctypes has it, and its fields as flat arrays in the same memory."""

        def kind(port: Port) -> Any:
            if port.whole:
                return ctypes.c_int
            if port.scalar:
                return self._real
            return self._real * port.rows if port.columns == 1 else (self._real * port.columns) * port.rows

        fields = [(port.name, kind(port)) for port in law.fields]
        made: Any = type(struct_name(self._package, law), (ctypes.Structure,), {"_fields_": fields})
        struct = made()
        memory = np.frombuffer(struct, dtype=np.dtype(made))
        return struct, {port.name: memory[port.name].reshape(-1) for port in law.fields}


class Call:
    """One law as a function of Python.

    It may be copied and sent to another process; copies share the compiled function and nothing else.

    Args:
        law: what it is.
        library: that evaluates it; None: CasADi does.

    Attributes:
        status: of the last call, a name of `covocp.export.laws.law.STATUSES`.
    """

    def __init__(self, law: Law, library: Library | None) -> None:
        """Keep both."""
        self.law, self._library = law, library
        self._backend = evaluated(law) if library is None else library.backend(law)
        self.status = "OK"

    def __deepcopy__(self, memo: dict[int, Any]) -> Call:
        """What changes from call to call is replaced then, never written into: a copy of the references is enough."""
        return copy.copy(self)

    def __copy__(self) -> Call:
        """One more caller of the same function."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other

    def __getstate__(self) -> dict[str, Any]:
        """Without what belongs to this process."""
        law = self.law.sent(evaluated=self._library is None)
        return {name: value for name, value in self.__dict__.items() if name != "_backend"} | {"law": law}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """In another process."""
        self.__dict__.update(state)
        self._backend = evaluated(self.law) if self._library is None else self._library.backend(self.law)

    def __call__(self, *values: Any, **named: Any) -> Any:
        """Evaluate the law.

        Args:
            values: arguments in their order, numbers or arrays of the shapes of the ports; of a solver those that are
                left out are those of the export.
            named: arguments by name.

        Returns:
            Of a function its result, or a tuple; of any other law a dict by name, with its "status". NaN where C writes
            nothing.

        Raises:
            ExportError: arguments that are missing, unknown, too many or of another shape.
        """
        row = self._row(values, named)
        results, status = self._backend(row)
        self.status = name = NAMES[status]
        parts = {p.name: _shaped(results[span(self.law.results, p.name)], p) for p in self.law.results}
        if self.law.kind != "function":
            return {**parts, "status": name}
        return next(iter(parts.values())) if len(parts) == 1 else tuple(parts.values())

    def _row(self, values: tuple[Any, ...], named: Mapping[str, Any]) -> Array:
        """All inputs, stacked."""
        given = self._given(values, named)
        parts = []
        for port in self.law.arguments:
            if port.name not in given:
                parts.append(self.law.defaults[span(self.law.inputs, port.name)])
                continue
            parts.append(self._flat(port, given[port.name]))
        return np.concatenate([np.zeros(0), *parts])

    def _flat(self, port: Port, value: Given) -> Array:
        """One argument, flat.

        Raises:
            ExportError: no numbers, or another shape.
        """
        try:
            array = real_numbers(value)
        except (TypeError, ValueError, OverflowError) as error:
            raise self._unfit(f"{port.name}={shown(value)}", "give numbers") from error
        matrices = port.columns > 1 and array.ndim > 1
        if array.size != port.size or (matrices and array.shape != port.shape):
            raise self._unfit(f"{port.name} {array.shape or '()'}", f"give '{port.name}' in its shape")
        return array.ravel()

    def _given(self, values: tuple[Any, ...], named: Mapping[str, Any]) -> dict[str, Any]:
        """What the caller gives by name; complains about names, never about values."""
        names = [port.name for port in self.law.arguments]
        if len(values) > len(names):
            raise self._unfit(f"{len(values)} values", f"give {len(names)} at most")
        given = dict(zip(names, values, strict=False))
        for name, value in named.items():
            if name not in names:
                what = f"there is no argument '{name}'"
                start = f"'initial_{name}' is meant, where '{name}' starts"
                remedy = start if f"initial_{name}" in names else spelling(name, names, f"leave '{name}' out")
                if name in self.law.instead:
                    remedy = f"only a start depends on '{name}': give {self.law.instead[name]}"
                elif name == "duration" and self.law.kind == "solver":
                    remedy = OTHER_DURATION
                raise self._unfit(f"{name}={value!r}", remedy, what)
            if name in given:
                raise self._unfit(f"'{name}' by its place and by its name", "give it once")
            given[name] = value
        missing = [name for name in names if name not in given]
        if missing and self.law.kind != "solver":
            raise self._unfit(", ".join(given) or "nothing", f"give {', '.join(missing)} too")
        return given

    def _unfit(self, received: str, remedy: str, what: str = "") -> ExportError:
        return ExportError(
            f"The arguments of '{self.law.name}' do not fit" + (f": {what}." if what else "."),
            expected=", ".join(f"{p.name} {p.shape or '()'}" for p in self.law.arguments) or "none",
            received=received[:100],
            remedy=remedy,
        )


class Controller(Call):
    """A controller as a function of Python: `step(measurement, time)` -> control.

    Attributes:
        state: fields of its struct by name, as arrays.
    """

    def __init__(self, law: Law, library: Library | None) -> None:
        """Start it."""
        super().__init__(law, library)
        self._size = stacked_size(law.inputs)
        self._places = {port.name: span(law.inputs, port.name) for port in law.inputs}
        self._ports = law.arguments
        self._kept = [(self._places[name], span(law.outputs, field)) for name, field in law.held.items()]
        self._control, self._estimate = (span(law.outputs, name) for name in (law.returned, "estimate"))
        self.init()

    def init(self) -> None:
        """Set it to the start of the nominal, its estimate to the mean."""
        self._values = self.law.start.copy() if self._library is None else self._library.started(self.law)
        self.status = "OK"

    @property
    def period(self) -> float | None:
        """Time between two steps that it was made for [s]; None: any."""
        return next((value for name, value in self.law.constants.items() if name.startswith("PERIOD")), None)

    @property
    def estimate(self) -> Array:
        """Its estimate of the deviation from the nominal, (n,)."""
        return np.asarray(self._values[self._estimate])

    @property
    def state(self) -> dict[str, Any]:
        """Fields of the struct."""
        ports = self.law.outputs
        return {p.name: _shaped(self._values[span(ports, p.name)], p) for p in self.law.fields}

    def step(self, measurement: Given, time: float) -> Array:
        """The control for a measurement at a time.

        Args:
            measurement: shape (r,); entries that are NaN are left out.
            time: of the measurement [s].

        Returns:
            The control, shape (m,), to be held until the next step.

        Raises:
            ExportError: no numbers, or not as many as are measured; nothing has happened then.
        """
        row = np.zeros(self._size)
        for place, field in self._kept:
            row[place] = self._values[field]
        for port, value in zip(self._ports, (measurement, time), strict=True):
            row[self._places[port.name]] = self._flat(port, value)
        results, status = self._backend(row)
        self._values = np.append(results, status)
        self.status = NAMES[status]
        return results[self._control]

    def __call__(self, measurement: Given, time: float) -> Array:
        """The same as `step`."""
        return self.step(measurement, time)


def _shaped(values: Array, port: Port) -> Any:
    """Flat values in the shape of the port."""
    return float(values[0]) if port.scalar else values.reshape(port.shape)


class Laws(Mapping[str, Call]):
    """The laws of a package by name, also as attributes; calling it calls the principal one.

    That is the controller, else the solver, else the first. As an attribute a law is not found where a mapping has one
    of its name (`items`, `keys`, `values`, `get`), nor where it is called `principal`: it is as an item.
    """

    def __init__(self, calls: Mapping[str, Call]) -> None:
        """Keep them."""
        self._calls = dict(calls)

    @property
    def principal(self) -> Call:
        """The law that a call of the whole stands for."""
        for kind in ("controller", "solver"):
            for call in self._calls.values():
                if call.law.kind == kind:
                    return call
        return next(iter(self._calls.values()))

    def __call__(self, *values: Any, **named: Any) -> Any:
        """Call the principal law."""
        return self.principal(*values, **named)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if name in self._calls:
            return self._calls[name]
        return getattr(self.principal, name)

    def __getitem__(self, name: str) -> Call:
        return self._calls[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._calls)

    def __len__(self) -> int:
        return len(self._calls)


def laws_of(laws: tuple[Law, ...], library: Library | None) -> Laws:
    """The laws as functions of Python, of a library or, without one, of CasADi."""
    return Laws({law.name: (Controller if law.kind == "controller" else Call)(law, library) for law in laws})
