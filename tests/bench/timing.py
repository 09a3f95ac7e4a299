"""Interleaved timing: what is compared runs in turn, so a machine that speeds up or slows down does so for all."""

import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass

import jax
import numpy as np


@dataclass
class Timing:
    first: float  # s, the first call: tracing and compiling included
    median: float  # s
    best: float  # s


def interleaved(
    methods: dict[Hashable, Callable], *arguments, seconds: float = 1.0, rounds: int = 30
) -> dict[Hashable, Timing]:
    """Call every method twice, then all of them in turn until the time is used up; at least three rounds."""
    first, runs = {}, {name: [] for name in methods}
    for name, method in methods.items():
        first[name] = _time(method, arguments)
        _time(method, arguments)
    start = time.perf_counter()
    for i in range(rounds):
        if i >= 3 and time.perf_counter() - start > seconds * len(methods):
            break
        for name, method in methods.items():
            runs[name].append(_time(method, arguments))
    return {name: Timing(first[name], float(np.median(t)), float(np.min(t))) for name, t in runs.items()}


def _time(method: Callable, arguments: tuple) -> float:
    start = time.perf_counter()
    jax.block_until_ready(method(*arguments))
    return time.perf_counter() - start


_seen: set[Hashable] = set()  # kinds that are compiled


def forget() -> None:
    """Every kind counts as new again, as when compiled programs are gone."""
    _seen.clear()


def timed(function: Callable, kind: Hashable = None):
    """A result and the seconds of a call, after one that compiles: for every call, or for the first of a kind."""
    if kind is None or kind not in _seen:
        jax.block_until_ready(function())
        _seen.add(kind)
    start = time.perf_counter()
    return jax.block_until_ready(function()), time.perf_counter() - start
