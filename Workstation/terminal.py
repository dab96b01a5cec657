"""What the commands say on a terminal: progress bars there and none in a pipe, tables, JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ModuleRegistrationLib.procedure import Progress


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A callback (step in words, share done 0..1); it draws on stderr when that is a terminal, else it is silent."""
    if not sys.stderr.isatty():
        yield lambda step, share: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as RichProgress

    columns = (TextColumn("{task.description:<36}"), BarColumn(), TextColumn("{task.percentage:>3.0f}%"), TimeElapsedColumn())
    with RichProgress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda step, share: bar.update(task, description=step, completed=share)


def print_table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """A table on stdout; the columns keep their width in a pipe."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="bold")
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index == 0 else "right", no_wrap=index > 0)
    for row in rows:
        table.add_row(*row)
    Console(width=None if sys.stdout.isatty() else 120, soft_wrap=True).print(table)


def print_json(record: Any) -> None:
    """The result for programs, on stdout."""
    json.dump(record, sys.stdout, indent=2)
    sys.stdout.write("\n")


def number(value: float | None, digits: int = 2) -> str:
    """A number for people; a dash where there is none."""
    return "–" if value is None or value != value else f"{value:.{digits}f}"
