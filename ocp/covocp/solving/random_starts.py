"""Random starts: controls, free initial values and free durations are drawn from one seed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from covocp.base.checks import is_whole
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.extremal.extremal import Guess
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import check_model, control_scale, controls_guess, is_plain, starts
from covocp.transcription.mesh import Mesh, control_places
from covocp.transcription.starts import (
    WIDE,
    base_run,
    bend_size,
    completed,
    reachable,
    targets,
    untold_units,
)
from covocp.transcription.steering import Run, steer

RANDOM_AMPLITUDE = 1.0
# Half waves of a random control; sizes of those to which the states do not answer in proportion, in units of the bend.
WAVES = 4
SIZES = (1.0, 2.0, 4.0)
# A free duration is drawn between its guess divided by this and times this, within its bounds.
STRETCH = 4.0
# Bounds further apart than by this factor, both positive, are drawn between by their logarithms.
DECADE = 5.0
# A control along which the model leaves its domain at the start is halved at most so often.
HALVINGS = 6
MULTISTART = "multistart"
STARTS, MOST_STARTS = 8, 10**6


def random_guesses(statement: Statement, mesh: Mesh, parameters: Array, count: int, seed: int) -> Iterator[Guess]:
    """Random starts.

    Free initial values and durations are drawn one from each of `count` equally likely ranges, in random order: few
    starts then look everywhere.
    """
    for k in range(count):
        guess = drawn_guess(statement, mesh, parameters, count, seed, k)
        if guess is not None:
            yield guess


def drawn_guess(statement: Statement, mesh: Mesh, parameters: Array, count: int, seed: int, k: int) -> Guess | None:
    """The random start number k, from 0, of so many; None where it lies outside the domain of the model."""
    tied = () if statement.tied is None else statement.tied.states
    free = [int(k) for k in np.flatnonzero(np.isnan(statement.boundary_values(parameters)[0])) if k not in tied]
    shares = _latin(len(free) + int(statement.duration.free), count, seed)[k]
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(k,)))
    return _random_guess(statement, mesh, parameters, free, shares, generator)


def phase_seed(seed: int, phase: int) -> int:
    """A seed for one of several phases, by its number."""
    return int(np.random.SeedSequence((seed, phase)).generate_state(1, np.uint64)[0])


def check_multistart(guess: Given, starts: Given, seed: Given) -> None:
    """A guess that is a word, and the options that belong to it.

    Raises:
        ProblemError: another word than "multistart", numbers that are none, or that belong to no guess.
    """
    if isinstance(guess, str) and guess != MULTISTART:
        raise ProblemError(
            "The guess is an unknown word.",
            expected="None, 'multistart', a Solution, or a dict of name to guess",
            received=repr(guess),
            remedy="correct guess=",
        )
    for name, number, most in (("starts", starts, MOST_STARTS), ("seed", seed, None)):
        if not is_whole(number, 0, most):
            raise ProblemError(
                f"The option '{name}' is not a whole number.",
                expected="0, 1, 2, ...",
                received=repr(number),
                remedy=f"correct {name}=",
            )
    if not isinstance(guess, str) and (starts != STARTS or seed != 0):
        name, number = ("starts", starts) if starts != STARTS else ("seed", seed)
        raise ProblemError(
            f"The option '{name}' belongs to guess='multistart'.",
            expected="guess='multistart', the best of several random starts",
            received=f"{name}={number!r} beside another guess",
            remedy=f"give guess='multistart', or leave {name}= out",
        )


def multistart(guess: Given, options: dict[str, Any]) -> tuple[int, int] | None:
    """Number of random starts and their seed, taken out of some options; None where the guess asks for none.

    Raises:
        ProblemError: as `check_multistart`; or the options are given without the guess.
    """
    extra = {name: options.pop(name) for name in ("starts", "seed") if name in options}
    if not isinstance(guess, str):
        if extra:
            raise ProblemError(
                "The options of multistart are given, but not multistart.",
                expected="guess='multistart'",
                received=", ".join(f"{name}={value!r}" for name, value in extra.items()) + " without it",
                remedy="add guess='multistart', or remove them",
            )
        return None
    starts, seed = extra.get("starts", STARTS), extra.get("seed", 0)
    check_multistart(guess, starts, seed)
    return starts, seed


@lru_cache(maxsize=64)
def _latin(columns: int, count: int, seed: int) -> Array:
    """Numbers in (0, 1), shape (count, columns): each column has one in each of `count` equal ranges."""
    generator = np.random.default_rng((seed, columns, count))
    order = [generator.permutation(count) for _ in range(columns)]
    places = np.stack(order, axis=1) if columns else np.zeros((count, 0))
    return np.asarray((places + generator.uniform(0.02, 0.98, places.shape)) / max(count, 1))


def _random_guess(
    statement: Statement, mesh: Mesh, parameters: Array, free: list[int], shares: Array, generator: np.random.Generator
) -> Guess | None:
    """One random start; None where it lies outside the domain of the model, however small its controls are."""
    start, e0 = starts(statement, mesh, parameters)
    for k, share in zip(free, shares, strict=False):
        start[k] = _drawn_state(statement, k, float(start[k]), float(share))
    for block in statement.states:
        if block.tangent:  # a random quaternion, of unit length
            start[block.span] /= np.linalg.norm(start[block.span])
    start, e0 = statement.started(start, parameters, e0)
    duration = _drawn_duration(statement, float(shares[-1])) if statement.duration.free else statement.duration.guess
    flat = controls_guess(statement, mesh.nodes, mesh.control, sign=0.0)
    units = untold_units(statement, mesh, parameters, flat)
    wave = _wave(statement, mesh, flat, generator) * np.maximum(units, 1.0)
    lower, upper = statement.control_bounds
    size = generator.choice(SIZES)
    if statement.nu and not statement.coupled:
        run = replace(base_run(statement, mesh, parameters, start, flat), duration=duration)
        wave = wave * reachable(run, flat, np.abs(wave).max(axis=0), WIDE)  # bounds may be far away
        bend = bend_size(run, flat, wave)
        wave = wave * np.minimum(units, 1.0) if bend >= 1.0 else np.asarray(size * bend * wave)
    for _ in range(HALVINGS):
        u = np.clip(flat + wave, lower, upper)
        try:
            check_model(statement, start, u[:1].ravel(), e0, duration, parameters)
        except ProblemError:
            wave = 0.5 * wave
            continue
        if statement.nu and not statement.coupled and _guesses_say_little(statement):
            u = _steered(run, u)
        trajectory = completed(statement, mesh, parameters, u, start=start, duration=duration)
        return Guess(trajectory=trajectory)
    return None


def _guesses_say_little(statement: Statement) -> bool:
    """Whether all guesses are single numbers, so that the controls may be steered."""
    own = [b for b in (*statement.controls, *statement.states) if b.role == "moving"]
    return all(is_plain(statement.guesses[b.name]) for b in own)


def _steered(run: Run, u: Array) -> Array:
    """Controls changed by as little as brings the states to their final values."""
    fixed, target = targets(run)
    return steer(run, fixed, target, u)[0] if fixed else u


def _wave(statement: Statement, mesh: Mesh, flat: Array, generator: np.random.Generator) -> Array:
    """A smooth random function for each control: a few cosines with random coefficients."""
    at = control_places(mesh.nodes, mesh.control)
    orders = np.arange(WAVES)
    columns = [np.zeros((at.size, 0))]
    for block in statement.controls:
        scale = control_scale(statement, block, flat[:, block.span])
        coefficients = generator.standard_normal((WAVES, block.size)) / (1.0 + orders[:, None])
        columns.append(RANDOM_AMPLITUDE * scale * (np.cos(np.pi * np.outer(at, orders)) @ coefficients))
    return np.concatenate(columns, axis=1)


def _drawn_state(statement: Statement, index: int, guess: float, share: float) -> float:
    """A free initial value: between its bounds where it has two, else around its guess."""
    from statistics import NormalDist

    lower, upper = (float(bound[index]) for bound in statement.state_bounds)
    if np.isfinite(lower) and np.isfinite(upper):
        return _between(lower, upper, share)
    block = next(b for b in statement.states if b.span.start <= index < b.span.stop)
    given = statement.scales.get(block.name)
    size = float(given[index - block.offset]) if given is not None else max(abs(guess), 1.0)
    return float(np.clip(guess + size * NormalDist().inv_cdf(share), lower, upper))


def _drawn_duration(statement: Statement, share: float) -> float:
    """A free duration, within its bounds."""
    duration = statement.duration
    lower, upper = max(duration.lower, duration.guess / STRETCH), min(duration.upper, duration.guess * STRETCH)
    return _between(lower, upper, share)


def _between(lower: float, upper: float, share: float) -> float:
    """The number at a share of the way between two others, by their logarithms where they are far apart."""
    if lower > 0 and upper > DECADE * lower:
        return float(np.exp(np.log(lower) + share * (np.log(upper) - np.log(lower))))
    return lower + share * (upper - lower)
