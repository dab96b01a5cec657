"""The widgets that panel_qt.py draws with: 3D Slicer's own inside the application, plain Qt (PySide6) outside.

Only setters and `property(name)` are used, which PythonQt and PySide6 spell alike.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from enum import Enum
from functools import cache
from time import sleep
from types import SimpleNamespace
from typing import Any

from CranioNavLib import host
from CranioNavLib.errors import InputError
from CranioNavLib.panel import Entry
from CranioNavLib.parameters import ParameterInfo

LOG = logging.getLogger(__name__)
NO_LIMIT = 1e6
LARGEST_INT = 2**31 - 1  # of Qt's spin box
POLL_MS = 50


@cache
def toolkit() -> Any:
    """All Qt classes in one namespace.

    Raises
    ------
    InputError
        Outside the application without PySide6.
    """
    if host.in_application():
        return importlib.import_module("qt")
    try:
        parts = [importlib.import_module(f"PySide6.{part}") for part in ("QtCore", "QtGui", "QtWidgets")]
    except ImportError as error:
        raise InputError(f"no Qt to draw the panel with: {error}; install PySide6-Essentials or run inside 3D Slicer") from None
    return SimpleNamespace(**{name: getattr(part, name) for part in parts for name in dir(part) if not name.startswith("_")})


def connect(widget: Any, signal: str, slot: Callable[..., Any]) -> None:
    """Connect a signal, given with its arguments ("valueChanged(double)"): PythonQt chooses among overloads by them."""
    if host.in_application():
        widget.connect(signal, slot)
    else:
        getattr(widget, signal.partition("(")[0]).connect(slot)


class Ticker:
    """Calls a function again and again from the event loop: how samples of a device's thread reach the scene."""

    def __init__(self, parent: Any, interval_ms: int, work: Callable[[], object]) -> None:
        self._work, self._timer = work, toolkit().QTimer() if parent is None else toolkit().QTimer(parent)
        self._timer.setInterval(interval_ms)
        connect(self._timer, "timeout()", self._tick)

    def start(self) -> None:
        """Begin; may be called twice."""
        self._timer.start()

    def stop(self) -> None:
        """End; may be called twice."""
        self._timer.stop()

    def _tick(self) -> None:
        if host.in_application():
            sleep(0.001)  # the application's event loop holds the interpreter: the device's thread runs in pauses like this
        try:
            self._work()
        except InputError:
            LOG.exception("refused while polling")  # the panel's read-outs say so, too


class ThreadRunner:
    """Long work in a thread of its own; what it brings back is handed over in the thread of the event loop."""

    def __init__(self, parent: Any) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="cranionav")
        self._future: Future[Any] | None = None
        self._finished: Callable[[Any], None] | None = None
        self._timer = toolkit().QTimer(parent)
        self._timer.setInterval(POLL_MS)
        connect(self._timer, "timeout()", self.poll)

    def start(self, compute: Callable[[], Any], finished: Callable[[Any], None]) -> None:
        """Return at once; `finished(result or exception)` follows."""
        self._future, self._finished = self._pool.submit(compute), finished
        self._timer.start()

    def poll(self) -> None:
        """Hand over what is done. While 3D Slicer's event loop waits, no other Python thread runs: so give it time here."""
        if host.in_application():
            sleep(POLL_MS / 2000)
        if self._future is None or self._finished is None or not self._future.done():
            return
        self._timer.stop()
        future, finished, self._future = self._future, self._finished, None
        finished(future.exception() or future.result())

    def close(self) -> None:
        """Let go of the thread."""
        self._timer.stop()
        self._pool.shutdown(wait=False)


class Section:
    """A collapsible part of the panel: ctkCollapsibleButton inside the application, a button over a body outside."""

    def __init__(self, title: str) -> None:
        qt = toolkit()
        if host.in_application():
            self.widget = self._head = importlib.import_module("ctk").ctkCollapsibleButton()
            self.layout = qt.QVBoxLayout(self.widget)
        else:
            self.widget, self._head, self._body = qt.QWidget(), qt.QPushButton(), qt.QWidget()
            self._head.setCheckable(True)
            self._head.setChecked(True)
            self._head.setStyleSheet("text-align: left; padding: 4px; font-weight: 600;")
            outer = qt.QVBoxLayout(self.widget)
            outer.setContentsMargins(0, 0, 0, 0)
            outer.addWidget(self._head)
            outer.addWidget(self._body)
            self.layout = qt.QVBoxLayout(self._body)
            connect(self._head, "toggled(bool)", self._body.setVisible)
        self.set_title(title)

    @property
    def title(self) -> str:
        """What stands above the section."""
        return str(self._head.property("text"))

    def set_title(self, title: str) -> None:
        """Show another title."""
        self._head.setProperty("text", title)

    def set_collapsed(self, collapsed: bool) -> None:
        """Fold or unfold."""
        if host.in_application():
            self.widget.setProperty("collapsed", collapsed)
        else:
            self._head.setProperty("checked", not collapsed)


class NodeChooser:
    """Choose a node of a class: qMRMLNodeComboBox inside the application, a combo box over the scene's nodes outside."""

    def __init__(self, mrml_class: str, chosen: Callable[[Any], object]) -> None:
        self._class, self._chosen, self._filling = mrml_class, chosen, False
        self._ids: list[str] = []
        if host.in_application():
            self.widget = host.slicer_package().qMRMLNodeComboBox()
            self.widget.nodeTypes = [mrml_class]
            self.widget.addEnabled = self.widget.removeEnabled = False
            self.widget.renameEnabled = self.widget.noneEnabled = True
            self.widget.setMRMLScene(host.scene())
            connect(self.widget, "currentNodeChanged(vtkMRMLNode*)", self._node_chosen)
        else:
            self.widget = toolkit().QComboBox()
            connect(self.widget, "currentIndexChanged(int)", self._index_chosen)

    def show(self, node: Any | None) -> None:
        """Show which node plays the role now, and which could."""
        self._filling = True
        try:
            if host.in_application():
                self.widget.setCurrentNode(node)
                return
            nodes = host.slicer_package().util.getNodesByClass(self._class)
            self._ids = ["", *(found.GetID() for found in nodes)]
            self.widget.clear()
            self.widget.addItems(["None", *(found.GetName() for found in nodes)])
            self.widget.setCurrentIndex(self._ids.index(node.GetID()) if node is not None else 0)
        finally:
            self._filling = False

    def _index_chosen(self, index: int) -> None:
        if not self._filling and 0 < index < len(self._ids):
            self._chosen(host.scene().GetNodeByID(self._ids[index]))

    def _node_chosen(self, node: Any) -> None:
        if not self._filling and node is not None:
            self._chosen(node)


class Chooser:
    """A list with one entry chosen; those that are done carry a tick."""

    def __init__(self, chosen: Callable[[str], object]) -> None:
        self.widget, self._chosen = toolkit().QListWidget(), chosen
        self._shown: tuple[tuple[Entry, ...], str] = ((), "")
        self.widget.setMaximumHeight(130)
        connect(self.widget, "itemClicked(QListWidgetItem*)", lambda *_: self._clicked())

    def show(self, entries: tuple[Entry, ...], chosen: str) -> None:
        """Show the entries and which one is chosen."""
        if (entries, chosen) == self._shown:
            return
        self._shown = (entries, chosen)
        self.widget.clear()
        for one in entries:
            self.widget.addItem("  ".join(filter(None, ["!" if one.doubtful else "✓" if one.done else "○", one.name, one.note])))
        names = [one.name for one in entries]
        self.widget.setCurrentRow(names.index(chosen) if chosen in names else -1)

    def _clicked(self) -> None:
        row = int(self.widget.property("currentRow"))
        if 0 <= row < len(self._shown[0]):
            self._chosen(self._shown[0][row].name)


class Drawing:
    """A drawing given as SVG text."""

    def __init__(self, label: str) -> None:
        self.widget = toolkit().QLabel()
        self._shown: str | None = None
        self.widget.setAccessibleName(label)
        self.widget.setToolTip(label)
        self.widget.setVisible(False)

    def show(self, svg: str | None) -> None:
        """Show another drawing, or none."""
        if svg == self._shown:
            return
        self._shown = svg
        self.widget.setVisible(bool(svg))
        if svg:
            picture = toolkit().QPixmap()
            picture.loadFromData(toolkit().QByteArray(svg.encode("utf-8")), "SVG")
            self.widget.setPixmap(picture)


class Editor:
    """An editor for one parameter: tick box, choice, number with unit, or text. An optional one may be switched off."""

    def __init__(self, info: ParameterInfo, edited: Callable[[Any], object]) -> None:
        qt = toolkit()
        self._info, self._edited, self._showing = info, edited, False
        self.input = _input_for(info)
        self.widget, self._switch = self.input, None
        if info.optional:
            self.widget = qt.QWidget()
            row = qt.QHBoxLayout(self.widget)
            row.setContentsMargins(0, 0, 0, 0)
            self._switch = qt.QCheckBox()
            self._switch.setToolTip("Off: chosen automatically")
            row.addWidget(self._switch)
            row.addWidget(self.input, 1)
            connect(self._switch, "toggled(bool)", lambda *_: self._changed())
        self.input.setToolTip(info.help)
        connect(self.input, _SIGNALS[_kind(info)], lambda *_: self._changed())

    def show(self, value: Any) -> None:
        """Show a value without reporting it as an edit."""
        self._showing = True
        try:
            if self._switch is not None:
                self._switch.setProperty("checked", value is not None)
                self.input.setEnabled(value is not None)
            if value is not None:
                self._put(value)
        finally:
            self._showing = False

    def value(self) -> Any:
        """What the user has entered."""
        if self._switch is not None and not self._switch.property("checked"):
            return None
        kind: Any = self._info.kind
        if kind is bool:
            return bool(self.input.property("checked"))
        if issubclass(kind, Enum):
            return list(kind)[int(self.input.property("currentIndex"))]
        return kind(self.input.property("text" if kind is str else "value"))

    def _put(self, value: Any) -> None:
        if isinstance(value, bool):
            self.input.setProperty("checked", value)
        elif isinstance(value, Enum):
            self.input.setCurrentIndex(list(type(value)).index(value))
        elif isinstance(value, str):
            if self.input.property("text") != value and not self.input.property("focus"):  # not while the user types
                self.input.setText(value)
        else:
            self.input.setValue(value)

    def _changed(self) -> None:
        if not self._showing:
            self._edited(self.value())


_SIGNALS = {
    "bool": "toggled(bool)",
    "choice": "currentIndexChanged(int)",
    "int": "valueChanged(int)",
    "float": "valueChanged(double)",
    "str": "editingFinished()",
}


def _kind(info: ParameterInfo) -> str:
    return "choice" if issubclass(info.kind, Enum) else info.kind.__name__


def _input_for(info: ParameterInfo) -> Any:
    qt, kind = toolkit(), _kind(info)
    if kind == "bool":
        return qt.QCheckBox()
    if kind == "choice":
        box = qt.QComboBox()
        box.addItems([str(choice.value) for choice in info.kind])  # type: ignore[attr-defined]
        return box
    if kind == "str":
        return qt.QLineEdit()
    spin = qt.QSpinBox() if kind == "int" else qt.QDoubleSpinBox()
    low, high = (info.limits.low, info.limits.high) if info.limits else (-NO_LIMIT, NO_LIMIT)
    if kind == "float":
        spin.setDecimals(_decimals(info.default, high))
        spin.setRange(low, high)
    else:
        spin.setRange(max(int(low), -LARGEST_INT), min(int(high), LARGEST_INT))
    spin.setKeyboardTracking(False)
    spin.setSuffix(f" {info.unit}" if info.unit else "")
    return spin


def _decimals(default: Any, high: float) -> int:
    """As many as the default needs, and enough to set a hundredth of small quantities."""
    shown = f"{default:.3f}".rstrip("0") if isinstance(default, float) else ""
    return max(len(shown.partition(".")[2]), 2 if high <= 100 else 1)
