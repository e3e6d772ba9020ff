"""Making messages in C does what the `__init__` that `dataclasses` writes does, also where it refuses."""

from __future__ import annotations

import dataclasses
import gc
import weakref
from typing import Any

import numpy as np
import pytest
from c_module import needs_native

from cortex.message_types import message


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
        ((1, 2.0, "q"), {}),
        ((1,), {"name": "q"}),
        ((), {"name": "q", "y": 1.0, "x": 4}),
        ((), {}),
        ((1, 2.0, "q", 4), {}),
        ((1,), {"x": 1}),
        ((1,), {"z": 1}),
        ((), {"y": 1.0}),
    ],
)
def test_makes_what_init_makes_and_refuses_what_it_refuses(args, kwargs):
    made = []
    for make in (Point, lambda *args, **kwargs: plain_init(Point, *args, **kwargs)):
        try:
            made.append(repr(make(*args, **kwargs)))
        except TypeError as error:
            made.append(str(error))
    assert made[0] == made[1]
    if made[0].startswith("Point("):
        assert Point(*args, **kwargs) == plain_init(Point, *args, **kwargs)
        assert type(Point(*args, **kwargs)) is Point


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


class Probe(np.ndarray):
    """An array that can be watched."""


def test_values_are_held_once_and_let_go():
    held = np.zeros(3).view(Probe)
    gone = weakref.ref(held)
    point: Any = Point(held)
    del held
    assert gone() is point.x
    del point
    gc.collect()
    assert gone() is None


def test_cycles_are_collected():
    items: list[Any] = []
    items += [Listed(1, items), Listed(2, [np.zeros(1).view(Probe)])]
    gone = weakref.ref(items[1].items[0])
    del items
    gc.collect()
    assert gone() is None
