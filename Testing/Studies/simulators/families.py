"""The families of simulated A-lines: no two share a model of tissue, pulse or hand."""

from __future__ import annotations

from types import ModuleType

from Testing.Studies.simulators import (
    bedside_lines,
    bench_lines,
    device_lines,
    disc_lines,
    echo_lines,
    facet_lines,
    grid_lines,
    kirchhoff_lines,
    latency_lines,
    layer_lines,
    lifted_lines,
    page_lines,
    piston_lines,
    plain_lines,
    range_lines,
    relief_lines,
    rough_lines,
    scan_lines,
    session_lines,
    sparse_lines,
    sphere_lines,
    stroke_lines,
    theatre_lines,
    tissue_lines,
)


def _by_name(*modules: ModuleType) -> dict[str, ModuleType]:
    return {module.__name__.rsplit(".", 1)[1]: module for module in modules}


HARD = _by_name(echo_lines, tissue_lines, bench_lines, page_lines)  # drawn to be hard, their lines hardly follow each other
SESSIONS = _by_name(  # as they go on a head
    session_lines,
    bedside_lines,
    facet_lines,
    theatre_lines,
    range_lines,
    layer_lines,
    grid_lines,
    kirchhoff_lines,
    scan_lines,
    piston_lines,
    disc_lines,
    relief_lines,
    stroke_lines,
    sparse_lines,
    rough_lines,
    device_lines,
    sphere_lines,
)
TEXTBOOK = _by_name(plain_lines)  # as a textbook would write them in a page
OFF_BONE = _by_name(lifted_lines)  # the probe meets no bone at all
UNSEEN = _by_name(latency_lines)  # no network is fitted to them
