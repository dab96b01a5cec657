"""What a panel shows, as plain data for the page; made anew from the PanelModel whenever something may have changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from enum import Enum
from typing import Any

from CranioNavLib.panel import Action, ListField, NodeField, Picture, PluginField, ReadOut
from CranioNavLib.panel_model import PanelModel
from CranioNavLib.parameters import ParameterInfo


def panel_state(model: PanelModel) -> dict[str, Any]:
    """Values, errors, read-outs, states and messages of a panel, JSON-ready."""
    fields: dict[str, Any] = {}
    readings: dict[str, Any] = {}
    blocked: dict[str, str] = {}
    nodes: dict[str, str] = {}
    settings: dict[str, list[dict[str, Any]]] = {}
    lists: dict[str, list[dict[str, Any]]] = {}
    pictures: dict[str, str] = {}
    for item in model.panel.items():
        if isinstance(item, Action):
            blocked[item.name] = model.blocked(item)
        elif isinstance(item, ReadOut):
            reading = model.reading(item)
            readings[item.name] = {"text": reading.text if reading else "–", "level": reading.level.value if reading else "plain"}
        elif isinstance(item, NodeField):
            node = model.node(item)
            nodes[item.role] = node.GetName() if node is not None else "not there yet"
        elif isinstance(item, Picture):
            pictures[item.name] = (model.drawing(item) or "") if item.on_page else ""
        else:
            if isinstance(item, ListField):
                lists[item.name] = [asdict(one) for one in model.entries(item)]
            fields[item.name] = _plain(model.value(item))
            if isinstance(item, PluginField):
                settings[item.name] = _settings(model, item)
    return {
        "fields": fields,
        "readings": readings,
        "blocked": blocked,
        "nodes": nodes,
        "settings": settings,
        "lists": lists,
        "pictures": pictures,
        "errors": dict(model.errors),
        "status": {step.name: _status(model, step) for step in model.panel.steps},
        "message": {"text": model.message.text, "level": model.message.level.value},
        "busy": None
        if model.busy is None
        else {"label": model.busy.label, "text": model.progress.text, "share": model.progress.share},
    }


def translated(state: Any, shown: Callable[[str], str]) -> Any:
    """The same with every text put as it may be shown."""
    if isinstance(state, dict):
        return {key: translated(value, shown) for key, value in state.items()}
    if isinstance(state, list):
        return [translated(value, shown) for value in state]
    return shown(state) if isinstance(state, str) else state


def choices_of(info: ParameterInfo) -> list[str] | None:
    """The values of a parameter that has only some, else None."""
    return [str(choice.value) for choice in info.kind] if issubclass(info.kind, Enum) else None


def parse(info: ParameterInfo, value: Any) -> Any:
    """What the page sent, as the parameter's own type; what cannot be one is passed on, to be refused in words."""
    if issubclass(info.kind, Enum):
        return info.kind(value)
    if info.optional and info.kind is not str and value == "":
        return None  # an emptied field: not given
    if info.kind in (int, float) and value not in (None, ""):
        try:
            return info.kind(value)
        except (TypeError, ValueError):
            return value
    return value


def _plain(value: Any) -> Any:
    return value.value if isinstance(value, Enum) else value


def _status(model: PanelModel, step: Any) -> dict[str, Any]:
    status, offered = model.status(step), model.offered(step)
    offer = {"name": offered.name, "label": offered.label} if offered is not None else None
    return {"state": status.state.value, "text": status.text, "offer": offer}


def _settings(model: PanelModel, field: PluginField) -> list[dict[str, Any]]:
    door = model.settings(field)
    if door is None:
        return []
    values = door.read()
    return [
        {
            "name": info.name,
            "key": f"{field.name}.{info.name}",
            "value": _plain(getattr(values, info.name)),
            "unit": info.unit,
            "help": info.help,
            "choices": choices_of(info),
            "switch": info.kind is bool,
        }
        for info in door.kind.describe()
    ]
