"""Draws a panel with Qt: inside 3D Slicer as a module's widget, outside with PySide6. Holds no behaviour of its own."""

from __future__ import annotations

from typing import Any

from CranioNavLib import host, scene
from CranioNavLib.errors import InputError
from CranioNavLib.panel import (
    Action,
    FileField,
    Item,
    Level,
    ListField,
    NodeField,
    ParameterField,
    Picture,
    PluginField,
    ReadOut,
    Step,
    StepState,
    label_of,
    words_of,
)
from CranioNavLib.panel_model import PanelModel
from CranioNavLib.panel_qt_widgets import Chooser, Drawing, Editor, NodeChooser, Section, ThreadRunner, connect, toolkit
from CranioNavLib.parameters import ParameterInfo
from CranioNavLib.sounds import SoundParameters, sound_parameters, sounds_are_on

REFRESH_MS = 200  # live read-outs; poses are drawn by the views, not here
STATE_SIGNS = {StepState.TODO: "○", StepState.DONE: "✓", StepState.ATTENTION: "!"}
LEVEL_SIGNS = {Level.PLAIN: "", Level.GOOD: "✓ ", Level.WARNING: "! ", Level.BAD: "✗ "}
# Dark enough on light and light enough on dark backgrounds (contrast above 3:1 on both).
LEVEL_COLORS = {Level.PLAIN: "", Level.GOOD: "#1b8a5a", Level.WARNING: "#b26a00", Level.BAD: "#d1495b"}
LARGE = "font-size: 28pt; font-weight: 600;"


class PanelWidget:
    """A panel in a Qt layout.

    Parameters
    ----------
    model : PanelModel
        Gets a runner that keeps the window alive, unless it has one.
    layout : QVBoxLayout
        Where the sections are put; its widget becomes their parent.
    """

    def __init__(self, model: PanelModel, layout: Any) -> None:
        self.model, self.qt = model, toolkit()
        self._layout = layout
        self.sections: dict[str, Section] = {}
        self.buttons: dict[str, Any] = {}
        self.readings: dict[str, Any] = {}
        self.editors: dict[str, Editor] = {}
        self.choosers: dict[str, NodeChooser] = {}
        self.lists: dict[str, Chooser] = {}
        self.pictures: dict[str, Drawing] = {}
        self.errors: dict[str, Any] = {}
        self._settings_boxes: dict[str, tuple[Any, PluginField]] = {}
        self._shown_plugin: dict[str, str] = {}
        for step in model.panel.steps:
            self._add_step(step)
        self._add_footer()
        self._runner = None
        if model.runner is None:
            model.runner = self._runner = ThreadRunner(layout.parentWidget())
        self._timer = self.qt.QTimer(layout.parentWidget())
        self._timer.setInterval(REFRESH_MS)
        connect(self._timer, "timeout()", self.tick)
        model.listen(self.refresh)
        self.refresh()

    def start(self) -> None:
        """Keep the read-outs alive; call it when the panel is shown."""
        self._timer.start()

    def stop(self) -> None:
        """No more live updates; call it when the panel is left."""
        self._timer.stop()

    def close(self) -> None:
        """Let go of the model and the thread."""
        self.stop()
        self.model.forget(self.refresh)
        if self._runner is not None:
            self._runner.close()
            self.model.runner = None

    def refresh(self) -> None:
        """Show everything as it is now."""
        for step in self.model.panel.steps:
            status = self.model.status(step)
            section = self.sections[step.name]
            section.set_title(f"{STATE_SIGNS[status.state]}  {step.title}" if step.status else step.title)
            section.widget.setToolTip(status.text or step.help)
        for item in self.model.panel.items():
            self._refresh_item(item)
        for name, label in self.errors.items():
            label.setText(LEVEL_SIGNS[Level.BAD] + self.model.errors[name] if name in self.model.errors else "")
            label.setVisible(name in self.model.errors)
        self.sounds.show(sounds_are_on())
        self.refresh_live()

    def say_of_sounds(self, limits: str) -> None:
        """Say beside the switch what of the sounds cannot be heard; "" if all can."""
        (info,) = SoundParameters.describe()
        self.sounds.input.setToolTip("; ".join(filter(None, [info.help, limits])))

    def tick(self) -> None:
        """What the timer does: everything if the scene has changed, else what lives."""
        if self.model.scene_changed():
            self.refresh()
        else:
            self.refresh_live()

    def refresh_live(self) -> None:
        """Show what changes by itself: read-outs, message, progress, which buttons can be used."""
        for item in self.model.panel.items():
            if isinstance(item, ReadOut):
                reading = self.model.reading(item)
                level = reading.level if reading else Level.PLAIN
                text = f"{LEVEL_SIGNS[level]}{reading.text}{item.spaced_unit}" if reading else "–"
                self.readings[item.name].setText(text)
                self.readings[item.name].setStyleSheet(_style(level, item.large))
            elif isinstance(item, Picture):
                self.pictures[item.name].show(self.model.drawing(item))
            elif isinstance(item, ListField):
                self.lists[item.name].show(self.model.entries(item), self.model.value(item))
            elif isinstance(item, Action):
                reason = self.model.blocked(item)
                self.buttons[item.name].setEnabled(not reason)
                self.buttons[item.name].setVisible(not (item.rare and reason))
                self.buttons[item.name].setToolTip(reason or item.help)
        message, busy = self.model.message, self.model.busy
        self._message.setText(f"{LEVEL_SIGNS[message.level]}{message.text}" if message.text else "")
        self._message.setStyleSheet(_style(message.level, False))
        self._progress_row.setVisible(busy is not None)
        self._progress.setValue(round(100 * self.model.progress.share))
        self._progress.setFormat(f"{self.model.progress.text or (busy.label if busy else '')}  %p%")

    def _add_step(self, step: Step) -> None:
        section = self.sections[step.name] = Section(step.title)
        section.set_collapsed(step is not self.model.panel.steps[0])
        if step.help:
            section.layout.addWidget(self._label(step.help))
        form = self.qt.QFormLayout()
        form.setRowWrapPolicy(self.qt.QFormLayout.WrapLongRows)
        section.layout.addLayout(form)
        for item in step.items:
            self._add_item(item, form)
        self._layout.addWidget(section.widget)

    def _add_item(self, item: Item, form: Any) -> None:
        if isinstance(item, Action):
            button = self.buttons[item.name] = self.qt.QPushButton(item.label)
            button.setObjectName(item.name)
            if item.shortcut:
                button.setShortcut(self.qt.QKeySequence(item.shortcut))
            connect(button, "clicked()", lambda *_: self.model.run(item))
            form.addRow(button)
        elif isinstance(item, ReadOut):
            label = self.readings[item.name] = self._label("–")
            form.addRow(f"{item.label}:", label)
        elif isinstance(item, Picture):
            drawing = self.pictures[item.name] = Drawing(item.label)
            form.addRow(drawing.widget)
        elif isinstance(item, ListField):
            shown = self.lists[item.name] = Chooser(lambda name: self.model.pick(item, name))
            shown.widget.setToolTip(item.help)
            form.addRow(f"{item.label}:", shown.widget)
        elif isinstance(item, NodeField):
            chooser = self.choosers[item.role] = NodeChooser(
                scene.role(item.role).mrml_class, lambda node: self.model.choose(item, node)
            )
            chooser.widget.setToolTip(item.help)
            form.addRow(f"{item.label}:", chooser.widget)
        elif isinstance(item, PluginField):
            self._add_plugin(item, form)
        else:
            self._add_parameter(item, form)

    def _add_parameter(self, item: ParameterField | FileField, form: Any) -> None:
        info = self.model.describe(item)
        editor = self.editors[item.name] = Editor(info, lambda value: self.model.change(item, value))
        editor.widget.setObjectName(item.name)
        widget = editor.widget
        if isinstance(item, FileField):
            widget = self.qt.QWidget()
            row = self.qt.QHBoxLayout(widget)
            row.setContentsMargins(0, 0, 0, 0)
            browse = self.qt.QPushButton("…")
            connect(browse, "clicked()", lambda *_: self._browse(item))
            row.addWidget(editor.widget, 1)
            row.addWidget(browse)
        form.addRow(f"{label_of(self.model.panel, item)}:", widget)
        form.addRow(self._error_label(item.name))

    def _add_plugin(self, item: PluginField, form: Any) -> None:
        combo = self.qt.QComboBox()
        combo.addItems(self.model.choices(item))
        combo.setObjectName(item.name)
        connect(combo, "currentTextChanged(QString)", lambda name: self.model.change(item, str(name)))
        form.addRow(f"{item.label}:", combo)
        form.addRow(self._error_label(item.name))
        box = self.qt.QWidget()
        self.qt.QFormLayout(box)
        form.addRow(box)
        self._settings_boxes[item.name] = (box, item)
        self.choosers[item.name] = combo

    def _refresh_item(self, item: Item) -> None:
        if isinstance(item, NodeField):
            self.choosers[item.role].show(self.model.node(item))
        elif isinstance(item, PluginField):
            self._refresh_plugin(item)
        elif isinstance(item, (ParameterField, FileField)):
            self.editors[item.name].show(self.model.value(item))

    def _refresh_plugin(self, item: PluginField) -> None:
        combo: Any = self.choosers[item.name]
        name = self.model.value(item)
        door = self.model.settings(item)
        if self._shown_plugin.get(item.name) != name:
            self._shown_plugin[item.name] = name
            combo.blockSignals(True)
            combo.setCurrentIndex(self.model.choices(item).index(name) if name in self.model.choices(item) else -1)
            combo.blockSignals(False)
            form = self._settings_boxes[item.name][0].layout()
            while form.rowCount():
                form.removeRow(0)
            for key in [key for key in self.editors if key.startswith(f"{item.name}.")]:
                del self.editors[key], self.errors[key]
            for info in door.kind.describe() if door else ():
                self._add_setting(item, info, form)
        if door is not None:
            values = door.read()
            for info in door.kind.describe():
                self.editors[f"{item.name}.{info.name}"].show(getattr(values, info.name))

    def _add_setting(self, item: PluginField, info: ParameterInfo, form: Any) -> None:
        key = f"{item.name}.{info.name}"
        editor = self.editors[key] = Editor(info, lambda value: self.model.change_setting(item, info.name, value))
        editor.widget.setObjectName(key)
        form.addRow(f"{words_of(info.name)}:", editor.widget)
        form.addRow(self._error_label(key))

    def _add_footer(self) -> None:
        self._message = self._label("")
        self._message.setObjectName("message")
        self._layout.addWidget(self._message)
        self._progress_row = self.qt.QWidget()
        row = self.qt.QHBoxLayout(self._progress_row)
        row.setContentsMargins(0, 0, 0, 0)
        self._progress = self.qt.QProgressBar()
        cancel = self.qt.QPushButton("Cancel")
        connect(cancel, "clicked()", lambda *_: self.model.cancel())
        row.addWidget(self._progress, 1)
        row.addWidget(cancel)
        self._layout.addWidget(self._progress_row)
        (info,) = SoundParameters.describe()
        self.sounds = Editor(info, lambda on: sound_parameters().change(sounds=on))
        self.sounds.input.setProperty("text", "Sounds")
        self.sounds.widget.setObjectName(info.name)
        self._layout.addWidget(self.sounds.widget)
        self._layout.addStretch(1)

    def _browse(self, item: FileField) -> None:
        dialog, filters = self.qt.QFileDialog, ";;".join(item.filters)
        if item.folder:
            found = dialog.getExistingDirectory(self._layout.parentWidget(), item.label)
        else:
            ask = dialog.getSaveFileName if item.save else dialog.getOpenFileName
            found = ask(self._layout.parentWidget(), item.label, str(self.model.value(item)), filters)
        path = found[0] if isinstance(found, tuple) else found  # PySide6 gives the filter too
        if path:
            self.model.change(item, str(path))

    def _label(self, text: str) -> Any:
        label = self.qt.QLabel(text)
        label.setWordWrap(True)
        return label

    def _error_label(self, name: str) -> Any:
        label = self.errors[name] = self._label("")
        label.setStyleSheet(_style(Level.BAD, False))
        label.setVisible(False)
        return label


def _style(level: Level, large: bool) -> str:
    color = f"color: {LEVEL_COLORS[level]};" if LEVEL_COLORS[level] else ""
    return color + (LARGE if large else "")


def show_in(widget: Any, model: PanelModel) -> PanelWidget:
    """The panel in a ScriptedLoadableModuleWidget's own layout, once the user was asked about missing packages.

    Without them the panel is drawn all the same; an action that needs one says so.
    """
    if host.in_application():
        try:
            host.install_missing_packages()
        except InputError as error:
            host.slicer_package().util.errorDisplay(str(error), windowTitle="CranioNav")
    return PanelWidget(model, widget.layout)
