"""What an exported solver is linked with: nothing, or the library of a plugin."""

from __future__ import annotations

from pathlib import Path

import casadi as ca

from covocp.base.dataclass import dataclass

CMAKE = """\
set(PLUGIN_INCLUDE "" CACHE PATH "folder that holds {include}")
set(PLUGIN_LIBRARIES {libraries} CACHE STRING "{plugin}: names or paths of the libraries")
if(PLUGIN_INCLUDE)
    target_include_directories({name} PRIVATE "${{PLUGIN_INCLUDE}}")
endif()
target_link_libraries({name} PUBLIC ${{PLUGIN_LIBRARIES}})
"""
WORDS = """\
### What has to be linked

The solver calls {plugin}: compile with the folder that holds `{include}` (`-I...`) and link
`LIBRARIES = {flags}`. With CMake: `-DPLUGIN_INCLUDE=... -DPLUGIN_LIBRARIES="..."`. The wheel of CasADi brings both, in
the folder of the Python package (`python -c "import casadi; print(casadi.__path__[0])"`) and its `include`; link with
`-Wl,-rpath,` and that folder too. {plugin} allocates memory; the code around it does not."""


@dataclass(frozen=True, kw_only=True)
class Linking:
    """A library that a plugin needs.

    Attributes:
        plugin: its name.
        header: that the generated code includes.
        libraries: names.
    """

    plugin: str
    header: str
    libraries: tuple[str, ...]

    @property
    def include(self) -> tuple[str, ...]:
        """Folders of headers, those of CasADi's wheel."""
        return (str(_wheel() / "include"),)

    @property
    def link(self) -> tuple[str, ...]:
        """Flags of the linker, for the libraries of CasADi's wheel."""
        return (f"-L{_wheel()}", *(f"-l{name}" for name in self.libraries), f"-Wl,-rpath,{_wheel()}")

    @property
    def words(self) -> str:
        """A paragraph of the README."""
        flags = " ".join(f"-l{name}" for name in self.libraries)
        return WORDS.format(plugin=self.plugin, include=self.header, flags=flags)

    def cmake(self, name: str) -> str:
        """Lines of CMakeLists.txt."""
        libraries = " ".join(self.libraries)
        return CMAKE.format(name=name, plugin=self.plugin, include=self.header, libraries=libraries)

    @property
    def cmake_options(self) -> tuple[str, ...]:
        """What CMake is told where the wheel of CasADi is used."""
        paths = [next(iter(sorted(_wheel().glob(f"lib{name}.*"))), Path(name)) for name in self.libraries]
        return (f"-DPLUGIN_INCLUDE={_wheel() / 'include'}", f"-DPLUGIN_LIBRARIES={';'.join(map(str, paths))}")


def _wheel() -> Path:
    """The folder of CasADi's Python package."""
    return Path(ca.__file__).resolve().parent


# Plugins of nlpsol that have C code.
PLUGINS: dict[str, Linking | None] = {
    "sqpmethod": None,
    "ipopt": Linking(plugin="Ipopt", header="coin-or/IpStdCInterface.h", libraries=("ipopt",)),
    "fatrop": Linking(plugin="fatrop", header="fatrop/ocp/OCPCInterface.h", libraries=("fatrop", "blasfeo")),
}
