"""The packages; without symbolic links in the checkout the two linked folders are mapped from where they lie."""

from pathlib import Path

from setuptools import find_packages, setup

plain = [name for name in ("models", "solvers") if not Path("ocp", "covocp", name).is_dir()]
mapped = [f"covocp.{name}.{inner}" for name in plain for inner in find_packages(name)]
setup(
    packages=[*find_packages("ocp"), *(f"covocp.{name}" for name in plain), *mapped],
    package_dir={"": "ocp", **{f"covocp.{name}": name for name in plain}},
)
