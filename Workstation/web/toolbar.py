"""The title bar's buttons for the views and the sound; each has a key, which the list behind "?" names."""

from __future__ import annotations

from trame.widgets import html
from trame.widgets import vuetify3 as v3

from Workstation.web import words
from Workstation.web.error_views import MAP, NONE, RESIDUALS
from Workstation.web.view_controls import LAYOUTS, WINDOWS

# (key, what it does) of what the keys of the page do in every step
KEYS = (
    (words.BRIGHT_KEY, words.BRIGHT),
    ("N", words.STEP_ON),
    ("B", words.STEP_BACK),
    (words.TAB_KEYS, words.TAB),
    *((choice.key, words.LAYOUTS[name]) for name, choice in LAYOUTS.items()),
    ("W", words.NEXT_WINDOW.format(titles=", ".join(words.WINDOWS.values()).lower())),
    ("D", words.DRAG_WINDOW),
    ("R", words.RESET),
    ("E", words.ERROR_COLORS),
    ("M", words.SOUNDS),
    (words.MOVE_KEYS, words.MOVE),
    (words.TURN_KEYS, words.TURN),
    (words.SIZE_KEYS, words.SIZE),
    ("?", words.SHOW_KEYS),
)


def draw_toolbar() -> None:
    """The buttons, in the current trame context."""
    with v3.VBtnToggle(
        model_value=("layout",),
        update_modelValue="$event && trigger('view_layout', [$event])",
        density="compact",
        variant="text",
        classes="mr-3",
        raw_attrs=["data-layouts"],
    ):
        for name, choice in LAYOUTS.items():
            v3.VBtn(
                icon=choice.icon,
                value=name,
                title=f"{words.LAYOUTS[name]} ({choice.key})",
                width=34,
                raw_attrs=[f'data-key="{choice.key}"'],
            )
    with v3.VBtnToggle(  # a press on the lit one brings its window back after a drag
        model_value=("window",),
        density="compact",
        variant="text",
        classes="mr-1",
        raw_attrs=["data-windows"],
    ):
        for name in WINDOWS:
            title = words.WINDOWS[name]
            v3.VBtn(
                title,
                value=name,
                title=words.WINDOW_HINT.format(title=title.lower()),
                size="small",
                click=f"trigger('view_window', ['{name}'])",
            )
    html.Button(style="display: none", click="trigger('view_window', [''])", raw_attrs=['data-key="W"'])
    _switch("drag_window", "mdi-contrast-circle", f"{words.DRAG_WINDOW} (D)", "D", "view_drag")
    v3.VBtn(
        icon="mdi-fit-to-screen-outline",
        size="small",
        title=f"{words.RESET} (R)",
        click="trigger('view_reset')",
        raw_attrs=['data-key="R"'],
    )
    v3.VBtn(
        icon=(f"({{ {MAP}: 'mdi-gradient-horizontal', {RESIDUALS}: 'mdi-dots-hexagon', {NONE}: 'mdi-palette' }})[error_shown]",),
        size="small",
        title=f"{words.ERROR_COLORS} (E)",
        color=(f"error_shown === '{NONE}' ? undefined : 'primary'",),
        click=f"error_shown = {{ {MAP}: '{RESIDUALS}', {RESIDUALS}: '{NONE}', {NONE}: '{MAP}' }}[error_shown]",
        raw_attrs=['data-key="E"', ':data-error="error_shown"'],
    )
    v3.VBtn(
        icon=("muted ? 'mdi-volume-off' : 'mdi-volume-high'",),
        size="small",
        title=f"{words.SOUNDS} (M)",
        click="muted = !muted",
        color=("muted ? 'warning' : undefined",),
        raw_attrs=['data-key="M"', "data-mute"],
    )


def _switch(name: str, icon: str, title: str, key: str, trigger: str = "") -> None:
    v3.VBtn(
        icon=icon,
        size="small",
        title=title,
        color=(f"{name} ? 'primary' : undefined",),
        variant=(f"{name} ? 'tonal' : 'text'",),
        click=f"trigger('{trigger}', [!{name}])" if trigger else f"{name} = !{name}",
        raw_attrs=[f'data-key="{key}"', f'data-switch="{name}"'],
    )
