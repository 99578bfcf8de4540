"""Models by name, and the user's own problems from scripts, with parameters given as words."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import pkgutil
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from types import ModuleType
from typing import Any

from covocp.base.dataclass import dataclass
from covocp.base.errors import CovocpError, ProblemError, kind_and_name, remedy_for_symbols, spelling
from covocp.problem.builder import Problem
from covocp.problem.phases import Phases

MODELS = "covocp.models"
WORDS = {"none": None, "true": True, "false": False}
# What a parameter without a default accepts, by its annotation.
KINDS: Mapping[str, Any] = {"float": 0.0, "int": 0, "str": "", "bool": False}


@dataclass(frozen=True, kw_only=True)
class Model:
    """A function that makes a problem, or one of several phases.

    Attributes:
        name: for file names.
        label: what the user calls it: "unknown_lag", "unknown_lag:steering", "path/to/script.py:function".
        make: the function.
        module: where it is; may have `figures()`, see `Model.figures`.
        script: the file, for a function of the user's.
    """

    name: str
    label: str
    make: Callable[..., Any] = field(repr=False)
    module: ModuleType = field(repr=False)
    script: Path | None = None

    @property
    def description(self) -> str:
        """First line of the documentation of its module; of the function where that is not the module's `problem`."""
        documented = self.module if self._own else self.make
        return (inspect.getdoc(documented) or "no description").splitlines()[0]

    @property
    def _own(self) -> bool:
        """Whether the function is the `problem` of a module of covocp."""
        return self.script is None and self.make is getattr(self.module, "problem", None)

    def defaults(self) -> dict[str, str]:
        """Parameters and their defaults as they are written."""
        parameters = inspect.signature(self.make).parameters.values()
        return {p.name: "VALUE" if p.default is p.empty else str(p.default) for p in parameters}

    def build(self, settings: Sequence[str] = ()) -> Problem | Phases:
        """The problem for some settings, each "name=value".

        Raises:
            ProblemError: an unknown parameter, one that is set twice, a value that does not fit, the function failed or
                returned no problem.
        """
        values = self._values(settings)
        problem = _called(self.label, self.script, lambda: self.make(**values))
        if not isinstance(problem, Problem | Phases):
            raise ProblemError(
                f"'{self.label}' did not return a problem.",
                expected="a covocp.Problem, or covocp.Phases",
                received=kind_and_name(problem),
                remedy="end the function by returning the problem that it makes",
            )
        return problem

    def figures(self) -> dict[str, Any]:
        """What the figures of the source show, by title; empty where the model names none.

        A figure is a list of designs, (label, problem) or (label, problem, nominal); or a dict of "designs" to such a
        list, and of what else `plot_solutions` takes: "names", "over", ... The nominal is that of `solve`, or a dict of
        control to history, which is evaluated.
        """
        if not self._own or not hasattr(self.module, "figures"):
            return {}
        figures: dict[str, Any] = self.module.figures()
        return figures

    def _values(self, settings: Sequence[str]) -> dict[str, Any]:
        """Settings as arguments of the function."""
        parameters = inspect.signature(self.make).parameters
        named = {n: p for n, p in parameters.items() if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
        anything = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        values: dict[str, Any] = {}
        for setting in settings:
            name, text = split_setting("--set", setting)
            check_once("--set", name, setting, values)
            if name not in named and not anything:
                raise ProblemError(
                    f"'{self.label}' has no parameter '{name}'.",
                    expected="one of " + (", ".join(named) or "none: it has no parameters"),
                    received=f"--set {setting}",
                    remedy=spelling(name, named, "correct the name"),
                )
            values[name] = _fitting(name, text, named[name]) if name in named else parse_value(text)
        missing = [n for n, p in named.items() if p.default is p.empty and n not in values]
        if missing:
            raise ProblemError(
                f"'{self.label}' needs a value of {', '.join(missing)}.",
                expected=" ".join(f"--set {name}=VALUE" for name in missing),
                received=", ".join(settings) or "no --set",
                remedy="give the missing values",
            )
        return values


def models() -> list[Model]:
    """The models that come with covocp, by name."""
    package = importlib.import_module(MODELS)
    found = []
    for entry in pkgutil.iter_modules(package.__path__):
        module = importlib.import_module(f"{MODELS}.{entry.name}")
        if hasattr(module, "problem"):
            found.append(Model(name=entry.name, label=entry.name, make=module.problem, module=module))
    return found


def find_model(text: str) -> Model:
    """The model of that name, or the function of a script.

    Args:
        text: a name of `models()`, the name of a model and one of its functions (unknown_lag:steering), or
            path/to/script.py:function.

    Raises:
        ProblemError: no such model, script or function, or the script failed.
    """
    path, colon, function = text.rpartition(":")
    if (colon and path.endswith(".py")) or text.endswith(".py"):
        return _from_script(Path(path if colon and path.endswith(".py") else text), function if path else "")
    available = models()
    for model in available:
        if model.name == text:
            return model
        if colon and model.name == path:
            return _other_function(model, function)
    raise ProblemError(
        f"There is no model '{text}'.",
        expected="one of " + ", ".join(model.name for model in available) + ", or path/to/script.py:function",
        received=text,
        remedy=spelling(text, [m.name for m in available], "correct the name; `covocp list` shows what the models are"),
    )


def problems(model: Model) -> list[Model]:
    """A model of covocp, and the other functions of its module that make problems, in their order."""
    others = [
        Model(name=f"{model.name}_{name}", label=f"{model.name}:{name}", make=value, module=model.module)
        for name, value in vars(model.module).items()
        if inspect.isfunction(value)
        and value is not model.make
        and not name.startswith("_")
        and value.__module__ == model.module.__name__
        and str(inspect.signature(value).return_annotation).endswith("Problem")
    ]
    return [model, *others]


def _other_function(model: Model, name: str) -> Model:
    """A function of a model's module that makes a problem."""
    own = {entry.make.__name__: entry for entry in problems(model)}
    if name not in own:
        raise ProblemError(
            f"The model '{model.name}' has no problem '{name}'.",
            expected="one of " + ", ".join(f"{model.name}:{n}" for n in own),
            received=f"{model.name}:{name}",
            remedy=spelling(name, own, "correct the name"),
        )
    return own[name]


def _from_script(path: Path, name: str) -> Model:
    """A function of a script, which is run as a module; its folder may be imported from."""
    if not path.is_file():
        raise ProblemError(
            f"There is no script '{path}'.",
            expected="path/to/script.py:function",
            received=str(path),
            remedy="check the path",
        )
    spec = importlib.util.spec_from_file_location(f"covocp_script_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module
    sys.path.insert(0, str(path.resolve().parent))
    loader = spec.loader
    _called(path.name, path, lambda: loader.exec_module(module))
    make = getattr(module, name, None) if name else None
    if not callable(make):
        own = [n for n, v in vars(module).items() if inspect.isfunction(v) and v.__module__ == module.__name__]
        raise ProblemError(
            f"'{path}' has no function '{name}'." if name else f"Which function of '{path}' makes the problem?",
            expected=f"{path}:function, the function one of " + (", ".join(own) or "none: the script has none"),
            received=f"{path}:{name}" if name else str(path),
            remedy="name a function that returns a covocp.Problem, or covocp.Phases",
        )
    return Model(name=path.stem, label=f"{path}:{name}", make=make, module=module, script=path)


def _called(name: str, script: Path | None, function: Callable[[], Any]) -> Any:
    """What a function of somebody else returns; whatever it raises becomes a `ProblemError` that says where.

    Raises:
        ProblemError: the function failed.
    """
    try:
        return function()
    except CovocpError:
        raise
    except (Exception, SystemExit) as error:
        place = ""
        if script is not None:
            lines = [
                f.lineno for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).name == script.name
            ]
            line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
            place = f" at {script}:{line}" if line else f" in {script}"
        text = " ".join(str(error).split())[:300]
        raise ProblemError(
            f"'{name}' failed{place}.",
            expected="a function that makes a problem",
            received=f"{type(error).__name__}: {text}" if text else type(error).__name__,
            remedy=remedy_for_symbols(error, "correct the script" if script else "check the values of --set"),
        ) from error


def split_setting(option: str, text: str) -> tuple[str, str]:
    """Name and value of "name=value".

    Raises:
        ProblemError: it is not of that form.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip().replace(".", "_").isidentifier() or not value.strip():
        raise ProblemError(
            f"'{option} {text}' is not understood.",
            expected=f"{option} name=value",
            received=f"{option} {text}",
            remedy="write the name, an equals sign and the value without blanks",
        )
    return name.strip(), value.strip()


def check_once(option: str, name: str, text: str, known: Mapping[str, Any]) -> None:
    """Refuse a name that has a value already: which of them is meant is not known.

    Raises:
        ProblemError: it has one.
    """
    if name in known:
        raise ProblemError(
            f"'{name}' is given twice.",
            expected=f"one {option} {name}=VALUE",
            received=f"{option} {name}={known[name]}, then {option} {text}",
            remedy="remove one of them",
        )


def parse_value(text: str) -> Any:
    """A number, none, true, false, a list or tuple of numbers, or the text itself."""
    if text.lower() in WORDS:
        return WORDS[text.lower()]
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    if text[0] in "[({'\"":
        try:
            return ast.literal_eval(text)
        except (ValueError, SyntaxError):
            return text
    return text


def _fitting(name: str, text: str, parameter: inspect.Parameter) -> Any:
    """A value of the kind of the default (or of the annotation where there is no default).

    Raises:
        ProblemError: it is of another kind.
    """
    annotation = parameter.annotation if isinstance(parameter.annotation, str) else ""
    annotation = annotation or getattr(parameter.annotation, "__name__", "")
    sample = KINDS.get(annotation, parameter.empty) if parameter.default is parameter.empty else parameter.default
    if isinstance(sample, str) or (sample is None and "str" in annotation):
        return text
    value = parse_value(text)
    if value is None and "None" in annotation:
        return None
    kind = "a number"
    if isinstance(sample, bool):
        fits, kind = isinstance(value, bool), "true or false"
    elif isinstance(sample, int):
        fits, kind = isinstance(value, int) and not isinstance(value, bool), "a whole number"
    elif isinstance(sample, float):
        fits = isinstance(value, (int, float)) and not isinstance(value, bool)
        value = float(value) if fits else value
    elif sample is None:
        fits, kind = not isinstance(value, str), "a number or none"
    else:
        fits = True
    if fits:
        return value
    raise ProblemError(
        f"The value of '{name}' does not fit.", expected=kind, received=text, remedy=f"correct --set {name}={text}"
    )
