"""While a session is brought back the page says so, until it can be shown whole."""

from __future__ import annotations

from types import SimpleNamespace

from Workstation.web.session_resume_view import AT_MOST_S, Resuming


def a_panel(action: str | None, text: str = "", share: float = 0.0) -> SimpleNamespace:
    busy = SimpleNamespace(name=action) if action is not None else None
    return SimpleNamespace(busy=busy, progress=SimpleNamespace(text=text, share=share))


def test_it_is_said_how_far_it_is_until_everything_is_drawn():
    state = SimpleNamespace()
    resuming = Resuming(state)
    assert state.resuming is None
    assert not resuming.refresh(a_panel("resumeSession", "reading the CT", 0.1), True, 0.0)
    assert state.resuming == {"text": "reading the CT", "share": 0.1}
    resuming.refresh(a_panel("resumeSession", "finding the bone", 0.3), True, 2.0)
    assert resuming.refresh(a_panel(None), True, 3.0)  # now the panels have to be looked at
    assert state.resuming == {"text": "finding the bone", "share": 0.3}  # they have not been shown yet
    assert not resuming.refresh(a_panel(None), False, 3.2)
    assert state.resuming is not None
    resuming.refresh(a_panel(None), True, 3.4)
    assert state.resuming is None


def test_views_that_are_never_drawn_do_not_keep_the_page_covered():
    state = SimpleNamespace()
    resuming = Resuming(state)
    resuming.refresh(a_panel("resumeSession"), True, 0.0)
    resuming.refresh(a_panel(None), False, 0.2)
    resuming.refresh(a_panel(None), False, AT_MOST_S + 0.1)
    assert state.resuming is None


def test_other_work_covers_nothing():
    state = SimpleNamespace()
    Resuming(state).refresh(a_panel("writeReport", "drawing", 0.5), True, 0.0)
    assert state.resuming is None
