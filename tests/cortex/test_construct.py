"""Making messages in C does what the `__init__` that `dataclasses` writes does, also where it refuses."""

from __future__ import annotations

import dataclasses
import gc
import weakref
from typing import Any

import numpy as np
import pytest

from cortex.compiled import native
from cortex.message import message

needs_native = pytest.mark.skipif(native is None, reason="cortex._native was not compiled")


@message
class Point:
    x: int
    y: float = 0.5
    name: str = "p"


@message
class Listed:
    x: int
    items: list[int] = dataclasses.field(default_factory=list)


def plain_init(cls: Any, *args: Any, **kwargs: Any) -> Any:
    """Make a message by the class's own `__init__`, whatever calling the class does."""
    made = object.__new__(cls)
    cls.__init__(made, *args, **kwargs)
    return made


@needs_native
def test_ordinary_classes_are_hastened_and_others_are_not():
    assert "__cortex_maker__" in vars(Point)

    @message
    class Checked:
        x: int

        def __post_init__(self) -> None:
            if self.x < 0:
                raise ValueError("x must be >= 0")

    @message
    class Own:
        x: int

        def __init__(self, x: int) -> None:
            object.__setattr__(self, "x", 2 * x)

    assert "__cortex_maker__" not in vars(Checked)
    assert "__cortex_maker__" not in vars(Own)
    with pytest.raises(ValueError, match=">= 0"):
        Checked(-1)
    assert Own(3).x == 6


@pytest.mark.parametrize(
    ("args", "kwargs"),
    [
        ((1,), {}),
        ((1, 2.0), {}),
        ((1, 2.0, "q"), {}),
        ((), {"x": 1}),
        ((1,), {"name": "q"}),
        ((), {"name": "q", "y": 1.0, "x": 4}),
    ],
)
def test_equals_what_init_makes(args, kwargs):
    made = Point(*args, **kwargs)
    assert made == plain_init(Point, *args, **kwargs)
    assert type(made) is Point
    assert repr(made) == repr(plain_init(Point, *args, **kwargs))


@pytest.mark.parametrize(
    ("args", "kwargs"),
    [
        ((), {}),
        ((1, 2.0, "q", 4), {}),
        ((1,), {"x": 1}),
        ((1,), {"z": 1}),
        ((), {"y": 1.0}),
    ],
)
def test_refuses_as_init_does(args, kwargs):
    with pytest.raises(TypeError) as ours:
        Point(*args, **kwargs)
    with pytest.raises(TypeError) as theirs:
        plain_init(Point, *args, **kwargs)
    assert str(ours.value) == str(theirs.value)


def test_factories_run_for_each_message():
    first, second = Listed(1), Listed(2)
    assert first.items == []
    assert first.items is not second.items
    given: list[int] = [7]
    assert Listed(1, given).items is given


def test_a_subclass_runs_its_own_init():
    class Doubled(Point):  # type: ignore[misc]
        def __init__(self, x: int) -> None:
            super().__init__(2 * x)

    assert Doubled(4).x == 8
    assert type(Doubled(4)) is Doubled

    @message
    class Longer(Point):
        z: int = 9

    assert Longer(1, 2.0, "q", 3) == plain_init(Longer, 1, 2.0, "q", 3)
    assert Longer(1).z == 9


def test_values_are_held_once_and_let_go():
    array = np.zeros(3)

    class Holder(np.ndarray):
        pass

    held = array.view(Holder)
    gone = weakref.ref(held)
    point: Any = Point(held)
    del held
    assert gone() is point.x
    del point
    gc.collect()
    assert gone() is None


def test_cycles_are_collected():
    items: list[Any] = []
    items.append(Listed(1, items))
    probe = Listed(2, [np.zeros(1).view(type("Probe", (np.ndarray,), {}))])
    gone = weakref.ref(probe.items[0])
    items.append(probe)
    del items, probe
    gc.collect()
    assert gone() is None
