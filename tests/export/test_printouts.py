"""What is printed of a build and of times: readable, with units; attributes and items as they are."""

from dataclasses import replace
from pathlib import Path

import pytest
from exports import package

from covocp.export.compiled.building import Build
from covocp.export.compiled.package import Timing, Timings

BUILD = Build(library=Path("a/b.so"), self_test=Path("a/b"), compiler="cc 1.0", object_bytes=1200, stack_bytes=340)


def test_a_build_says_where_it_is_and_how_large():
    assert str(BUILD) == (
        f"library: {BUILD.library}\nself-test: {BUILD.self_test}\n"
        "object code: 1200 bytes; stack: at most 340 bytes; cc 1.0"
    )
    unknown = str(replace(BUILD, object_bytes=None, stack_bytes=None))
    assert unknown.endswith("object code: not known; stack: not known; cc 1.0")


@pytest.mark.parametrize(
    ("nanoseconds", "text"),
    [(0.52, "0.52 ns"), (21.34, "21.3 ns"), (999.4, "999 ns"), (999.6, "1 us"), (1234.0, "1.23 us"),
     (999_600.0, "1 ms"), (2.5e7, "25 ms"), (3.4567e9, "3.46 s")],
)  # fmt: skip
def test_times_have_units(nanoseconds, text):
    timing = Timing(c=nanoseconds, python=nanoseconds, virtual_machine=nanoseconds)
    assert str(timing) == f"{text} a call in C, {text} in CasADi, {text} from Python"


def test_times_of_laws_are_a_dict_that_prints_a_line_each():
    times = Timings(sample=Timing(c=1, python=3e3, virtual_machine=2), step=Timing(c=4, python=6, virtual_machine=5))
    assert str(times) == (
        "sample: 1 ns a call in C, 2 ns in CasADi, 3 us from Python\n"
        "step: 4 ns a call in C, 5 ns in CasADi, 6 ns from Python"
    )
    assert times["step"].c == 4
    assert dict(times) == times


@pytest.mark.needs_cc
def test_the_package_returns_them():
    made = package("lag")
    built, times = made.build(flags=["-Werror"]), made.time(seconds=0.01)
    assert str(built).startswith(f"library: {made.directory}")
    assert built.sizes == str(made.check(samples=20)).splitlines()[-1]
    assert [line.partition(":")[0] for line in str(times).splitlines()] == ["sample", "step"]
    assert all(f"{times[name].c:.3g} ns a call in C" in str(times) for name in times if times[name].c < 999)
