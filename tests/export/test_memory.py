"""What the compiled laws need: no allocation, a known stack, and nothing that valgrind or the sanitizers see."""

import re
import shutil
import subprocess

import pytest
from exports import SANITIZE, package, sanitized

pytestmark = pytest.mark.needs_cc
NAMES = ["lag", "lag_sampled", "lag_single", "mars", "mars_sampled", "mars_single", "swing", "history", "filters"]
NAMES += ["theta", "planner"]
SAMPLE_BYTES = 8 * 76  # of the Mars entry: all that a sample keeps; 1001 samples
ALLOCATION = {
    "malloc",
    "calloc",
    "realloc",
    "free",
    "alloca",
    "aligned_alloc",
    "posix_memalign",
    "strdup",
    "mmap",
    "sbrk",
}
OUTPUT = {"printf", "puts", "putchar", "fprintf", "fwrite", "exit", "abort"}


def undefined_symbols(name):
    """What the objects of a package take from outside."""
    folder = package(name).directory / "build"
    objects = [folder / f"{name}.o", folder / f"{name}_casadi.o"]
    done = subprocess.run(["nm", "-u", *objects], check=True, capture_output=True, text=True)
    return {line.split()[-1].split("@")[0] for line in done.stdout.splitlines() if " U " in line}


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_allocated_nor_printed(name):
    if not shutil.which("nm"):
        pytest.skip("there is no nm")
    symbols = undefined_symbols(name)
    assert not symbols & (ALLOCATION | OUTPUT)
    own = {symbol for symbol in symbols if symbol.startswith(name)}
    known = {
        "sin",
        "cos",
        "exp",
        "sqrt",
        "atan",
        "fmin",
        "fmax",
        "floor",
        "memcpy",
        "memmove",
        "memset",
        "log",
        "pow",
        "fabs",
    }
    known |= {"sincos", "__isfinite"}
    if name.endswith("_single"):  # nothing is computed in double precision
        known = {f"{function}f" for function in known if not function.startswith("mem")} | {"memcpy", "memset"}
    assert symbols - own - known <= {"_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}


@pytest.mark.parametrize("name", NAMES)
def test_stack_and_size_of_the_object_code_are_stated(name):
    made = package(name)
    built = made._built
    if built.stack_bytes is None:
        pytest.skip("the compiler does not say how much stack it uses")
    readme = (made.directory / "README.md").read_text()
    for law, size in made.work_bytes.items():
        assert f"| `{name}_{law}` | {size} |" in readme
        if next(entry.kind for entry in made.laws if entry.name == law) != "solver":
            assert size <= built.stack_bytes + 64  # the compiler may leave out what it does not need
    assert built.stack_bytes < 20_000
    tables = 1001 * SAMPLE_BYTES if name == "mars_sampled" else 0
    assert built.object_bytes is None or 1000 < built.object_bytes - tables < 400_000
    assert f"stack: at most {built.stack_bytes} bytes" in str(made.check(samples=20))


@pytest.mark.parametrize("name", NAMES)
def test_the_self_test_is_clean_under_valgrind(name):
    if not shutil.which("valgrind"):
        pytest.skip("there is no valgrind")
    program = package(name)._built.self_test
    command = ["valgrind", "--error-exitcode=9", "--leak-check=full", "--track-origins=no", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert re.search(r"ERROR SUMMARY: 0 errors", done.stderr)


@pytest.mark.parametrize("name", NAMES)
def test_the_self_test_is_clean_under_the_sanitizers(name, tmp_path):
    if not sanitized(name):
        pytest.skip("the compiler has no sanitizers")
    folder = package(name).directory
    command = ["cc", "-std=c99", *SANITIZE, f"-I{folder}", folder / "main.c", *sanitized(name), "-lm"]
    subprocess.run([*command, "-o", tmp_path / "selftest"], check=True, capture_output=True)
    done = subprocess.run([tmp_path / "selftest"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert not done.stderr
