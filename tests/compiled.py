"""Generated C code, compiled and loaded: what a block does outside Python."""

from __future__ import annotations

import subprocess

import casadi as ca
import numpy as np


def compile_function(function: ca.Function, directory, *, real: str = "double"):
    """C code of a function, compiled; a callable on arrays that returns arrays, in double or single precision.

    Single precision goes through ctypes: CasADi's own loader takes doubles only.
    """
    name = f"{function.name()}_{real}"
    source, library = directory / f"{name}.c", directory / f"{name}.so"
    options = {"casadi_real": real, "with_header": False}
    generator = ca.CodeGenerator(source.name, options)
    generator.add(function)
    generator.generate(f"{directory}/")
    text = source.read_text(encoding="utf-8")
    assert "linsol" not in text
    assert "casadi_qr" not in text
    subprocess.run(["gcc", "-O0", "-shared", "-fPIC", "-o", library, source, "-lm"], check=True)
    return _Library(function, library, np.float64 if real == "double" else np.float32)


class _Library:
    """One function of a compiled library, called through its C interface."""

    def __init__(self, function: ca.Function, library, kind) -> None:
        import ctypes

        self._function, self._kind = function, kind
        self._pointer = np.ctypeslib.ndpointer(kind, flags="C")
        self._code = getattr(ctypes.CDLL(str(library)), function.name())
        self._ctypes = ctypes
        real = ctypes.c_double if kind == np.float64 else ctypes.c_float
        self._real = ctypes.POINTER(real)
        self._code.restype = ctypes.c_int

    def __call__(self, *arguments):
        ctypes, function = self._ctypes, self._function
        inputs = [
            np.ascontiguousarray(np.asarray(value, dtype=self._kind).reshape(function.size_in(i)).ravel(order="F"))
            for i, value in enumerate(arguments)
        ]
        outputs = [np.zeros(function.nnz_out(i), dtype=self._kind) for i in range(function.n_out())]
        sizes = [max(1, size) for size in (function.sz_arg(), function.sz_res(), function.sz_iw(), function.sz_w())]
        given, results = (self._real * sizes[0])(), (self._real * sizes[1])()
        for i, value in enumerate(inputs):
            given[i] = value.ctypes.data_as(self._real)
        for i, value in enumerate(outputs):
            results[i] = value.ctypes.data_as(self._real)
        integers, work = np.zeros(sizes[2], dtype=np.int64), np.zeros(sizes[3], dtype=self._kind)
        failed = self._code(
            given,
            results,
            integers.ctypes.data_as(ctypes.POINTER(ctypes.c_longlong)),
            work.ctypes.data_as(self._real),
            ctypes.c_int(0),
        )
        assert failed == 0
        return [value.reshape(function.size_out(i), order="F") for i, value in enumerate(outputs)]
