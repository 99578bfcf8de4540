"""One line for what holds arrays, in the whole package."""

import importlib
import inspect
import pkgutil
import re
import reprlib
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import casadi as ca
import numpy as np
import pytest

import covocp
import covocp.base.dataclass as base
from covocp.base.short_repr import LONGEST, short_repr

ARRAYS = re.compile(r"\bArray\b|\bNDArray\b|\bca\.")


@dataclass(frozen=True, kw_only=True)
class Thing:
    values: Any = None
    name: str = ""
    count: int = 3
    hidden: Any = field(default=None, repr=False)

    __repr__ = short_repr


def classes():
    """All dataclasses of the package."""
    for found in pkgutil.walk_packages(covocp.__path__, "covocp."):
        if not found.name.endswith("__main__"):
            module = importlib.import_module(found.name)
            yield from (c for c in vars(module).values() if is_dataclass(c) and c.__module__ == found.name)


def prints_arrays(cls):
    """Whether the representation of a class is the one that dataclasses make, and shows arrays."""
    made = inspect.unwrap(cls.__repr__).__code__.co_filename in ("<string>", base.__file__, reprlib.__file__)
    return made and any(f.repr and ARRAYS.search(str(f.type)) for f in fields(cls))


@pytest.mark.parametrize("decorator", [dataclass, base.dataclass])
def test_what_dataclasses_show_is_recognised(decorator):
    @decorator(frozen=True)
    class Default:
        """Shown as Python shows it."""

        values: "ca.DM"

    assert prints_arrays(Default)


def test_every_class_that_shows_arrays_has_it_or_its_own():
    assert [f"{cls.__module__}.{cls.__qualname__}" for cls in classes() if prints_arrays(cls)] == []


def test_fields_at_their_defaults_and_hidden_ones_are_left_out():
    assert repr(Thing()) == "Thing()"
    assert repr(Thing(count=3, hidden=np.zeros(5))) == "Thing()"
    assert repr(Thing(count=4)) == "Thing(count=4)"


def test_arrays_are_their_shapes_and_few_numbers_themselves():
    assert repr(Thing(values=np.zeros((101, 2)))) == "Thing(values=array(101, 2))"
    assert repr(Thing(values=np.zeros(101))) == "Thing(values=array(101,))"
    assert repr(Thing(values=np.zeros((0, 2)))) == "Thing(values=array(0, 2))"
    assert repr(Thing(values=np.array([1.0, 1 / 3]))) == "Thing(values=[1, 0.333333])"
    assert repr(Thing(values=[np.zeros(9)] * 5)) == "Thing(values=[5 entries])"
    assert repr(Thing(values={"a": np.zeros(9)})) == "Thing(values={a})"
    assert repr(Thing(values=Thing())) == "Thing(values=Thing(...))"


def test_casadi_is_told_by_its_size_or_name():
    x = ca.MX.sym("x", 2)
    assert repr(Thing(values=ca.sin(x))) == "Thing(values=MX(2, 1))"
    assert repr(Thing(values=ca.Function("f", [x], [x]))) == "Thing(values=Function f)"


def test_it_is_one_line_whatever_is_in_it():
    long = Thing(values=["w" * 60 + "\n"] * 4, name="n" * 500, count=10**90)
    assert len(repr(long)) <= LONGEST
    assert "\n" not in repr(long)
    assert repr(long).endswith("...)")


def test_equality_and_hash_are_those_of_the_fields():
    assert Thing(name="a") == Thing(name="a")
    assert Thing(name="a") != Thing(name="b")
    assert hash(Thing(name="a")) == hash(Thing(name="a"))
