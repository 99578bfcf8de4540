"""One import name: the folders ocp/, models/ and solvers/ install as covocp and nothing else."""

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
SETUPTOOLS = PROJECT["tool"]["setuptools"]
ROOTS = {"covocp": "ocp", "covocp.models": "models", "covocp.solvers": "solvers"}
NAME_VERSION = f"covocp-{PROJECT['project']['version']}"


def modules_on_disk() -> set[str]:
    """Paths inside the installed package of every Python file under the three folders."""
    return {
        str(PurePosixPath(*package.split("."), *path.relative_to(ROOT / folder).parts))
        for package, folder in ROOTS.items()
        for path in (ROOT / folder).rglob("*.py")
    }


def run_python(code: str, directory: Path) -> subprocess.CompletedProcess[str]:
    """A fresh interpreter with the directory first on its path."""
    return subprocess.run([sys.executable, "-c", code], cwd=directory, capture_output=True, text=True, timeout=120)


def test_every_folder_with_python_files_is_a_listed_package():
    folders = {str(PurePosixPath(module).parent).replace("/", ".") for module in modules_on_disk()}
    assert sorted(SETUPTOOLS["packages"]) == sorted(folders)


def test_package_directories_are_the_three_folders():
    assert SETUPTOOLS["package-dir"] == ROOTS


def test_installed_version_is_that_of_the_project():
    assert metadata.version("covocp") == PROJECT["project"]["version"]


def test_import_leaves_the_names_of_the_folders_to_the_user(tmp_path):
    found = run_python(
        "import sys, covocp; print(sorted({'ocp', 'models', 'solvers'} & set(sys.modules)))",
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


def test_importing_the_folder_of_a_checkout_says_what_to_do():
    found = run_python("import ocp", ROOT)
    assert found.returncode != 0
    message = found.stderr.strip().splitlines()[-1]
    assert message.startswith("ImportError")
    assert "import covocp" in message


def test_command_is_callable():
    (command,) = metadata.entry_points(group="console_scripts", name="covocp")
    assert callable(command.load())


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> tuple[set[str], set[str]]:
    """Names in the sdist of a copy of the project, and in the wheel that is built from that sdist."""
    copy = tmp_path_factory.mktemp("source") / "project"
    hidden = [path.name for path in ROOT.glob(".*") if path.name not in (".ci", ".gitignore")]
    shutil.copytree(
        ROOT, copy, ignore=shutil.ignore_patterns(*hidden, "__pycache__", "*.egg-info", "build", "dist", "venv")
    )
    output = copy.parent / "dist"
    built = subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(output), str(copy)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert built.returncode == 0, built.stdout + built.stderr
    (sdist,) = output.glob("*.tar.gz")
    (wheel,) = output.glob("*.whl")
    with tarfile.open(sdist) as archive:
        in_sdist = {str(PurePosixPath(*PurePosixPath(member.name).parts[1:])) for member in archive if member.isfile()}
    with zipfile.ZipFile(wheel) as archive:
        in_wheel = {name for name in archive.namelist() if not name.endswith("/")}
    return in_sdist, in_wheel


def test_wheel_from_the_sdist_contains_covocp_only(distributions):
    _, in_wheel = distributions
    assert {PurePosixPath(name).parts[0] for name in in_wheel} == {"covocp", f"{NAME_VERSION}.dist-info"}


def test_wheel_from_the_sdist_contains_every_module(distributions):
    _, in_wheel = distributions
    assert {name for name in in_wheel if name.endswith(".py")} == modules_on_disk()


def test_wheel_says_that_it_is_typed(distributions):
    _, in_wheel = distributions
    assert "covocp/py.typed" in in_wheel


def test_sdist_contains_what_a_developer_needs(distributions):
    in_sdist, _ = distributions
    wanted = {"README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "pyproject.toml", "setup.cfg", ".ci/run"}
    for folder in ("tests", "examples", "benchmarks"):
        wanted |= {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob("*.py")}
    assert wanted <= in_sdist
