"""Every interleaving of the ring's protocol on a machine that delays and reorders stores, as ARM does.

Each step of a thread is one access. A store waits in the thread's buffer and may reach memory after later
ones, but not across a fence, and a release not before what precedes it. Each rule of WIRE.md, 3.3 is left out
once: then the search must find what goes wrong.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest

Step = tuple[Any, ...]


class State(NamedTuple):
    """Memory, and for each thread where it is, what it has read, and which stores wait."""

    memory: tuple[tuple[str, int], ...]
    at: tuple[int, ...]
    read: tuple[tuple[tuple[str, int], ...], ...]
    waiting: tuple[tuple[tuple[str, int, bool], ...], ...]


def swap(items: tuple, index: int, item: Any) -> tuple:
    return (*items[:index], item, *items[index + 1 :])


def commits(state: State, thread: int) -> list[State]:
    """What memory may look like after one more store of a thread has reached it."""
    found, waiting = [], state.waiting[thread]
    for place, (name, value, release) in enumerate(waiting):
        before = waiting[:place]
        if name == "fence":
            if not before:
                found.append(state._replace(waiting=swap(state.waiting, thread, waiting[1:])))
            break
        if (release and before) or any(other[0] == name for other in before):
            continue
        memory = tuple(sorted({**dict(state.memory), name: value}.items()))
        rest = (*before, *waiting[place + 1 :])
        found.append(state._replace(memory=memory, waiting=swap(state.waiting, thread, rest)))
    return found


def run(state: State, thread: int, step: Step) -> State | None:
    """The state after a step; None if it cannot be taken yet."""
    kind, *operands = step
    memory, waiting = dict(state.memory), state.waiting[thread]
    at = swap(state.at, thread, state.at[thread] + 1)
    if kind in ("store", "release"):
        entry = (operands[0], operands[1], kind == "release")
        return state._replace(at=at, waiting=swap(state.waiting, thread, (*waiting, entry)))
    if kind == "order":  # a release fence: later stores stay behind earlier ones
        return state._replace(at=at, waiting=swap(state.waiting, thread, (*waiting, ("fence", 0, False))))
    if kind == "fence":
        return None if waiting else state._replace(at=at)
    name = operands[0]
    if kind == "exchange":
        if waiting:
            return None
        memory[name], value = operands[1], memory[name]
    else:
        value = next((v for n, v, _ in reversed(waiting) if n == name), memory[name])
    if kind == "skip unless" and value != operands[1]:
        at = swap(state.at, thread, state.at[thread] + 1 + operands[2])
    known = tuple(sorted({**dict(state.read[thread]), name: value}.items()))
    return State(tuple(sorted(memory.items())), at, swap(state.read, thread, known), state.waiting)


def explore(
    memory: dict[str, int], *threads: list[Step]
) -> list[tuple[dict[str, int], list[dict[str, int]]]]:
    """Memory, and what each thread has read, at the end of every run."""
    count = len(threads)
    first = State(tuple(sorted(memory.items())), (0,) * count, ((),) * count, ((),) * count)
    seen, todo, ends = {first}, [first], []
    while todo:
        state = todo.pop()
        following = [each for thread in range(count) for each in commits(state, thread)]
        for thread, steps in enumerate(threads):
            if state.at[thread] < len(steps):
                taken = run(state, thread, steps[state.at[thread]])
                following += [] if taken is None else [taken]
        if not following:
            ends.append((dict(state.memory), [dict(known) for known in state.read]))
        todo += [each for each in following if each not in seen]
        seen.update(following)
    assert ends
    return ends


def without(steps: list[Step], left_out: Step | None) -> list[Step]:
    return [step for step in steps if step != left_out]


@pytest.mark.parametrize("left_out", [None, "publisher", "reader"], ids=str)
def test_who_sleeps_is_woken(left_out):
    """The reader has seen no frame and sleeps: then the bell rings."""
    publisher = [
        ("release", "head", 1),
        ("fence",),
        ("skip unless", "sleeping", 1, 2),
        ("exchange", "sleeping", 0),
        ("store", "bell", 1),
    ]
    reader = [("store", "sleeping", 1), ("fence",), ("load", "head")]
    ends = explore(
        {"head": 0, "sleeping": 0, "bell": 0},
        without(publisher, ("fence",) if left_out == "publisher" else None),
        without(reader, ("fence",) if left_out == "reader" else None),
    )
    overslept = [memory for memory, (_, read) in ends if read["head"] == 0 and not memory["bell"]]
    assert bool(overslept) == (left_out is not None)


@pytest.mark.parametrize("entries", [1, 2])
@pytest.mark.parametrize("left_out", [None, ("order",)], ids=["as it is", "without the fence"])
def test_what_is_written_over_is_not_taken(left_out, entries):
    """The reader copies two words of an entry while both are replaced, and then looks at `reserved`.

    That was raised once for all entries.
    """
    publisher = [("store", "reserved", 1 + entries), ("order",)]
    for entry in range(2, 2 + entries):
        publisher += [("store", "one", entry), ("store", "two", entry), ("release", "head", entry)]
    reader = [("load", "one"), ("load", "two"), ("load", "reserved")]
    ends = explore({"reserved": 1, "head": 1, "one": 1, "two": 1}, without(publisher, left_out), reader)
    taken = [read for _, (_, read) in ends if read["reserved"] == 1]
    assert taken
    assert any((read["one"], read["two"]) != (1, 1) for read in taken) == (left_out is not None)


@pytest.mark.parametrize("kind", ["release", "store"])
def test_what_is_announced_is_whole(kind):
    """A reader that sees the new head sees the entry."""
    publisher = [
        ("store", "reserved", 2),
        ("order",),
        ("store", "one", 2),
        ("store", "two", 2),
        (kind, "head", 2),
    ]
    reader = [("skip unless", "head", 2, 2), ("load", "one"), ("load", "two")]
    ends = explore({"reserved": 1, "head": 1, "one": 1, "two": 1}, publisher, reader)
    found = [read for _, (_, read) in ends if read["head"] == 2]
    assert found
    assert any((read["one"], read["two"]) != (2, 2) for read in found) == (kind == "store")


@pytest.mark.parametrize("early", [False, True])
def test_what_a_reliable_reader_has_not_read_is_not_written_over(early):
    """The publisher writes once the tail says so; a tail that is stored too early gives the entry away."""
    publisher = [("skip unless", "tail", 1, 2), ("store", "one", 2), ("store", "two", 2)]
    loads: list[Step] = [("load", "one"), ("load", "two")]
    tail: list[Step] = [("release", "tail", 1)]
    ends = explore({"tail": 0, "one": 1, "two": 1}, publisher, tail + loads if early else loads + tail)
    torn = [read for _, (_, read) in ends if (read["one"], read["two"]) != (1, 1)]
    assert bool(torn) == early


@pytest.mark.parametrize("left_out", [None, "publisher", "reader"], ids=str)
def test_what_is_leased_is_not_written(left_out):
    """The publisher takes a slot while a reader leases it: one of the two sees the other."""
    publisher = [("store", "word", 0), ("fence",), ("skip unless", "lease", 0, 1), ("store", "body", 2)]
    reader = [("store", "lease", 1), ("fence",), ("skip unless", "word", 1, 1), ("load", "body")]
    ends = explore(
        {"word": 1, "lease": 0, "body": 1},
        without(publisher, ("fence",) if left_out == "publisher" else None),
        without(reader, ("fence",) if left_out == "reader" else None),
    )
    read = [read["body"] for _, (_, read) in ends if "body" in read]
    assert read
    assert (2 in read) == (left_out is not None)
