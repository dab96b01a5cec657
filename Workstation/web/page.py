"""The page: title bar, the procedure's steps, the open step's panel, Slicer's views."""

from __future__ import annotations

from typing import Any

from CranioNavLib.panel import Step
from trame.ui.html import DivLayout
from trame.ui.vuetify3 import VAppLayout
from trame.widgets import client, html
from trame.widgets import vuetify3 as v3

from Workstation.web import words
from Workstation.web.drawings_view import STYLE as DRAWINGS_STYLE
from Workstation.web.drawings_view import draw_live
from Workstation.web.keyboard import draw_help
from Workstation.web.panel_view import PanelView, pressed
from Workstation.web.procedure import DEVICES, HAND, SESSION, ProcedureStep
from Workstation.web.session_files_view import draw_files
from Workstation.web.session_link import draw_link
from Workstation.web.session_resume_view import draw_resuming
from Workstation.web.sounds_view import draw_sounds
from Workstation.web.toolbar import draw_toolbar
from Workstation.web.view_frame import STYLE as FRAME_STYLE

SIGN_OF = "({ 'to do': '○', 'done': '✓', 'needs attention': '!' })"
COLOR_OF = "({ 'to do': undefined, 'done': '#2fbf8f', 'needs attention': '#f0b429' })"
STYLE = """
html { overflow: hidden; }
.views { display: flex; width: 100%; height: 100%; }
.views div { min-width: 0; min-height: 0; }
.v-application { font-size: 16px; }
.v-btn { text-transform: none; letter-spacing: 0; font-size: 16px; }
.v-btn--disabled.v-btn--variant-flat { background: #37474f !important; color: #b0bec5 !important; opacity: 1 !important; }
.v-btn--disabled .v-btn__overlay { opacity: 0 !important; }
.step-sign { width: 26px; height: 26px; border-radius: 50%; border: 2px solid currentColor;
  text-align: center; line-height: 22px; font-weight: 700; }
.in-sight { position: sticky; top: 0; z-index: 2; padding-top: 10px; background: rgb(var(--v-theme-surface)); }
.buttons { display: flex; flex-wrap: wrap; gap: 8px; margin: 8px 0; }
.buttons > div { flex: 1 1 40%; min-width: 0; }
.buttons > .wide { flex-basis: 100%; }
.buttons .v-btn { height: auto; min-height: 38px; padding: 6px 8px; }
.buttons .v-btn__content { white-space: normal; line-height: 1.15; }
.headline .v-btn { height: auto; min-height: 36px; max-width: 100%; padding: 6px 12px; }
.headline .v-btn--size-small { min-height: 28px; padding: 3px 12px; }
.headline .v-btn__content { white-space: normal; line-height: 1.15; }
.headline .v-alert { border-radius: 4px; }
.v-messages__message { line-height: 1.3; }
.said { overflow-wrap: anywhere; max-height: 7.5em; overflow-y: auto; }
*:focus-visible { outline: 3px solid #ffd54f !important; outline-offset: 2px; }
.v-list-item:focus-visible, .v-btn-group .v-btn:focus-visible, .remote-controlled-area:focus-visible,
.v-expansion-panel-title:focus-visible, .v-card-text:focus-visible { outline-offset: -3px; }
.v-field:has(:focus-visible), .v-selection-control__input:has(:focus-visible) {
  outline: 3px solid #ffd54f; outline-offset: 4px; }
.v-field :focus-visible, .v-selection-control__input :focus-visible, [tabindex="-1"]:focus-visible,
.v-overlay__content:focus-visible { outline: none !important; }
.disclaimer { flex: 1 1 0; min-width: 110px; margin: 0 12px; text-align: right; font-size: 13px; line-height: 1.2; }
.v-toolbar__content > :not(.disclaimer) { flex-shrink: 0; }
.v-toolbar__content { overflow-x: auto; overflow-y: hidden; }
@media (max-width: 1000px) { .title { display: none; } }
.part .v-input--density-compact { margin-top: 14px !important; }
.unsaved { position: fixed; top: 48px; right: 0; left: 580px; z-index: 890; padding: 8px 16px; text-align: center;
  background: #4a1a10; color: #ffb4a2; border-bottom: 2px solid #ff7b5c; }
.part { border-top: 1px solid rgba(255, 255, 255, 0.12); padding-top: 12px; margin-top: 12px; }
"""


class Page:
    """Builds the page once; everything that changes later is in the shared state.

    The list of steps and each step are templates of their own: the browser makes only what is open, and draws anew only that.
    """

    def __init__(self, server: Any, panels: dict[str, PanelView], layouts: Any, procedure: tuple[ProcedureStep, ...]) -> None:
        self.server, self.panels = server, panels
        server.state.step = procedure[0].name
        server.state.speaks = ""  # the panel whose message is shown
        server.state.typed = ""  # the part in whose field something is being typed that has not been sent yet
        server.state.trame__title = words.TITLE
        self._draw_steps(procedure)
        for number in range(1, len(procedure) + 1):
            self._draw_step(number, procedure)
        with VAppLayout(server) as self.layout:
            self.layout.root.theme = "dark"
            client.Style(STYLE + DRAWINGS_STYLE + FRAME_STYLE)
            self._draw_title(procedure)
            for width, name in ((230, "'steps'"), (350, "'step_' + step")):
                with v3.VNavigationDrawer(permanent=True, width=width), html.Div():
                    client.ServerTemplate(name=(name,))
            with v3.VMain(style="height: 100vh;"), html.Div(classes="views"):
                layouts.initialize_layout_grid(self.layout)
            with html.Div(v_if="unsaved", classes="unsaved", raw_attrs=["data-unsaved", 'role="alert"']):
                html.Div(f"✗ {words.UNSAVED} {{{{ unsaved }}}}", classes="text-body-1")
            draw_resuming(self.panels[SESSION].key)
            draw_link()

    def _draw_title(self, procedure: tuple[ProcedureStep, ...]) -> None:
        with v3.VAppBar(density="compact", flat=True, border=True):
            v3.VAppBarTitle(words.TITLE, style="flex: none", classes="title")
            v3.VChip(words.SIMULATED, v_if="simulated", color="warning", variant="flat", size="small", classes="ml-3 flex-0-0")
            html.Div(words.DISCLAIMER, classes="disclaimer text-medium-emphasis")
            draw_toolbar()
            draw_sounds()
            draw_help(procedure, self.panels)

    def _draw_steps(self, procedure: tuple[ProcedureStep, ...]) -> None:
        with DivLayout(self.server, "steps"), v3.VList(nav=True, density="comfortable"):
            for number, step in enumerate(procedure, start=1):
                state = self._state_of(step)
                with (
                    v3.VListItem(
                        title=f"{number}  {step.title}",
                        active=(f"step === '{step.name}'",),
                        click=f"step = '{step.name}'",
                        color="primary",
                        raw_attrs=[f'data-step="{step.name}"'],
                    ),
                    v3.Template(v_slot_prepend=True),
                ):
                    html.Div(
                        f"{{{{ {SIGN_OF}[{state}] }}}}",
                        classes="step-sign mr-3",
                        style=(f"{{ color: {COLOR_OF}[{state}] }}",),
                        title=(state,),
                    )

    def _draw_step(self, number: int, procedure: tuple[ProcedureStep, ...]) -> None:
        step, after = procedure[number - 1], procedure[number] if number < len(procedure) else None
        with (
            DivLayout(self.server, f"step_{step.name}"),
            html.Div(classes="pa-4", raw_attrs=[f'data-panel="{step.name}"', 'tabindex="-1"']),
        ):
            html.Div(f"{number}  {step.title}", classes="text-h6")
            with html.Div(classes="in-sight headline"):
                self._draw_what_next(step, procedure[: number - 1], after)
                draw_live(step.name)
            for module, name in step.parts:
                view = self.panels[module]
                shown = f"{view.key}.status['{name}'].state !== 'done'" if name == "resume" else "true"
                only_simulated = module == HAND and name != "patient"
                with html.Div(classes="part", v_show="simulated" if only_simulated else shown):
                    view.draw(self._part(module, name))
            if step.name == "report":
                self._draw_files()

    def _draw_what_next(self, step: ProcedureStep, before: tuple[ProcedureStep, ...], after: ProcedureStep | None) -> None:
        """What to do now with the one button for it, what was said of it, and the way on, which is never locked."""
        done, busy = f"{self._state_of(step)} === 'done'", self._busy(step)
        with v3.VAlert(
            variant="tonal",
            density="compact",
            classes="mb-3",
            color=(f"{{ done: 'success', 'needs attention': 'warning' }}[{self._state_of(step)}] || 'info'",),
            raw_attrs=[f'data-next="{step.name}"'],
        ):
            texts = f"[{', '.join(self._statuses(step))}].map(one => one.text).filter(Boolean)[0]"
            now = f"'{words.NOW}' + ({self._waiting(step)}.text || '{words.SEE_BELOW}')"
            html.Div(f"{{{{ {done} ? '{words.DONE} ' + ({texts} || '') : {now} }}}}", v_if=f"!({busy})", classes="text-body-1")
            self._draw_offer(step, done, busy)
            if step.name == "ct":
                draw_files(f"!({done} || {busy})", f"!{self._offer(step)}")
            for module in dict.fromkeys(module for module, _ in step.parts):
                parts = [self._part(module, name) for one, name in step.parts if one == module]
                self.panels[module].draw_said(parts)
            self._draw_ways(step, before, after, done)

    def _draw_offer(self, step: ProcedureStep, done: str, busy: str) -> None:
        """The button to press now; where all is done what the simulated hand may still show."""
        v3.VBtn(
            "{{ one.label }}",
            v_for=f"one in !({busy}) && {self._offer(step)} ? [{self._offer(step)}] : []",
            key="one.name",
            block=True,
            classes="my-2",
            color="primary",
            variant=(f"{done} ? 'tonal' : 'flat'",),
            click="typed = ''; trigger(one.panel + '_run', [one.name])",
            raw_attrs=[':data-offer="one.name"'],
        )

    def _draw_ways(self, step: ProcedureStep, before: tuple[ProcedureStep, ...], after: ProcedureStep | None, done: str) -> None:
        """Back to the first step that is not done where this one waits for it; and on. What is under way waits for none but the
        devices, which may have been lost."""
        earlier = ", ".join(
            f"{{ name: '{one.name}', title: '{number} {one.title}', state: {self._state_of(one)} }}"
            for number, one in enumerate(before, start=1)
        )
        under_way = f"{self._state_of(step)} === 'needs attention'"
        missing = f"[{earlier}].filter(one => one.state !== 'done' && (!({under_way}) || one.name === '{DEVICES}'))"
        waits = f"(({done}) || {self._offer(step)} ? [] : {missing}.slice(0, 1))"
        v3.VBtn(
            f"{words.FIRST} {{{{ one.title }}}}",
            v_for=f"one in {waits}",
            key="one.name",
            classes="mt-2 mr-2",
            size="small",
            color="primary",
            variant="flat",
            click="step = one.name",
            raw_attrs=['data-go="first"'],
        )
        if after is not None:
            v3.VBtn(
                words.NEXT_STEP.format(title=after.title),
                classes="mt-2",
                size=(f"{done} ? 'default' : 'small'",),
                block=(done,),
                color=(f"{done} ? 'primary' : undefined",),
                variant=(f"{done} ? 'flat' : 'text'",),
                click=f"step = '{after.name}'",
                raw_attrs=['data-go="next"'],
            )

    def _draw_files(self) -> None:
        v3.VBtn(
            f"{words.OPEN_FILE} {{{{ one }}}}",
            v_for="one in files",
            key="one",
            block=True,
            variant="tonal",
            classes="my-2",
            href=("'session/' + one",),
            target="_blank",
            raw_attrs=[':data-file="one"'],
        )

    def _part(self, module: str, name: str) -> Step:
        return next(part for part in self.panels[module].model.panel.steps if part.name == name)

    def _busy(self, step: ProcedureStep) -> str:
        """A JavaScript expression: whether something runs that this step has begun; the page goes on in another one."""
        begun = []
        for module in dict.fromkeys(module for module, _ in step.parts):
            key = self.panels[module].key
            names = [item for one, name in step.parts if one == module for item in pressed(self._part(module, name))]
            begun.append(f"({key}.busy && {names!r}.includes({key}.last))")
        return " || ".join(begun)

    def _statuses(self, step: ProcedureStep, hand: bool = False) -> list[str]:
        """JavaScript of the status of each part that has one; the simulated hand's do not make a step done."""
        return [
            f"{self.panels[module].key}.status['{name}']"
            for module, name in step.parts
            if self._part(module, name).status and (hand or module != HAND)
        ]

    def _state_of(self, step: ProcedureStep) -> str:
        """A JavaScript expression: the state of the step's first part that is not done, else done."""
        return f"([{', '.join(self._statuses(step))}].map(one => one.state).find(one => one !== 'done') || 'done')"

    def _open(self, step: ProcedureStep) -> str:
        """A JavaScript expression: the parts that offer a button. Nothing is asked for beyond one that needs attention, but
        of the simulated hand."""
        parts = ", ".join(
            f"{{ panel: '{self.panels[module].key}', hand: {str(module == HAND).lower()}, "
            f"...{self.panels[module].key}.status['{name}'] }}"
            for module, name in step.parts
            if self._part(module, name).status
        )
        calm = "!all.slice(0, at).some(two => two.state === 'needs attention')"
        return f"[{parts}].filter((one, at, all) => one.state !== 'done' && one.offer && (one.hand || {calm}))"

    def _waiting(self, step: ProcedureStep) -> str:
        """A JavaScript expression: the status of the part that offers the button, else of the first that is not done."""
        waiting = f"[{', '.join(self._statuses(step, hand=True))}].filter(one => one.state !== 'done')"
        return f"({self._open(step)}[0] || {waiting}[0] || {{ text: '' }})"

    def _offer(self, step: ProcedureStep) -> str:
        """A JavaScript expression: panel, name and label of the button to press now; undefined if there is none."""
        return f"{self._open(step)}.map(one => ({{ panel: one.panel, ...one.offer }}))[0]"
