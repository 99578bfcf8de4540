"""The packages, and the compiled passage of covariances, without which everything works more slowly.

Without symbolic links in the checkout the two linked folders are mapped from where they lie.
"""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

# Nothing that changes how the process computes: linking with
# -ffast-math would flush subnormal numbers everywhere.
FLAGS = ["-g0", "-ftree-vectorize", "-fno-math-errno", "-fno-trapping-math"]


class BuildPassage(build_ext):
    """Flags of the compiler that is there, and files beside one another."""

    def build_extensions(self) -> None:
        """Compile with them."""
        if self.compiler.compiler_type in ("unix", "mingw32"):
            for extension in self.extensions:
                extension.extra_compile_args = FLAGS
            one = self.compiler.compile

            def compile_all(sources: list[str], *args: Any, **options: Any) -> list[str]:
                with ThreadPoolExecutor() as threads:
                    made = threads.map(lambda source: one([source], *args, **options), sources)
                    return [name for names in made for name in names]

            self.compiler.compile = compile_all
        super().build_extensions()


plain = [name for name in ("models", "solvers") if not Path("ocp", "covocp", name).is_dir()]
mapped = [f"covocp.{name}.{inner}" for name in plain for inner in find_packages(name)]
passage = Extension(
    "covocp.passage._passage",
    ["ocp/covocp/passage/passage.c", "ocp/covocp/passage/newer.c"],
    depends=sorted(str(path) for path in Path("ocp", "covocp", "passage").glob("*.h")),
    py_limited_api=True,
    optional=True,  # without a compiler: `covocp.build_info()` says so
)
setup(
    packages=[*find_packages("ocp"), *(f"covocp.{name}" for name in plain), *mapped],
    package_dir={"": "ocp", **{f"covocp.{name}": name for name in plain}},
    ext_modules=[passage],
    cmdclass={"build_ext": BuildPassage},
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
