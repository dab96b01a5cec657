"""A study as one picture: the TRE of every trial in each mode, with what the chapter measured beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.files import written_whole
from CranioNavLib.phantom import MODES
from CranioNavLib.rigid import Array

from ModuleRegistrationLib.verification.studies import LARGE_TRE_MM, TrialRow

# Mean and SD of the TRE, mm, as the chapter reports them: measured, not simulated
CHAPTER_TRE_MM: dict[str, dict[str, tuple[float, float]]] = {
    "phantom": {"Ia": (0.58, 0.23), "Ib": (1.78, 0.39), "IIa": (2.78, 1.20), "IIb": (1.38, 0.35), "III": (1.37, 0.51)},
    "cadaver": {"Ia": (0.51, 0.18), "III": (1.97, 1.76)},
    "patient": {},  # the chapter's patients have plausibility distances only
}
MODE_TITLES = {
    "Ia": "Ia\nbone screws",
    "Ib": "Ib\nskin markers",
    "IIa": "IIa\nlandmarks",
    "IIb": "IIb\n+ bone touched",
    "III": "III\n+ A-mode",
}
SIMULATED_COLOUR, CHAPTER_COLOUR = "#1f6f8b", "#b5541c"


def write_figure(path: str | Path, rows: Sequence[TrialRow]) -> None:
    """A picture (.png, .svg or .pdf by the name) of one study's trials; failed trials are counted below their mode.

    Raises
    ------
    InputError
        No rows, or rows of several studies.
    """
    studies = {row.study for row in rows}
    if len(studies) != 1:
        raise InputError(f"a figure shows one study, got {', '.join(sorted(studies)) or 'no rows'}; draw one figure a study")
    study = studies.pop()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    modes = [mode for mode in MODES if any(row.mode == mode for row in rows)]
    figure = Figure(figsize=(1.6 + 1.5 * len(modes), 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    labels = []
    for place, mode in enumerate(modes):
        tre = np.array([row.tre_mean_mm for row in rows if row.mode == mode])
        _draw_mode(axes, place, tre[np.isfinite(tre)], CHAPTER_TRE_MM[study].get(mode))
        failed = int((~np.isfinite(tre)).sum())
        labels.append(MODE_TITLES[mode] + (f"\n{failed} failed" if failed else ""))
    axes.axhline(LARGE_TRE_MM, color="0.6", linewidth=0.8, linestyle=":")
    axes.set_xticks(range(len(modes)), labels)
    axes.set_xlim(-0.6, len(modes) - 0.4)
    axes.set_ylim(bottom=0)
    axes.set_ylabel("TRE of a trial, mean over ten targets (mm)")
    axes.set_title(f"Simulated {study} study, {len({row.seed for row in rows})} trials a mode", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    _legend(axes, bool(CHAPTER_TRE_MM[study]))
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _draw_mode(axes: Any, place: int, tre: Array, chapter: Optional[tuple[float, float]]) -> None:
    spread = 0.12 * np.sin(np.arange(len(tre)) * 2.4)  # side by side, and the same on every run
    if len(tre):
        axes.scatter(place + spread - 0.08, tre, s=14, color=SIMULATED_COLOUR, alpha=0.45, linewidths=0)
        axes.plot([place - 0.28, place + 0.12], [tre.mean()] * 2, color=SIMULATED_COLOUR, linewidth=2.2)
    if chapter is not None:
        mean, sd = chapter
        axes.errorbar(place + 0.27, mean, sd, fmt="D", markersize=5, color=CHAPTER_COLOUR, capsize=3)


def _legend(axes: Any, with_chapter: bool) -> None:
    from matplotlib.lines import Line2D

    entries = [
        Line2D([], [], color=SIMULATED_COLOUR, marker="o", alpha=0.45, linestyle="", label="simulated trial"),
        Line2D([], [], color=SIMULATED_COLOUR, linewidth=2.2, label="simulated mean"),
    ]
    if with_chapter:
        entries.append(
            Line2D([], [], color=CHAPTER_COLOUR, marker="D", linestyle="", label="measured in the chapter, mean and SD")
        )
    axes.legend(handles=entries, frameon=False, fontsize=8)
