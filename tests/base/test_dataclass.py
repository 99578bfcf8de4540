"""The dataclasses of the package are Python's own in everything that a user sees of them."""

import copy
import dataclasses
import inspect
import pickle
import pydoc
from dataclasses import FrozenInstanceError, field
from typing import Any

import pytest

from covocp.base.dataclass import dataclass


def defined(decorator: Any, **options: Any) -> Any:
    """A class with all kinds of fields."""

    @decorator(frozen=True, **options)
    class Thing:
        """Something."""

        first: float
        name: str = "no name"
        entries: list[int] = field(default_factory=list)
        hidden: Any = field(default=None, repr=False)
        apart: int = field(default=0, compare=False)
        kept: dict[str, int] = field(default_factory=dict, init=False, repr=False, compare=False)
        fixed: int = field(default=7, init=False)

    return Thing


OPTIONS = ({}, {"kw_only": True}, {"eq": False}, {"kw_only": True, "eq": False})


@dataclass(frozen=True, kw_only=True)
class Sent:
    """What is pickled."""

    values: tuple[int, ...]
    doubled: bool = False

    def __post_init__(self) -> None:
        if self.doubled:
            object.__setattr__(self, "values", tuple(2 * v for v in self.values))


@dataclass(frozen=True)
class Own:
    """With methods that stay."""

    number: int

    def __repr__(self) -> str:
        return "own"

    def __eq__(self, other: object) -> bool:
        return True


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_what_help_and_inspect_show(options):
    own, pythons = defined(dataclass, **options), defined(dataclasses.dataclass, **options)
    assert str(inspect.signature(own)) == str(inspect.signature(pythons))
    assert pydoc.plain(pydoc.render_doc(own)) == pydoc.plain(pydoc.render_doc(pythons))
    assert own.__match_args__ == pythons.__match_args__
    assert own.__init__.__annotations__ == pythons.__init__.__annotations__
    assert str(dataclasses.fields(own)) == str(dataclasses.fields(pythons))
    for name in ("__init__", "__repr__", "__setattr__", "__delattr__"):
        mine, theirs = getattr(own, name), getattr(pythons, name)
        assert (mine.__name__, mine.__qualname__, mine.__module__) == (name, theirs.__qualname__, theirs.__module__)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_objects_are_made_shown_and_compared_alike(options):
    own, pythons = defined(dataclass, **options), defined(dataclasses.dataclass, **options)
    for given in ({"first": 1.0}, {"first": 1.0, "apart": 3, "entries": [1]}, {"first": float("nan"), "hidden": "h"}):
        mine, theirs = own(**given), pythons(**given)
        assert repr(mine) == repr(theirs)
        assert vars(mine) == vars(theirs) or given["first"] != given["first"]
        assert dataclasses.asdict(mine).keys() == dataclasses.asdict(theirs).keys()
        for changed in ({}, {"apart": 5}, {"name": "other"}):
            same = mine == dataclasses.replace(mine, **changed)
            assert same == (theirs == dataclasses.replace(theirs, **changed))
        assert mine != theirs
    assert own(first=1.0).entries is not own(first=1.0).entries
    assert own(first=1.0).kept == {}


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_wrong_calls_are_refused_in_the_same_words(options):
    own, pythons = defined(dataclass, **options), defined(dataclasses.dataclass, **options)
    for args, given in (((), {}), ((), {"first": 1, "unknown": 2}), ((), {"first": 1, "fixed": 2}), ((1,) * 9, {})):
        messages = []
        for cls in (own, pythons):
            with pytest.raises(TypeError) as caught:
                cls(*args, **given)
            messages.append(str(caught.value))
        assert messages[0] == messages[1]


def test_fields_cannot_be_changed():
    thing = defined(dataclass)(1.0)
    for name in ("first", "other"):
        with pytest.raises(FrozenInstanceError, match=f"cannot assign to field '{name}'"):
            setattr(thing, name, 2.0)
        with pytest.raises(FrozenInstanceError, match=f"cannot delete field '{name}'"):
            delattr(thing, name)

    class Derived(defined(dataclass)):
        """A plain class may have more."""

    derived = Derived(1.0)
    derived.more = 3
    del derived.more
    with pytest.raises(FrozenInstanceError):
        derived.first = 2.0


def test_hashes_are_those_of_the_fields():
    assert hash(Sent(values=(1, 2))) == hash(((1, 2), False))
    assert {Sent(values=(1,)), Sent(values=(1,))} == {Sent(values=(1,))}
    by_identity = defined(dataclass, eq=False)
    thing = by_identity(1.0)
    assert hash(thing) == object.__hash__(thing)
    assert thing == thing
    assert thing != by_identity(1.0)


def test_copies_and_pickles():
    sent = Sent(values=(1, 2), doubled=True)
    assert sent.values == (2, 4)
    for made in (copy.copy(sent), copy.deepcopy(sent), pickle.loads(pickle.dumps(sent))):
        assert made == sent
        assert made.values == (2, 4)


def test_methods_of_the_body_stay():
    assert repr(Own(1)) == "own"
    assert Own(1) == Own(2)
    assert hash(Own(1)) == hash((1,))


def test_an_object_that_holds_itself_is_shown():
    thing = defined(dataclass)(1.0)
    thing.entries.append(thing)
    assert "entries=[...]" in repr(thing)


def test_pythons_own_decorator_derives_from_them():
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class More(Sent):
        """With another field."""

        more: int = 0

    assert repr(More(values=(1,), more=2)).endswith("More(values=(1,), doubled=False, more=2)")
    with pytest.raises(FrozenInstanceError):
        More(values=(1,)).values = ()
    with pytest.raises(TypeError, match="frozen"):

        @dataclasses.dataclass
        class _Changeable(Sent):
            """What may change cannot be derived from what may not."""

    @dataclass(frozen=True, kw_only=True)
    class Less(Sent):
        """Derived by the package's own."""

        less: int = 1

    assert [f.name for f in dataclasses.fields(Less)] == ["values", "doubled", "less"]
    assert Less(values=(3,), less=4) == dataclasses.replace(Less(values=(3,)), less=4)


def test_a_first_construction_by_a_subclass():
    base = defined(dataclass)

    class Derived(base):
        """Made before any of its base."""

    assert Derived(2.0).first == 2.0
    assert base(3.0).first == 3.0
    assert "__init__" not in vars(Derived)
