"""Draws a panel's steps with Vuetify. Holds no behaviour: it shows a panel's state and passes on what the user does."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from typing import Any

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
)
from CranioNavLib.panel_model import PanelModel
from trame.widgets import html
from trame.widgets import vuetify3 as v3

from Workstation.web import words
from Workstation.web.panel_state import choices_of, panel_state, parse, translated

Translation = Callable[[str], str]
OF_THE_SESSION = ("recording_path", "output_folder", "calibration_folder")  # the session fills these in

OF_PATHS = ("path", "file", "folder")  # how a plugin's setting that holds one is called

# Okabe and Ito's colours, which the colour-blind tell apart; a sign stands beside each.
COLORS = "({ good: '#2fbf8f', warning: '#f0b429', bad: '#ff7b5c', plain: undefined })"
SIGNS = "({ good: '✓ ', warning: '! ', bad: '✗ ', plain: '' })"


class PanelView:
    """One panel in the page; `key` names its state variable and its events."""

    def __init__(
        self,
        server: Any,
        model: PanelModel,
        key: str,
        shown: Translation = str,
        meant: Translation = str,
        typed: Translation = str,
        before: Callable[[], object] = bool,
    ) -> None:
        self.server, self.model, self.key = server, model, key
        self._shown, self._meant = shown, meant  # texts on their way to the page and back
        self._typed = typed  # and those of fields that hold a path
        self._before = before  # called before an action: what the devices have to say by now
        self._last = ""  # action whose message stands
        self._said = ("", "")  # the message that stands, and the state of its step when it was said
        self._part = ""  # the step that is being drawn
        self.refresh()
        model.listen(self.refresh)
        server.controller.trigger(f"{key}_change")(self._change)
        server.controller.trigger(f"{key}_setting")(self._change_setting)
        server.controller.trigger(f"{key}_pick")(self._pick)
        server.controller.trigger(f"{key}_run")(self.run)
        server.controller.trigger(f"{key}_cancel")(self.model.cancel)

    def refresh(self) -> None:
        """Put the panel's present state into the page's."""
        state = translated(panel_state(self.model), self._shown)
        state["last"] = self._last
        if self._is_over(state):
            state["message"] = {"text": "", "level": Level.PLAIN.value}
        if self.server.state[self.key] != state:
            with self.server.state as shared:
                shared[self.key] = state

    def _is_over(self, state: dict[str, Any]) -> bool:
        """Whether the message tells of what was to be done ("pivot for 10 s") and it has been done since."""
        owner = next((step for step in self.model.panel.steps if self._last in pressed(step)), None)
        now = state["status"][owner.name]["state"] if owner is not None else ""
        if self._said[0] != state["message"]["text"]:
            self._said = (state["message"]["text"], now)
        good = state["message"]["level"] == Level.GOOD.value
        return good and now == StepState.DONE.value and self._said[1] not in ("", now)

    def draw(self, step: Step) -> None:
        """The widgets of one step, in the current trame context. `draw_said` shows what is running and was said."""
        self._part = step.name
        if step.help:
            html.Div(step.help, classes="text-body-2 text-medium-emphasis mb-3")
        shown = [item for item in step.items if not _is_setting(item)]
        for are_buttons, items in groupby(shown, lambda item: isinstance(item, Action)):
            with html.Div(classes="buttons" if are_buttons else ""):
                for item in items:
                    self._draw_item(item)
        settings = [item for item in step.items if _is_setting(item)]
        if settings:
            with (
                v3.VExpansionPanels(variant="accordion", classes="my-2"),
                v3.VExpansionPanel(title=words.DETAILS, raw_attrs=[f'data-details="{step.name}"']),
                v3.VExpansionPanelText(),
            ):
                for item in settings:
                    self._draw_item(item)

    def _draw_item(self, item: Item) -> None:
        if isinstance(item, Action):
            self._draw_action(item)
        elif isinstance(item, ReadOut):
            self._draw_reading(item)
        elif isinstance(item, NodeField):
            with html.Div(classes="d-flex text-body-2 py-1"):
                html.Span(item.label, classes="text-medium-emphasis flex-grow-1")
                html.Span(f"{{{{ {self.key}.nodes['{item.role}'] }}}}")
        elif isinstance(item, PluginField):
            self._draw_plugin(item)
        elif isinstance(item, ListField):
            self._draw_list(item)
        elif isinstance(item, Picture) and not item.on_page:
            return
        elif isinstance(item, Picture):
            html.Div(
                v_html=f"{self.key}.pictures['{item.name}']",
                v_if=f"{self.key}.pictures['{item.name}']",
                classes="my-2 text-center",
                raw_attrs=[f'data-picture="{item.name}"', 'role="img"', f'aria-label="{item.label}"'],
            )
        else:
            self._draw_parameter(item)

    def _draw_action(self, item: Action) -> None:
        key = f'data-shortcut="{item.shortcut}"' if item.shortcut else ""
        meant = f"{item.help} ({item.shortcut})" if item.shortcut else item.help
        with html.Div(
            classes="wide" if item.primary else "",
            title=(f"{self.key}.blocked['{item.name}'] || '{_quoted(meant)}'",),
            v_show=f"!{self.key}.blocked['{item.name}']" if item.rare else "true",
        ):
            v3.VBtn(
                item.label,
                block=True,
                color="primary" if item.primary else None,
                variant="tonal",  # the one bright button is the one to press now, which the page draws
                disabled=(f"!!{self.key}.blocked['{item.name}'] && typed !== '{self.key}.{self._part}'",),
                click=f"typed = ''; trigger('{self.key}_run', ['{item.name}'])",
                raw_attrs=[f'data-action="{item.name}"', *filter(None, [key])],
            )
            if item.primary:  # of the others the title says it: a screen full of reasons hides what matters
                html.Div(
                    f"{{{{ {self.key}.blocked['{item.name}'] }}}}",
                    v_if=f"{self.key}.blocked['{item.name}'] && !{self.key}.busy && typed !== '{self.key}.{self._part}'",
                    classes="text-caption text-medium-emphasis mt-1",
                )

    def _draw_reading(self, item: ReadOut) -> None:
        reading = f"{self.key}.readings['{item.name}']"
        unit = f"(/^[-–]?[0-9]/.test({reading}.text) ? '{item.spaced_unit}' : '')"  # words have no unit
        with html.Div(classes="py-1", v_show=f"{reading}.text !== '–'"):
            html.Div(item.label, classes="text-caption text-medium-emphasis")
            html.Div(
                f"{{{{ {SIGNS}[{reading}.level] + {reading}.text + {unit} }}}}",
                classes=(f"{reading}.text.length > 22 ? 'text-h6' : 'text-h4'",) if item.large else "text-body-1",
                style=(f"{{ color: {COLORS}[{reading}.level], lineHeight: 1.2 }}",),
                raw_attrs=[f'data-reading="{item.name}"'],
            )

    def _draw_parameter(self, item: ParameterField | FileField) -> None:
        info = self.model.describe(item)
        common = {
            "label": label_of(self.model.panel, item),
            "model_value": (f"{self.key}.fields['{item.name}']",),
            "hint": info.help,
            "persistent_hint": True,  # one that goes with the focus moves the button away from under a click
            "error_messages": (f"{self.key}.errors['{item.name}']",),
            "density": "compact",
            "variant": "outlined",
            "hide_details": "auto",
            "classes": "my-2",
            "raw_attrs": [f'data-field="{item.name}"'],
        }
        changed = f"trigger('{self.key}_change', ['{item.name}', $event])"
        if info.kind is bool:
            v3.VSwitch(update_modelValue=changed, color="primary", **common)
        elif choices_of(info):
            v3.VSelect(items=(repr(choices_of(info)),), update_modelValue=changed, **common)
        else:
            entered = f"trigger('{self.key}_change', ['{item.name}', $event.target.value])"
            # a button that waits for what is being typed can be pressed at once: leaving the field sends it before the click
            kind = "number" if info.kind in (int, float) else "text"
            v3.VTextField(suffix=info.unit, change=entered, input=f"typed = '{self.key}.{self._part}'", type=kind, **common)

    def _draw_list(self, item: ListField) -> None:
        html.Div(item.label, classes="text-caption text-medium-emphasis", title=item.help)
        with (
            v3.VList(density="compact", classes="py-0 my-1", raw_attrs=[f'data-list="{item.name}"']),
            v3.VListItem(
                v_for=f"one in {self.key}.lists['{item.name}']",
                key="one.name",
                active=(f"one.name === {self.key}.fields['{item.name}']",),
                color="primary",
                title=("(one.doubtful ? '! ' : one.done ? '✓ ' : '○ ') + one.name",),
                min_height=34,
                subtitle=("one.note || undefined",),
                click=f"trigger('{self.key}_pick', ['{item.name}', one.name])",
                raw_attrs=[':data-entry="one.name"'],
            ),
        ):
            pass

    def _draw_plugin(self, item: PluginField) -> None:
        v3.VSelect(
            label=item.label,
            model_value=(f"{self.key}.fields['{item.name}']",),
            items=(repr(self.model.choices(item)),),
            update_modelValue=f"trigger('{self.key}_change', ['{item.name}', $event])",
            error_messages=(f"{self.key}.errors['{item.name}']",),
            density="compact",
            variant="outlined",
            hide_details="auto",
            classes="my-2",
            raw_attrs=[f'data-field="{item.name}"'],
        )
        changed = f"trigger('{self.key}_setting', ['{item.name}', one.name, $event])"
        entered = f"trigger('{self.key}_setting', ['{item.name}', one.name, $event.target.value])"
        with (
            v3.VExpansionPanels(v_if=f"{self.key}.settings['{item.name}'].length", variant="accordion", classes="my-2"),
            v3.VExpansionPanel(title=words.SETTINGS),
            v3.VExpansionPanelText(),
            html.Div(v_for=f"one in {self.key}.settings['{item.name}']", key="one.key", classes="my-2"),
        ):
            shared = {
                "label": ("one.name.replaceAll('_', ' ')",),
                "model_value": ("one.value",),
                "hint": ("one.help",),
                "persistent_hint": True,
                "error_messages": (f"{self.key}.errors[one.key]",),
                "density": "compact",
                "variant": "outlined",
                "hide_details": "auto",
            }
            v3.VSwitch(v_if="one.switch", update_modelValue=changed, color="primary", **shared)
            v3.VSelect(v_else_if="one.choices", items=("one.choices",), update_modelValue=changed, **shared)
            v3.VTextField(v_else=True, change=entered, suffix=("one.unit",), **shared)

    def draw_said(self, steps: list[Step]) -> None:
        """What is running and what was last said, of an action of these steps."""
        mine = f"{[name for step in steps for name in pressed(step)]!r}.includes({self.key}.last)"
        with html.Div(v_if=f"{self.key}.busy && {mine}", classes="mt-2"):
            html.Div(f"{{{{ {self.key}.busy.text || {self.key}.busy.label }}}} …", classes="text-body-2")
            v3.VProgressLinear(
                model_value=(f"100 * {self.key}.busy.share",), indeterminate=(f"!{self.key}.busy.share",), height=6
            )
            v3.VBtn(words.CANCEL, size="small", variant="text", click=f"trigger('{self.key}_cancel')")
        html.Div(
            f"{{{{ {SIGNS}[{self.key}.message.level] + {self.key}.message.text }}}}",
            v_if=f"{self.key}.message.text && speaks === '{self.key}' && {mine}",
            style=(f"{{ color: {COLORS}[{self.key}.message.level] }}",),
            classes="text-body-2 mt-2 said",
            raw_attrs=[f'data-message="{self.key}"'],
        )

    def _change(self, name: str, value: Any) -> None:
        field = self._field(name)
        if isinstance(value, str):
            value = self._typed(value) if isinstance(field, FileField) else self._meant(value)
        self.model.change(field, parse(self.model.describe(field), value))
        self._is_typed()

    def _change_setting(self, name: str, setting: str, value: Any) -> None:
        field = self._field(name)
        door = self.model.settings(field)
        if door is not None:
            info = next(one for one in door.kind.describe() if one.name == setting)
            value = self._typed(value) if isinstance(value, str) and setting.endswith(OF_PATHS) else value
            self.model.change_setting(field, setting, parse(info, value))
        self._is_typed()

    def _is_typed(self) -> None:
        """What was being typed has come: from now on the buttons of its part can be pressed as it allows."""
        with self.server.state as shared:
            shared.typed = ""

    def _pick(self, name: str, entry: str) -> None:
        self._speaks(name)
        field = next(item for item in self.model.panel.items() if isinstance(item, ListField) and item.name == name)
        self.model.pick(field, entry)

    def run(self, name: str) -> None:
        """Do what a button says, as if it had been pressed."""
        self._speaks(name)
        self._before()
        self.model.run(next(action for action in self.model.panel.actions() if action.name == name))

    def _speaks(self, name: str) -> None:
        """What this panel will say of it takes the place of what another has said."""
        self._last, self._said = name, ("", "")
        with self.server.state as shared:
            shared.speaks = self.key

    def _field(self, name: str) -> Any:
        fields = (item for item in self.model.panel.items() if isinstance(item, (ParameterField, FileField, PluginField)))
        return next(item for item in fields if item.name == name)


def pressed(step: Step) -> list[str]:
    """What can be pressed or picked in a step."""
    return [item.name for item in step.items if isinstance(item, (Action, ListField))]


def _is_setting(item: Item) -> bool:
    """What has a good value already, and so is shown only on request. Switches of a view are no settings."""
    if isinstance(item, ParameterField):
        return item.name not in ("follow", "zoom", "ring")
    if isinstance(item, PluginField):
        return item.kind in ("segmentation", "registration")
    return isinstance(item, NodeField) or (isinstance(item, FileField) and item.name in OF_THE_SESSION)


def _quoted(text: str) -> str:
    return text.replace("\\", "\\\\").replace("'", "\\'")
