"""What is seen of a run of the NLP solver while it goes on: its progress, and whether it has lost its way."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.statement.conditions import beyond
from covocp.transcription.program import Program

# A run that has not brought its largest violation below this share of the smallest one before, for so many iterations,
# has lost its way, unless it violates (in the units of the NLP) less than this: then it may take its time.
PATIENCE = 40
PROGRESS = 0.9
NEAR = 1e-3
# Largest violation, in units of its row, from which on a run has gone away. One that stays there for so many iterations
# without that progress does not come back: none is known that did.
AWAY, ASTRAY = 30.0, 100
# A run crawls after so many steps that are the same but for this share. The Hessian of limited memory is then the first
# one, the identity: pairs without positive curvature are left out, and steps are unit steps along the gradient.
SAME_STEPS, SAME = 8, 0.02
# Rows that are violated by no more than this, in the units of the program, count as met.
MET = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class Iterate:
    """Variables and multipliers (of the scaled cost) of one iteration, its cost and its largest violation."""

    w: Array
    lam_x: Array
    lam_g: Array
    cost: float
    violation: float

    __repr__ = short_repr

    @property
    def rank(self) -> tuple[float, float]:
        """Less is better: what violates no row by its cost, anything else by what it violates."""
        return (0.0, self.cost) if self.violation <= MET else (self.violation, self.cost)


class _Steps:
    """Steps of a run, and how many of the last ones were the same."""

    def __init__(self) -> None:
        """Begin."""
        self._last: Array | None = None
        self._step: Array | None = None
        self._count = 0

    def same(self, w: Array) -> int:
        """How many steps up to this point were the one before them."""
        last, before = self._last, self._step
        self._last = w.copy()
        if last is None:
            return 0
        self._step = self._last - last
        size = float(np.abs(self._step).max(initial=0.0))
        alike = before is not None and size > 0.0 and float(np.abs(self._step - before).max()) <= SAME * size
        self._count = self._count + 1 if alike else 0
        return self._count


class Monitor(ca.Callback):
    """Ipopt's iteration callback: reports progress, and stops when the user asks."""

    def __init__(self, nlp: Program) -> None:
        ca.Callback.__init__(self)
        self._sizes = {"x": nlp.w.shape[0], "g": nlp.g.shape[0], "p": nlp.p.shape[0], "f": 1}
        self._progress: Progress | None = None
        self._scale, self._iteration = 1.0, 0
        self._bounds: dict[str, Array] = {}
        self._impatient, self.wandered = False, False
        self.astray = False
        self._least, self._since, self._away = np.inf, 0, 0
        self._steps, self._crawling, self.crawled = _Steps(), False, False
        self._patience: int | None = None
        self.spent = False  # that patience
        self.best: Iterate | None = None  # of a run that a limit may end
        self.construct("progress", {})

    def attach(
        self,
        progress: Progress,
        scale: float,
        bounds: dict[str, Array],
        impatient: bool = False,
        crawling: bool = False,
        patience: int | None = None,
    ) -> None:
        """Report to this progress from now on.

        Args:
            progress: who is told.
            scale: of the cost.
            bounds: of the program.
            impatient: whether a run that has lost its way is stopped.
            crawling: whether one is that crawls.
            patience: iterations after which one is; None: those that the solver allows.
        """
        self._progress, self._scale, self._bounds, self._iteration = progress, scale, bounds, 0
        self._impatient, self.wandered, self.astray = impatient, False, False
        self._least, self._since, self._away = np.inf, 0, 0
        self._steps, self._crawling, self.crawled = _Steps(), crawling, False
        self._patience, self.spent = patience, False
        self.best = None

    def get_n_in(self) -> int:
        """One for each output of the solver."""
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        """Whether to stop."""
        return 1

    def get_name_in(self, i: int) -> str:
        """Names of the outputs of the solver."""
        return str(ca.nlpsol_out(i))

    def get_name_out(self, i: int) -> str:
        """The name that nlpsol asks for."""
        return "ret"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Columns."""
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i).removeprefix("lam_")], 1)

    def has_eval_buffer(self) -> bool:
        """Numbers come as they lie in memory: matrices made of them would take longer than a small iteration."""
        return True

    def eval_buffer(self, arg: tuple[memoryview, ...], res: tuple[memoryview, ...]) -> int:
        """One iteration."""
        names = ("f", "g", "x", "lam_x", "lam_g")
        cost, g, *point = (np.frombuffer(arg[ca.nlpsol_out().index(name)], dtype=float) for name in names)
        np.frombuffer(res[0], dtype=float)[:] = self.seen(float(cost[0]), g, *point)
        return 0

    def seen(self, cost: float, g: Array, w: Array, lam_x: Array, lam_g: Array) -> bool:
        """Report an iteration with such a cost and such rows, variables and multipliers; whether to stop."""
        if self._progress is None:
            return False
        violation = float(beyond(g, self._bounds["lbg"], self._bounds["ubg"]).max(initial=0.0))
        if self._progress.limited and self._progress.believes(cost * self._scale):
            one = Iterate(w=w, lam_x=lam_x, lam_g=lam_g, cost=cost, violation=violation)
            if self.best is None or one.rank < self.best.rank:
                self.best = replace(one, w=w.copy(), lam_x=lam_x.copy(), lam_g=lam_g.copy())
        self._progress.update(self._iteration, cost * self._scale, violation)
        self._iteration += 1
        self.crawled = self._crawling and self._steps.same(w) >= SAME_STEPS
        self.spent = self._patience is not None and self._iteration > self._patience
        return self._progress.stop or self.crawled or self.spent or self._is_lost(violation)

    def _is_lost(self, violation: float) -> bool:
        """Whether a run has made no progress for long that is far away, or that need not be finished."""
        self._away = self._away + 1 if violation > AWAY else 0
        if violation < PROGRESS * self._least:
            self._least, self._since, self._away = violation, self._iteration, 0
        self.astray = self._away >= ASTRAY
        self.wandered = self._impatient and violation > NEAR and self._iteration - self._since >= PATIENCE
        return self.wandered or self.astray
