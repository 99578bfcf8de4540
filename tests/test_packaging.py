"""One import name: the folders ocp/, models/ and solvers/ install as covocp and nothing else."""

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
HOUSE = ROOT / "ocp" / "covocp"
LINKS = ("models", "solvers")
NAME_VERSION = f"covocp-{PROJECT['project']['version']}"


def modules_on_disk() -> set[str]:
    """Paths inside the installed package of every Python file under the three folders."""
    roots = {"covocp": HOUSE, **{f"covocp/{name}": ROOT / name for name in LINKS}}
    found = {f"{at}/{path.relative_to(folder).as_posix()}" for at, folder in roots.items() for path in walk(folder)}
    assert len(found) > 100
    return found


def walk(folder: Path) -> list[Path]:
    """Python files under a folder, not through links."""
    return [Path(at, name) for at, _, names in os.walk(folder) for name in names if name.endswith(".py")]


def run_python(code: str, directory: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """A fresh interpreter with the directory first on its path."""
    settings = {"cwd": directory, "capture_output": True, "text": True, "timeout": 120}
    return subprocess.run([sys.executable, "-c", code], env=os.environ | environment, **settings)


def copy_of_the_project(target: Path) -> Path:
    """The checkout as a clone has it, links included."""
    hidden = [path.name for path in ROOT.glob(".*") if path.name not in (".ci", ".gitignore")]
    left_out = shutil.ignore_patterns(*hidden, "__pycache__", "*.egg-info", "build", "dist", "venv", "site")
    shutil.copytree(ROOT, target, symlinks=True, ignore=left_out)
    return target


def test_the_links_lead_to_the_folders_of_the_top_level():
    for name in LINKS:
        assert os.readlink(HOUSE / name) == f"../../{name}"


def test_a_new_file_in_any_folder_is_importable_without_installing_again(tmp_path):
    """An editable install is one static path to ocp/: what is written there is live."""
    project = copy_of_the_project(tmp_path / "project")
    folders = {path.parent for path in walk(project / "ocp") + [p for n in LINKS for p in walk(project / n)]}
    for folder in folders:
        (folder / "brand_new.py").write_text("mine = True\n", encoding="utf-8")
    names = []
    for folder in folders:
        inside = folder.relative_to(project / "ocp" if "ocp" in folder.relative_to(project).parts else project)
        parts = inside.parts if inside.parts[0] == "covocp" else ("covocp", *inside.parts)
        names.append(".".join((*parts, "brand_new")))
    assert len(names) > 15
    code = f"import importlib; print(all(importlib.import_module(n).mine for n in {sorted(names)!r}))"
    found = run_python(code, tmp_path, PYTHONPATH=str(project / "ocp"))
    assert found.stdout.strip() == "True", found.stderr


def test_the_editable_install_is_a_path_to_the_folder():
    """Type checkers and editors follow it to the files themselves."""
    files = metadata.distribution("covocp").files or []
    paths = [Path(str(file.locate())).read_text(encoding="utf-8").split() for file in files if file.suffix == ".pth"]
    if not paths:
        pytest.skip("not an editable install")
    assert [[str(ROOT / "ocp")]] == paths


def test_installed_version_is_that_of_the_project():
    assert metadata.version("covocp") == PROJECT["project"]["version"]


def test_import_leaves_the_names_of_the_folders_to_the_user(tmp_path):
    found = run_python(
        "import sys, covocp; print(sorted({'ocp', 'models', 'solvers'} & set(sys.modules)))",
        tmp_path,
    )
    assert found.returncode == 0, found.stderr
    assert found.stdout.strip() == "[]"


def test_import_loads_neither_scipy_nor_the_laws(tmp_path):
    """Both take longer than all the rest; a law is loaded when it is asked for."""
    found = run_python(
        "import sys, covocp; print(sorted({'scipy', 'matplotlib', 'covocp.blocks.theta_d'} & set(sys.modules)));"
        "print(covocp.blocks.theta_d.__name__)",
        tmp_path,
    )
    assert found.returncode == 0, found.stderr
    assert found.stdout.split() == ["[]", "covocp.blocks.theta_d"]


def test_import_loads_little_that_a_plain_solve_does_not_need(tmp_path):
    """And the solve nothing but its method: what few problems need is loaded where it is needed."""
    found = run_python(
        "import sys, casadi, numpy\n"
        "before = set(sys.modules)\n"
        "import covocp as co\n"
        "loaded = set(sys.modules) - before\n"
        "print(sorted({'statistics', 'fractions', 'html', 'pathlib', 'tempfile'} & loaded))\n"
        "seldom = ('extremal.optimality', 'extremal.curvature', 'problem.attitude', 'problem.description',\n"
        "  'base.pages', 'problem.phases', 'solution.phases', 'solution.fingerprint', 'transcription.detours')\n"
        "print([name for name in seldom if f'covocp.{name}' in loaded])\n"
        "from covocp.models import mass_chain\n"
        "import covocp.solvers.ipopt\n"
        "before = set(sys.modules)\n"
        "co.solve(mass_chain.problem(masses=1), progress=False, intervals=30)\n"
        "print([name for name in seldom if f'covocp.{name}' in set(sys.modules) - before])\n"
        "print(co.evaluate.__name__, co.Phases.__name__)",
        tmp_path,
    )
    assert found.returncode == 0, found.stderr
    assert found.stdout.splitlines() == ["[]", "[]", "[]", "evaluate Phases"]


def test_a_solve_loads_nothing_that_takes_as_long(tmp_path):
    """With necessary conditions, on a mesh that refines itself, with and without covariances, under feedback."""
    found = run_python(
        "import sys, covocp as co\n"
        "from covocp.models import bryson_denham, mass_chain, unknown_lag\n"
        "co.solve(mass_chain.problem(masses=1), progress=False, intervals=30).optimality\n"
        "co.solve(bryson_denham.problem(), progress=False, refine=1e-3).optimality\n"
        "co.solve(unknown_lag.steering(), progress=False).optimality\n"
        "print(sorted({'scipy', 'numpy.ma', 'numpy.random', 'matplotlib'} & set(sys.modules)))",
        tmp_path,
    )
    assert found.returncode == 0, found.stderr
    assert found.stdout.strip() == "[]"


def test_modules_of_the_user_with_the_names_of_the_folders_do_not_collide(tmp_path):
    for name in ("ocp", "models", "solvers"):
        (tmp_path / f"{name}.py").write_text("mine = True\n", encoding="utf-8")
    found = run_python("import covocp, ocp, models, solvers; print(ocp.mine, models.mine, solvers.mine)", tmp_path)
    assert found.returncode == 0, found.stderr
    assert found.stdout.split() == ["True"] * 3


def test_command_is_callable():
    (command,) = metadata.entry_points(group="console_scripts", name="covocp")
    assert callable(command.load())


def build(project: Path, output: Path, *kinds: str) -> None:
    """The sdist of a project and the wheel from that sdist, or what is named; its C compiled as fast as can be."""
    command = [sys.executable, "-m", "build", *kinds, "--no-isolation", "--outdir", str(output), str(project)]
    quickly = os.environ | {"CFLAGS": "-O0"}
    built = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=300, env=quickly, check=False
    )
    assert built.returncode == 0, built.stdout + built.stderr


def names_in_wheel(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if not name.endswith("/")}


@pytest.fixture(scope="module", params=["links", "text"])
def distributions(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[set[str], Path]:
    """Names in the sdist, and the wheel from it; of a clone with its links, and of one that has text in their place."""
    project = copy_of_the_project(tmp_path_factory.mktemp("source") / "project")
    if request.param == "text":
        for name in LINKS:
            link = project / "ocp" / "covocp" / name
            target = os.readlink(link)
            link.unlink()
            link.write_text(target, encoding="utf-8")
    output = project.parent / "dist"
    build(project, output)
    (sdist,), (wheel,) = output.glob("*.tar.gz"), output.glob("*.whl")
    with tarfile.open(sdist) as archive:
        in_sdist = {str(PurePosixPath(*PurePosixPath(member.name).parts[1:])) for member in archive if member.isfile()}
    return in_sdist, wheel


def test_wheel_from_the_sdist_contains_covocp_only(distributions):
    in_wheel = names_in_wheel(distributions[1])
    assert {PurePosixPath(name).parts[0] for name in in_wheel} == {"covocp", f"{NAME_VERSION}.dist-info"}


def test_wheel_from_the_sdist_contains_every_module(distributions):
    in_wheel = names_in_wheel(distributions[1])
    assert {name for name in in_wheel if name.endswith(".py")} == modules_on_disk()


def test_wheel_says_that_it_is_typed(distributions):
    in_wheel = names_in_wheel(distributions[1])
    assert "covocp/py.typed" in in_wheel


def test_sdist_contains_what_a_developer_needs(distributions):
    in_sdist, _ = distributions
    wanted = {"README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "pyproject.toml", "setup.py", ".ci/run"}
    for folder in ("tests", "examples", "benchmarks"):
        wanted |= {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob("*.py")}
    assert wanted <= in_sdist


def test_the_wheel_imports_from_its_own_files(distributions, tmp_path):
    with zipfile.ZipFile(distributions[1]) as archive:
        archive.extractall(tmp_path)
    code = (
        "import covocp, covocp.models.unknown_lag as lag, covocp.solvers.ipopt as ipopt\n"
        "print(covocp.__file__); print(lag.__file__); print(ipopt.__file__); print(covocp.simulate, covocp.export_c)"
    )
    found = run_python(code, tmp_path, PYTHONPATH=str(tmp_path))
    assert found.returncode == 0, found.stderr
    assert all(line.startswith(str(tmp_path)) for line in found.stdout.splitlines()[:3])


@pytest.fixture(scope="module")
def wheel_of_the_checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkout")
    project = copy_of_the_project(folder / "project")
    build(project, folder, "--wheel")
    (wheel,) = folder.glob("*.whl")
    return wheel


def test_the_wheel_of_the_checkout_is_that_from_the_sdist(distributions, wheel_of_the_checkout):
    assert names_in_wheel(wheel_of_the_checkout) == names_in_wheel(distributions[1])
